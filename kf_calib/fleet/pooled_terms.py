"""Terms of the pooled model of many runs, and what they leave of everything else.

A term is an effect with an attribution: coefficients that all runs of a bench have in common, or coefficients of each
unit (or run) that are drawn about a common mean. The terms are eliminated from the inside out, each with its normal
prior: first what is a unit's own, then what units have in common.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.effects import Bearer
from kf_calib.fleet.campaign import FLAT, Blocks, Campaign, Group, posterior


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
        own = [term for term in self.terms if not term.attribution.common]
        if not own:
            return blocks
        columns = np.concatenate([np.arange(term.group.columns.start, term.group.columns.stop) for term in own])
        spread = np.concatenate([_spreads(term, blocks) for term in own], axis=1)
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

    def solved(self, campaign: Campaign) -> tuple[Floats, Floats]:
        """Mean (j,) and covariance (j, j) of the common coefficients from all runs."""
        parts = [self.sums(self.beside_own(blocks)) for blocks in campaign.units(self.repairs)]
        total = sum(parts[1:], parts[0])
        return posterior(total.info, total.score, self.prior)


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
