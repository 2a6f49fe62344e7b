"""Specific force from raw readings: what a calibration is for.

The reading of accelerometer i is s_i . f + b_i + e_i(f, T), with effects e of the model. With rows s_i of S,

    f = S^-1 (reading - b - e(f, T)),

where e is small, so that a few iterations from f = S^-1 (reading - b) suffice. The covariance of f by that of the state
is S^-1 H P H^T S^-T, H (3, p) being the design at f and T; noise of the reading itself adds S^-1 D S^-T.

Effects that depend on more than specific force and temperature belong to the run or the platform, not to the sensors
wherever they are; they are left out and named.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import EXACT, IN_CACHE, Floats
from kf_calib.bench.bench import Bench
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.bench.raw_input import RawInput
from kf_calib.effects import Effect
from kf_calib.effects.inputs import beyond_force_and_temperature, depends_on_temperature, stimulus_of
from kf_calib.effects.stimulus import REFERENCE_TEMPERATURE_C, Stimulus
from kf_calib.errors import InputError, UnobservableError
from kf_calib.estimation.measurement_model import Model
from kf_calib.support.searches import MOST_STEPS

_BLOCK = IN_CACHE // 32  # readings at a time


@dataclass(frozen=True, eq=False)
class Corrected:
    """Corrected readings, and how far they may be wrong.

    - force_mps2 (n, 3): specific force in the frame of the block; NaN where a reading is not finite, or none of any
      specific force.
    - sigma_mps2 (n, 3): by the calibration alone; it is common to all readings, so a mean has it, too.
    - noise_mps2 (3,): of a single reading on the bench, in the same frame; a mean of many readings has less.
    - left_out: effects of the model that are not corrected, and why.
    """

    force_mps2: Floats
    sigma_mps2: Floats
    noise_mps2: Floats
    left_out: Mapping[str, str]


@dataclass(frozen=True, eq=False)
class Correction:
    """The inverse of the measurement model; raises UnobservableError if the run did not determine all of it.

    - bench: by which effects know gravity and gimbals, and what the device sends (``input``).
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
        return tuple(str(each) for each in self.effects if depends_on_temperature(each, self.bench))

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
        return self.sigma_of(self.gravities, REFERENCE_TEMPERATURE_C).max(axis=0)

    @property
    def gravities(self) -> Floats:
        """Specific force (26, 3) of the block at rest: on its faces, edges and corners."""
        directions = np.array([each for each in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(each)])
        return self.bench.gravity_mps2 * directions / np.linalg.norm(directions, axis=1, keepdims=True)

    @cached_property
    def matrix(self) -> Floats:
        """S^-1 (3, 3), which turns readings without bias into specific force."""
        return np.asarray(np.linalg.inv(self.sensitivity), float)

    @property
    def input(self) -> RawInput:
        """What the device sends, which is what ``__call__`` takes."""
        return self.bench.input

    def __call__(self, raw: Floats, temperature_c: Floats | float | None = None) -> Floats:
        """Specific force (n, 3) in the frame of the block, m/s^2, from raw readings (n, 3) as the device sends them
        (``input``) and temperatures (n,), degC.

        Raises InputError if an effect needs the temperature and there is none.
        """
        return self.of_readings(self.input.readings(self._three_columns(raw, self.input.unit_words)), temperature_c)

    def of_readings(self, readings_mps2: Floats, temperature_c: Floats | float | None = None) -> Floats:
        """The same from readings (n, 3) of accelerometers 1, 2, 3 in m/s^2, such as a recording holds."""
        readings = self._three_columns(readings_mps2, "m/s^2")
        temperature = self._temperature(temperature_c, len(readings))
        force_mps2 = np.empty_like(readings)
        for first in range(0, len(readings), _BLOCK):
            part = slice(first, first + _BLOCK)
            force_mps2[part] = self._corrected(readings[part], temperature[part])
        return force_mps2

    def _three_columns(self, values: object, unit: str) -> Floats:
        """Return readings as (n, 3)."""
        readings = _numbers("readings", values)
        if readings.shape == (3,):
            readings = readings[None]
        if readings.ndim != 2 or readings.shape[1] != 3:
            raise InputError(f"readings have the shape {readings.shape}: give (n, 3), in {unit}.")
        return readings

    def _temperature(self, temperature_c: Floats | float | None, count: int) -> Floats:
        """Return temperatures (n,); the reference where none is needed."""
        if temperature_c is None and self.needs_temperature:
            raise InputError(
                f"{', '.join(self.needs_temperature)} cannot be corrected without the temperature: give one for each "
                "reading, degC."
            )
        if temperature_c is None or not self.needs_temperature:
            return np.full(count, REFERENCE_TEMPERATURE_C)
        given = _numbers("temperatures", temperature_c)
        if given.shape not in ((), (1,), (count,)):
            raise InputError(f"{count} readings have temperatures of the shape {given.shape}: give ({count},), degC.")
        return np.broadcast_to(given, (count,))

    def _corrected(self, readings: Floats, temperature_c: Floats) -> Floats:
        """Return the specific force of one block of readings; NaN where there is none that gives such a reading."""
        start = (readings - self.bias_mps2) @ self.matrix.T
        if not self.effects:
            return start
        good = np.isfinite(start).all(axis=1) & np.isfinite(temperature_c)
        if good.all():
            return self._without_effects(start, temperature_c)[0]
        out = np.full_like(start, np.nan)
        out[good] = self._without_effects(start[good], temperature_c[good])[0]
        return out

    def rounds(self, readings_mps2: Floats, temperature_c: Floats) -> int:
        """How many rounds of the iteration these readings (n, 3) need, all of which are finite."""
        start = (readings_mps2 - self.bias_mps2) @ self.matrix.T
        return self._without_effects(start, temperature_c)[1] if self.effects else 0

    def _without_effects(self, start: Floats, temperature_c: Floats) -> tuple[Floats, int]:
        """Return f = start - S^-1 e(f, T), by iteration from ``start``, NaN where it does not converge; and how many
        rounds it took.

        A step is as much smaller than the one before as the error that it leaves is smaller than itself.
        """
        tolerance, inverse = EXACT * self.bench.gravity_mps2, self.matrix.T
        at_rest = stimulus_of(start, temperature_c, self.bench, self.sensitivity)
        force, change, size = start, np.full_like(start, np.inf), np.abs(start).max(initial=tolerance)
        with np.errstate(over="ignore", invalid="ignore"):  # where it diverges
            for number in range(MOST_STEPS):
                stimulus = replace(at_rest, force_mps2=force, previous_force_mps2=force)
                now = start - self._added(stimulus) @ inverse
                change = np.abs(now - force)
                step = change.max(initial=0.0)
                if step * min(step / size, 1.0) <= tolerance:
                    return now, number + 1
                force, size = now, step
            force[~(change <= tolerance).all(axis=1)] = np.nan
        return force, MOST_STEPS

    def _added(self, stimulus: Stimulus) -> Floats:
        """Return what the effects add to the readings (n, 3)."""
        added_mps2 = np.zeros_like(stimulus.force_mps2)
        for effect in self.effects:
            part = self._part(effect)
            added_mps2 += effect.added(stimulus, self.state[part.start : part.start + len(effect.coefficients)])
        return added_mps2

    def corrected(self, raw: Floats, temperature_c: Floats | float | None = None) -> Corrected:
        """As ``__call__``, with the uncertainty of each corrected reading."""
        force = self(raw, temperature_c)
        noise = self.matrix @ np.diag(self.noise_mps2**2) @ self.matrix.T
        return Corrected(force, self.sigma_of(force, temperature_c), np.sqrt(np.diag(noise)), self.left_out)

    def predicted(self, force_mps2: Floats, temperature_c: Floats | float | None = None) -> Floats:
        """Readings (n, 3), m/s^2, of this specific force (n, 3): what ``of_readings`` inverts."""
        temperature = self._temperature(temperature_c, len(force_mps2))
        stimulus = stimulus_of(force_mps2, temperature, self.bench, self.sensitivity)
        return force_mps2 @ self.sensitivity.T + self.bias_mps2 + self._added(stimulus)

    def covariance_of(
        self, force_mps2: Floats, temperature_c: Floats | float | None = None, noise: bool = False
    ) -> Floats:
        """Covariance (n, 3, 3) of corrected specific force (n, 3), m^2/s^4, by the uncertainty of the calibration.

        noise: with that of a single reading. NaN where specific force or temperature is not finite.
        """
        force = np.atleast_2d(np.asarray(force_mps2, float))
        temperature = self._temperature(temperature_c, len(force))
        covariances = np.full((len(force), 3, 3), np.nan)
        good = np.flatnonzero(np.isfinite(force).all(axis=1) & np.isfinite(temperature))
        for first in range(0, len(good), _BLOCK):
            part = good[first : first + _BLOCK]
            stimulus = stimulus_of(force[part], temperature[part], self.bench, self.sensitivity)
            design = self.matrix @ Model(self.bench, self.effects).columns(stimulus, self.state[self._kept])
            covariances[part] = design @ self._covariance @ np.swapaxes(design, 1, 2)
        return covariances + self.matrix @ np.diag(self.noise_mps2**2) @ self.matrix.T if noise else covariances

    @cached_property
    def _kept(self) -> list[int]:
        """Which states are corrected."""
        own = (range(*self._part(effect).indices(len(self.state))) for effect in self.effects)
        return [*range(STATE_COUNT), *itertools.chain(*own)]

    @cached_property
    def _covariance(self) -> Floats:
        """Their covariance."""
        return self.covariance[np.ix_(self._kept, self._kept)]

    def _part(self, effect: Effect) -> slice:
        return self.model.parts[str(effect)]

    def sigma_of(self, force_mps2: Floats, temperature_c: Floats | float | None = None, noise: bool = False) -> Floats:
        """Sigma (n, 3) of each component of corrected specific force (n, 3), m/s^2; as ``covariance_of``."""
        return np.sqrt(np.einsum("nii->ni", self.covariance_of(force_mps2, temperature_c, noise)))


def _numbers(what: str, values: object) -> Floats:
    """Return values as an array of numbers."""
    try:
        return np.asarray(values, float)
    except (TypeError, ValueError):
        raise InputError(f"{what} are no array of numbers: give one.") from None
