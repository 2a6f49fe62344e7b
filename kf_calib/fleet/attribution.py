"""Which effects many runs have, and of what each is: the likeliest terms one after another, each against all rivals.

A term is taken in if no further term has a probability below 1 %. As all hypotheses compete in one table with
probabilities, noise alone leads to a first term in at most 1 % of campaigns, however many effects are tried (Markov's
inequality, for noise as it is stated). After each new term the others are decided anew beside it.
"""

from __future__ import annotations

from dataclasses import dataclass

from kf_calib.fleet.campaign import Campaign
from kf_calib.fleet.hypotheses import AttributionHypothesis, AttributionTable, attribution_table
from kf_calib.fleet.pooled_terms import Attribution, PooledTerms, Term

NONE = 0.01
"""Probability of no further term above which the search ends."""
_MOST = 12
_ROUNDS = 4


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
