"""Odds of an effect of known size, whose coefficients may point in any direction."""

from __future__ import annotations

import numpy as np

from kf_calib.bench.arrays import Floats

_LEAST = 1e-12  # the smallest fall put into the formula, which would divide by zero at a fall of none
_LARGE = 1e8  # above this the asymptotic form of the Bessel function is exact; the library fails from 1e9 on


def log_odds(dof: int, falls: Floats | float, sigmas: float) -> Floats:
    """Log of the likelihood ratio of an effect of a given size against no effect, averaged over its directions.

    With w the whitened residual in the space of the effect, u a unit vector in it, n = ``sigmas`` and k = ``dof``, the
    mean of exp(n u'w - n^2 / 2) over all u is Gamma(k/2) (2 / x)^v I_v(x) exp(-n^2 / 2), where v = k/2 - 1 and x = n
    |w| (the normalisation of the von Mises-Fisher distribution).

    dof: dimension of the space of the effect. falls: chi-squared that it explains there, |w|^2; a number or an array.
    sigmas: size of the effect in sigma. Returns the natural logarithm, of the shape of ``falls``.
    """
    from scipy.special import gammaln, ive

    order, x = 0.5 * dof - 1.0, sigmas * np.sqrt(np.maximum(falls, _LEAST))
    bessel = np.where(x < _LARGE, ive(order, np.minimum(x, _LARGE)), 1.0 / np.sqrt(2.0 * np.pi * x))
    return gammaln(0.5 * dof) + order * np.log(2.0 / x) + np.log(bessel) + x - 0.5 * sigmas**2
