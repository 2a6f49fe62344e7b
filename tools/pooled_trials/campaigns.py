"""Campaigns with a hidden effect: of the bench, of all sensors, of some, or of a bench that was repaired."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.effects import Bearer, described
from kf_calib.fleet.run_factor import RunFactor
from pooled_trials.runs import simulated

UNITS = 40
KINDS = ("noise", "bench", "repaired", "sensors", "population", "half", "half-large", "same-in-all")
"""Nothing; one vector of the bench, or one from some run on; each unit its own of one size, or drawn about a mean; half
of the units, at 2 to 3 or at 6 sigma; a sensor's effect that is the same in all units of the type."""
_OF_BENCH = ("bench", "repaired")
_ALIKE = (*_OF_BENCH, "same-in-all")
_SEEN = 1e-6


@dataclass(frozen=True)
class Truth:
    """What was hidden: coefficients (units, q) of an effect; repaired: the first run after a repair."""

    kind: str
    effect: str
    sigmas: float
    coefficients: Floats
    repaired: int | None = None

    @property
    def common(self) -> bool:
        """Whether the bench has it."""
        return self.kind in _OF_BENCH

    @property
    def alike(self) -> bool:
        """Whether it is the same in all units."""
        return self.kind in _ALIKE

    @property
    def units(self) -> set[str]:
        """The units that have it."""
        return {unit_name(k) for k, own in enumerate(self.coefficients) if own.any()}


def unit_name(number: int) -> str:
    """The name of a unit."""
    return f"unit{number:03d}"


def fitting(kind: str, runs: Sequence[RunFactor]) -> list[str]:
    """Return the effects that may be hidden: those that the runs show, of the bench or of sensors as the kind asks."""
    if kind == "noise":
        return [""]
    first = runs[0]
    names = [name for name, own in first.effects.items() if all(_left(first, column) for column in own)]
    bearer = Bearer.BENCH if kind in _OF_BENCH else Bearer.SENSORS
    return [name for name in names if (effect := described(name)) is not None and effect.borne_by is bearer]


def _left(run: RunFactor, column: str) -> bool:
    """Tell whether the run's own parameters leave something of a column."""
    own = run.factor[:, run.places[column]]
    return float(np.linalg.norm(own[run.width :])) > _SEEN * float(np.linalg.norm(own))


def signal(run: RunFactor, effect: str, coefficients: Floats) -> Floats:
    """Return what an effect adds to the whitened readings of a run beside its own parameters, (rows,)."""
    places = [run.places[column] for column in run.effects[effect]]
    return run.factor[run.width :, places] @ coefficients


def draw(kind: str, effect: str, runs: Sequence[RunFactor], rng: np.random.Generator) -> Truth:
    """Draw the coefficients of a hidden effect for the runs of a campaign."""
    sigmas = 6.0 if kind == "half-large" else float(rng.uniform(2.0, 3.0))
    if kind == "noise":
        return Truth(kind, effect, 0.0, np.zeros((len(runs), 0)))
    count = len(runs[0].effects[effect])

    def scaled(vector: Floats, run: RunFactor) -> Floats:
        return vector * sigmas / np.linalg.norm(signal(run, effect, vector))

    if kind in _ALIKE:
        first = int(rng.integers(10, len(runs) - 9)) if kind == "repaired" else 0
        own = np.tile(scaled(rng.standard_normal(count), runs[0]), (len(runs), 1))
        own[:first] = 0.0
        return Truth(kind, effect, sigmas, own, first if kind == "repaired" else None)
    own = np.array([scaled(rng.standard_normal(count), run) for run in runs])
    if kind == "population":
        mean = scaled(rng.standard_normal(count), runs[0])
        spread = np.linalg.norm(mean) / np.sqrt(count)
        own = np.sqrt(0.5) * (mean + spread * rng.standard_normal(own.shape))
    if kind.startswith("half"):
        own[rng.permutation(len(runs))[: len(runs) // 2]] = 0.0
    return Truth(kind, effect, sigmas, own)


def linear(runs: Sequence[RunFactor], truth: Truth, rng: np.random.Generator) -> list[RunFactor]:
    """Return the runs with drawn noise, and with the hidden effect by its columns."""
    return [_named(_drawn(run, truth, k, rng), k) for k, run in enumerate(runs)]


def _drawn(run: RunFactor, truth: Truth, number: int, rng: np.random.Generator) -> RunFactor:
    upper = run.factor.copy()
    upper[: run.width, -1], upper[-1, -1] = 0.0, 0.0
    upper[run.width : -1, -1] = rng.standard_normal(len(upper) - 1 - run.width)
    if truth.effect:
        upper[run.width :, -1] += signal(run, truth.effect, truth.coefficients[number])
    return replace(run, factor=upper)


def nonlinear(
    seeds: Sequence[int], truth: Truth, made: Callable[[int, Sequence[str]], RunFactor] = simulated
) -> list[RunFactor]:
    """Return runs that are simulated with the hidden effect through the nonlinear truth."""
    out = list[RunFactor]()
    for k, seed in enumerate(seeds):
        own = truth.coefficients[k] if truth.effect else np.zeros(0)
        text = f"{truth.effect}={','.join(map(repr, own.tolist()))}"
        out.append(_named(made(seed, [text] if own.any() else []), k))
    return out


def _named(run: RunFactor, number: int) -> RunFactor:
    date = f"2026-03-{1 + number // 24:02d}T{number % 24:02d}:00:00Z"
    return replace(run, run=f"run{number:03d}", unit=unit_name(number), bench="bench 1", date=date)
