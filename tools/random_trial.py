#!/usr/bin/env python
"""Benches that nobody would plan, through ``diagnose`` or ``improve``: random axes, poses, dwells, rates, noise stated
or not, and up to two effects. Only a refusal in a sentence may be raised. Names of 90 % or more not hidden, and
large effects beside which a run agrees, are printed with their seed, by which any run is played again.

``--usual``: in place of up to two effects each one there is, with a probability of 0.15 and a size that is usual.

usage: .venv/bin/python tools/random_trial.py [--runs 200] [--first 0] [--jobs 2] [--improve] [--usual]
"""

from __future__ import annotations

import sys
import traceback
import warnings
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from kf_calib import Bench, diagnose, improve
from kf_calib.bench.bench import axes_of
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.effects import kind_of
from kf_calib.errors import KfCalibError
from kf_calib.sources.simulation.detectability import sized
from kf_calib.sources.simulation.injected import parse
from kf_calib.sources.simulation.injected.kinds import Hidden, catalogue
from kf_calib.sources.simulation.physics import Ambient
from kf_calib.sources.simulation.sensors import GRADES, TrueNoise
from kf_calib.sources.simulation.simulator import Simulation, without_angles
from kf_calib.sources.simulation.visit_plans import PlannedVisit

KNOWN = {kind.name: kind for kind in catalogue().values() if kind.known}
NAMES = sorted(KNOWN)
PRESENT = 0.15  # probability of each effect where all there are may be present
ANGLES_DEG = 0.0, 90.0, 180.0, 270.0, 45.0, -30.0
SURE, LARGE = 0.9, 20.0  # probability of a name; sigma of an effect that should not be overlooked


@dataclass(frozen=True)
class RandomRun:
    """A run of a seed, what is hidden in it, with sizes in sigma, and its noise."""

    source: Simulation
    hidden: dict[str, float]
    noise: dict[str, float]

    @property
    def names(self) -> set[str]:
        """The names of all that is missing in the model, noise included."""
        return {*self.hidden} | ({"bias-walk"} if "walk_mps2_per_sqrt_s" in self.noise else set[str]())


def drawn(seed: int, usual: bool = False) -> RandomRun:
    """The run of a seed. Raises KfCalibError where it cannot be: an effect that these poses do not show."""
    rng = np.random.default_rng(seed)
    axes, grade = str(rng.choice(["yzx", "zx", "yz", "xz", "x", "zxy"])), str(rng.choice([*GRADES]))
    noise = _noise(rng)
    stated = int(rng.integers(4))  # nothing, the setting error, both, the scatter
    states: dict[str, Any] = {"angle_sigma_deg": noise.get("setting_sigma_deg", 0.0)} if stated in (1, 2) else {}
    states |= {"scatter_sigma_mps2": noise.get("scatter_mps2", 0.0)} if stated > 1 else {}
    bench = Bench(axes_of(axes), 9.81, latitude_deg=50.0, **states)
    base = Simulation(
        bench, GRADES[grade].sensors(seed), TrueNoise(**noise), _plan(rng, len(axes)), seed=seed,
        sample_hz=float(rng.choice([5, 20, 50, 100, 200])), angle_hz=float(rng.choice([2, 20])),
        slew_rate_degps=float(rng.choice([20, 90, np.inf])),
        ambient=Ambient(swing_c=float(rng.choice([0, 5])), period_s=300.0, sigma_c=float(rng.choice([0, 0.01]))),
    )  # fmt: skip
    if usual:
        hidden = _usual(rng, grade, bench)
        return RandomRun(base.hiding(hidden), {each.kind.name: 0.0 for each in hidden}, noise)
    names = rng.choice(NAMES, size=int(rng.integers(3)), replace=False).tolist()
    hidden = {name: float(f"{10 ** rng.uniform(0.7, 3.0):.3g}") for name in names}
    by_hand = bool(rng.random() < 0.2)
    texts, seen = [f"{name}={size}sigma" for name, size in hidden.items()], without_angles(base) if by_hand else base
    run = base.hiding(parse(texts, bench.axes, seed=seed, grade=grade, sized=partial(sized, seen)))
    return RandomRun(run.by_hand() if by_hand else run, hidden, noise)


def _usual(rng: np.random.Generator, grade: str, bench: Bench) -> list[Hidden]:
    """Return some of all effects, of sizes that are usual in sensors of a grade, on all gimbals or accelerometers."""
    hidden = list[Hidden]()
    for name in (name for name in NAMES if rng.random() < PRESENT):
        share, ends = rng.random(), getattr(KNOWN[name], grade if grade == "mems" else "navigation")
        both = [parse([f"{name}={end}"], bench.axes, seed=0, grade=grade) for end in ends]
        for low, high in zip(*both, strict=True):
            sizes = [np.sign(a) * abs(a) ** (1.0 - share) * abs(b) ** share if a else b
                     for a, b in zip(low.sizes, high.sizes, strict=True)]  # fmt: skip
            hidden.append(replace(low, sizes=tuple(map(float, sizes))))
    return hidden


def _noise(rng: np.random.Generator) -> dict[str, float]:
    """Return noise of the readings, with each further part in some of the runs."""
    white = float(10.0 ** rng.uniform(-6.0, -2.3))
    parts = {
        "ar1_phi": rng.uniform(0.0, 0.98), "flicker_mps2": white * 10.0 ** rng.uniform(-1.5, 0.0),
        "walk_mps2_per_sqrt_s": white * 10.0 ** rng.uniform(-2.0, 0.0),
        "scatter_mps2": white * 10.0 ** rng.uniform(-1.0, 0.7), "setting_sigma_deg": 10.0 ** rng.uniform(-4.0, 0.0),
        "encoder_step_deg": 10.0 ** rng.uniform(-3.0, -0.5),
    }  # fmt: skip
    noise = {"white_mps2": white} | {name: float(size) for name, size in parts.items() if rng.random() < 0.25}
    return noise | ({"outlier_rate": 1e-3, "outlier_mps2": 50.0 * white} if rng.random() < 0.2 else {})


def _plan(rng: np.random.Generator, gimbals: int) -> list[PlannedVisit]:
    """Return poses of round and of any angles, and their dwells: alike, or each of another length."""
    lengths_s = [8.0, 8.0, 20.0, float(rng.uniform(0.3, 2.0)), float(rng.uniform(2.0, 40.0))]
    some_s = lengths_s if rng.random() < 0.5 else [float(rng.choice(lengths_s))]
    count = int(rng.choice([4, 6, 7, 9, 12, 16, 24, 40]))
    poses = [rng.choice([*ANGLES_DEG, rng.uniform(-180.0, 180.0)], size=gimbals).tolist() for _ in range(count)]
    poses[-1] = poses[0] if rng.random() < 0.3 else poses[-1]
    return [PlannedVisit(tuple(pose), float(rng.choice(some_s))) for pose in poses]


def played(improving: bool, usual: bool, seed: int) -> tuple[int, str, str]:
    """The seed, how its run ended, and what was said."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            run = drawn(seed, usual)
            return (seed, *(_improved(run) if improving else _diagnosed(run)))
        except KfCalibError as error:
            return seed, "refused", str(error)
        except Exception:  # a run that the program does not survive is a finding, not the end of the trial
            return seed, "exception", traceback.format_exc()


def _diagnosed(run: RandomRun) -> tuple[str, str]:
    """Return how a diagnosis ended, and its verdict."""
    found: Diagnosis = diagnose(run.source)
    table, large = found.table, any(size > LARGE for size in run.hidden.values())
    if found.test.consistent and large:
        return "overlooked", found.verdict
    if found.missing and table is not None and table.probability(found.missing) >= SURE:
        wrong = {*map(kind_of, found.missing)} - run.names
        is_same = bool({*map(kind_of, table.same)} & run.names)  # it is told under the other's name
        return ("wrong name" if wrong and not is_same else "right name"), found.verdict
    return ("unknown" if found.unknown else "agrees" if found.test.consistent else "not sure"), found.verdict


def _improved(run: RandomRun) -> tuple[str, str]:
    """Return how an improvement ended, and its reason."""
    state = improve(run.source)
    added = {kind_of(str(step.name)) for step in state.steps}
    wrong = added - run.names
    return (f"added {', '.join(sorted(wrong))}" if wrong else state.because), state.reason


@click.command()
@click.option("--runs", default=200, show_default=True)
@click.option("--first", default=0, show_default=True, help="Seed of the first run.")
@click.option("--jobs", default=2, show_default=True)
@click.option("--improve", "improving", is_flag=True, help="Add what is missing, in place of one diagnosis.")
@click.option("--usual", is_flag=True, help="Each effect with a probability of 0.15, of a usual size.")
def main(runs: int, first: int, jobs: int, improving: bool, usual: bool) -> None:
    """Print each run that ended otherwise than it should, and how many ended how."""
    ends = Counter[str]()
    expected = {"refused", "right name", "unknown", "agrees", "not sure", "consistent", "ambiguous"}
    with ProcessPoolExecutor(jobs) as pool:
        for seed, end, said in pool.map(partial(played, improving, usual), range(first, first + runs)):
            ends[end] += 1
            if end not in expected:
                print(f"{seed}: {end}: {said}\n", flush=True)
    print("\n".join(f"{count:5d}  {end}" for end, count in ends.most_common()))


if __name__ == "__main__":
    main()
