"""What more in the model explains of the residuals of a run: what it predicts of them, and what it leaves."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.effect_shape import EffectShape, shape_over, shapes_of
from kf_calib.diagnosis.residual_drivers import Driver, misfit_beyond_noise, unexplained_mps2
from kf_calib.estimation.residual_table import mean_sigmas
from kf_calib.estimation.results import Calibration


@dataclass(frozen=True, eq=False)
class Explanation:
    """A model with more in it than the one whose residuals are looked at.

    names: what it has in addition, formulas without the name that they were given. before, after: the two
    calibrations. fits: whether it fits the run. p_value: the family-wise p-value of a single effect of the catalogue;
    None of anything else.
    """

    names: tuple[str, ...]
    before: Calibration
    after: Calibration
    fits: bool
    p_value: float | None = None

    @property
    def name(self) -> str:
        """The effects, as a sum."""
        return " + ".join(self.names)

    @property
    def share(self) -> float | None:
        """Part of the misfit beyond noise that it explains, 0 to 1: the decrease of chi-squared from refit to refit,
        less the degrees of freedom that it takes; None if the means of the dwells agree without it."""
        excess, before, after = misfit_beyond_noise(self.before), self.before.consistency, self.after.consistency
        return _share(before.statistic - after.statistic, before.dof - after.dof, excess) if excess > 0.0 else None

    @cached_property
    def shapes(self) -> list[EffectShape]:
        """What the readings show of each of its effects, over the quantity that the effect goes with."""
        return shapes_of(self.before, self.after)

    def over(self, driver: Driver) -> EffectShape:
        """The same of all its effects together, over a quantity of the bench."""
        return shape_over(self.before, self.after, driver, self.name)

    @cached_property
    def unexplained_mps2(self) -> Floats:
        """What it leaves of the residuals (D, 3)."""
        return unexplained_mps2(self.after)

    @cached_property
    def unexplained_ratios(self) -> Floats:
        """The same over the sigma of the means."""
        return self.unexplained_mps2 / mean_sigmas(self.before)

    @cached_property
    def predicted_mps2(self) -> Floats:
        """What it predicts of the residuals (D, 3): the difference of the two models' predictions."""
        return self.before.residuals_mps2 - self.unexplained_mps2


def _share(delta_chi2: float, dof: int, excess: float) -> float:
    """Return the part of the misfit beyond noise that a fall of chi-squared beyond its degrees of freedom explains."""
    return float(np.clip((delta_chi2 - dof) / excess, 0.0, 1.0)) if excess > 0.0 else 0.0
