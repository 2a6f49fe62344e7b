"""Terms of the pooled model of many runs, what they leave of everything else, and the evidence of those of a bench.

A term is an effect with an attribution: coefficients that all runs of a bench have in common (or that change once, when
it is repaired), or coefficients of each unit (or run) that are drawn about a common mean. The terms are eliminated from
the inside out, each with its normal prior: first what is a unit's own, then what units have in common.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench.arrays import Floats
from kf_calib.effects import Bearer
from kf_calib.fleet.campaign import FLAT, STEP, Blocks, Campaign, Group, log_evidence, log_mean, posterior, sizes
from kf_calib.support.tail_probabilities import weights


class Attribution(StrEnum):
    """Of what an effect is: how its coefficients in different runs go together.

    - BENCH: all runs of a bench have the same.
    - REPAIRED: the same, but others from some date on.
    - SENSORS: each unit has its own, about a mean of this type of sensor.
    - SOME: some units have it, each its own, and the others do not.
    - RUN: each run has its own.
    """

    BENCH = "bench"
    REPAIRED = "bench-repaired"
    SENSORS = "sensors"
    SOME = "some-units"
    RUN = "runs"

    @property
    def common(self) -> bool:
        """Whether the coefficients are the bench's."""
        return self in (Attribution.BENCH, Attribution.REPAIRED)

    def possible(self, borne_by: Bearer) -> bool:
        """Whether an effect can be this, by its physics; in each run it may be another, whatever has it."""
        if self is Attribution.RUN or borne_by is Bearer.EITHER:
            return True
        return self.common == (borne_by is Bearer.BENCH)


@dataclass(frozen=True)
class Term:
    """A term of the pooled model; sizes are in units of ``Group.sigma``.

    - size: of the prior of a bench's coefficients, or the spread of the units' about their mean.
    - mean_size: of the prior of that mean.
    - repair: number of the bench and first rank after the repair.
    - units: the units that have it, where not all do; unsure: further units that may have it.
    """

    group: Group
    attribution: Attribution
    size: float
    mean_size: float = 0.0
    repair: tuple[int, int] | None = None
    units: frozenset[str] | None = None
    unsure: frozenset[str] = frozenset()

    def free(self) -> Term:
        """The same with nothing supposed of its coefficients: none is drawn to zero, to a mean or to those of others.

        Sizes decide what there is; what it is, is then estimated without them.
        """
        units = None if self.units is None else self.units | self.unsure
        return replace(self, size=FLAT, mean_size=0.0, units=units)


class WeighedTerm(NamedTuple):
    """A term with what is not known of it where it is likeliest, and its log evidence against none, averaged over what
    is not known."""

    term: Term
    log_odds: float


@dataclass(frozen=True)
class Common:
    """A coefficient that runs have in common: its column, the runs that have it, and the size of its prior.

    bench: number of the bench, or -1 for all. since, until: ranks of the first run that has it and of the first that
    has it no more.
    """

    column: int
    size: float
    bench: int = -1
    since: int = 0
    until: int = np.iinfo(np.int64).max

    def within(self, blocks: Blocks) -> Floats:
        """1 for each block that has it, 0 for the others (n,)."""
        here = (blocks.bench == self.bench) | (self.bench < 0)
        return (here & (blocks.rank >= self.since) & (blocks.rank < self.until)).astype(float)


@dataclass(frozen=True)
class Sums:
    """Information (j, j) and score (j,) of common coefficients, summed over all blocks."""

    info: Floats
    score: Floats

    def __add__(self, other: Sums) -> Sums:
        return Sums(self.info + other.info, self.score + other.score)

    def __sub__(self, other: Sums) -> Sums:
        return Sums(self.info - other.info, self.score - other.score)


class PooledTerms:
    """The accepted terms of the pooled model and the coefficients that these have in common."""

    def __init__(self, terms: Sequence[Term], benches: int) -> None:
        self.terms = tuple(terms)
        self.common = [each for term in terms for each in commons_of(term, benches)]
        self.prior = np.array([each.size for each in self.common])

    @property
    def repairs(self) -> list[tuple[int, int]]:
        """Benches and first ranks of the repairs among the terms."""
        return [term.repair for term in self.terms if term.repair is not None]

    def names(self) -> set[str]:
        """The effects of the terms."""
        return {term.group.name for term in self.terms}

    def beside_own(self, blocks: Blocks) -> Blocks:
        """The blocks with the coefficients eliminated that are a unit's own."""
        of_units = [term for term in self.terms if not term.attribution.common]
        if not of_units:
            return blocks
        columns = np.concatenate([np.arange(term.group.columns.start, term.group.columns.stop) for term in of_units])
        spread = np.concatenate([_spreads(term, blocks) for term in of_units], axis=1)
        across = blocks.info[:, columns] * spread[:, :, None]
        inner = np.eye(len(columns)) + across[:, :, columns] * spread[:, None, :]
        gains = np.linalg.solve(inner, across)
        turned = np.swapaxes(gains, 1, 2)
        score = blocks.score - (turned @ (blocks.score[:, columns] * spread)[:, :, None])[:, :, 0]
        return replace(blocks, info=blocks.info - turned @ across, score=score)

    def sums(self, blocks: Blocks, more: Sequence[Common] = ()) -> Sums:
        """What blocks tell of the common coefficients and of ``more`` of them."""
        every = [*self.common, *more]
        if not every:
            return Sums(np.zeros((0, 0)), np.zeros(0))
        columns, shares = [each.column for each in every], shares_of(every, blocks)
        info = np.einsum("nij,ni,nj->ij", blocks.info[:, columns][:, :, columns], shares, shares)
        return Sums(info, np.sum(blocks.score[:, columns] * shares, axis=0))


def shares_of(common: Sequence[Common], blocks: Blocks) -> Floats:
    """``Common.within`` of several coefficients (n, j)."""
    return np.array([each.within(blocks) for each in common]).reshape(len(common), len(blocks.bench)).T


def commons_of(term: Term, benches: int) -> Iterable[Common]:
    """The coefficients that runs have in common by a term."""
    columns = range(term.group.columns.start, term.group.columns.stop)
    if not term.attribution.common:
        return [Common(column, term.mean_size) for column in columns if term.mean_size]
    commons = list[Common]()
    for bench in range(benches):
        whole = [Common(column, term.size, bench) for column in columns]
        if term.repair is None or term.repair[0] != bench:
            commons += whole
        else:
            first = term.repair[1]
            commons += [replace(each, until=first) for each in whole] + [replace(each, since=first) for each in whole]
    return commons


def _spreads(term: Term, blocks: Blocks) -> Floats:
    """Return the spread (n, q) of the coefficients in each block: 0 in those of units that do not have the effect."""
    count = term.group.columns.stop - term.group.columns.start
    if term.units is None:
        return np.full((len(blocks.units), count), term.size)
    has = np.array([unit in term.units for unit in blocks.units], float)
    return np.repeat(term.size * has[:, None], count, axis=1)


_SLOTS = 48  # at most as many parts of a campaign between which a repair is looked for at first
_PERIODS = 12  # at most as many parts in which a coefficient is followed over time
_LEAST = 0.5  # sigma of all runs together: the smallest size that is expected
_SIDES = np.array([[1.0, 1.0], [1.0, 0.0], [0.0, 1.0]])  # of a repair on which there is an error: both, or only one
_COARSE = 4.0  # ratio of the sizes of a coefficient that changes


@dataclass(frozen=True)
class BenchEstimate:
    """Coefficients (q,) of a bench from the run of rank ``since`` on, with their covariance, in ``Group.sigma``."""

    bench: int
    since: int
    mean: Floats
    covariance: Floats


class DatedSums:
    """What runs tell, summed over parts of the campaign between dates, each of one bench: memory does not grow with
    the number of runs."""

    def __init__(self, campaign: Campaign, terms: PooledTerms, parted: Sequence[tuple[int, int]] = ()) -> None:
        """parted: benches and first ranks of further parts."""
        self._campaign, self._terms, self._parted = campaign, terms, [*terms.repairs, *parted]
        self._first = [self._firsts(bench) for bench in range(len(campaign.benches))]
        counts = [len(own) for own in self._first]
        self._starts, slots, columns = np.cumsum([0, *counts]), sum(counts), campaign.groups[-1].columns.stop
        self._slots = Blocks(
            (), (), np.repeat(np.arange(len(counts)), counts), np.concatenate(self._first),
            np.zeros((slots, columns, columns)), np.zeros((slots, columns)),
        )  # fmt: skip

    def _firsts(self, bench: int) -> NDArray[np.intp]:
        """Return the rank of the first run of each part: equal numbers of runs, and a new part at each repair."""
        name = self._campaign.benches[bench]
        ranks = np.sort([key.rank for key in self._campaign.keys if key.bench == name])
        chosen = ranks[np.unique(np.linspace(0, len(ranks), min(_SLOTS, len(ranks)), endpoint=False).astype(int))]
        return np.unique([*chosen, *(first for where, first in self._parted if where == bench)])

    def add(self, blocks: Blocks) -> None:
        """Add runs, of which what is their own has been eliminated."""
        for k, (bench, rank) in enumerate(zip(blocks.bench, blocks.rank, strict=True)):
            place = self._starts[bench] + np.searchsorted(self._first[bench], rank, side="right") - 1
            self._slots.info[place] += blocks.info[k]
            self._slots.score[place] += blocks.score[k]

    @classmethod
    def of(cls, campaign: Campaign, terms: PooledTerms, parted: Sequence[tuple[int, int]] = ()) -> DatedSums:
        """The sums over all runs of a campaign."""
        dated = cls(campaign, terms, parted)
        for blocks in campaign.runs():
            dated.add(terms.beside_own(blocks))
        return dated

    def estimates(self, group: Group, repair: tuple[int, int] | None = None) -> list[BenchEstimate]:
        """The coefficients of each bench beside the terms, with nothing known of them before."""
        term = Term(group, Attribution.REPAIRED if repair else Attribution.BENCH, FLAT, repair=repair)
        return self._estimated(group, list(commons_of(term, len(self._first))))

    def over_time(self, group: Group, bench: int) -> list[BenchEstimate]:
        """The coefficients of one bench in each of a few parts of the campaign, as if it were repaired between them."""
        first = self._first[bench]
        edges = first[np.unique(np.linspace(0, len(first), min(_PERIODS, len(first)), endpoint=False).astype(int))]
        ends = [*edges[1:].tolist(), Common.until]
        parts = [Common(k, FLAT, bench, since, until)
                 for since, until in zip(edges.tolist(), ends, strict=True) for k in _range(group)]  # fmt: skip
        return self._estimated(group, [*parts, *self._of_others(group, bench, FLAT)])[: len(edges)]

    def _estimated(self, group: Group, more: Sequence[Common]) -> list[BenchEstimate]:
        """Return the estimates of further coefficients beside the terms: those of the group, again and again."""
        sums = self._terms.sums(self._slots, more)
        known, count = len(self._terms.prior), len(_range(group))
        mean, covariance = posterior(sums.info, sums.score, np.append(self._terms.prior, np.full(len(more), FLAT)))
        parts = [slice(known + k, known + k + count) for k in range(0, len(more), count)]
        return [BenchEstimate(first.bench, first.since, mean[part], covariance[part, part])
                for first, part in zip(more[::count], parts, strict=True)]  # fmt: skip

    def _of_others(self, group: Group, bench: int, size: float) -> list[Common]:
        """Return the coefficients of all benches but one."""
        return [Common(k, size, other) for other in range(len(self._first)) if other != bench for k in _range(group)]

    def constant(self, group: Group) -> WeighedTerm:
        """The evidence that the runs of each bench have one coefficient vector."""
        sizes_tried = self._sizes(group, STEP)
        more = [Common(k, 1.0, bench) for bench in range(len(self._first)) for k in _range(group)]
        sums = self._terms.sums(self._slots, more)
        logs = log_evidence(sums.info, sums.score, self._priors(sizes_tried, len(more))) - self._nothing()
        return WeighedTerm(Term(group, Attribution.BENCH, float(sizes_tried[np.argmax(logs)])), float(log_mean(logs)))

    def repaired(self, group: Group) -> WeighedTerm | None:
        """The evidence that on one bench it is another vector from some run on; None if no bench has two runs."""
        tried = self._sizes(group, _COARSE)
        benches = [k for k, firsts in enumerate(self._first) if len(firsts) > 1]
        if not benches:
            return None
        logs = {bench: self._with_repairs(group, bench, tried) for bench in benches}
        bench = max(benches, key=lambda k: float(logs[k].max()))
        place, size = np.unravel_index(np.argmax(logs[bench]), logs[bench].shape)
        mean = log_mean(np.array([log_mean(own, axis=0) for own in logs.values()]))
        repair = bench, int(self._first[bench][place + 1])
        return WeighedTerm(Term(group, Attribution.REPAIRED, float(tried[size]), repair=repair), float(mean))

    def dates(self, group: Group, bench: int) -> tuple[NDArray[np.intp], Floats]:
        """First ranks (k,) after a repair of a bench between its parts, and the probability of each."""
        logs = log_mean(self._with_repairs(group, bench, self._sizes(group, _COARSE)), axis=1)
        firsts = self._first[bench]
        return firsts[1:], weights(logs + np.log(np.diff(firsts)))

    def _with_repairs(self, group: Group, bench: int, tried: Floats) -> Floats:
        """Return the log evidence (k, t) of a repair of one bench before each of its parts but the first.

        It is as likely that there is an error before and after it as that there is none before, or none after.
        """
        others = self._of_others(group, bench, 1.0)
        fixed = [*self._terms.common, *others]
        whole = self._terms.sums(self._slots, others)
        part = slice(self._starts[bench], self._starts[bench + 1])
        of_all = self._slots
        slots = Blocks((), (), of_all.bench[part], of_all.rank[part], of_all.info[part], of_all.score[part])
        of_group, columns, shares = list(_range(group)), [each.column for each in fixed], shares_of(fixed, slots)
        inner = np.cumsum(slots.info[:, of_group][:, :, of_group], axis=0)
        across = np.cumsum(slots.info[:, columns][:, :, of_group] * shares[:, :, None], axis=0)
        along = np.cumsum(slots.score[:, of_group], axis=0)
        before = [each[:-1] for each in (inner, across, along)]
        after = [each[-1:] - each[:-1] for each in (inner, across, along)]
        infos, scores = _joined(whole.info, whole.score, before, after)
        present = np.concatenate([np.ones((len(_SIDES), len(fixed))), np.repeat(_SIDES, len(of_group), axis=1)], axis=1)
        priors = self._priors(tried, len(others) + 2 * len(of_group)) * present[:, None]
        logs = log_evidence(infos[:, None, None], scores[:, None, None], priors)
        return log_mean(logs, axis=1) - self._nothing()

    def _nothing(self) -> float:
        """Return the log evidence of the terms alone."""
        found = self._terms.sums(self._slots)
        return float(log_evidence(found.info, found.score, self._terms.prior))

    def _sizes(self, group: Group, step: float) -> Floats:
        return sizes(_LEAST / np.sqrt(len(self._campaign.keys)), group.largest, step)

    def _priors(self, tried: Floats, count: int) -> Floats:
        """Return the standard deviations (t, j) of the terms' coefficients and of ``count`` more."""
        known = np.broadcast_to(self._terms.prior, (len(tried), len(self._terms.prior)))
        return np.concatenate([known, np.repeat(tried[:, None], count, axis=1)], axis=1)


def _range(group: Group) -> range:
    return range(group.columns.start, group.columns.stop)


def _joined(info: Floats, score: Floats, before: Sequence[Floats], after: Sequence[Floats]) -> tuple[Floats, Floats]:
    """Return information and score (k, ...) of fixed coefficients and of those before and after each possible date.

    Each side is the information (k, q, q) of its coefficients, that with the fixed ones (k, j, q), and the score.
    """
    dates, fixed, width = before[1].shape
    infos = np.zeros((dates, fixed + 2 * width, fixed + 2 * width))
    infos[:, :fixed, :fixed] = info
    for k, (inner, across, _) in enumerate((before, after)):
        part = slice(fixed + k * width, fixed + (k + 1) * width)
        infos[:, part, part], infos[:, :fixed, part] = inner, across
        infos[:, part, :fixed] = np.swapaxes(across, 1, 2)
    scores = np.concatenate([np.broadcast_to(score, (dates, fixed)), before[2], after[2]], axis=1)
    return infos, scores
