"""Noise as real sensors and benches have it, in the readings of a small bench: neither white nor of any catalogue."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from kf_calib.bench.arrays import Floats
from unknown_trials.hidden import second_order
from unknown_trials.small_bench import G_MPS2, RATE_HZ, WHITE_MPS2, SmallRun, hidden_run

_MEAN_MPS2 = WHITE_MPS2 / np.sqrt(240.0)  # noise of the mean of a dwell

Altered = Callable[[Floats, np.random.Generator], Floats]


def _switched_on_again(readings: Floats, rng: np.random.Generator) -> Floats:
    later = np.arange(len(readings)) >= len(readings) // 2
    return readings + later[:, None, None] * rng.normal(size=3) * 15.0 * _MEAN_MPS2


def _switched_on_for_each_dwell(readings: Floats, rng: np.random.Generator) -> Floats:
    return readings + rng.normal(size=(len(readings), 1, 3)) * 5.0 * _MEAN_MPS2


def _heavy_tails(readings: Floats, rng: np.random.Generator) -> Floats:
    return readings + rng.standard_t(2.5, size=(len(readings), 1, 3)) * 3.0 * _MEAN_MPS2


def _rounded(steps: float) -> Altered:
    size = steps * WHITE_MPS2
    return lambda readings, rng: np.round(readings / size) * size


def _cut_off(readings: Floats, rng: np.random.Generator) -> Floats:
    return np.clip(readings, -0.97 * G_MPS2, 0.97 * G_MPS2)


def _last_second(readings: Floats, rng: np.random.Generator) -> Floats:
    count, pulled = int(RATE_HZ), readings.copy()
    course = np.linspace(0.0, 1.0, count)[:, None] ** 2
    pulled[:, -count:] += course * rng.normal(size=(len(readings), 1, 3)) * 2e-3 * G_MPS2
    return pulled


def _unequal(readings: Floats, rng: np.random.Generator) -> Floats:
    louder = np.exp(rng.normal(size=(len(readings), 1, 1)))
    return readings + rng.normal(size=readings.shape) * louder * WHITE_MPS2


KINDS: dict[str, Altered] = {
    "white": lambda readings, rng: readings,
    "switched on again half-way": _switched_on_again,
    "switched on for each dwell": _switched_on_for_each_dwell,
    "heavy tails of the dwells": _heavy_tails,
    "steps of 3 sigma": _rounded(3.0),
    "steps of 10 sigma": _rounded(10.0),
    "cut off at 0.97 g": _cut_off,
    "the last second of each dwell": _last_second,
    "dwells of unequal noise": _unequal,
    "stamps an hour later half-way": lambda readings, rng: readings,
    "stamps 8 s earlier half-way": lambda readings, rng: readings,
}
_LATE_S = {"stamps an hour later half-way": 3600.0, "stamps 8 s earlier half-way": -8.0}


def noisy_run(kind: str, sigmas: float, seed: int) -> SmallRun:
    """A run with noise of this kind, and a second-order term of this size in sigmas of white noise hidden."""
    run = hidden_run(second_order, sigmas, seed)
    half = np.arange(len(run.at.time_s)) >= len(run.at.time_s) // 2
    return replace(run, altered=KINDS[kind], late_s=half[:, None] * _LATE_S.get(kind, 0.0))
