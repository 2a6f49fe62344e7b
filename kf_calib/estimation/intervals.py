"""Intervals of parameters where noise from dwell to dwell was not stated, and few dwells tell how large it is.

With the noise that is known alone, the misfit is r times as large as expected, with nu degrees of freedom. The whole
noise has R times the variance of the known one; nu r / R is chi-squared with nu degrees of freedom. Before the run,
R > 1 is three times as likely as R = 1 (none more), and any logarithm of it is as likely up to 10^2. A sigma that was
computed with R_0 stands for an interval of 95 % of +- k sigma, where k is that with which the mean of
P(|z| < k sqrt(R_0 / R)) over all R is 0.95, and no less than 1.96. Where no noise is known, this is Student's t with nu
degrees of freedom.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from kf_calib.estimation.fit import Fit
from kf_calib.noise.noise_model import mean_covariances

LEVEL = 0.95
"""Probability with which an interval holds a parameter."""

NORMAL = 1.959963984540054
"""Half the length of the interval in sigmas where all noise is known."""

_MORE = 0.75  # prior probability that there is more noise than is known
_LARGEST = 1e2  # of R
_NODES = 400


def sigmas_of_interval(fitted: Fit, misfit: float, dof: int) -> float:
    """Half the length of the interval of 95 % of a parameter, in units of its sigma.

    misfit, dof: chi-squared of the fit by the noise that was stated or seen, and its degrees of freedom.
    """
    noise = fitted.noise
    if dof <= 0 or (noise.setting.stated and noise.scatter.stated):
        return NORMAL
    if not noise.within_seen and not noise.scatter.stated:
        return _student(dof)
    linearised = fitted.linearised
    traces = [np.einsum("dii->d", mean_covariances(each.of_readings, linearised.means, linearised.state))
              for each in (noise, noise.without_estimates())]  # fmt: skip
    return max(NORMAL, _averaged(dof, misfit / dof, float(np.mean(traces[0] / np.maximum(traces[1], 1e-300)))))


@lru_cache(maxsize=256)
def _student(dof: int) -> float:
    """Return the quantile of Student's t."""
    from scipy.special import stdtrit

    return float(stdtrit(dof, 0.5 + 0.5 * LEVEL))


@lru_cache(maxsize=256)
def _averaged(dof: int, misfit: float, taken: float) -> float:
    """Return k for a misfit r, where the sigma was computed with R_0 = taken."""
    from scipy.special import erf

    log_ratios = np.linspace(0.0, math.log(_LARGEST), _NODES)
    logs = -0.5 * dof * (log_ratios + misfit * np.exp(-log_ratios))
    weights = np.exp(logs - logs.max()) * _MORE / _NODES
    weights[0] += (1.0 - _MORE) * math.exp(logs[0] - logs.max())
    weights /= weights.sum()
    shrink = np.sqrt(taken * np.exp(-log_ratios) / 2.0)
    low, high = 0.0, 100.0 * NORMAL
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if weights @ erf(middle * shrink) < LEVEL else (low, middle)
    return 0.5 * (low + high)
