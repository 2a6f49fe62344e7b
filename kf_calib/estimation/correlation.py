"""Correlations of what a run estimates: the twelve parameters and the coefficients of effects."""

from __future__ import annotations

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.estimation.results import Estimate


def correlation(estimate: Estimate) -> Floats:
    """Correlations (12 + q, 12 + q) of the twelve parameters and the coefficients of effects; NaN in the rows and
    columns of those that are not determined."""
    covariance = estimate.covariance
    jacobian = np.eye(len(covariance))
    jacobian[:STATE_COUNT, :STATE_COUNT] = paper_parameters.jacobian(estimate.state[:STATE_COUNT])
    sigma = np.sqrt(np.diag(jacobian @ covariance @ jacobian.T))
    sigma[np.isnan(np.concatenate([estimate.sigma, estimate.effect_sigma]))] = np.nan
    return jacobian @ covariance @ jacobian.T / np.outer(sigma, sigma)
