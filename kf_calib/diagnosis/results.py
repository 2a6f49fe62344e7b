"""What a diagnosis gives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.candidate_tests import (
    CandidateTests,
)
from kf_calib.estimation.calibration import refitted
from kf_calib.estimation.noise_model import mean_covariances
from kf_calib.estimation.results import Calibration, Parameter
from kf_calib.support.printing import printed


@dataclass(frozen=True)
class Suspect:
    """An effect that would explain something: p-value of the run, whether the model fits with it, its refit.

    known: symbols of the effects that were in the model already.
    """

    name: str
    statistic: float
    dof: int
    p_value: float
    fits: bool
    refit: Calibration
    known: tuple[str, ...]

    @property
    def coefficients(self) -> list[Parameter]:
        """Of this effect in its refit."""
        return [p for p in list(self.refit.parameters.values())[12:] if p.symbol not in self.known]


@dataclass(frozen=True)
class Diagnosis:
    """missing: the names that make the model fit (empty: nothing is missing, or none of the known ones does).

    ambiguity: every single effect that fits as well as the first, and those that do together; overlaps: of each with
    it. together: the pairs among them that explain as much, and are no exchange of one effect for one that is alike.
    alone: a single effect that would do in the place of two. as_scatter: what is missing could as well be dwells that
    scatter by more than is stated, or, where nothing is named, what would fit is less likely than that; back_s: the
    walk that is missing could go to and fro with this time constant (None: not as well). judged: the run by whose noise
    effects were told from each other, where that was estimated (None: by that of ``before``).
    """

    before: Calibration
    test: CandidateTests
    suspects: tuple[Suspect, ...]
    missing: tuple[str, ...]
    unknown: bool
    ambiguity: tuple[str, ...]
    overlaps: dict[str, float]
    after: Calibration | None
    verdict: str
    together: tuple[tuple[str, str], ...] = ()
    alone: str = ""
    as_scatter: bool = False
    back_s: float | None = None
    judged: Calibration | None = None

    def __repr__(self) -> str:
        return f"<Diagnosis: {self.verdict}>"

    def __str__(self) -> str:
        return printed(self)

    @property
    def residual_ratios(self) -> Floats:
        """Residuals of the dwells (D, 3) over the sigma of their means."""
        carried = self.before.carried
        spread = mean_covariances(self.before.noise.judging, carried.means, carried.state)
        return self.before.residuals_mps2 / np.sqrt(np.einsum("dii->di", spread))

    def refit_with(self, name: str) -> Calibration:
        """The run with this effect, too: of a suspect it is there already."""
        own = (suspect.refit for suspect in self.suspects if suspect.name == name)
        return next(own, None) or with_effects(self.before, (name,))


def with_effects(before: Calibration, added: Sequence[str]) -> Calibration:
    """The same run with further effects in the model."""
    return refitted(before, (*before.settings.effects, *added))
