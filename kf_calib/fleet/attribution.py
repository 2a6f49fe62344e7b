"""Which effects many runs have, and of what each is: the likeliest terms one after another, each against all rivals.

A term is taken in if no further term has a probability below 1 %. As all hypotheses (every effect with every
attribution, and none of them) compete in one table with probabilities, noise alone leads to a first term in at most 1 %
of campaigns, however many effects are tried (Markov's inequality, for noise as it is stated). After each new term the
others are decided anew beside it.

Before the runs, none has a probability of one half. The other half is shared equally by the effects that the runs can
show, and the share of an effect by what can have it, as its physics says: an error of an encoder is never of sensors.
A bench that was repaired, and what is each run's own, are a quarter as likely as the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.fleet.campaign import Blocks, Campaign, Group, log_evidence, log_evidence_of_modes, log_mean, modes, sizes
from kf_calib.fleet.own_coefficients import UnitInformation, UnitsAndCommon
from kf_calib.fleet.pooled_terms import (
    Attribution,
    Common,
    DatedSums,
    PooledTerms,
    Sums,
    Term,
    WeighedTerm,
    shares_of,
)
from kf_calib.fleet.shape import SomeUnits
from kf_calib.support.tail_probabilities import weights

NONE = 0.01
"""Probability of no further term above which the search ends."""
_MOST = 12
_ROUNDS = 4
_NONE = 0.5
_RARELY = {Attribution.REPAIRED: 0.25, Attribution.RUN: 0.25}  # how much likelier others are: 1
_HAS_IT = 0.5  # probability above which a unit counts as one that has the effect
_MAY_HAVE_IT = 0.05  # and as one that may have it


_LEAST = 0.25  # sigma of one run: the smallest spread that is expected
_RATIOS = np.array([0.0, 1.0, 3.0])  # of the mean of a population to its spread


@dataclass(frozen=True)
class Attributed:
    """The terms that were found, the table of each with all its rivals beside the others, and the last table."""

    terms: tuple[Term, ...]
    tables: tuple[AttributionTable, ...]
    rest: AttributionTable


def attributed(campaign: Campaign) -> Attributed:
    """Find the terms of a campaign."""
    benches, terms, tables = len(campaign.benches), list[Term](), list[AttributionTable]()
    rest = attribution_table(campaign, PooledTerms(terms, benches))
    while rest.none < NONE and len(terms) < _MOST:
        before = _kinds(terms)
        terms, tables = _settled(campaign, [*terms, chosen(rest).term], [*tables, rest])
        rest = attribution_table(campaign, PooledTerms(terms, benches))
        if _kinds(terms) == before:
            break
    return Attributed(tuple(terms), tuple(tables), rest)


def chosen(attributions: AttributionTable) -> AttributionHypothesis:
    """The likeliest attribution of the likeliest effect: first whether it is of the bench, then how."""
    name = next(iter(attributions.effects()))
    shares = attributions.of(name)
    of_bench = sum(share for each, share in shares.items() if each.common)
    side = {each: share for each, share in shares.items() if each.common == (of_bench > 0.5 * sum(shares.values()))}
    best = max(side, key=lambda each: side[each])
    return next(each for each in attributions.hypotheses if each.name == name and each.attribution is best)


def _settled(
    campaign: Campaign, terms: list[Term], tables: list[AttributionTable]
) -> tuple[list[Term], list[AttributionTable]]:
    """Decide each term anew beside the others until none changes; the last one was decided beside all others."""
    for _ in range(_ROUNDS if len(terms) > 1 else 0):
        before = _kinds(terms)
        for k in reversed(range(len(terms))):
            others = [term for n, term in enumerate(terms) if n != k]
            tables[k] = attribution_table(campaign, PooledTerms(others, len(campaign.benches)))
            terms[k] = chosen(tables[k]).term
        kept = [k for k, each in enumerate(tables) if each.none < NONE]
        terms, tables = [terms[k] for k in kept], [tables[k] for k in kept]
        if _kinds(terms) == before:
            break
    return terms, tables


def _kinds(terms: list[Term]) -> set[tuple[str, Attribution]]:
    return {(term.group.name, term.attribution) for term in terms}


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


def _of_runs(campaign: Campaign, terms: PooledTerms, groups: Sequence[Group]) -> list[WeighedTerm]:
    """Return the terms of coefficients of benches and, if units were measured again, of single runs."""
    of_bench = [group for group in groups if Attribution.BENCH.possible(group.borne_by)]
    dated = DatedSums(campaign, terms)
    sums = [OwnCoefficients(group, Attribution.RUN, terms) for group in groups] if campaign.repeats else []
    for blocks in campaign.runs():
        rest = terms.beside_own(blocks)
        dated.add(rest)
        for coefficients in sums:
            coefficients.add(rest)
    of_benches = [each for group in of_bench for each in (dated.constant(group), dated.repaired(group))]
    return [*filter(None, of_benches), *(coefficients.evidence() for coefficients in sums)]


def _of_units(campaign: Campaign, terms: PooledTerms, groups: Sequence[Group]) -> list[WeighedTerm]:
    """Return the terms of coefficients that units have, all of them or some."""
    groups = [group for group in groups if Attribution.SENSORS.possible(group.borne_by)]
    sums = [OwnCoefficients(group, Attribution.SENSORS, terms) for group in groups]
    parts = [list[UnitsAndCommon]() for _ in groups]
    for blocks in campaign.units(terms.repairs):
        rest = terms.beside_own(blocks)
        for group, coefficients, part in zip(groups, sums, parts, strict=True):
            coefficients.add(rest)
            part.append(UnitsAndCommon.of(group, terms, rest))
    weighed = list[WeighedTerm]()
    for group, coefficients, part in zip(groups, sums, parts, strict=True):
        information, (term, log_odds) = UnitsAndCommon.joined(part), coefficients.evidence()
        units, too_much = information.integrated(), information.explained_by_common()
        some = SomeUnits(group, units, with_mean=log_odds > 0.0)  # where nothing speaks for a mean of all, none
        every = float(np.logaddexp(log_odds, some.log_odds_of_all - too_much) - np.log(2.0))
        weighed += [WeighedTerm(term, every), WeighedTerm(_of_some(group, units, some), some.log_odds - too_much)]
    return weighed


def _of_some(group: Group, information: UnitInformation, some: SomeUnits) -> Term:
    """Return the term that some units have; which is asked only if it may be so."""
    chances = some.probabilities.tolist() if some.log_odds > 0.0 else [0.0] * len(information.units)
    may_have, has = (frozenset(unit for unit, chance in zip(information.units, chances, strict=True) if chance > least)
                     for least in (_MAY_HAVE_IT, _HAS_IT))  # fmt: skip
    return Term(group, Attribution.SOME, some.size, units=has, unsure=may_have - has)


def _log_prior(term: Term, tried: set[Attribution], groups: int) -> float:
    """Return the log of the probability of a term before the runs."""
    share = _RARELY.get(term.attribution, 1.0) / sum(_RARELY.get(each, 1.0) for each in tried)
    return float(np.log((1.0 - _NONE) / groups * share))


class OwnCoefficients:
    """Sums over units (or runs, by the attribution) for one effect, for each spread of a grid: the evidence that its
    coefficients are each one's own, drawn about the mean of a population (random effects).

    It is exact for normal coefficients of a given spread, and averaged over the spread and the ratio of the mean to it.
    """

    def __init__(self, group: Group, attribution: Attribution, terms: PooledTerms) -> None:
        self._terms, self._group, self._attribution = terms, group, attribution
        self._spreads = sizes(_LEAST, group.largest)
        self._more = [Common(k, 1.0) for k in range(group.columns.start, group.columns.stop)]
        count = len(terms.common) + len(self._more)
        self._own = np.zeros(len(self._spreads))
        self._total = Sums(np.zeros((count, count)), np.zeros(count))
        self._lost = Sums(np.zeros((len(self._spreads), count, count)), np.zeros((len(self._spreads), count)))

    def add(self, blocks: Blocks) -> None:
        """Add units, of which what is their own by other terms has been eliminated."""
        columns, commons = self._group.columns, [*self._terms.common, *self._more]
        shares = shares_of(commons, blocks)
        values, along, turned = modes(blocks.info[:, columns, columns], blocks.score[:, columns])
        across = turned @ (blocks.info[:, columns][:, :, [each.column for each in commons]] * shares[:, None, :])
        rows, scores = across.reshape(-1, len(commons)), along.reshape(-1)
        for k, spread in enumerate(self._spreads):
            gain = (spread**2 / (1.0 + spread**2 * values)).reshape(-1, 1)
            self._own[k] += log_evidence_of_modes(values, along, spread).sum()
            self._lost.info[k] += rows.T @ (gain * rows)
            self._lost.score[k] += (gain * rows).T @ scores
        self._total = self._total + self._terms.sums(blocks, self._more)

    def evidence(self) -> WeighedTerm:
        """The term, with the likeliest spread and size of the mean, by all blocks that were added."""
        count = len(self._terms.common)
        left = self._total - self._lost
        means = self._spreads[:, None] * _RATIOS
        prior = np.concatenate([
            np.broadcast_to(self._terms.prior, (*means.shape, count)),
            np.repeat(means[..., None], len(self._more), axis=2),
        ], axis=2)  # fmt: skip
        logs = log_evidence(left.info[:, None], left.score[:, None], prior) + self._own[:, None]
        logs -= log_evidence(self._total.info[:count, :count], self._total.score[:count], self._terms.prior)
        best = np.unravel_index(np.argmax(logs), logs.shape)
        term = Term(self._group, self._attribution, float(self._spreads[best[0]]), float(means[best]))
        return WeighedTerm(term, float(log_mean(logs)))
