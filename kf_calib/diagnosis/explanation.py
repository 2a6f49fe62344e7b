"""What more in the model explains of the residuals of a run: what it predicts of them, and what it leaves.

The shape of each of its effects is a partial-residual plot: what the fitted effect adds to each dwell, with the
residuals that are left put back on it, over the regressor of the effect (``effects.axis``). An error of a gimbal's
angle is drawn as the turn of the platform about that gimbal, which the three readings of a dwell show together.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.residual_drivers import Driver, is_function_of, misfit_beyond_noise, unexplained_mps2, walk_path
from kf_calib.diagnosis.unknown_effect import explained_share
from kf_calib.effects import Effect, RotationEffect, Stimulus
from kf_calib.effects.inputs import axis_of, is_formula, turned_gimbal
from kf_calib.effects.stimulus import smooth_between
from kf_calib.estimation.residual_table import mean_sigmas, means_over_dwells
from kf_calib.estimation.results import Calibration

ACCELEROMETERS = "accelerometer 1", "accelerometer 2", "accelerometer 3"
_LEAST_LEVER = 0.05  # of gravity: a dwell that shows a turn with 20 times the sigma of others is left out


@dataclass(frozen=True, eq=False, kw_only=True)
class EffectShape:
    """What an effect adds to the mean of each of D dwells, and what the readings show of it.

    - effect: its name.
    - words, symbol, unit: the quantity that it is drawn over: in words, in the letters of formulas ("": none), SI unit.
    - values (D, C): that quantity.
    - quantity: SI unit of all that follows: m/s^2 of C = 3 accelerometers, or rad of the C = 1 turn of the platform,
      which is NaN in dwells that do not show it.
    - residuals: what the model without the effect leaves. left: what the model with it leaves.
    - component: what the fitted effect adds, about its mean where that is larger than all changes. component_sigma: of
      the component; of readings, less its mean over the dwells, as the biases take up any mean.
    - sigma: of a dwell, as the misfit is judged. bars: of noise alone, and with the scatter that the fit estimates.
    - is_curve: whether the component is nearly a function of the quantity.
    - gimbal: number, from 1, of the one about which the platform turns; 0 for readings of accelerometers.
    """

    effect: str
    words: str
    symbol: str
    unit: str
    values: Floats
    quantity: str
    residuals: Floats
    left: Floats
    component: Floats
    component_sigma: Floats
    sigma: Floats
    bars: tuple[Floats, ...]
    is_curve: bool
    gimbal: int = 0

    @property
    def readings(self) -> Floats:
        """What the readings show of the effect (D, C): the component with what is left."""
        return self.component + self.left

    @property
    def channels(self) -> tuple[str, ...]:
        """What each of the C columns is of."""
        return (f"turn about gimbal {self.gimbal}",) if self.gimbal else ACCELEROMETERS

    def curve(self, column: int, count: int = 200) -> tuple[Floats, Floats, Floats]:
        """Values (n,) of the quantity that rise, and the component and its sigma there, smooth between the dwells."""
        known = np.isfinite(self.component[:, column])
        x, first = np.unique(self.values[known, column], return_index=True)
        at = np.linspace(x[0], x[-1], count) if len(x) else x
        middle, sigma = (each[known, column][first] for each in (self.component, self.component_sigma))
        return at, smooth_between(x, middle, at), smooth_between(x, sigma, at)

    @property
    def clearest(self) -> int:
        """The column in which the component stands out most from the sigma of the dwells."""
        spread = self.component - np.nanmean(self.component, axis=0)
        return int(np.argmax(np.nansum((spread / self.sigma) ** 2, axis=0)))


def shapes_of(before: Calibration, after: Calibration) -> list[EffectShape]:
    """The shapes of the effects that a calibration has beyond another and dwells show, in the order of its model;
    formulas beside each other have one."""
    added = [effect for effect in after.model.effects if not (str(effect) in before.model.parts or effect.dynamic)]
    return [_shape(before, after, list(group)) for _, group in itertools.groupby(added, _drawn_together)]


def _drawn_together(effect: Effect) -> tuple[str, int | None]:
    """Return what effects that are next to each other have in common if they are drawn as one."""
    gimbal = effect.gimbal if isinstance(effect, RotationEffect) else None
    return (type(effect).__name__ if is_formula(effect) else str(effect)), gimbal


def _shape(before: Calibration, after: Calibration, effects: Sequence[Effect]) -> EffectShape:
    (component, component_sigma), left = _component(after, effects), unexplained_mps2(after)
    component = component - _constant(component)
    residuals, quantity, sigmas = before.residuals_mps2, "m/s^2", (mean_sigmas(before), *bars_of(after))
    axis = axis_of(effects, before.bench)
    gimbal = turned_gimbal(effects) if axis else 0
    if axis and (gimbal or not _framed(effects)):
        (values,) = means_over_dwells(after, [axis.of])
        words, symbol, unit = axis.words, axis.symbol, axis.unit
    elif _framed(effects):  # reading i changes by |s_i| g times the turn of gravity towards its input axis
        words, symbol, unit = "turn of gravity towards the input axis", "", "rad"
        values = component / (np.linalg.norm(after.linearised.state[:12].reshape(3, 4)[:, :3], axis=1)
                              * before.bench.gravity_mps2)  # fmt: skip
    else:
        words, symbol, unit, values = "what the fit of it adds", "", "m/s^2", component
    if gimbal and isinstance(effects[0], RotationEffect):
        lever, quantity, values = _lever(after, effects[0].about), "rad", values[:, :1]
        component, residuals, left = (_turn(each, lever, sigmas[0]) for each in (component, residuals, left))
        lengths = np.linalg.norm(lever, axis=1, keepdims=True)
        component_sigma = np.linalg.norm(component_sigma, axis=1, keepdims=True) / lengths
        sigmas = tuple(np.sum((lever / sigma) ** 2, axis=1, keepdims=True) ** -0.5 for sigma in sigmas)
    return EffectShape(
        effect=_name(effects), words=words, symbol=symbol, unit=unit, values=values, quantity=quantity,
        residuals=residuals, left=left, component=component, component_sigma=component_sigma,
        is_curve=is_function_of(component, values, unit) or any(effect.walks for effect in effects),
        sigma=sigmas[0], bars=sigmas[1:], gimbal=gimbal,
    )  # fmt: skip


def bars_of(result: Calibration) -> tuple[Floats, Floats]:
    """Sigmas (D, 3) of the means of dwells: of noise alone, and with the scatter and setting error of its estimate."""
    return mean_sigmas(result, result.noise.without_estimates()), mean_sigmas(result, result.noise)


def _framed(effects: Sequence[Effect]) -> bool:
    return all(isinstance(effect, RotationEffect) for effect in effects)


def _name(effects: Sequence[Effect]) -> str:
    """Return the effects as a sum, formulas without the names that they were given."""
    return " + ".join(effect.title if is_formula(effect) else str(effect) for effect in effects)


def _constant(component: Floats) -> Floats:
    """Return the mean (3,) of what an effect adds where all that it changes is less than what it always adds, as of a
    decay far longer than the run: the biases take that up; zeros elsewhere."""
    far = np.abs(component).min(axis=0) > np.ptp(component, axis=0)
    return np.where(far, component.mean(axis=0), 0.0)


def _component(after: Calibration, effects: Sequence[Effect]) -> tuple[Floats, Floats]:
    """Return what effects add to the mean readings (D, 3), the path of the biases where one lets them walk, and its
    sigma from the covariance of the coefficients."""
    parts = [after.model.parts[str(effect)] for effect in effects]
    columns = np.array([column for part in parts for column in range(part.start, part.stop)], int)
    design, covariance = after.linearised.means.design[:, :, columns], after.estimate.covariance
    added = design @ after.estimate.state[columns]
    if not _framed(effects):
        design = design - design.mean(axis=0)
    sigma = np.sqrt(np.einsum("dip,pq,diq->di", design, covariance[np.ix_(columns, columns)], design))
    return added + (walk_path(after) if any(effect.walks for effect in effects) else 0.0), sigma


def _lever(after: Calibration, about: Callable[[Stimulus], Floats]) -> Floats:
    """Return the change (D, 3) of each mean reading per unit of a turn about an axis, m/s^2; NaN where it is little."""
    (lever,) = means_over_dwells(after, [lambda s: np.cross(about(s), s.force_mps2) @ s.sensitivity.T])
    little = np.linalg.norm(lever, axis=1) < _LEAST_LEVER * after.bench.gravity_mps2
    return np.where(little[:, None], np.nan, lever)


def _turn(values_mps2: Floats, lever: Floats, sigma: Floats) -> Floats:
    """Return the turn (D, 1) that changes of the readings (D, 3) amount to, by weighted least squares."""
    weights = lever / sigma**2
    return np.sum(weights * values_mps2, axis=1, keepdims=True) / np.sum(weights * lever, axis=1, keepdims=True)


@dataclass(frozen=True, eq=False)
class Explanation:
    """A model with more in it than the one whose residuals are looked at.

    names: what it has in addition, formulas without the name that they were given. before, after: the two
    calibrations. p_value: the family-wise p-value of a single effect of the catalogue; None of anything else.
    """

    names: tuple[str, ...]
    before: Calibration
    after: Calibration
    p_value: float | None = None

    @property
    def fits(self) -> bool:
        """Whether it fits the run, as far as that can be tested."""
        return self.after.consistency.consistent is not False

    @property
    def name(self) -> str:
        """The effects, as a sum."""
        return " + ".join(self.names)

    @property
    def share(self) -> float | None:
        """Part of the misfit beyond noise that it explains, 0 to 1: the decrease of chi-squared from refit to refit,
        less the degrees of freedom that it takes; None if the means of the dwells agree without it."""
        before, after = self.before.consistency, self.after.consistency
        return explained_share(before, after) if misfit_beyond_noise(self.before) > 0.0 else None

    @cached_property
    def shapes(self) -> list[EffectShape]:
        """What the readings show of each of its effects, over the quantity that the effect goes with."""
        return shapes_of(self.before, self.after)

    def over(self, driver: Driver) -> EffectShape:
        """The same of all its effects together, over a quantity of the bench."""
        before = self.before
        added = [each for each in self.after.model.effects if str(each) not in before.model.parts]
        component, component_sigma = _component(self.after, added)
        return EffectShape(
            effect=self.name, words=driver.words, symbol=driver.symbol, unit=driver.unit, values=driver.values,
            quantity="m/s^2", residuals=before.residuals_mps2, left=self.unexplained_mps2, component=component,
            component_sigma=component_sigma, is_curve=is_function_of(component, driver.values, driver.unit),
            sigma=mean_sigmas(before), bars=bars_of(self.after),
        )  # fmt: skip

    @cached_property
    def unexplained_mps2(self) -> Floats:
        """What it leaves of the residuals (D, 3)."""
        return unexplained_mps2(self.after)

    @cached_property
    def unexplained_ratios(self) -> Floats:
        """The same over the sigma of the means."""
        return self.unexplained_mps2 / mean_sigmas(self.before)
