"""The sizes of an effect's coefficients: the prior of those that are usual, and the smallest that a run would show.

The coefficients c of one effect are normal with a common standard deviation s, and log s is uniform over the sizes that
such coefficients usually have in sensors of the grade at hand (``Effect.typical``), with tails on both sides: the
density falls by a factor e for each decade beyond. The prior is proper, and says what physics says: an effect that
would have a size that it never has is an unlikely name, however well its columns fit. An effect that is too small to be
seen is none: sizes below one sigma count as its absence. A coefficient whose value is known, as the rate of the Earth
is, is normal about that value. Where no usual size is known, as of formulas, every size from 1 to 1e7 sigma is equally
likely, in common for all such effects of an explanation.

The smallest size at which an effect would be found is computed from its columns alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.candidate_tests import CandidateTests
from kf_calib.effects import Coefficient, Effect, RotationEffect, Stimulus
from kf_calib.effects.effect import Grade, Typical
from kf_calib.estimation.dwell_columns import stimulus_of
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.measurement_model import effect_columns

_TAIL = 1.0  # decades beyond the usual sizes in which the density falls by a factor e
_SHARPER = 100.0  # where only the greatest usual size is known, the least one is smaller by this factor

QUIET = 1e-4
"""Density of white noise below which sensors are of navigation grade, m/s^2/sqrt(Hz) (10 ug/sqrt(Hz))."""
_CONDITIONS = {
    "temperature_c": "the temperature does not change in this run, or is not recorded",
    "variance_mps2_2": "the strength of vibration does not change in this run, or is not looked at",
}
"""Conditions, other than orientations, that effects may depend on, and what is said where they do not vary."""


@dataclass(frozen=True)
class SizePrior:
    """The prior of the common standard deviation s of some coefficients, in SI.

    low, high: sizes that are usual. tail: decades beyond them in which the density of log s falls by a factor e. value:
    about which the coefficients are normal.
    """

    low: float
    high: float
    tail: float = _TAIL
    value: float = 0.0

    def below(self, sizes: Floats) -> Floats:
        """Probability that s is below each of these sizes."""
        low, high, at = np.log10(self.low), np.log10(self.high), np.log10(sizes)
        before = self.tail * np.exp(np.minimum(at - low, 0.0) / self.tail)
        after = self.tail * -np.expm1(-np.maximum(at - high, 0.0) / self.tail)
        return np.asarray((before + np.clip(at - low, 0.0, high - low) + after) / (high - low + 2.0 * self.tail), float)


def usual_sizes(effect: Effect, grade: Grade) -> SizePrior | None:
    """The prior of an effect from the sizes that its coefficients usually have; None where these are not known."""
    if effect.expected is not None:
        value, spread = effect.expected
        return SizePrior(spread, spread, 0.01, value)
    usual = effect.typical.of(grade)
    return None if usual is None else SizePrior(usual[0] or usual[1] / _SHARPER, usual[1])


def best_sigma(root: Floats) -> float:
    """Sigma of the coefficient that is determined best, from a root (r, q) of the information on them all."""
    return float(1.0 / max(np.linalg.norm(root, axis=0).max(initial=0.0), 1e-100))


@dataclass(frozen=True)
class Detectable:
    """The size of a coefficient at which an effect is found in 90 of 100 runs; of several, that of the least visible.

    name: of the effect. minimum: the size in SI. coefficient: which of them it is the size of. typical: usual sizes of
    such coefficients, in SI.
    """

    name: str
    minimum: float
    coefficient: Coefficient
    typical: Typical

    @property
    def unit(self) -> str:
        """The SI unit of the coefficient."""
        return self.coefficient.unit


@dataclass(frozen=True)
class Unseen:
    """An effect of which a run shows nothing, and why."""

    name: str
    why: str


def detectable(test: CandidateTests) -> list[Detectable]:
    """The smallest detectable size of every visible effect, from its columns and not from the readings."""
    limits = list[Detectable]()
    for name in test.effects.best:
        if name not in test.invisible and (smallest := test.effects.smallest_size(name)) is not None:
            coefficient, minimum = smallest
            limits.append(Detectable(name, minimum, coefficient, test.effects.candidate(name).effect.typical))
    return limits


def unseen(fitted: Fit, test: CandidateTests) -> list[Unseen]:
    """The effects of which a run shows nothing, each with the reason; then frequencies that were not searched."""
    bench, dwells = fitted.linearised.model.bench, fitted.dwells
    stimulus = stimulus_of(dwells, bench, fitted.linearised.state)
    in_dwells = [name for name in test.effects.unseen if name not in test.effects.in_slews_only]
    effects = [Unseen(name, _reason(test.effects.candidate(name).effect, stimulus)) for name in in_dwells]
    effects += [
        Unseen(name, "shows while the platform turns, and only dwells are tested")
        for name in test.effects.in_slews_only
    ]
    if test.lines.untested_band:
        effects.append(Unseen(test.lines.untested_band, "not among the frequencies that are searched in this run"))
    return effects


def _reason(effect: Effect, stimulus: Stimulus) -> str:
    """Return why nothing of an effect is seen in dwells."""
    columns = effect_columns([effect], stimulus)
    if not stimulus.bench.angles and not columns.any() and _needs_angles(effect, stimulus):
        return "depends on how the platform stands, which is not known without angles"
    for quantity, words in _CONDITIONS.items():
        values = np.nan_to_num(getattr(stimulus, quantity))
        ramp = np.arange(len(values), dtype=float).reshape(-1, *[1] * (values.ndim - 1)) / len(values)
        if not np.ptp(values, axis=0).any():
            changed = effect_columns([effect], replace(stimulus, **{quantity: values + ramp}))
            if not np.array_equal(changed, columns):
                return words
    if not columns.any():
        return "adds nothing to a reading in these orientations"
    return effect.degeneracy(stimulus.bench) or "adds to every dwell what the model adds already"


def _needs_angles(effect: Effect, stimulus: Stimulus) -> bool:
    """Tell whether an effect would have columns if some attitude were known."""
    if isinstance(effect, RotationEffect):
        return True
    poses = np.random.default_rng(1).normal(size=stimulus.pose.shape)
    return bool(effect_columns([effect], replace(stimulus, pose=poses, previous_pose=poses)).any())


def sensor_grade(fitted: Fit) -> Grade:
    """The grade of the sensors, by the noise of this run: navigation grade below 10 ug/sqrt(Hz), otherwise MEMS.

    The density of a reading's noise is its effective sigma (as if white) times the square root of the time from one
    reading to the next; that of the quietest accelerometer counts. Quartz-flexure accelerometers have about
    1 ug/sqrt(Hz), consumer chips 100 and more; 10 is half way between in logarithm.
    """
    dwells = fitted.dwells
    readings, lasting_s = sum(dwell.count - 1 for dwell in dwells), sum(d.end_s - d.start_s for d in dwells)
    density = fitted.noise.effective_sigma_mps2 * np.sqrt(lasting_s / max(readings, 1))
    return "navigation" if float(density.min()) < QUIET else "mems"
