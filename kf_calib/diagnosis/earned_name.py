"""Whether the likeliest explanation may be named: what its own refit supports.

The table compares explanations with each other, so that its first row may have all of the probability although it shows
nothing by itself. A name must therefore be earned: by a coefficient that is seen, and by an error that does not grow on
dwells that the refit leaves out.
"""

from __future__ import annotations

import numpy as np

from kf_calib.diagnosis.hypothesis_table import Hypothesis
from kf_calib.estimation.results import Calibration
from kf_calib.support.tail_probabilities import chi_squared_tail

SEEN = 3.0
"""In sigmas of its refit: the least size of the largest coefficient of an effect that is named."""

_TOGETHER_P = 6e-7  # of 5 sigma: of coefficients that are all determined, but clear only together
_GROWN = 1.05  # the held-out error before and after; what shows only within dwells, or in slews, leaves it as it was


def unearned(row: Hypothesis, before: Calibration, walk: str) -> str:
    """Why the effects of a row must not be named, in words that follow "but"; "" where they may, or where no refit was
    made.

    before: the calibration without them. walk: the name of the random walk, which has no coefficient.
    """
    after = row.refit
    if after is None:
        return ""
    for name in row.effects:
        if name == walk and _walk_sigma(before) < SEEN:
            return f"{name} is below {SEEN:g} sigma"
        if name != walk and _largest_ratio(after, name) < SEEN and not _clear_together(after, name):
            return f"no coefficient of {name} is beyond {SEEN:g} sigma"
    errors = before.held_out_rms_mps2, after.held_out_rms_mps2
    if errors[0] is None or errors[1] is None or errors[1] <= _GROWN * errors[0]:
        return ""
    what = "they make" if len(row.effects) > 1 else "it makes"
    return f"{what} the held-out error {errors[1] / errors[0]:.3g} times as large"


def _largest_ratio(after: Calibration, name: str) -> float:
    """Return the largest of an effect's coefficients over its sigma; 0 where none is determined."""
    effect = next(each for each in after.model.effects if str(each) == name)
    known = [after.parameters[coefficient.symbol] for coefficient in effect.parameters]
    return max((abs(p.value) / p.sigma for p in known if p.value is not None and p.sigma), default=0.0)


def _clear_together(after: Calibration, name: str) -> bool:
    """Tell whether the coefficients of an effect are beyond doubt by their joint covariance, though none is alone: as
    of columns that are alike."""
    effect = next(each for each in after.model.effects if str(each) == name)
    if any(after.parameters[coefficient.symbol].value is None for coefficient in effect.coefficients):
        return False
    first = after.model.parts[name].start
    places = slice(first, first + len(effect.coefficients))
    state, covariance = after.estimate.state[places], after.estimate.covariance[places, places]
    statistic = float(state @ np.linalg.lstsq(covariance, state, rcond=None)[0])
    return chi_squared_tail(len(state), statistic) < _TOGETHER_P


def _walk_sigma(before: Calibration) -> float:
    """Return the significance of a random walk in sigmas: the square root of what it takes from chi-squared."""
    return float(max(2.0 * before.fit.walk_gain, 0.0)) ** 0.5
