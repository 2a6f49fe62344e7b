"""The table of hypotheses that compete to be the next term: every effect with every attribution, and none of them.

Before the runs, none has a probability of one half. The other half is shared equally by the effects that the runs can
show, and the share of an effect by what can have it, as its physics says: an error of an encoder is never of sensors.
A bench that was repaired, and what is each run's own, are a quarter as likely as the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.fleet.bench_coefficient import DatedSums
from kf_calib.fleet.campaign import Campaign, Group
from kf_calib.fleet.own_coefficients import UnitInformation, UnitsAndCommon
from kf_calib.fleet.pooled_terms import Attribution, PooledTerms, Term
from kf_calib.fleet.population_evidence import OwnCoefficients
from kf_calib.fleet.some_units import SomeUnits
from kf_calib.support.logarithms import weights

_NONE = 0.5
_RARELY = {Attribution.REPAIRED: 0.25, Attribution.RUN: 0.25}  # how much likelier others are: 1
_HAS_IT = 0.5  # probability above which a unit counts as one that has the effect
_MAY_HAVE_IT = 0.05  # and as one that may have it


_Weighed = tuple[Term, float]
"""A term and its log evidence against none."""


@dataclass(frozen=True)
class AttributionHypothesis:
    """A term that may be the next: its log evidence against none, and the log of its probability before the runs."""

    term: Term
    log_odds: float
    log_prior: float

    @property
    def name(self) -> str:
        """Its effect."""
        return self.term.group.name

    @property
    def attribution(self) -> Attribution:
        """Of what the effect is."""
        return self.term.attribution


@dataclass(frozen=True)
class AttributionTable:
    """All hypotheses with their probabilities (n,), and the probability that there is no further term."""

    hypotheses: tuple[AttributionHypothesis, ...]
    probabilities: Floats
    none: float

    def of(self, name: str) -> dict[Attribution, float]:
        """The probability of each attribution of an effect."""
        rows = zip(self.hypotheses, self.probabilities.tolist(), strict=True)
        return {each.attribution: share for each, share in rows if each.name == name}

    def effects(self) -> dict[str, float]:
        """The probability of each effect, whatever it is of, the likeliest first."""
        probabilities = {each.name: 0.0 for each in self.hypotheses}
        for each, share in zip(self.hypotheses, self.probabilities.tolist(), strict=True):
            probabilities[each.name] += share
        return dict(sorted(probabilities.items(), key=lambda item: -item[1]))


def attribution_table(campaign: Campaign, terms: PooledTerms) -> AttributionTable:
    """The table of the hypotheses for one term more than ``terms``."""
    groups = [group for group in campaign.groups if group.sigma and group.name not in terms.names()]
    weighed = [*_of_units(campaign, terms, groups), *_of_runs(campaign, terms, groups)]
    tried = {group.name: {term.attribution for term, _ in weighed if term.group is group} for group in groups}
    rows = [
        AttributionHypothesis(term, log_odds, _log_prior(term, tried[term.group.name], len(groups)))
        for term, log_odds in weighed
    ]
    logs = np.array([np.log(_NONE), *(each.log_odds + each.log_prior for each in rows)])
    found = weights(logs)
    return AttributionTable(tuple(rows), found[1:], float(found[0]))


def _of_runs(campaign: Campaign, terms: PooledTerms, groups: Sequence[Group]) -> list[_Weighed]:
    """Return the terms of coefficients of benches and, if units were measured again, of single runs."""
    of_bench = [group for group in groups if Attribution.BENCH.possible(group.borne_by)]
    dated, weighed = DatedSums(campaign, terms), list[_Weighed]()
    sums = [OwnCoefficients(group, terms) for group in groups] if campaign.repeats else []
    for blocks in campaign.runs():
        rest = terms.beside_own(blocks)
        dated.add(rest)
        for coefficients in sums:
            coefficients.add(rest)
    for group in of_bench:
        one, two = dated.constant(group), dated.repaired(group)
        weighed.append((Term(group, Attribution.BENCH, one.size), one.log_odds))
        if two is not None:
            term = Term(group, Attribution.REPAIRED, two.size, repair=two.repair)
            weighed.append((term, two.log_odds))
    return [
        *weighed,
        *(_drawn(group, Attribution.RUN, coefficients) for group, coefficients in zip(groups, sums, strict=False)),
    ]


def _of_units(campaign: Campaign, terms: PooledTerms, groups: Sequence[Group]) -> list[_Weighed]:
    """Return the terms of coefficients that units have, all of them or some."""
    groups = [group for group in groups if Attribution.SENSORS.possible(group.borne_by)]
    sums, parts = [OwnCoefficients(group, terms) for group in groups], [list[UnitsAndCommon]() for _ in groups]
    for blocks in campaign.units(terms.repairs):
        rest = terms.beside_own(blocks)
        for group, coefficients, part in zip(groups, sums, parts, strict=True):
            coefficients.add(rest)
            part.append(UnitsAndCommon.of(group, terms, rest))
    weighed = list[_Weighed]()
    for group, coefficients, part in zip(groups, sums, parts, strict=True):
        information, (term, log_odds) = UnitsAndCommon.joined(part), _drawn(group, Attribution.SENSORS, coefficients)
        units, too_much = information.integrated(), information.explained_by_common()
        some = SomeUnits(group, units, with_mean=log_odds > 0.0)  # where nothing speaks for a mean of all, none
        weighed.append((term, float(np.logaddexp(log_odds, some.log_odds_of_all - too_much) - np.log(2.0))))
        weighed.append((_of_some(group, units, some), some.log_odds - too_much))
    return weighed


def _of_some(group: Group, information: UnitInformation, some: SomeUnits) -> Term:
    """Return the term that some units have; which is asked only if it may be so."""
    chances = some.probabilities.tolist() if some.log_odds > 0.0 else [0.0] * len(information.units)
    may_have, has = (frozenset(unit for unit, chance in zip(information.units, chances, strict=True) if chance > least)
                     for least in (_MAY_HAVE_IT, _HAS_IT))  # fmt: skip
    return Term(group, Attribution.SOME, some.size, units=has, unsure=may_have - has)


def _drawn(group: Group, attribution: Attribution, coefficients: OwnCoefficients) -> _Weighed:
    found = coefficients.evidence()
    return Term(group, attribution, found.spread, found.mean_size), found.log_odds


def _log_prior(term: Term, tried: set[Attribution], groups: int) -> float:
    """Return the log of the probability of a term before the runs."""
    share = _RARELY.get(term.attribution, 1.0) / sum(_RARELY.get(each, 1.0) for each in tried)
    return float(np.log((1.0 - _NONE) / groups * share))
