"""The chance that an F or a chi-squared distribution exceeds a value: every run needs these two numbers. And
what it becomes where it is the smallest of many.

``scipy.special.fdtrc`` gives it too, but takes longer to import than a short recording to evaluate, and of its digits
half are lost where the noise is known to 1e9 degrees of freedom.
"""

from __future__ import annotations

import math

import numpy as np

LEVEL = 0.01
"""Probability of a false alarm in one run."""

_ENOUGH = 4e-16
_KNOWN = 1e18  # degrees of freedom of noise that is as good as known


def f_tail(freedom: float, noise_freedom: float, ratio: float) -> float:
    """Chance that F with so many degrees of freedom, of the numerator and of the denominator, exceeds ``ratio``.

    It is the incomplete beta function I_x(a, b) with a, b half of ``noise_freedom`` and ``freedom`` and x = a / (a + b
    ratio), by the continued fraction of DiDonato and Morris (1992), equation 9. The factor before it is written as
    that of Loader (2000), in which nothing large cancels.
    """
    if not 0.0 < ratio < math.inf:
        return 1.0 if ratio <= 0.0 else 0.0 if ratio > 0.0 else math.nan
    a, b = 0.5 * noise_freedom, 0.5 * freedom
    both, beyond = a + b, a + b * ratio
    logarithm = b * math.log(ratio) - both * math.log1p(b * (ratio - 1.0) / both)
    logarithm += _stirling_error(both) - _stirling_error(a) - _stirling_error(b)
    factor = math.sqrt(a * b / (2.0 * math.pi * both)) * math.exp(logarithm)
    away = a * b * (ratio - 1.0) / beyond
    if factor == 0.0:
        return 0.0 if ratio > 1.0 else 1.0
    if away > 0.0:
        return factor / _fraction(a, b, a / beyond, away)
    return 1.0 - factor / _fraction(b, a, b * ratio / beyond, -away)


def chi_squared_tail(freedom: float, value: float) -> float:
    """Chance that chi-squared with so many degrees of freedom exceeds ``value``: F of noise that is known."""
    return f_tail(freedom, _KNOWN, value / freedom)


def sidak(p_value: float, tests: float) -> float:
    """The chance that any of ``tests`` independent tests shows a p-value as small: 1 - (1 - p)^n (Sidak 1967)."""
    return float(-np.expm1(tests * np.log1p(-min(p_value, 1.0 - 1e-16))))


def _fraction(a: float, b: float, x: float, away: float) -> float:
    """What divides x^a (1 - x)^b / B(a, b), by Lentz's method; away: a - (a + b) x >= 0."""
    value = upper = a * (away + 1.0) / (a + 1.0)
    lower, m, change = 0.0, 0, 2.0
    while abs(change - 1.0) > _ENOUGH:
        m += 1
        step = a + 2.0 * m - 1.0
        top = (a + m - 1.0) * (a + b + m - 1.0) * m * (b - m) * (x / step) ** 2
        own = m + m * (b - m) * x / step + (a + m) * (away + 1.0 + m * (2.0 - x)) / (step + 2.0)
        lower, upper = 1.0 / (own + top * lower), own + top / upper
        change = upper * lower
        value *= change
    return value


def _stirling_error(z: float) -> float:
    """log Gamma(z) less Stirling's formula (z - 1/2) log z - z + log(2 pi) / 2."""
    if z < 16.0:
        return math.lgamma(z) - (z - 0.5) * math.log(z) + z - 0.5 * math.log(2.0 * math.pi)
    square = 1.0 / z**2
    return (1 / 12 - square * (1 / 360 - square * (1 / 1260 - square * (1 / 1680 - square / 1188)))) / z
