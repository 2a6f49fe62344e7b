#!/usr/bin/env python
"""A bench that may stop at any dwell: how often a run in which nothing is missing is ever alarmed, and how often a
wrong name is ever told, looked at after every dwell.

The streams are those of a bench written with scipy's rotations (tests/helpers/independent_bench.py), dwell by dwell as
``live`` judges them: the sequential test after each, and the diagnosis after each once it was alarmed. A stream counts
as wrong if at any of its looks a name that is not its truth has 90 % or more. Of 2000 streams an alarm rate of 1 % is
known to 0.2 %.

usage: .venv/bin/python tools/stopping_trial.py [--quiet 2000] [--missing 40] [--dwells 24] [--jobs 2]
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import click
import numpy as np
from scipy.spatial.transform import Rotation

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "tests"), str(ROOT), str(ROOT / "tools")]

from coverage_trial import KINDS, NoisyBench, bench_of  # noqa: E402
from helpers.independent_bench import IndependentBench, State  # noqa: E402

from kf_calib import diagnose  # noqa: E402
from kf_calib.estimation.calibration import evaluate  # noqa: E402
from kf_calib.estimation.dwell_pass import Pass  # noqa: E402
from kf_calib.estimation.settings import Settings  # noqa: E402
from kf_calib.online.sequential_test import SequentialTest  # noqa: E402

QUIET = "white", "setting error", "scatter", "setting error and scatter"
FIRST = 5
"""Dwells after which the first look is taken."""
SURE = 0.9


@dataclass(frozen=True)
class Missing:
    """What a stream lacks in its model: the name in the catalogue, "" where that has none."""

    name: str
    size: float

    def bench(self, seed: int) -> IndependentBench:
        """A bench that has it, larger or smaller by a factor of up to five."""
        size = self.size * 5.0 ** np.random.default_rng([seed, 7]).uniform(-1.0, 1.0)
        if self.name:
            return IndependentBench(seed, bias=lambda state: size * along(state) ** 2)
        return IndependentBench(seed, gimbals=lambda state: size * twist(state))


def along(state: State) -> np.ndarray:
    """The force (n, 3), g, along the axes of the platform."""
    return Rotation.from_euler("YZX", state.angles_rad).inv().apply([0.0, 1.0, 0.0])


def twist(state: State) -> np.ndarray:
    """Of the inner gimbal alone, a step where it has turned by more than half a turn, and a fifth harmonic."""
    inner = state.angles_rad[:, 2]
    return np.column_stack([0.0 * inner, 0.0 * inner, np.cos(5.0 * inner) + (inner > np.pi)])


MISSING = {"second-order": Missing("second-order", 2e-5), "twist (no name)": Missing("", 4e-6)}


def looks(source: IndependentBench) -> Iterator[SequentialTest]:
    """The sequential test after each dwell of a stream."""
    dwells = Pass(source, Settings()).fold()
    sequential = SequentialTest.over(dwells[:FIRST], source.bench)
    yield sequential
    for dwell in dwells[FIRST:]:
        sequential = sequential.after(dwell)
        yield sequential


def names_told(source: IndependentBench) -> set[tuple[str, ...]] | None:
    """The names that are told with 90 % or more at any look; None where there is no alarm."""
    told, alarmed = set[tuple[str, ...]](), False
    for sequential in looks(source):
        if sequential.alarmed is not None:
            alarmed = True
            first = diagnose(evaluate(sequential.dwells, source.bench, Settings())).table
            if first is not None and first.first.effects and first.first.probability >= SURE:
                told.add(first.first.effects)
    return told if alarmed else None


def quiet(kind: str, dwells: int, seed: int) -> set[tuple[str, ...]] | None:
    """``names_told`` of a stream in which nothing is missing."""
    return names_told(NoisyBench(100_000 + seed, dwells, bench=bench_of(KINDS[kind], stated=True), kind=KINDS[kind]))


def missing(name: str, dwells: int, seed: int) -> set[tuple[str, ...]] | None:
    """``names_told`` of a stream that lacks an effect."""
    return names_told(MISSING[name].bench(200_000 + seed))


@click.command()
@click.option("--quiet", "quiet_streams", default=2000, help="Streams in which nothing is missing, of all kinds.")
@click.option("--missing", "missing_streams", default=40, help="Streams that lack an effect, of each.")
@click.option("--dwells", default=24)
@click.option("--jobs", default=2)
def main(quiet_streams: int, missing_streams: int, dwells: int, jobs: int) -> None:
    """Print the table."""
    print("| stream | streams | ever alarmed | ever named at 90 %: right | wrong |\n|---|---|---|---|---|")
    with ProcessPoolExecutor(jobs) as pool:
        for play, name, count in (
            *((quiet, kind, quiet_streams // len(QUIET)) for kind in QUIET),
            *((missing, name, missing_streams) for name in MISSING),
        ):
            results = list(pool.map(partial(play, name, dwells), range(count), chunksize=4))
            truth = MISSING[name].name if name in MISSING else ""
            alarmed = [told for told in results if told is not None]
            right = sum((truth,) in told for told in alarmed)
            wrong = [told - {(truth,)} for told in alarmed if told - {(truth,)}]
            print(f"| {name} | {count} | {len(alarmed)} | {right} | {len(wrong)} |", flush=True)
            if wrong:
                print(f"<!-- {Counter(' + '.join(names) for told in wrong for names in told)} -->", flush=True)


if __name__ == "__main__":
    main()
