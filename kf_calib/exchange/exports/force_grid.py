"""Where the error of a correction is judged: all directions of gravity, and all temperatures of the run alike."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.effects.stimulus import REFERENCE_TEMPERATURE_C
from kf_calib.estimation.correction import Correction

_DIRECTIONS = 10_000  # with the opposite of each, so that odd powers of the force cancel exactly
_LOBATTO = np.array([[-1.0, 0.1], [-np.sqrt(3 / 7), 49 / 90], [0.0, 32 / 45], [np.sqrt(3 / 7), 49 / 90], [1.0, 0.1]])
"""Nodes, weights: exact up to the seventh power of the temperature, and both ends are among the nodes."""


class ErrorLeft(NamedTuple):
    """Length of the error of corrected specific force, m/s^2."""

    rms_mps2: float
    worst_mps2: float


@dataclass(frozen=True, eq=False)
class ForceGrid:
    """Specific force (n, 3), temperature (n,), and shares (n,) that add up to one; low_c, high_c: the temperatures."""

    force_mps2: Floats
    temperature_c: Floats
    weight: Floats
    low_c: float
    high_c: float

    def error_of(self, correction: Correction, corrected: Callable[[Floats, Floats], Floats]) -> ErrorLeft:
        """How far ``corrected`` (readings, temperature) is from the specific force of which these are the readings."""
        found = corrected(correction.predicted(self.force_mps2, self.temperature_c), self.temperature_c)
        square = np.sum((found - self.force_mps2) ** 2, axis=1)
        return ErrorLeft(float(np.sqrt(self.weight @ square)), float(np.sqrt(square.max())))


def force_grid(gravity_mps2: float, low_c: float | None, high_c: float | None) -> ForceGrid:
    """Directions spread evenly by the golden angle, each at five temperatures from low to high (None: not known)."""
    low, high = (REFERENCE_TEMPERATURE_C if each is None else each for each in (low_c, high_c))
    number = np.arange(_DIRECTIONS // 2) + 0.5
    height, turn = 1.0 - 4.0 * number / _DIRECTIONS, number * np.pi * (1.0 + np.sqrt(5.0))
    radius = np.sqrt(1.0 - height**2)
    force = gravity_mps2 * np.column_stack([radius * np.cos(turn), radius * np.sin(turn), height])
    force = np.vstack([force, -force])
    temperature = 0.5 * (low + high) + 0.5 * (high - low) * _LOBATTO[:, 0]
    return ForceGrid(
        np.tile(force, (len(temperature), 1)),
        np.repeat(temperature, _DIRECTIONS),
        np.repeat(_LOBATTO[:, 1] / 2.0 / _DIRECTIONS, _DIRECTIONS),
        low,
        high,
    )
