"""When a bench was repaired: the probability of each time between two runs at which its coefficients changed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kf_calib.fleet.bench_coefficient import DatedSums
from kf_calib.fleet.campaign import Campaign, RunKey
from kf_calib.fleet.pooled_terms import PooledTerms, Term

_LEVEL = 0.95
_LIKELY = 1e-3  # of a part of a campaign: above it the part is looked at run by run


@dataclass(frozen=True)
class Gap:
    """The time between two runs of one bench that follow each other, and the probability that it was repaired then."""

    after: str
    before: str
    after_run: str
    before_run: str
    probability: float


@dataclass(frozen=True)
class RepairDate:
    """gaps: in the order of their probabilities, as few as hold 95 % of it together."""

    bench: str
    gaps: tuple[Gap, ...]


def repair_date(campaign: Campaign, others: PooledTerms, term: Term) -> RepairDate:
    """The date at which the coefficients of a term changed, beside the other terms."""
    assert term.repair is not None
    bench = term.repair[0]
    runs = [key for key in campaign.by_date if key.bench == campaign.benches[bench]]
    first, chances = DatedSums.of(campaign, others).dates(term.group, bench)
    if len(first) + 1 < len(runs):
        near = _near(first.tolist(), chances.tolist(), [key.rank for key in runs])
        first, chances = DatedSums.of(campaign, others, [(bench, rank) for rank in near]).dates(term.group, bench)
    places = {key.rank: k for k, key in enumerate(runs)}
    order = np.argsort(-chances)
    count = int(np.searchsorted(np.cumsum(chances[order]), _LEVEL)) + 1
    gaps = [_gap(runs, places[int(first[k])], float(chances[k])) for k in order[:count]]
    return RepairDate(campaign.benches[bench], tuple(gaps))


def _near(first: list[int], chances: list[float], ranks: list[int]) -> list[int]:
    """Return the ranks of all runs in the parts on either side of each date that is likely."""
    edges, nearby = [ranks[0], *first, ranks[-1] + 1], list[int]()
    for k, chance in enumerate(chances, start=1):
        if chance > _LIKELY:
            nearby += [rank for rank in ranks if edges[k - 1] <= rank < edges[k + 1]]
    return sorted(set(nearby))


def _gap(runs: list[RunKey], place: int, probability: float) -> Gap:
    before, after = runs[place - 1], runs[place]
    return Gap(before.date, after.date, before.run, after.run, probability)
