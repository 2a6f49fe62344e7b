"""What more in the model explains of the residuals of a run: what it predicts of them, and what it leaves."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.residual_drivers import misfit_beyond_noise, unexplained_mps2, walk_path
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

    @cached_property
    def contribution_mps2(self) -> Floats:
        """What its effects add to the mean readings (D, 3), before the other parameters take up a part of it."""
        columns = self._own
        added = np.einsum(
            "dip,p->di", self.after.linearised.means.design[:, :, columns], self.after.estimate.state[columns]
        )
        return added + walk_path(self.after)

    @cached_property
    def contribution_sigma_mps2(self) -> Floats:
        """Sigma (D, 3) of the contribution, from the covariance of its coefficients."""
        columns = self._own
        design, covariance = self.after.linearised.means.design[:, :, columns], self.after.estimate.covariance
        return np.sqrt(np.einsum("dip,pq,diq->di", design, covariance[np.ix_(columns, columns)], design))

    @cached_property
    def _own(self) -> NDArray[np.intp]:
        """Return the places of its coefficients in the state; a walk has none, its path is no coefficient."""
        model, parts_before = self.after.model, self.before.model.parts
        added = (part for name, part in model.parts.items() if name not in parts_before)
        return np.array([column for part in added for column in range(*part.indices(model.count))], int)


def _share(delta_chi2: float, dof: int, excess: float) -> float:
    """Return the part of the misfit beyond noise that a fall of chi-squared beyond its degrees of freedom explains."""
    return float(np.clip((delta_chi2 - dof) / excess, 0.0, 1.0)) if excess > 0.0 else 0.0
