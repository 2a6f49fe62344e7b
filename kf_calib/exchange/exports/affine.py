"""Programs that correct by a matrix, an offset and, some of them, a cubic of the temperature.

    f = matrix (reading - offset - drift(T)),   drift(T) = drift_1 u + drift_2 u^2 + drift_3 u^3,   u = T - reference

The numbers are those with the least rms error over all directions of gravity and all temperatures of the run. Where
the program can hold all of the calibration, this error is zero, and they are those of the calibration.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.polynomial import Polynomial

from kf_calib.bench.arrays import Floats
from kf_calib.effects import Effect
from kf_calib.effects.inputs import stimulus_of
from kf_calib.effects.stimulus import REFERENCE_TEMPERATURE_C
from kf_calib.exchange.exports.target import Target

_SAME = 1e-9
_POWERS = 3


@dataclass(frozen=True, eq=False)
class Affine:
    """matrix (3, 3), m/s^2 a unit of what is read; offset (3,) in that unit; drift (powers, 3): coefficients of u, u^2
    ...; none where there is no drift."""

    matrix: Floats
    offset: Floats
    drift: Floats
    reference_c: float

    def __call__(self, readings_mps2: Floats, temperature_c: Floats) -> Floats:
        return (readings_mps2 - self.offset - self.drift_at(temperature_c)) @ self.matrix.T

    def drift_at(self, temperature_c: Floats | float) -> Floats:
        """The drift (n, 3) at temperatures (n,)."""
        u = np.atleast_1d(temperature_c)[:, None] - self.reference_c
        return np.hstack([u ** (k + 1) for k in range(len(self.drift))] or [np.zeros((len(u), 0))]) @ self.drift


class AffineTarget(Target):
    """diagonal: the matrix is. bias: it holds an offset. thermal: it holds a drift, about ``reference_c``."""

    diagonal: ClassVar[bool] = False
    bias: ClassVar[bool] = True
    thermal: ClassVar[bool] = False
    reference_c: ClassVar[float] = REFERENCE_TEMPERATURE_C

    @cached_property
    def affine(self) -> Affine:
        """The numbers that the program is given: they turn raw readings into specific force, where it folds."""
        of_readings = self._of_readings
        if self.input.is_plain:
            return of_readings
        a = self.input.matrix
        inverse = np.asarray(np.linalg.inv(a), float)
        return Affine(
            of_readings.matrix @ a, inverse @ of_readings.offset, of_readings.drift @ inverse.T, of_readings.reference_c
        )

    @cached_property
    def _of_readings(self) -> Affine:
        """The numbers that turn readings in m/s^2 into specific force."""
        fitted = self._fitted
        return fitted if self.bias else Affine(fitted.matrix, np.zeros(3), fitted.drift, fitted.reference_c)

    def corrected(self, readings_mps2: Floats, temperature_c: Floats) -> Floats:
        return self._of_readings(readings_mps2, temperature_c)

    @property
    def lost(self) -> tuple[str, ...]:
        sensitivity = self.correction.sensitivity
        turned = bool((sensitivity != np.diag(np.diag(sensitivity))).any())
        return (
            *(["alignment"] if self.diagonal and turned else []),
            *(["bias"] if not self.bias and self.correction.bias_mps2.any() else []),
            *(str(effect) for effect in self.correction.effects if not self._holds(effect)),
        )

    @property
    def drifts(self) -> bool:
        """Whether the calibration has a drift with the temperature that the program is to hold."""
        grid = self.grid
        return self.thermal and grid.high_c > grid.low_c and bool(self.correction.needs_temperature)

    @property
    def _powers(self) -> Floats:
        """1 and, where there is a drift, the powers of the temperature from -1 to 1 over its range: (n, 1 or 4)."""
        grid = self.grid
        if not self.drifts:
            return np.ones((len(grid.force_mps2), 1))
        half = 0.5 * (grid.high_c - grid.low_c)
        return np.vander((grid.temperature_c - grid.low_c) / half - 1.0, _POWERS + 1, increasing=True)

    def _holds(self, effect: Effect) -> bool:
        """Whether matrix, offset and drift are enough for an effect: its columns are made of their terms."""
        if str(effect) in self.correction.needs_temperature and not self.drifts:
            return False
        grid = self.grid
        terms = self._powers if self.diagonal else np.hstack([self._powers, grid.force_mps2])
        stimulus = stimulus_of(grid.force_mps2, grid.temperature_c, self.correction.bench, self.correction.sensitivity)
        columns = effect.columns(stimulus).reshape(len(terms), -1)
        left = columns - terms @ np.linalg.lstsq(terms, columns, rcond=None)[0]
        return bool(np.abs(left).max() <= _SAME * np.abs(columns).max())

    @cached_property
    def _fitted(self) -> Affine:
        """Least squares: specific force along each axis by the readings, 1 and the powers of the temperature."""
        grid, powers = self.grid, self._powers
        readings = self.correction.predicted(grid.force_mps2, grid.temperature_c)
        matrix, rest = np.zeros((3, 3)), np.empty((powers.shape[1], 3))
        root = np.sqrt(grid.weight)[:, None]
        for i in range(3):
            used = [i] if self.diagonal else [0, 1, 2]
            design = np.hstack([readings[:, used], powers])
            found = np.linalg.lstsq(root * design, root[:, 0] * grid.force_mps2[:, i], rcond=None)[0]
            matrix[i, used], rest[:, i] = found[: len(used)], found[len(used) :]
        subtracted = -rest @ np.linalg.inv(matrix).T
        about = self._about_reference(subtracted)
        return Affine(matrix, about[0], about[1:], self.reference_c)

    def _about_reference(self, coefficients: Floats) -> Floats:
        """Return polynomials (powers, 3) of the temperature from -1 to 1 as such of u."""
        if len(coefficients) == 1:
            return coefficients
        grid = self.grid
        half = 0.5 * (grid.high_c - grid.low_c)
        scaled = Polynomial([(self.reference_c - grid.low_c) / half - 1.0, 1.0 / half])
        found = [Polynomial(own)(scaled).coef for own in coefficients.T]
        return np.array([np.pad(each, (0, _POWERS + 1 - len(each))) for each in found], float).T
