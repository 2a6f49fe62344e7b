"""What the residuals of a run go with, and what an explanation predicts of them.

A driver is a quantity of the bench, such as a gimbal angle, the temperature, or the last step of the specific force.
Smooth functions of each driver are tested together, projected off the model as effects are; the share of the misfit
that they explain orders the drivers. An explanation is a model with more in it: what it predicts of the residuals is
the difference between the two models' predictions.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.refits import Refits
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.effects.formula import formula, quantities
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.noise_model import mean_covariances
from kf_calib.estimation.residual_table import mean_sigmas, quantity_means
from kf_calib.estimation.results import Calibration, consistency
from kf_calib.estimation.score_test import Frame
from kf_calib.support.tail_probabilities import chi_squared_tail

_OF_FORCE = ("{0}*{0}", "{0}**3", "{0}**4")
_OF_STEP = ("{0}", "{0}*abs({0})", "sign({0})")
_OF_ANGLE = tuple(f"{wave}({turns}*{{0}})" for turns in (1, 2, 3) for wave in ("sin", "cos"))
_OF_TIME = ("{0}", "{0}*{0}", "{0}**3")
_FUNCTIONS = {"a": _OF_FORCE, "p": _OF_FORCE, "o": _OF_FORCE, "da": _OF_STEP, "t": _OF_TIME, "T": _OF_TIME,
              "dT": ("{0}", "{0}*{0}"), "tau": ("{0}",)}  # fmt: skip
_WORDS = {"a": "force along the input axis", "p": "force along the pendulous axis",
          "o": "force along the output axis", "da": "last step along the input axis",
          "T": "temperature less 25 °C", "dT": "rate of the temperature", "t": "time",
          "tau": "time since the arrival"}  # fmt: skip
_NEARLY = 0.2
"""What may be left, of the standard deviation, of values that are said to be a function of a driver."""

_CONSTANT = 1e-6
"""A quantity that varies by less than this share of its size, or of a typical size, drives nothing."""


@dataclass(frozen=True)
class Driver:
    """A quantity of the bench against which residuals are drawn.

    symbol: its name in formulas. words: what it is. unit: its SI unit. values (D, 3): its mean over each dwell, for
    each accelerometer. fall, dof: decrease of chi-squared by smooth functions of it, and their degrees of freedom.
    share: part of the misfit beyond noise that they explain, 0 to 1; 0 if the model fits.
    """

    symbol: str
    words: str
    unit: str
    values: Floats
    fall: float
    dof: int
    share: float

    @property
    def p_value(self) -> float:
        """The chance that functions of this quantity explain so much by noise alone."""
        return chi_squared_tail(self.dof, self.fall) if self.dof else 1.0


def drivers_of(result: Calibration) -> list[Driver]:
    """The quantities that vary in a run, those that explain most of the misfit first."""
    fitted, known = result.fit, quantities(result.bench.axes)
    gimbals = range(1, len(result.bench.axes) + 1)
    functions = _FUNCTIONS | {f"q{k}": _OF_ANGLE for k in gimbals}
    words = _WORDS | {f"q{k}": f"angle of gimbal {k}" for k in gimbals}
    values = {name: each for name, each in quantity_means(result, list(functions)).items() if _varies(each)}
    falls = _falls(fitted, {name: [text.format(name) for text in functions[name]] for name in values})
    misfit = consistency(fitted)
    excess = misfit.statistic - misfit.dof if misfit.consistent is False else 0.0
    found = [
        Driver(name, words[name], known[name].unit, each, *falls[name], _share(*falls[name], excess))
        for name, each in values.items()
    ]
    return sorted(found, key=lambda each: (-each.share, each.p_value))


def _varies(values: Floats) -> bool:
    """Tell whether a quantity (D, 3) takes different values in different dwells."""
    return bool(np.ptp(values, axis=0).max() > _CONSTANT * max(np.abs(values).max(), 1e-3))


def _share(fall: float, dof: int, excess: float) -> float:
    """Return the part of the misfit beyond noise that a fall of chi-squared beyond its degrees of freedom explains."""
    return float(np.clip((fall - dof) / excess, 0.0, 1.0)) if excess > 0.0 else 0.0


def _falls(fitted: Fit, texts: dict[str, list[str]]) -> dict[str, tuple[float, int]]:
    """Return for each driver the decrease of chi-squared by all its functions together, and their rank."""
    bench = fitted.carried.model.bench
    effects = {
        name: [formula(f"drv{k} = {text}", bench.axes, bench.gravity_mps2, checked=False)
               for k, text in enumerate(own)] for name, own in texts.items()
    }  # fmt: skip
    frame = Frame(fitted.carried, fitted.noise.judging, [])
    scanned = frame.scan(fitted.carried, [effect for own in effects.values() for effect in own])
    left, out = iter(scanned.candidates), dict[str, tuple[float, int]]()
    for name, own in effects.items():
        out[name] = scanned.explained(np.concatenate([next(left).basis for _ in own], axis=1))
    return out


def is_function_of(values: Floats, driver: Driver) -> bool:
    """Tell whether values (D, 3) are, for each accelerometer, nearly a smooth function of a driver, or a step at 0."""
    for x, y in zip(driver.values.T, values.T, strict=True):
        angle = driver.unit == "rad"
        columns = [np.ones_like(x)]
        if angle:
            columns += [wave(turns * x) for turns in (1, 2, 3, 4) for wave in (np.sin, np.cos)]
        else:
            unit = x / max(np.abs(x).max(), 1e-300)
            columns += [np.sign(x), np.abs(unit), *(unit**power for power in (1, 2, 3, 4))]
        basis, spread = np.column_stack(columns), float(np.ptp(y))
        if len(x) <= basis.shape[1] + 2:
            return False
        left = y - basis @ np.linalg.lstsq(basis, y, rcond=None)[0]
        if spread > 0.0 and left.std() > _NEARLY * y.std():
            return False
    return True


@dataclass(frozen=True, eq=False)
class Explanation:
    """A model with more in it than the one whose residuals are looked at.

    names: what it has in addition. before, after: the two calibrations. fits: whether it fits the run.
    """

    names: tuple[str, ...]
    before: Calibration
    after: Calibration
    fits: bool

    @property
    def name(self) -> str:
        """The effects, as a sum."""
        return " + ".join(self.names)

    @cached_property
    def left_mps2(self) -> Floats:
        """What it leaves of the residuals (D, 3)."""
        return self.after.residuals_mps2 - _walk_path(self.after)

    @cached_property
    def left_ratios(self) -> Floats:
        """The same over the sigma of the means."""
        return self.left_mps2 / mean_sigmas(self.before)

    @cached_property
    def predicted_mps2(self) -> Floats:
        """What it predicts of the residuals (D, 3): the difference of the two models' predictions."""
        return self.before.residuals_mps2 - self.left_mps2

    @cached_property
    def contribution_mps2(self) -> Floats:
        """What its effects add to the mean readings (D, 3), before the other parameters take up a part of it."""
        own = self._own
        added = np.einsum("dip,p->di", self.after.carried.means.design[:, :, own], self.after.estimate.state[own])
        return added + _walk_path(self.after)

    @cached_property
    def contribution_sigma_mps2(self) -> Floats:
        """Sigma (D, 3) of the contribution, from the covariance of its coefficients."""
        own = self._own
        design, covariance = self.after.carried.means.design[:, :, own], self.after.estimate.covariance
        return np.sqrt(np.einsum("dip,pq,diq->di", design, covariance[np.ix_(own, own)], design))

    @cached_property
    def _own(self) -> NDArray[np.intp]:
        """Return the places of its coefficients in the state."""
        return np.array([p for name in self.names for p in _places(self.after, name)], int)

    @cached_property
    def predicted_sigma_mps2(self) -> Floats:
        """Sigma (D, 3) of what it predicts: that of its coefficients, seen through the model that had none of them.

        With the design H of the model before, the columns G of the additional effects, and the weight W of the means,
        G is projected, M = G - H (H^T W H)^-1 H^T W G, and the covariance of M c is M C M^T.
        """
        own = self._own
        means, design = self.after.carried.means, self.after.carried.means.design
        if not len(own):
            return np.zeros((len(design), 3))
        spread = mean_covariances(self.after.noise.judging, means, self.after.carried.state)
        lower = np.linalg.inv(np.linalg.cholesky(spread))
        kept = np.setdiff1d(np.arange(design.shape[2]), own)
        rows = (lower @ design).reshape(-1, design.shape[2])
        found = np.linalg.lstsq(rows[:, kept], rows[:, own], rcond=None)[0]
        left = design[:, :, own] - design[:, :, kept] @ found
        covariance = self.after.estimate.covariance[np.ix_(own, own)]
        return np.sqrt(np.maximum(np.einsum("dip,pq,diq->di", left, covariance, left), 0.0))


def _walk_path(result: Calibration) -> Floats:
    """Return the path of the biases (D, 3), less where it ends, m/s^2; zeros if they do not walk.

    The best linear prediction K (K + R)^-1 r from the residuals r by the final state, where K = q^2 min(T - s, T - t)
    is the covariance of a random walk that is known at its end T, and R that of the means.
    """
    intensity, means = result.noise.walk_mps2_per_sqrt_s, result.carried.means
    if not intensity:
        return np.zeros_like(result.residuals_mps2)
    before_end_s = means.ends_s[-1, 1] - means.ends_s.mean(axis=1)
    covariance = intensity**2 * np.minimum.outer(before_end_s, before_end_s)
    path = [covariance @ np.linalg.solve(covariance + np.diag(sigma**2), residual)
            for sigma, residual in zip(mean_sigmas(result).T, result.residuals_mps2.T, strict=True)]  # fmt: skip
    return np.array(path).T


def _places(result: Calibration, name: str) -> list[int]:
    """Return the places of an effect's coefficients in the state; none for a walk, whose path is no coefficient."""
    part = result.model.parts.get(name.partition("=")[0].strip())
    return list(range(*part.indices(result.model.count))) if part is not None else []


def explanations(found: Diagnosis, refits: Refits | None = None) -> list[Explanation]:
    """The explanations of a diagnosis, the best first: what is missing, or the formula that describes an unknown
    misfit; then the other suspects.

    refits: of the run, if there are any.
    """
    out = list[Explanation]()
    if found.missing and found.after is not None:
        out.append(Explanation(found.missing, found.before, found.after, True))
    elif found.description is not None:
        formulas = found.description.formulas
        names = tuple(text.partition("=")[2].strip() or text for text in formulas)
        out.append(Explanation(names, found.before, (refits or Refits()).with_effects(found.before, formulas), False))
    rest = [each for each in found.suspects if (each.name,) != found.missing]
    rest.sort(key=lambda each: not each.fits)  # stable: those that fit, by significance, before those that do not
    return [*out, *(Explanation((each.name,), found.before, each.refit, each.fits) for each in rest)]
