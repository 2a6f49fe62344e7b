"""Makes the recordings of a simulated campaign: many runs of many units on a few benches, the truth apart from them.

usage: .venv/bin/python tools/fleet_generator.py FOLDER [--runs 2000] [--units 40] [--benches 2]
           [--of-bench EFFECT=SIZE]... [--of-unit EFFECT=SIZE]... [--share 1.0] [--repaired 0.5] [--jobs 2] [--seed 1]

Runs go round the units, and each unit stays on one bench. An effect of the bench has the same coefficients in all runs
of a bench; one of the units has coefficients of each unit's own, in a share of the units. Sizes are those of
``kf-calib simulate --hide``; in sigma they are of one run. With --repaired the effects of the benches are there up to
that part of the campaign only. FOLDER/runs/BENCH/UNIT/ gets the recordings, FOLDER/truth.json what no estimator opens.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from kf_calib.bench.arrays import one_blas_thread
from kf_calib.bench.bench import Bench
from kf_calib.bench.streams import Batch, Stream
from kf_calib.sources.files.recorder import Recorder
from kf_calib.sources.simulation.detectability import sized
from kf_calib.sources.simulation.injected import Hidden, parse
from kf_calib.sources.simulation.sensors import GRADES, generator
from kf_calib.sources.simulation.simulator import Simulation
from kf_calib.sources.simulation.visit_plans import PlannedVisit, spread_plan

_PLANS = 8  # tours that the runs of a bench share: to find one takes as long as to simulate a run
_DAY_NS = 86_400_000_000_000


@dataclass(frozen=True)
class Campaign:
    """What is simulated; of_bench, of_unit: effects as ``simulate --hide`` has them."""

    folder: Path
    runs: int = 2000
    units: int = 40
    benches: int = 2
    of_bench: tuple[str, ...] = ()
    of_unit: tuple[str, ...] = ()
    share: float = 1.0
    repaired: float = 1.0
    dwells: int = 24
    dwell_s: float = 6.0
    sample_hz: float = 10.0
    days: float = 365.0
    seed: int = 1

    def unit_of(self, run: int) -> int:
        return run % self.units

    def bench_of(self, run: int) -> int:
        return self.unit_of(run) * self.benches // self.units

    def place(self, run: int) -> Path:
        unit, bench = self.unit_of(run), self.bench_of(run)
        return self.folder / "runs" / f"bench-{bench + 1}" / f"unit-{unit + 1:04d}" / f"run-{run + 1:06d}.mcap"

    def has(self, unit: int) -> bool:
        """Whether a unit is among the share that has effects of its own."""
        return unit in generator(self.seed, "share").permutation(self.units)[: round(self.share * self.units)]

    def begin_ns(self, run: int) -> int:
        """How long after the first run it begins."""
        return int(run / max(self.runs - 1, 1) * self.days * _DAY_NS)

    def simulation(self, run: int) -> Simulation:
        """The run without any effect."""
        unit, bench = self.unit_of(run), self.bench_of(run)
        grade = GRADES["navigation"]
        notes = {"block_serial": f"unit-{unit + 1:04d}", "bench": f"bench-{bench + 1}"}
        stated = {"axes": "y z x", "gravity_mps2": "9.81", "angle_sigma_deg": "0", "scatter_sigma_mps2": "0"}
        return Simulation(
            Bench.from_metadata(stated | notes), grade.sensors(_seed(self.seed, "unit", unit)), grade.noise,
            _tour(self, bench, run % _PLANS), sample_hz=self.sample_hz, angle_hz=5.0, slew_rate_degps=180.0,
            seed=_seed(self.seed, "run", run), grade="navigation",
        )  # fmt: skip

    def effects(self, run: int) -> dict[str, list[Hidden]]:
        """The effects in a run: those of its bench, and those of its unit."""
        unit, bench = self.unit_of(run), self.bench_of(run)
        there = run < self.repaired * self.runs
        return {
            "of_bench": _sized(self, "bench", bench, self.of_bench) if there else [],
            "of_unit": _sized(self, "unit", unit, self.of_unit) if self.has(unit) else [],
        }


@cache
def _tour(campaign: Campaign, bench: int, number: int) -> list[PlannedVisit]:
    seed = _seed(campaign.seed, "tour", bench * _PLANS + number)
    return spread_plan(campaign.dwells, dwell_s=campaign.dwell_s, seed=seed)


@cache
def _sized(campaign: Campaign, kind: str, number: int, texts: tuple[str, ...]) -> list[Hidden]:
    """The effects of one bench or unit, with signs of its own; sizes in sigma are those in its first run."""
    owner = {"unit": campaign.unit_of, "bench": campaign.bench_of}[kind]
    first = campaign.simulation(next(run for run in range(campaign.runs) if owner(run) == number))
    axes = first.bench.axes
    return parse(texts, axes, seed=_seed(campaign.seed, f"{kind} effects", number), sized=partial(sized, first))


def _seed(seed: int, name: str, number: int) -> int:
    return int(generator(seed, f"{name} {number}").integers(1 << 31))


def record(campaign: Campaign, run: int) -> dict[str, Any]:
    """Record one run; returns its truth."""
    with one_blas_thread():
        hidden, plain = campaign.effects(run), campaign.simulation(run)
        path = campaign.place(run)
        path.parent.mkdir(parents=True, exist_ok=True)
        with Recorder(path, plain.bench, overwrite=True) as recorder:
            for batch in plain.hiding([each for own in hidden.values() for each in own]):
                recorder.write(_later(batch, campaign.begin_ns(run)))
    return {
        "run": str(path.relative_to(campaign.folder)),
        "unit": plain.bench.notes["block_serial"],
        "bench": plain.bench.notes["bench"],
        "parameters": dict(plain.sensors.parameters),
        **{owner: [effect.truth for effect in own] for owner, own in hidden.items()},
    }


def _later(batch: Batch, by_ns: int) -> Batch:
    """The batch as of a run that began later."""
    streams = (batch.accel, batch.pose, batch.temperature)
    return Batch(*(Stream(each.time_ns + np.int64(by_ns), each.values) for each in streams))


def recorded(campaign: Campaign, jobs: int) -> Iterator[dict[str, Any]]:
    """The truths of all runs, as they are recorded; the runs of a unit by one process, which sizes its effects once."""
    groups = [list(range(unit, campaign.runs, campaign.units)) for unit in range(min(campaign.units, campaign.runs))]
    with ProcessPoolExecutor(jobs) as pool:
        for truths in pool.map(partial(_of_group, campaign), groups):
            yield from truths


def _of_group(campaign: Campaign, runs: Sequence[int]) -> list[dict[str, Any]]:
    return [record(campaign, run) for run in runs]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    for name, default in (("runs", 2000), ("units", 40), ("benches", 2), ("dwells", 24), ("seed", 1)):
        parser.add_argument(f"--{name}", type=int, default=default)
    for name, default in (("share", 1.0), ("repaired", 1.0), ("dwell-s", 6.0), ("sample-hz", 10.0), ("days", 365.0)):
        parser.add_argument(f"--{name}", type=float, default=default)
    for name in ("of-bench", "of-unit"):
        parser.add_argument(f"--{name}", action="append", default=[], metavar="EFFECT=SIZE")
    parser.add_argument("--jobs", type=int, default=2)
    options = vars(parser.parse_args())
    jobs = options.pop("jobs")
    campaign = Campaign(**{key: tuple(value) if isinstance(value, list) else value for key, value in options.items()})
    truths = sorted(recorded(campaign, jobs), key=lambda truth: truth["run"])
    (campaign.folder / "truth.json").write_text(json.dumps(truths, indent=1))
    print(f"{len(truths)} recordings in {campaign.folder / 'runs'}, their truth in {campaign.folder / 'truth.json'}")


if __name__ == "__main__":
    main()
