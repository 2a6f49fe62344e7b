"""Coefficients of any direction: a normal density, or one that vanishes where the runs show nothing.

The density of a unit's coefficients c is in proportion to (c' A c)^m N(c; 0, T) with A the information of its runs, a
moment prior (V. E. Johnson and D. Rossell, 2010). With m = 0 it is normal, and some of the units that have the effect
show little of it. The larger m, the more alike are their sizes in units of their noise. T is in proportion to A^-a with
a = m / (m + q / 2): if it were not, the factor would turn nearly all coefficients to the direction that is seen best.
"""

from __future__ import annotations

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.fleet.campaign import Group
from kf_calib.fleet.evidence import modes, sizes
from kf_calib.fleet.own_coefficients import UnitInformation
from kf_calib.fleet.shape import SHARES, Shape

_SEEN = 1e-6  # of the largest information of a unit: what is less counts as not seen
_LEAST = 1.0  # sigma of one run: the smallest size of the effect of a unit
_STEPS = {0: 2.0**0.5, 2: 2.0**0.5, 32: 1.2}  # ratio of a size to the one before: closer where sizes are alike
POWERS = tuple(_STEPS)
"""Of c' A c: normal, clearly not zero, and nearly of one size."""

_ALIKE = 64.0  # sigma of one run: the largest size that is tried where all are nearly one


def about_zero(group: Group, information: UnitInformation, power: int) -> Shape:
    """The shape with m = ``power``."""
    values, along, _ = modes(information.info, information.score)
    tried = sizes(_LEAST, _ALIKE if power == max(POWERS) else group.largest, _STEPS[power])
    log_prior = np.full((len(SHARES), len(tried)), -np.log(len(SHARES) * len(tried)))
    ratios = _ratios(values, along, tried, power)[:, None]
    return Shape(len(values), ratios.__getitem__, log_prior, tried[None] / np.sqrt(values.shape[1]))


def _ratios(values: Floats, along: Floats, tried: Floats, power: int) -> Floats:
    """Return the log of the likelihood ratio (n, sizes) of coefficients that add ``tried`` sigmas to the readings.

    It is that of normal ones times the mean of (c' A c)^m after the readings over that before them. Everything is along
    the directions in which the information is apart, in units of the noise.
    """
    count = values.shape[1]
    seen = values > _SEEN * values.max(axis=1, keepdims=True)
    noted = np.where(seen, along / np.sqrt(np.where(seen, values, 1.0)), 0.0)[:, None]
    spread = np.where(seen, values, 0.0) ** (0.5 * count / (power + 0.5 * count))
    spread = spread / np.maximum(np.mean(spread, axis=1, keepdims=True), _SEEN) if power else spread
    before = spread[:, None] * tried[:, None] ** 2 / (2.0 * power + count)  # variances (n, sizes, q)
    after = before / (1.0 + before)
    normal = 0.5 * np.sum(noted**2 * after - np.log1p(before), axis=2)
    return normal + _log_moment(after, noted * after, power) - _log_moment(before, np.zeros_like(before), power)


def _log_moment(variances: Floats, means: Floats, power: int) -> Floats:
    """Return the log of the mean of (sum x^2)^m, but for a factor of m alone, of normal x with these variances and
    means (..., q): from the cumulants of the sum."""
    whole = np.sum(variances + means**2, axis=-1)
    whole = np.where(whole > 0.0, whole, 1.0)  # of a unit that sees nothing: before and after are the same
    part, squares = variances / whole[..., None], means**2 / whole[..., None]
    cumulants, moments = np.empty((power, *whole.shape)), np.ones((power + 1, *whole.shape))
    raised = np.ones_like(part)
    for k in range(power):
        cumulants[k] = np.sum(raised * (part + (k + 1) * squares), axis=-1)
        moments[k + 1] = np.einsum("k...,k...", cumulants[: k + 1], moments[k::-1]) / (k + 1)
        raised = 2.0 * part * raised
    return power * np.log(whole) + np.log(np.maximum(moments[-1], np.finfo(float).tiny))
