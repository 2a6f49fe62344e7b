#!/usr/bin/env python
"""Coverage of the intervals and rate of alarms, in noise of many kinds, on a bench that knows nothing of the program.

Each run has a bench written with scipy's rotations (tests/helpers/independent_bench.py), other sensors and poses, and
noise of one kind; its truth is compared with ``low`` and ``high`` of each of the twelve. Of 1000 runs the share of one
parameter is known to 0.7 %, that of all twelve together to some 0.3 %, and an alarm rate of 1 % to 0.3 %.

usage: .venv/bin/python tools/coverage_trial.py [--runs 1000] [--kind white ...] [--dwells 6 ...] [--jobs 2]
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import click
import numpy as np
from scipy.signal import lfilter

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "tests"), str(ROOT)]

from helpers.independent_bench import BENCH, IndependentBench, State  # noqa: E402

from kf_calib.bench import paper_parameters  # noqa: E402
from kf_calib.bench.bench import Bench  # noqa: E402
from kf_calib.bench.streams import Batch, Stream  # noqa: E402
from kf_calib.errors import KfCalibError  # noqa: E402
from kf_calib.estimation.calibration import calibrate  # noqa: E402

WHITE = 5e-5
"""Of a reading, m/s^2; that of the mean of a dwell is WHITE / sqrt(160) = 4e-6."""
MEAN = WHITE / np.sqrt(160.0)
SETTING_DEG = 5e-5
SCATTER = 3.0 * MEAN

Noise = Callable[[np.random.Generator, State, np.ndarray], np.ndarray]


def white(rng: np.random.Generator, state: State, force: np.ndarray) -> np.ndarray:
    return WHITE * rng.standard_normal(force.shape)


def one_correlated(rng: np.random.Generator, state: State, force: np.ndarray) -> np.ndarray:
    """The second channel is AR(1) with 0.95 from reading to reading, of the same deviation."""
    noise = white(rng, state, force)
    noise[:, 1] = lfilter([np.sqrt(1.0 - 0.95**2)], [1.0, -0.95], noise[:, 1])
    return noise


def by_load(rng: np.random.Generator, state: State, force: np.ndarray) -> np.ndarray:
    """A deviation in proportion to what the channel reads."""
    return white(rng, state, force) * np.abs(force) / 5.0


def faster_than_white(rng: np.random.Generator, state: State, force: np.ndarray) -> np.ndarray:
    """Differences, as of a converter that keeps the rest: the mean is known better than the readings tell."""
    return lfilter([1.0, -0.8], [1.0], white(rng, state, force), axis=0)


def flicker(rng: np.random.Generator, state: State, force: np.ndarray) -> np.ndarray:
    """White noise and 1/f noise, whose mean over a dwell is as uncertain by the one as by the other."""
    count = len(force)
    frequency = np.fft.rfftfreq(count)
    spectrum = np.fft.rfft(rng.standard_normal((count, 3)), axis=0)
    spectrum[1:] /= np.sqrt(frequency[1:, None] * count)
    spectrum[0] = 0.0
    pink = np.fft.irfft(spectrum, count, axis=0)
    still = [(state.dwell == k) & (state.since_s > 0.0) for k in range(state.dwell.max() + 1)]
    means = np.array([pink[each].mean(axis=0) for each in still])
    return white(rng, state, force) + MEAN * pink / means.std()


def counts(rng: np.random.Generator, state: State, force: np.ndarray) -> np.ndarray:
    """A step of half a deviation beside white noise, which spreads it."""
    noise, step = white(rng, state, force), 2.0 * WHITE
    return step * np.rint((force + noise) / step) - force


@dataclass(frozen=True)
class Kind:
    """Noise of readings, and what changes from dwell to dwell: error of the angles (deg) and scatter (m/s^2)."""

    noise: Noise = white
    setting_deg: float = 0.0
    scatter_mps2: float = 0.0


KINDS = {
    "white": Kind(),
    "setting error": Kind(setting_deg=SETTING_DEG),
    "scatter": Kind(scatter_mps2=SCATTER),
    "setting error and scatter": Kind(setting_deg=SETTING_DEG, scatter_mps2=SCATTER),
    "one channel correlated": Kind(one_correlated),
    "by load": Kind(by_load),
    "faster than white": Kind(faster_than_white),
    "1/f": Kind(flicker),
    "counts": Kind(counts),
}
DWELLS = 6, 8, 12, 24


@dataclass(frozen=True)
class NoisyBench(IndependentBench):
    """A run in noise of a kind."""

    kind: Kind = Kind()

    @cached_property
    def truth(self) -> np.ndarray:
        """The twelve."""
        axes, scales, biases = self._sensors(np.random.default_rng([self.seed, 1]))
        return paper_parameters.parameters_of(np.column_stack([scales[:, None] * axes, biases]).ravel())

    def __iter__(self) -> Iterator[Batch]:
        rng = np.random.default_rng([self.seed, 2])
        errors = np.radians(self.kind.setting_deg) * rng.standard_normal((self.dwells, 3))
        still = replace(self, white_mps2=0.0, gimbals=lambda state: errors[state.dwell])
        (batch,) = IndependentBench.__iter__(still)
        force, state = batch.accel.values, self.state
        scatter = self.kind.scatter_mps2 * rng.standard_normal((self.dwells, 3))
        readings = force + self.kind.noise(rng, state, force) + scatter[state.dwell]
        yield Batch(Stream(batch.accel.time_ns, readings), batch.pose)


def bench_of(kind: Kind, stated: bool) -> Bench:
    """What is stated of it: the true sizes, or nothing."""
    if not stated:
        return replace(BENCH, angle_sigma_deg=None, scatter_sigma_mps2=None)
    return replace(BENCH, angle_sigma_deg=kind.setting_deg, scatter_sigma_mps2=kind.scatter_mps2)


def played(name: str, stated: bool, dwells: int, seed: int) -> tuple[list[bool], bool | None] | str:
    """Whether each of the twelve is within its interval, and whether the model was alarmed; why there is no result."""
    kind = KINDS[name]
    source = NoisyBench(seed, dwells, bench=bench_of(kind, stated), kind=kind)
    try:
        result = calibrate(source)
    except KfCalibError as error:
        return str(error)
    within = list[bool]()
    for parameter, truth in zip(result.parameters.values(), source.truth, strict=True):
        low, high = result.interval(parameter)
        if low is None or high is None:
            return f"{parameter.symbol} is not determined"
        within.append(low <= truth <= high)
    return within, None if result.consistency.p_value is None else result.consistency.consistent is False


def row(pool: ProcessPoolExecutor, name: str, stated: bool, dwells: int, runs: int) -> str:
    """A line of the table."""
    results = list(pool.map(partial(played, name, stated, dwells), range(runs), chunksize=10))
    known = [each for each in results if not isinstance(each, str)]
    within = np.array([each[0] for each in known])
    alarms = [each[1] for each in known if each[1] is not None]
    shares = 100.0 * within.mean(axis=0)
    words = [name, "stated" if stated else "not stated", str(dwells), f"{shares.min():.1f} to {shares.max():.1f}",
             f"{shares.mean():.1f}", f"{100.0 * np.mean(alarms):.1f}" if alarms else "not judged",
             str(runs - len(known))]  # fmt: skip
    return f"| {' | '.join(words)} |"


@click.command()
@click.option("--runs", default=1000)
@click.option("--kind", "kinds", multiple=True, type=click.Choice(list(KINDS)))
@click.option("--dwells", "counts_of_dwells", multiple=True, type=int)
@click.option("--jobs", default=2)
def main(runs: int, kinds: tuple[str, ...], counts_of_dwells: tuple[int, ...], jobs: int) -> None:
    """Print the table."""
    headings = "noise", "sizes", "dwells", "each of the twelve, %", "all, %", "alarms at 1 %, %", "refused"
    print(f"| {' | '.join(headings)} |\n{'|---' * len(headings)}|")
    with ProcessPoolExecutor(jobs) as pool:
        for name in kinds or KINDS:
            for stated in (True, False):
                for dwells in counts_of_dwells or DWELLS:
                    print(row(pool, name, stated, dwells, runs), flush=True)


if __name__ == "__main__":
    main()
