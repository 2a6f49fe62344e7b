"""Results of a diagnosis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.candidate_tests import CandidateTests
from kf_calib.estimation.calibration import refitted
from kf_calib.estimation.noise_model import mean_covariances
from kf_calib.estimation.results import Calibration, Parameter
from kf_calib.support.printing import printed


@dataclass(frozen=True)
class Suspect:
    """An effect that explains a significant part of the misfit.

    name: of the effect. statistic: fall of chi-squared. dof: its degrees of freedom. p_value: family-wise p-value.
    fits: whether the model with the effect fits the run. refit: the calibration with it. known: symbols of the effects
    that were in the model before.
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
        """The coefficients of this effect in its refit."""
        return [p for p in list(self.refit.parameters.values())[12:] if p.symbol not in self.known]


@dataclass(frozen=True)
class Diagnosis:
    """What a diagnosis found.

    before: the calibration that was diagnosed. test: the tests of all candidates. suspects: the significant ones, the
    likeliest first. missing: names of the effects that make the model fit (empty: nothing is missing, or no known
    effect fits). unknown: whether something is missing that no known effect explains. ambiguity: all effects that
    explain as much, those named as missing included. overlaps: overlap of each look-alike with the effect that it could
    replace. after: the calibration with the missing effects. verdict: the result in a sentence.

    together: pairs of effects that explain as much. alone: a single effect that could replace two. as_scatter: scatter
    from dwell to dwell larger than stated would explain the misfit as well, or, where no effect is named, better than
    those that would fit. back_s: time constant with which the biases may return, s, in place of the random walk that is
    named (None: they do not). judged: the run with the noise by which the effects were compared, where that noise was
    estimated (None: it is that of ``before``).
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
        """Residuals of the dwell means (D, 3), over their sigma."""
        carried = self.before.carried
        spread = mean_covariances(self.before.noise.judging, carried.means, carried.state)
        return self.before.residuals_mps2 / np.sqrt(np.einsum("dii->di", spread))

    def refit_with(self, name: str) -> Calibration:
        """The calibration with this effect added; that of a suspect is not computed again."""
        own = (suspect.refit for suspect in self.suspects if suspect.name == name)
        return next(own, None) or with_effects(self.before, (name,))


def with_effects(before: Calibration, added: Sequence[str]) -> Calibration:
    """The same run calibrated with further effects in the model."""
    return refitted(before, (*before.settings.effects, *added))
