"""The table of hypotheses that compete to be the next term: every effect with every attribution, and none of them.

Before the runs, none has a probability of one half. The other half is shared equally by the effects that the runs can
show. Of the share of an effect, two thirds are for what it usually belongs to, the bench or the sensors, and one third
is for the other; each part is shared equally, but a bench that was repaired is a quarter as likely as one that was not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.fleet.bench_coefficient import DatedSums
from kf_calib.fleet.campaign import Campaign, Group
from kf_calib.fleet.pooled_terms import Attribution, PooledTerms, Term
from kf_calib.fleet.population import Own, OwnCoefficients
from kf_calib.fleet.some_units import SomeUnits
from kf_calib.support.logarithms import weights

_USUAL = 2.0 / 3.0
_HAS_IT = 0.5
_RARELY = 0.25  # how much rarer a repair is than a bench that stays as it is


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

    @property
    def best(self) -> AttributionHypothesis:
        """The likeliest hypothesis."""
        return self.hypotheses[int(np.argmax(self.probabilities))]

    def of(self, name: str) -> dict[Attribution, float]:
        """The probability of each attribution of an effect."""
        rows = zip(self.hypotheses, self.probabilities.tolist(), strict=True)
        return {each.attribution: share for each, share in rows if each.name == name}

    def effects(self) -> dict[str, float]:
        """The probability of each effect, whatever it is of, the likeliest first."""
        found = {each.name: 0.0 for each in self.hypotheses}
        for each, share in zip(self.hypotheses, self.probabilities.tolist(), strict=True):
            found[each.name] += share
        return dict(sorted(found.items(), key=lambda item: -item[1]))


def table(campaign: Campaign, terms: PooledTerms) -> AttributionTable:
    """The table of the hypotheses for one term more than ``terms``."""
    groups = [group for group in campaign.groups if group.sigma and group.name not in terms.names()]
    every = [each for each in _every(campaign, terms, groups) if _can_be_told(each.term)]
    tried = {name: {each.attribution for each in every if each.name == name} for name in (g.name for g in groups)}
    rows = [replace(each, log_prior=_log_prior(each.term, tried[each.name], len(groups))) for each in every]
    logs = np.array([np.log(_HAS_IT), *(each.log_odds + each.log_prior for each in rows)])
    found = weights(logs)
    return AttributionTable(tuple(rows), found[1:], float(found[0]))


def _every(campaign: Campaign, terms: PooledTerms, groups: Sequence[Group]) -> list[AttributionHypothesis]:
    return [*_of_units(campaign, terms, groups), *_of_runs(campaign, terms, groups)]


def _can_be_told(term: Term) -> bool:
    """Tell whether the runs can speak for a term: what one unit alone shows is of what it usually belongs to."""
    return not term.group.alone or term.attribution.common == term.group.of_the_bench


def _of_runs(campaign: Campaign, terms: PooledTerms, groups: Sequence[Group]) -> list[AttributionHypothesis]:
    """Return the hypotheses of coefficients of benches and, if units were measured again, of single runs."""
    dated, out = DatedSums(campaign, terms), list[AttributionHypothesis]()
    sums = [OwnCoefficients(group, terms) for group in groups] if campaign.repeats else []
    for blocks in campaign.runs():
        rest = terms.beside_own(blocks)
        dated.add(rest)
        for own in sums:
            own.add(rest)
    for group in groups:
        one, two = dated.constant(group), dated.repaired(group)
        out.append(AttributionHypothesis(Term(group, Attribution.BENCH, one.size), one.log_odds, 0.0))
        if two is not None:
            term = Term(group, Attribution.REPAIRED, two.size, repair=two.repair)
            out.append(AttributionHypothesis(term, two.log_odds, 0.0))
    return [*out, *(_drawn(group, Attribution.RUN, own) for group, own in zip(groups, sums, strict=False))]


def _of_units(campaign: Campaign, terms: PooledTerms, groups: Sequence[Group]) -> list[AttributionHypothesis]:
    """Return the hypotheses of coefficients that units have, all of them or some."""
    means, sums = terms.solved(campaign)[0], [OwnCoefficients(group, terms) for group in groups]
    parts = [list[Own]() for _ in groups]
    for blocks in campaign.units(terms.repairs):
        rest = terms.beside_own(blocks)
        for group, own, part in zip(groups, sums, parts, strict=True):
            own.add(rest)
            part.append(Own.of(group, terms, means, rest))
    out = list[AttributionHypothesis]()
    for group, own, part in zip(groups, sums, parts, strict=True):
        units = Own.joined(part)
        every = _drawn(group, Attribution.SENSORS, own)
        some = SomeUnits(group, units, with_mean=every.log_odds > 0.0)  # where nothing speaks for any mean, none
        shapes = float(np.logaddexp(every.log_odds, some.log_odds_of_all) - np.log(2.0))
        out.append(replace(every, log_odds=shapes))
        out.append(_of_some(group, units, some))
    return out


def _of_some(group: Group, units: Own, some: SomeUnits) -> AttributionHypothesis:
    """Return the hypothesis that some units have it; which is asked only if it may be so."""
    held = some.probabilities > _HAS_IT if some.log_odds > 0.0 else np.zeros(len(units.units), bool)
    having = frozenset(unit for unit, here in zip(units.units, held.tolist(), strict=True) if here)
    return AttributionHypothesis(Term(group, Attribution.SOME, some.size, units=having), some.log_odds, 0.0)


def _drawn(group: Group, attribution: Attribution, own: OwnCoefficients) -> AttributionHypothesis:
    found = own.evidence()
    return AttributionHypothesis(Term(group, attribution, found.spread, found.mean_size), found.log_odds, 0.0)


def _log_prior(term: Term, tried: set[Attribution], groups: int) -> float:
    """Return the log of the probability of a term before the runs."""
    alike = {each: _RARELY if each is Attribution.REPAIRED else 1.0 for each in tried}
    usual = term.group.of_the_bench == term.attribution.common
    total = sum(part for each, part in alike.items() if each.common == term.attribution.common)
    share = (_USUAL if usual else 1.0 - _USUAL) * alike[term.attribution] / total
    return float(np.log((1.0 - _HAS_IT) / groups * share))
