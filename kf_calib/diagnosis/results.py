"""What a diagnosis gives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.design import next_orientation as advise
from kf_calib.design.next_orientation import Advice
from kf_calib.diagnosis.candidate_tests import CandidateTests
from kf_calib.diagnosis.detectability import Detectable, detectable
from kf_calib.diagnosis.unknown_effect import Description, describe
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

    @cached_property
    def residual_ratios(self) -> Floats:
        """Residuals of the dwells (D, 3) over the sigma of their means."""
        carried = self.before.carried
        spread = mean_covariances(self.before.noise.judging, carried.means, carried.state)
        return self.before.residuals_mps2 / np.sqrt(np.einsum("dii->di", spread))

    @cached_property
    def description(self) -> Description | None:
        """What an unknown misfit looks like; None where the misfit is known (one dwell, too), or there is none."""
        if not self.unknown or self.before.outlying:
            return None
        return describe(self.before.fit, self.before.residuals_mps2, self.test.trend)

    @cached_property
    def detectable(self) -> list[Detectable]:
        """The smallest size of every visible effect that such a run would find."""
        return detectable(self.test)

    @cached_property
    def next_orientation(self) -> tuple[Advice, str] | None:
        """Where to go next, and why: to tell equal suspects apart, to size the one there is, or to show what is
        hidden."""
        fitted, test = (self.judged or self.before).fit, self.test
        named = [name for name in self.ambiguity if name in test.best]
        if named and not self.unknown:
            first = test.candidate(named[0])
            rivals = [test.candidate(name).effect for name in named[1:5]] if len(self.missing) == 1 else []
            advice = advise.to_tell_apart(fitted, first.effect, test.scan.coefficients(first), rivals)
            if advice is None:
                return None
            words = f"tells {named[0]} from {', '.join(advice.told)}" if advice.told else f"shows {named[0]} best"
            stay = "" if advice.stay_s is None else f" in {advice.stay_s / 60.0:.0f} min there"
            return advice, f"{words}: separation {advice.before:.1f} -> {advice.after:.1f} sigma{stay}"
        hidden = [test.candidate(name).effect for name in test.invisible if name in test.best]
        shown = advise.to_show(fitted, hidden)
        if shown is None or not shown[1]:
            return None
        return shown[0], f"would show {shown[1]} of {len(hidden)} effects that these orientations cannot"

    def refit_with(self, name: str) -> Calibration:
        """The run with this effect, too: of a suspect it is there already."""
        own = (suspect.refit for suspect in self.suspects if suspect.name == name)
        return next(own, None) or with_effects(self.before, (name,))


def with_effects(before: Calibration, added: Sequence[str]) -> Calibration:
    """The same run with further effects in the model."""
    return refitted(before, (*before.settings.effects, *added))
