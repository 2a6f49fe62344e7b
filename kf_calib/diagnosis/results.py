"""Results of a diagnosis, and two of them side by side: of two recordings, or of one recording with two models."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from kf_calib.bench.arrays import Floats, Mask
from kf_calib.design import next_orientation as advise
from kf_calib.design.next_orientation import Advice
from kf_calib.diagnosis.candidate_tests import CandidateTests
from kf_calib.diagnosis.coefficient_sizes import Detectable, Unseen, detectable, sensor_grade, unseen
from kf_calib.diagnosis.explanation import Explanation
from kf_calib.diagnosis.hypothesis_table import ALIKE, IRREGULAR, SURE, Hypothesis, HypothesisTable
from kf_calib.diagnosis.replication import Replication
from kf_calib.diagnosis.residual_drivers import Driver, drivers_of
from kf_calib.diagnosis.unknown_effect import Description, channel_of, describe_irregular, explained_share
from kf_calib.effects.effect import Grade
from kf_calib.estimation.filter_history import DwellReadings
from kf_calib.estimation.results import Calibration, Condition, OutlyingDwell, Parameter
from kf_calib.noise.noise_model import mean_covariances
from kf_calib.support.tail_probabilities import chi_squared_tail
from kf_calib.support.text import as_html, listing, printed
from kf_calib.support.units import span

_TOLD_APART = 4  # most rivals that the next orientation is to tell from the likeliest effect


@dataclass(frozen=True)
class Suspect:
    """An effect that explains a significant part of the misfit.

    name: of the effect. statistic: fall of chi-squared. dof: its degrees of freedom. p_value: family-wise p-value.
    refit: the calibration with it. known: symbols of the effects that were in the model before. probability: of this
    effect and no other, as in the table of explanations; probability_with_others: of it alone or with others.
    """

    name: str
    statistic: float
    dof: int
    p_value: float
    refit: Calibration
    known: tuple[str, ...]
    probability: float
    probability_with_others: float

    @property
    def fits(self) -> bool:
        """Whether the model with the effect fits the run."""
        return self.refit.consistency.consistent is not False

    @property
    def coefficients(self) -> list[Parameter]:
        """The coefficients of this effect in its refit."""
        return [p for p in list(self.refit.parameters.values())[12:] if p.symbol not in self.known]


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """What a diagnosis found.

    before: the calibration that was diagnosed. test: the tests of all candidates. table: all explanations with their
    probabilities (None: nothing could be tested). verdict: the result in a sentence.

    missing: names of the effects of the likeliest explanation (empty: nothing is missing, or no known effect). unknown:
    whether the likeliest is none of the known effects. unearned: why the effects of the likeliest explanation are not
    named, in words; "" where they are. noise: whether it is noise that was not stated. ambiguity: the
    effects of the explanations that have 99 % of the probability together, those missing first. overlaps: overlap of
    each other effect with the one that it could replace. together: pairs among these explanations. as_scatter: noise
    that was not stated has more than 1 %. after: the calibration with the missing effects. suspects: single effects
    that were refitted, the likeliest first.

    before_in_noise_left: ``before`` in the noise that the likeliest explanation leaves, where noise was estimated
    (None: it is that of ``before``). replication: how what is named predicts dwells that choosing it never saw (None:
    nothing is named, or it was not asked for). apart: numbers of dwells that do not fit, whatever else is missing: all
    else is said of the run without them. wrong_dwell: that of the likeliest explanation, where all others agree without
    it (None: there is none, or there are no angles). disturbed_readings: those of the dwell that the verdict calls
    disturbed (None: there is none, or the readings are gone).
    """

    before: Calibration
    test: CandidateTests
    verdict: str = ""
    table: HypothesisTable | None = None
    suspects: tuple[Suspect, ...] = ()
    missing: tuple[str, ...] = ()
    unearned: str = ""
    unknown: bool = False
    noise: bool = False
    ambiguity: tuple[str, ...] = ()
    overlaps: dict[str, float] = field(default_factory=dict[str, float])
    after: Calibration | None = None
    together: tuple[tuple[str, str], ...] = ()
    as_scatter: bool = False
    before_in_noise_left: Calibration | None = None
    replication: Replication | None = None
    apart: tuple[int, ...] = ()
    wrong_dwell: OutlyingDwell | None = None
    disturbed_readings: DwellReadings | None = None

    def __repr__(self) -> str:
        return f"<Diagnosis: {self.verdict}>"

    def __str__(self) -> str:
        return printed(self)

    def _repr_html_(self) -> str | None:
        return as_html(self)

    @property
    def condition(self) -> Condition | None:
        """What was not stated and the agreement rests on; None where there is none, or nothing agrees."""
        return self.before.consistency.condition if self.test.consistent else None

    @property
    def consistent(self) -> bool | None:
        """Whether model and run agree; None where nothing could be tested, or where it rests on what was not stated."""
        return None if self.condition else self.test.consistent

    @cached_property
    def floor_mps2(self) -> float | None:
        """What noise alone gives as held-out error: in the model with what is missing, else in that of the likeliest
        explanation. A model that fails takes for noise what it lacks. None where nothing tells it."""
        first = self.likeliest
        return (self.after or (first and first.refit) or self.before).held_out_floor_mps2

    @cached_property
    def residual_ratios(self) -> Floats:
        """Residuals of the dwell means (D, 3), over their sigma."""
        linearised = self.before.linearised
        spread = mean_covariances(self.before.noise.for_goodness_of_fit.of_readings, linearised.means, linearised.state)
        return self.before.residuals_mps2 / np.sqrt(np.einsum("dii->di", spread))

    @cached_property
    def description(self) -> Description | None:
        """What an unknown misfit looks like; None where the misfit is known (one dwell, too), or there is none."""
        first, residuals = self.likeliest, self.before.residuals_mps2
        if not self.unknown or (first is not None and first.dwells):
            return None
        if first is None or not first.formulas or first.refit is None:
            driver = "" if first is None or first.driver in (IRREGULAR, ALIKE) else first.driver
            return describe_irregular(self.before.fit, residuals, self.test.trend, driver)
        share = explained_share(self.before.consistency, first.refit.consistency)
        return Description(channel_of(residuals), first.driver, share, first.formulas)

    @property
    def disturbed_dwell(self) -> int:
        """Number of the dwell that the verdict calls wrong or disturbed; 0 where it speaks of none."""
        first, loud = self.likeliest, self.before.readings.loud
        if self.apart:
            return self.apart[0]
        if first is not None and first.dwells:
            return first.dwells[0]
        return loud.numbers[0] if loud else 0

    @property
    def likeliest(self) -> Hypothesis | None:
        """The likeliest explanation of a misfit; None where there is none to explain."""
        if self.table is None or self.test.consistent is not False:
            return None
        return self.table.first

    @cached_property
    def drivers(self) -> list[Driver]:
        """The quantities that vary in the run, those that explain most of the misfit first."""
        return drivers_of(self.before)

    @cached_property
    def explanations(self) -> list[Explanation]:
        """What could be added to the model: what the verdict names, then the other suspects, of which those that fit
        come first."""
        best = self.explanation
        suspects = sorted(self.suspects, key=lambda each: not each.fits)  # stable: by significance
        others = [Explanation((each.name,), self.before, each.refit, each.p_value)
                  for each in suspects if (each.name,) != self.missing]  # fmt: skip
        return others if best is None else [best, *others]

    @cached_property
    def explanation(self) -> Explanation | None:
        """What the verdict names: the missing effects, or the formula of a quantity that an unknown misfit goes with;
        None where it names neither."""
        if self.missing and self.after is not None:
            alone = self.test.effects.p_values.get(self.missing[0]) if len(self.missing) == 1 else None
            return Explanation(self.missing, self.before, self.after, alone)
        first = self.likeliest
        if self.description is None or first is None or not first.formulas or first.refit is None:
            return None
        names = tuple(text.partition("=")[2].strip() or text for text in first.formulas)
        return Explanation(names, self.before, first.refit)

    @cached_property
    def detectable(self) -> list[Detectable]:
        """The smallest size of every visible effect that such a run would find."""
        return detectable(self.test)

    @cached_property
    def unseen(self) -> list[Unseen]:
        """The effects of which the run shows nothing, and why."""
        return unseen(self.before.fit, self.test)

    @property
    def sure(self) -> bool:
        """Whether the effects that are named, or what is the same here, are missing with 95 % probability."""
        return bool(self.missing) and self.table is not None and self.table.probability_of_class(self.missing) >= SURE

    @property
    def grade(self) -> Grade:
        """The grade of the sensors, by the noise of the run."""
        return sensor_grade(self.before.fit)

    @cached_property
    def next_orientation(self) -> tuple[Advice, str] | None:
        """Where to go next, and why: to tell equal suspects apart, to size the one there is, or to show what is
        hidden."""
        fitted, test = (self.before_in_noise_left or self.before).fit, self.test
        named = [name for name in self.ambiguity if name in test.effects.best]
        if named and not self.unknown:
            first = test.effects.candidate(named[0])
            alone = [row.effects[0] for row in (self.table.rivals if self.table else ()) if len(row.effects) == 1]
            others = [test.effects.candidate(name).effect for name in alone if name in test.effects.best]
            rivals = others[:_TOLD_APART] if len(self.missing) == 1 else []
            advice = advise.to_tell_apart(fitted, first.effect, test.effects.scan.coefficients(first), rivals)
            if advice is None:
                return None
            words = f"tells {named[0]} from {listing(advice.told)}" if advice.told else f"shows {named[0]} best"
            stay = "" if advice.stay_s is None else f" after {span(advice.stay_s)} there"
            return advice, f"{words}: by {advice.after:.1f} sigma{stay}, {advice.before:.1f} without it"
        hidden = [test.effects.candidate(name).effect for name in test.invisible if name in test.effects.best]
        showing = advise.to_show(fitted, hidden)
        if showing is None or not showing.shows:
            return None
        return showing, f"would show {showing.shows} of {len(hidden)} effects that these orientations cannot"


@dataclass(frozen=True)
class Difference:
    """A parameter in two evaluations, the second less the first.

    sigma: one standard deviation of the difference; None, as for the parameters, where one of them is not determined.
    Of two recordings it is the root of the sum of squares, since their noise is independent. Of two models of one
    recording it is the larger of both sigmas: the same readings are in both, and the difference says how much the model
    matters.
    """

    first: Parameter
    second: Parameter
    sigma: float | None

    @property
    def symbol(self) -> str:
        return self.first.symbol

    @property
    def value(self) -> float | None:
        """The second less the first, in SI units; None where one of them is not determined."""
        if self.first.value is None or self.second.value is None:
            return None
        return self.second.value - self.first.value

    @property
    def sigmas(self) -> float | None:
        """The difference over its sigma."""
        return None if self.value is None or not self.sigma else self.value / self.sigma


def differences(first: Calibration, second: Calibration, same_recording: bool) -> tuple[Difference, ...]:
    """The differences of the parameters that both models have: of the twelve, then of coefficients of effects."""
    rows, others = list[Difference](), second.parameters
    for name, parameter in first.parameters.items():
        if name in others:
            sigmas = parameter.sigma, others[name].sigma
            determined = [sigma for sigma in sigmas if sigma is not None]
            sigma_of_both = max(determined, default=0.0) if same_recording else float(np.hypot.reduce(determined))
            rows.append(Difference(parameter, others[name], sigma_of_both if len(determined) == len(sigmas) else None))
    return tuple(rows)


@dataclass(frozen=True)
class SideBySide:
    """Two diagnoses, and whether they are of one recording, evaluated with two models."""

    first: Diagnosis
    second: Diagnosis
    same_recording: bool

    @cached_property
    def differences(self) -> tuple[Difference, ...]:
        """The differences of the parameters, the second's less the first's."""
        return differences(self.first.before, self.second.before, self.same_recording)

    @cached_property
    def p_value(self) -> float | None:
        """The chance that noise alone lets the twelve parameters of two recordings differ as much.

        d^T (P1 + P2)^-1 d of the parameters that both determine is chi-squared distributed. None for one recording.
        """
        if self.same_recording:
            return None
        one, other = self.first.before.estimate, self.second.before.estimate
        determined: Mask = ~(one.unseen | other.unseen)
        if not determined.any():
            return None
        differ = (other.parameters - one.parameters)[determined]
        spread = (one.parameter_covariance + other.parameter_covariance)[np.ix_(determined, determined)]
        return chi_squared_tail(len(differ), float(differ @ np.linalg.solve(spread, differ)))

    @property
    def farthest(self) -> Difference | None:
        """The difference that is largest in its sigma."""
        return max((each for each in self.differences if each.sigmas is not None),
                   key=lambda each: abs(each.sigmas or 0.0), default=None)  # fmt: skip
