"""Specific force from readings: what a calibration is for.

The reading of accelerometer i is s_i . f + b_i + e_i(f, T), with effects e of the model. With rows s_i of S,

    f = S^-1 (reading - b - e(f, T)),

where e is small, so that a few iterations from f = S^-1 (reading - b) suffice. The covariance of f by that of the state
is S^-1 H P H^T S^-T, H (3, p) being the design at f and T; noise of the reading itself adds S^-1 D S^-T.

Effects that depend on more than specific force and temperature belong to the run or the platform, not to the sensors
wherever they are; they are left out and named.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench
from kf_calib.effects import Effect
from kf_calib.effects.inputs import beyond_force_and_temperature, stimulus_of
from kf_calib.effects.stimulus import REFERENCE_TEMPERATURE_C
from kf_calib.errors import InputError, UnobservableError
from kf_calib.estimation.measurement_model import STATE_COUNT, Model

_BLOCK = 1 << 14  # readings at a time: what is at work stays in the cache
_MOST_ROUNDS = 20
_CONVERGED = 1e-13  # of gravity


@dataclass(frozen=True, eq=False)
class Correction:
    """The inverse of the measurement model; raises UnobservableError if the run did not determine all of it.

    - bench: by which effects know gravity and gimbals.
    - model: the fitted model, each effect with its constants.
    - state (p,), covariance (p, p): the estimate.
    - noise_mps2 (3,): sigma of a reading.
    - unseen: symbols of parameters and coefficients that the run did not determine.
    """

    bench: Bench
    model: Model
    state: Floats
    covariance: Floats
    noise_mps2: Floats
    unseen: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        needed = {c.symbol for effect in self.effects for c in effect.coefficients}
        lost = [symbol for symbol in self.unseen if symbol in paper_parameters.SYMBOLS or symbol in needed]
        if lost:
            raise UnobservableError(
                f"the calibration cannot be applied, as its run did not determine {', '.join(lost)}: add orientations "
                "(kf-calib plan --recording), or state a --prior."
            )

    @cached_property
    def left_out(self) -> dict[str, str]:
        """Effects of the model that are not corrected, and why."""
        reasons = {str(effect): beyond_force_and_temperature(effect, self.bench) for effect in self.model.effects}
        return {name: why for name, why in reasons.items() if why}

    @cached_property
    def effects(self) -> tuple[Effect, ...]:
        """Effects of the model that are corrected."""
        return tuple(effect for effect in self.model.effects if str(effect) not in self.left_out)

    @cached_property
    def needs_temperature(self) -> tuple[str, ...]:
        """Names of the corrected effects that depend on temperature."""
        force = self.bench.gravity_mps2 * np.eye(3)
        cold, warm = (
            stimulus_of(force, np.full(3, REFERENCE_TEMPERATURE_C + change), self.bench, self.sensitivity)
            for change in (0.0, 10.0)
        )
        return tuple(str(e) for e in self.effects if not np.array_equal(e.columns(cold), e.columns(warm)))

    @property
    def sensitivity(self) -> Floats:
        """S (3, 3): rows s_i = K_i E_i."""
        return self.state[:STATE_COUNT].reshape(3, 4)[:, :3]

    @property
    def bias_mps2(self) -> Floats:
        """b (3,)."""
        return self.state[:STATE_COUNT].reshape(3, 4)[:, 3]

    @cached_property
    def worst_sigma_mps2(self) -> Floats:
        """Sigma (3,) of corrected specific force by the calibration alone, the largest over directions of gravity."""
        directions = np.vstack([np.eye(3), -np.eye(3)]) * self.bench.gravity_mps2
        temperature = REFERENCE_TEMPERATURE_C if self.needs_temperature else None
        return self.sigma_of(directions, temperature).max(axis=0)

    @cached_property
    def matrix(self) -> Floats:
        """S^-1 (3, 3), which turns readings without bias into specific force."""
        return np.asarray(np.linalg.inv(self.sensitivity), float)

    def __call__(self, readings_mps2: Floats, temperature_c: Floats | float | None = None) -> Floats:
        """Specific force (n, 3) in the frame of the block, m/s^2, from readings (n, 3) and temperatures (n,), degC.

        Raises InputError if an effect needs the temperature and there is none.
        """
        readings = np.atleast_2d(np.asarray(readings_mps2, float))
        if readings.ndim != 2 or readings.shape[1] != 3:
            raise InputError(f"readings have the shape {np.shape(readings_mps2)}: give (n, 3), in m/s^2.")
        temperature = self._temperature(temperature_c, len(readings))
        out = np.empty_like(readings)
        for first in range(0, len(readings), _BLOCK):
            part = slice(first, first + _BLOCK)
            out[part] = self._corrected(readings[part], temperature[part])
        return out

    def _temperature(self, temperature_c: Floats | float | None, count: int) -> Floats:
        """Return temperatures (n,); the reference where none is needed."""
        if temperature_c is None:
            if self.needs_temperature:
                raise InputError(
                    f"{', '.join(self.needs_temperature)} cannot be corrected without the temperature: give one for "
                    "each reading, degC."
                )
            return np.full(count, REFERENCE_TEMPERATURE_C)
        return np.broadcast_to(np.asarray(temperature_c, float), (count,))

    def _corrected(self, readings: Floats, temperature_c: Floats) -> Floats:
        """Return the specific force of one block of readings."""
        force = readings
        for force in self.rounds(readings, temperature_c):  # noqa: B007  # the last one is wanted
            pass
        return force

    def rounds(self, readings: Floats, temperature_c: Floats) -> Iterator[Floats]:
        """Specific force (n, 3) without effects, then round by round with them, until it changes no more."""
        force = start = (readings - self.bias_mps2) @ self.matrix.T
        yield force
        for _ in range(_MOST_ROUNDS if self.effects else 0):
            before, force = force, start - self._added(force, temperature_c) @ self.matrix.T
            yield force
            with np.errstate(invalid="ignore"):  # readings that are not finite stay so
                if not np.nanmax(np.abs(force - before), initial=0.0) > _CONVERGED * self.bench.gravity_mps2:
                    return

    def _added(self, force: Floats, temperature_c: Floats) -> Floats:
        """Return what the effects add to the readings (n, 3)."""
        stimulus = stimulus_of(force, temperature_c, self.bench, self.sensitivity)
        out = np.zeros_like(force)
        for effect in self.effects:
            part = self.model.parts[str(effect)]
            own = self.state[part.start : part.start + len(effect.coefficients)]
            out += effect.columns(stimulus) @ own
        return out

    def predicted(self, force_mps2: Floats, temperature_c: Floats | float | None = None) -> Floats:
        """Readings (n, 3) of this specific force (n, 3): what ``__call__`` inverts."""
        temperature = self._temperature(temperature_c, len(force_mps2))
        return force_mps2 @ self.sensitivity.T + self.bias_mps2 + self._added(force_mps2, temperature)

    def covariance_of(
        self, force_mps2: Floats, temperature_c: Floats | float | None = None, noise: bool = False
    ) -> Floats:
        """Covariance (n, 3, 3) of corrected specific force (n, 3), m^2/s^4, by the uncertainty of the calibration.

        noise: with that of a single reading.
        """
        temperature = self._temperature(temperature_c, len(force_mps2))
        stimulus = stimulus_of(np.asarray(force_mps2, float), temperature, self.bench, self.sensitivity)
        design = Model(self.bench, self.effects).columns(stimulus, self.state)
        kept = [*range(STATE_COUNT), *(p for e in self.effects for p in range(*self._part(e).indices(len(self.state))))]
        covariance = self.covariance[np.ix_(kept, kept)]
        design = self.matrix @ design
        out = np.einsum("nip,pq,njq->nij", design, covariance, design, optimize=True)
        return out + self.matrix @ np.diag(self.noise_mps2**2) @ self.matrix.T if noise else out

    def _part(self, effect: Effect) -> slice:
        return self.model.parts[str(effect)]

    def sigma_of(self, force_mps2: Floats, temperature_c: Floats | float | None = None, noise: bool = False) -> Floats:
        """Sigma (n, 3) of each component of corrected specific force (n, 3), m/s^2; as ``covariance_of``."""
        covariance = self.covariance_of(np.atleast_2d(force_mps2), temperature_c, noise)
        return np.sqrt(np.einsum("nii->ni", covariance))
