"""Tail probabilities of the F and chi-squared distributions, and the p-value of the most significant of many tests.

``scipy.special.fdtrc`` gives the same, but importing it takes longer than evaluating a short recording, and it loses
half of its digits when the denominator has 1e9 degrees of freedom.
"""

from __future__ import annotations

import math
from functools import cache
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

LEVEL = 0.01
"""Probability of a false alarm in one run."""
SHARE = 0.4
"""Share of the false-alarm probability that is given to the test of the misfit, and as much to the scan of effects."""
REST = 0.5 * (1.0 - 2.0 * SHARE)
"""Share that is given to the test of spectral lines, and as much to that of trends within dwells."""

CLEAR = LEVEL**2
"""p-value below which something is told, or given up, that an alarm by chance must not bring with it."""
NO_CHANCE = LEVEL**3
"""p-value of what is no chance, however many runs and dwells there are."""

SIGMAS_95 = NormalDist().inv_cdf(0.975)
"""Within so many sigmas lie 95 % of normal numbers: 1.96; its square, 3.84, is the 95 % point of chi-squared with one
degree of freedom, and the 2.5 % point of the likelihood ratio of a variance against zero, half of it."""
VARIANCE_SEEN = NormalDist().inv_cdf(1.0 - LEVEL) ** 2
"""1 % point of the likelihood ratio of a variance against zero: 5.41."""

_PRECISION = 4e-16
_INFINITE = 1e18  # degrees of freedom of noise that is as good as known


def f_tail(freedom: float, noise_freedom: float, ratio: float) -> float:
    """Probability that F with these degrees of freedom of numerator and denominator exceeds ``ratio``.

    It is the incomplete beta function I_x(a, b) with a, b half of ``noise_freedom`` and ``freedom`` and x = a / (a + b
    ratio), by the continued fraction of DiDonato and Morris (1992), equation 9. The factor before it is written as
    that of Loader (2000), in which nothing large cancels.
    """
    if not 0.0 < ratio < math.inf:
        return 1.0 if ratio <= 0.0 else 0.0 if ratio > 0.0 else math.nan
    a, b = 0.5 * noise_freedom, 0.5 * freedom
    total, beyond = a + b, a + b * ratio
    logarithm = b * math.log(ratio) - total * math.log1p(b * (ratio - 1.0) / total)
    logarithm += _stirling_error(total) - _stirling_error(a) - _stirling_error(b)
    factor = math.sqrt(a * b / (2.0 * math.pi * total)) * math.exp(logarithm)
    distance = a * b * (ratio - 1.0) / beyond
    if factor == 0.0:
        return 0.0 if ratio > 1.0 else 1.0
    if distance > 0.0:
        return factor / _fraction(a, b, a / beyond, distance)
    return 1.0 - factor / _fraction(b, a, b * ratio / beyond, -distance)


def chi_squared_tail(freedom: float, value: float) -> float:
    """Probability that chi-squared with these degrees of freedom exceeds ``value``: F with a known noise."""
    return f_tail(freedom, _INFINITE, value / freedom)


@cache
def normal_quantile(probability: float) -> float:
    """The number below which a normal one of unit variance is with this probability; for 0.75 the median of its
    size."""
    return NormalDist().inv_cdf(probability)


def sidak(p_value: float, tests: float) -> float:
    """The chance that any of ``tests`` independent tests shows a p-value as small: 1 - (1 - p)^n (Sidak 1967)."""
    return float(-np.expm1(tests * np.log1p(-min(p_value, 1.0 - 1e-16))))


def log_odds_of(p_value: float) -> float:
    """The largest log odds that a p-value gives against what it tests: -ln(-e p ln p), 0 above 1/e (T. Sellke, M.
    Bayarri, J. Berger, 2001)."""
    p_value = max(p_value, 1e-300)
    return -math.log(-math.e * p_value * math.log(p_value)) if p_value < 1.0 / math.e else 0.0


def _fraction(a: float, b: float, x: float, distance: float) -> float:
    """The continued fraction that divides x^a (1 - x)^b / B(a, b), by Lentz's method; away: a - (a + b) x >= 0."""
    value = upper = a * (distance + 1.0) / (a + 1.0)
    lower, m, change = 0.0, 0, 2.0
    while abs(change - 1.0) > _PRECISION:
        m += 1
        step = a + 2.0 * m - 1.0
        numerator = (a + m - 1.0) * (a + b + m - 1.0) * m * (b - m) * (x / step) ** 2
        denominator = m + m * (b - m) * x / step + (a + m) * (distance + 1.0 + m * (2.0 - x)) / (step + 2.0)
        lower, upper = 1.0 / (denominator + numerator * lower), denominator + numerator / upper
        change = upper * lower
        value *= change
    return value


def _stirling_error(z: float) -> float:
    """log Gamma(z) less Stirling's formula (z - 1/2) log z - z + log(2 pi) / 2."""
    if z < 16.0:
        return math.lgamma(z) - (z - 0.5) * math.log(z) + z - 0.5 * math.log(2.0 * math.pi)
    square = 1.0 / z**2
    return (1 / 12 - square * (1 / 360 - square * (1 / 1260 - square * (1 / 1680 - square / 1188)))) / z


def weights(logarithms: NDArray[np.float64]) -> NDArray[np.float64]:
    """Numbers that sum to 1 and are in proportion to those given by their logarithms."""
    return np.exp(logarithms - np.logaddexp.reduce(logarithms, axis=None))
