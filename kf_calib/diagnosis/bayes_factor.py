"""Odds of an effect against none where its coefficients may point any way.

A fall of chi-squared is that of the best direction and the best value of a constant; a likelihood in which these are
integrated out, as that of a random walk is over all its paths, is compared with their mean.
"""

from __future__ import annotations

import numpy as np

from kf_calib.bench.arrays import Floats

_LEAST = 1e-12  # of a fall: the odds of none are their limit
_LARGE = 1e8  # where the Bessel function is its limit, and from 1e9 on unknown to the library


def log_odds(dof: int, falls: Floats | float, sigmas: float) -> Floats:
    """log of the likelihood ratio of an effect of ``sigmas`` against none, averaged over its directions.

    falls: of chi-squared in its space of ``dof`` dimensions. The mean of exp(n u w - n^2 / 2) over the unit sphere,
    |w|^2 the fall, is Gamma(k/2) (2 / x)^v I_v(x) exp(-n^2 / 2), v = k/2 - 1, x = n |w| (von Mises, Fisher).
    """
    from scipy.special import gammaln, ive

    order, x = 0.5 * dof - 1.0, sigmas * np.sqrt(np.maximum(falls, _LEAST))
    bessel = np.where(x < _LARGE, ive(order, np.minimum(x, _LARGE)), 1.0 / np.sqrt(2.0 * np.pi * x))
    return gammaln(0.5 * dof) + order * np.log(2.0 / x) + np.log(bessel) + x - 0.5 * sigmas**2


def as_fall(dofs: Floats, falls: Floats, tried: int = 1) -> float:
    """Twice the log of the same of an effect at its likeliest size, averaged over the values of its constant: what a
    fall of chi-squared is worth beside a likelihood in which nothing is left to choose.

    dofs, falls (values,): at each value; tried: these are the best of so many.
    """
    sigmas = float(np.sqrt(max((falls - dofs).max(), 1.0)))
    parts = [log_odds(int(dof), fall, sigmas) for dof, fall in zip(dofs, falls, strict=True)]
    return 2.0 * float(np.logaddexp.reduce(parts) - np.log(max(len(parts), tried)))
