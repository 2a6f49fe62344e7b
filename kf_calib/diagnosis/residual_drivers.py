"""What the residuals of a run go with.

A driver is a quantity of the bench, such as a gimbal angle, the temperature, or the last step of the specific force.
Smooth functions of each driver are tested together, projected off the model as effects are; the share of the misfit
that they explain orders the drivers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import ROUNDING, Floats, one_blas_thread, sign
from kf_calib.effects.formula import formula, quantities
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.residual_table import mean_sigmas, quantity_means
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.score_test import joint_delta_chi2
from kf_calib.noise.random_walk import known_at_end
from kf_calib.support.tail_probabilities import f_tail

_OF_FORCE = ("{0}*{0}", "{0}**3", "{0}**4")
_OF_STEP = ("{0}", "{0}*abs({0})", "tanh({0}/(0.01*m/s**2))")  # the last is a sign, but for small steps
_WAVES = tuple(f"{wave}({turns}*{{0}})" for turns in (1, 2, 3) for wave in ("sin", "cos"))
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
    each accelerometer. delta_chi2, dof: decrease of chi-squared by smooth functions of it, and their degrees of
    freedom. share: part of the misfit beyond noise that they explain beyond what as many arbitrary functions would, 0
    to 1; 0 if the model fits. p_value: the chance that as many arbitrary functions explain as much of this misfit.
    """

    symbol: str
    words: str
    unit: str
    values: Floats
    delta_chi2: float
    dof: int
    share: float
    p_value: float


def drivers_of(result: Calibration) -> list[Driver]:
    """The quantities that vary in a run, those that explain most of the misfit first."""
    gimbals = range(1, len(result.bench.axes) + 1)
    functions = _FUNCTIONS | {f"q{k}": _WAVES for k in gimbals}
    words = _WORDS | {f"q{k}": f"angle of gimbal {k}" for k in gimbals}
    values = {name: means for name, means in quantity_means(result, list(functions)).items() if _varies(means)}
    gains = _delta_chi2(result.fit, {name: _formulas(name, functions[name]) for name in values})
    units = {name: quantity.unit for name, quantity in quantities(result.bench.axes).items()}
    drivers = [
        Driver(name, words[name], units[name], means, *gains[name], *_beyond_chance(*gains[name], result))
        for name, means in values.items()
    ]
    return sorted(drivers, key=lambda each: (-each.share, each.p_value))


def _varies(values: Floats) -> bool:
    """Tell whether a quantity (D, 3) takes different values in different dwells."""
    return bool(np.ptp(values, axis=0).max() > _CONSTANT * max(np.abs(values).max(), 1e-3))


def misfit_beyond_noise(result: Calibration) -> float:
    """What chi-squared has more than its degrees of freedom; 0 if the model agrees with the run."""
    misfit = result.consistency
    return misfit.statistic - misfit.dof if misfit.consistent is False else 0.0


def _beyond_chance(delta_chi2: float, dof: int, result: Calibration) -> tuple[float, float]:
    """Return the share of a driver and its p-value.

    Of a misfit of n degrees of freedom, any k functions explain k / n on average, however large the misfit is. So chi-
    squared per degree of freedom with the functions is compared with that without them (as R-squared is adjusted), and
    their decrease per function with what they leave per degree of freedom (the F-test), which is noise at least.
    """
    misfit = result.consistency
    rest = misfit.dof - dof
    if not dof or rest <= 0:
        return 0.0, 1.0
    unexplained = max(misfit.statistic - delta_chi2, 0.0) / rest
    p_value = f_tail(dof, rest, delta_chi2 / dof / max(unexplained, 1.0))
    excess = misfit_beyond_noise(result) / misfit.dof
    return (float(np.clip(1.0 - (unexplained - 1.0) / excess, 0.0, 1.0)) if excess > 0.0 else 0.0), p_value


def _formulas(symbol: str, functions: Sequence[str]) -> list[str]:
    """Return what is added to readings in proportion to functions of a quantity; with a gimbal's angle, that gimbal
    may also turn by such functions, as by errors of its encoder, and the waves of readings are those of one turn."""
    texts = [text.format(symbol) for text in functions]
    if not symbol.startswith("q"):
        return [f"drv{k} = {text}" for k, text in enumerate(texts)]
    return [*(f"drv{k}:{symbol[1:]} = {text}" for k, text in enumerate(texts)),
            *(f"drr{k} = {text}" for k, text in enumerate(texts[:2]))]  # fmt: skip


def _delta_chi2(fitted: Fit, texts: dict[str, list[str]]) -> dict[str, tuple[float, int]]:
    """Return for each driver the decrease of chi-squared by all its functions together, and their rank."""
    bench = fitted.linearised.model.bench
    groups = [
        [formula(text, bench.axes, bench.gravity_mps2, checked=False) for text in of_driver]
        for of_driver in texts.values()
    ]
    with one_blas_thread():
        gains = joint_delta_chi2(fitted.linearised, fitted.noise.for_goodness_of_fit, groups)
    return dict(zip(texts, gains, strict=True))


def is_function_of(values: Floats, quantity: Floats, unit: str) -> bool:
    """Tell whether values (D, C) are, in each column, nearly a smooth function of a quantity (D, C), or a step at 0.

    unit: SI unit of the quantity; an angle goes round.
    """
    return all(_is_function(x, y, unit == "rad") for x, y in zip(quantity.T, values.T, strict=True))


def _is_function(x: Floats, y: Floats, of_an_angle: bool) -> bool:
    """The same of one column (D,); instants where it is not known do not count."""
    known = np.isfinite(x) & np.isfinite(y)
    x, y = x[known], y[known]
    unit = x / max(np.abs(x).max(initial=0.0), 1e-300)
    columns = [np.ones_like(x), x, sign(unit, ROUNDING)]  # a mean over a dwell holds rounding, which has a sign
    if of_an_angle:
        columns += [wave(turns * x) for turns in (1, 2, 3, 4) for wave in (np.sin, np.cos)]
    else:
        columns += [np.abs(unit), *(unit**power for power in (2, 3, 4))]
    basis = np.column_stack(columns)
    if len(x) <= basis.shape[1] + 2:
        return False
    residuals = y - basis @ np.linalg.lstsq(basis, y, rcond=None)[0]
    return not (np.ptp(y) > 0.0 and residuals.std() > _NEARLY * y.std())


def unexplained_mps2(result: Calibration) -> Floats:
    """Residuals (D, 3) less the path of the biases where these walk, m/s^2."""
    return result.residuals_mps2 - walk_path(result)


def walk_path(result: Calibration) -> Floats:
    """The path of the biases (D, 3), less where it ends, m/s^2; zeros if they do not walk.

    The best linear prediction K (K + R)^-1 r from the residuals r by the final state, where K = q^2 min(T - s, T - t)
    is the covariance of a random walk that is known at its end T, and R that of the means.
    """
    if not result.noise.walk.steps:
        return np.zeros_like(result.residuals_mps2)
    by_time, path = known_at_end(result.linearised.means.ends_s), np.zeros_like(result.residuals_mps2)
    for i, (q, sigma) in enumerate(zip(result.noise.walk_mps2_per_sqrt_s, mean_sigmas(result).T, strict=True)):
        covariance = q**2 * by_time
        path[:, i] = covariance @ np.linalg.solve(covariance + np.diag(sigma**2), result.residuals_mps2[:, i])
    return path
