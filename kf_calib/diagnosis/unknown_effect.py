"""Description of a misfit that no known effect explains: where it shows, what it depends on, and formulas to try."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.effects import walk_named
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.results import Consistency, consistency
from kf_calib.estimation.within_dwell_trend import Trend
from kf_calib.support.tail_probabilities import LEVEL

BETWEEN_DWELLS = "nothing that was recorded (irregular from dwell to dwell)"
WITHIN_DWELLS = "time (irregular, within dwells too)"


@dataclass(frozen=True)
class Description:
    """What an unknown misfit looks like.

    channel: axis of the accelerometer in which it shows most (x, y, z, or all). driver: in words, what it depends on.
    share: share of the chi-squared beyond noise that is explained. formulas: effects to add to the model as they stand.
    """

    channel: str
    driver: str
    share: float
    formulas: tuple[str, ...]

    @property
    def formula(self) -> str:
        """The first of the formulas."""
        return self.formulas[0]


def describe_irregular(
    fitted: Fit, residuals: Floats, trend: Trend | None = None, driver: str = ""
) -> Description | None:
    """Description of a misfit that changes irregularly, with the random walk of the biases as the formula to try; None
    where that is in the model.

    fitted: the fit whose misfit is described. residuals: of the dwell means, (D, 3). trend: its test within dwells.
    driver: what it depends on; "" for nothing that is known.
    """
    name = "" if fitted.linearised.model.walks else walk_named(fitted.linearised.model.bench)
    if not name:
        return None
    misfit, walk, scatter = consistency(fitted), fitted.walk_gain, fitted.scatter_gain
    irregular, excess = 2.0 * max(walk, scatter), misfit.statistic - misfit.dof
    within = trend is not None and trend.p_value < LEVEL
    driver = driver or (WITHIN_DWELLS if within else BETWEEN_DWELLS)
    return Description(channel_of(residuals), driver, irregular / max(excess, irregular, 1.0), (name,))


def explained_share(before: Consistency, after: Consistency) -> float:
    """Share of the chi-squared beyond noise that a refit with further effects explains."""
    excess = before.statistic - before.dof
    explained = before.statistic - after.statistic - (before.dof - after.dof)
    return min(max(explained, 0.0) / excess, 1.0) if excess > 0 else 1.0


def channel_of(residuals: Floats) -> str:
    """The axis of the accelerometer with most of the squared residuals (D, 3); "all" where none stands out."""
    squares = np.sum(residuals**2, axis=0)
    return "xyz"[int(np.argmax(squares))] if squares.max() > 0.7 * squares.sum() else "all"
