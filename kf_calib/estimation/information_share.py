"""The share of the information about each parameter that each orientation of a run brought."""

from __future__ import annotations

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.estimation import square_root_information
from kf_calib.estimation.results import Calibration, Estimate


def prior_estimate(result: Calibration) -> Estimate:
    """The estimate before the first dwell; nothing is determined in it where the prior is diffuse."""
    factor = square_root_information.start(result.settings.prior, result.model)
    return Estimate(*square_root_information.solve(factor, result.model.nominal_state()))


def shares_of(sigmas: Floats) -> Floats:
    """Shares (n, k): by how much each dwell raised 1 / sigma^2 of each parameter, over its final value.

    sigmas (n + 1, k): before the first dwell and after each, NaN where not determined. The shares are those of the
    dwells in their order, beside what was known before each: a parameter that is not yet determined has no information,
    and the dwell that determines it brings all there then is. With what a stated prior brings they sum to 1. A share is
    negative where biases that walk were lost faster than a dwell found them; a parameter that the run does not
    determine, or that the prior holds exact, has none (NaN).
    """
    known = np.where(sigmas[-1] > 0.0, sigmas, np.nan)
    return np.diff(np.nan_to_num(known**-2), axis=0) * known[-1] ** 2
