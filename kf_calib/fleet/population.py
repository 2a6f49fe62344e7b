"""Coefficients that are each unit's own, drawn about the mean of a population (random effects).

The evidence is exact for normal coefficients of a given spread and averaged over the spread and over the ratio of the
mean to it. The spread itself is estimated by restricted likelihood (REML), in which the mean has no prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import Floats, Mask
from kf_calib.fleet.campaign import Blocks, Group
from kf_calib.fleet.evidence import (
    FLAT,
    log_evidence,
    log_evidence_of_modes,
    log_mean,
    modes,
    posterior,
    sizes,
)
from kf_calib.fleet.pooled_terms import Common, PooledTerms, Sums, shares_of
from kf_calib.support.logarithms import weights

_LEAST = 0.25  # sigma of one run: the smallest spread that is expected
_RATIOS = np.array([0.0, 1.0, 3.0])  # of the mean of a population to its spread
_NARROW = 0.02  # sigma of one run: the smallest spread that is told from none
_FINE = 1.05  # ratio of the spreads among which the likeliest is looked for


@dataclass(frozen=True)
class PopulationEvidence:
    """Log evidence of own coefficients against none, and the likeliest spread and size of the mean, in
    ``Group.sigma``."""

    log_odds: float
    spread: float
    mean_size: float


class OwnCoefficients:
    """Sums over units (or runs) for one effect, for each spread of a grid."""

    def __init__(self, group: Group, terms: PooledTerms) -> None:
        self._terms, self._group = terms, group
        self._spreads = sizes(_LEAST, group.largest)
        self._more = [Common(k, 1.0) for k in range(group.columns.start, group.columns.stop)]
        count = len(terms.common) + len(self._more)
        self._own = np.zeros(len(self._spreads))
        self._total = Sums(np.zeros((count, count)), np.zeros(count))
        self._lost = Sums(np.zeros((len(self._spreads), count, count)), np.zeros((len(self._spreads), count)))

    def add(self, blocks: Blocks) -> None:
        """Add units, of which what is their own by other terms has been eliminated."""
        own, every = self._group.columns, [*self._terms.common, *self._more]
        shares = shares_of(every, blocks)
        values, along, turned = modes(blocks.info[:, own, own], blocks.score[:, own])
        across = turned @ (blocks.info[:, own][:, :, [each.column for each in every]] * shares[:, None, :])
        rows, scores = across.reshape(-1, len(every)), along.reshape(-1)
        for k, spread in enumerate(self._spreads):
            gain = (spread**2 / (1.0 + spread**2 * values)).reshape(-1, 1)
            self._own[k] += log_evidence_of_modes(values, along, spread).sum()
            self._lost.info[k] += rows.T @ (gain * rows)
            self._lost.score[k] += (gain * rows).T @ scores
        self._total = self._total + self._terms.sums(blocks, self._more)

    def evidence(self) -> PopulationEvidence:
        """The evidence of all blocks that were added."""
        count = len(self._terms.common)
        info, score = self._total.info - self._lost.info, self._total.score - self._lost.score
        means = self._spreads[:, None] * _RATIOS
        prior = np.concatenate([
            np.broadcast_to(self._terms.prior, (*means.shape, count)),
            np.repeat(means[..., None], len(self._more), axis=2),
        ], axis=2)  # fmt: skip
        logs = log_evidence(info[:, None], score[:, None], prior) + self._own[:, None]
        logs -= log_evidence(self._total.info[:count, :count], self._total.score[:count], self._terms.prior)
        best = np.unravel_index(np.argmax(logs), logs.shape)
        return PopulationEvidence(float(log_mean(logs)), float(self._spreads[best[0]]), float(means[best]))


@dataclass(frozen=True)
class Own:
    """What units tell of their own coefficients of one effect, with everything else known, in ``Group.sigma``.

    units (n,): their names. info (n, q, q), score (n, q).
    """

    units: Sequence[str]
    info: Floats
    score: Floats

    @classmethod
    def of(cls, group: Group, terms: PooledTerms, means: Floats, blocks: Blocks) -> Own:
        """What blocks tell, with the common coefficients of other terms at their ``means`` (j,)."""
        own, columns = group.columns, [each.column for each in terms.common]
        offsets = shares_of(terms.common, blocks) * means
        known = (blocks.info[:, own][:, :, columns] @ offsets[:, :, None])[:, :, 0]
        return cls(blocks.labels, blocks.info[:, own, own].copy(), blocks.score[:, own] - known)  # no view of all

    def only(self, kept: Mask) -> Own:
        """Some of them."""
        units = [unit for unit, here in zip(self.units, kept.tolist(), strict=True) if here]
        return Own(units, self.info[kept], self.score[kept])

    def by_unit(self) -> Own:
        """With one entry for each unit, where a repair of the bench has parted its runs."""
        names = list(dict.fromkeys(self.units))
        numbers = {unit: k for k, unit in enumerate(names)}
        places = [numbers[unit] for unit in self.units]
        info, score = np.zeros((len(names), *self.info.shape[1:])), np.zeros((len(names), *self.score.shape[1:]))
        np.add.at(info, places, self.info)
        np.add.at(score, places, self.score)
        return Own(names, info, score)

    @classmethod
    def joined(cls, parts: Sequence[Own]) -> Own:
        """All of several parts."""
        units = [unit for part in parts for unit in part.units]
        return cls(units, np.concatenate([part.info for part in parts]), np.concatenate([p.score for p in parts]))


@dataclass(frozen=True)
class Population:
    """Mean (q,) of a population with its covariance (q, q), and the spread about it with its 95 % interval."""

    mean: Floats
    covariance: Floats
    spread: float
    spread_interval: tuple[float, float]

    def coefficients(self, own: Own) -> list[tuple[Floats, Floats]]:
        """The coefficients (q,) of each unit with their covariance (q, q), given that it is of this population."""
        prior = np.full(len(self.mean), self.spread)
        rows = zip(own.info, own.score - own.info @ self.mean, strict=True)
        found = [posterior(info, score, prior) for info, score in rows]
        return [(self.mean + departure, covariance) for departure, covariance in found]


def population(own: Own, largest: float) -> Population:
    """The population from its units by restricted likelihood; largest: the largest spread that is tried."""
    tried, flat = np.concatenate([[0.0], sizes(_NARROW, largest, _FINE)]), np.full(own.score.shape[1], FLAT)
    values, along, turned = modes(own.info, own.score)
    told = [told_of_mean(values, along, turned, spread) for spread in tried.tolist()]
    rests = [Sums(info.sum(axis=0), score.sum(axis=0)) for info, score in told]
    logs = np.array([
        log_evidence_of_modes(values, along, spread).sum() + log_evidence(rest.info, rest.score, flat)
        for spread, rest in zip(tried.tolist(), rests, strict=True)
    ])  # fmt: skip
    best = int(np.argmax(logs))
    mean, covariance = posterior(rests[best].info, rests[best].score, flat)
    share = np.cumsum(weights(logs) * np.gradient(tried))
    places = np.searchsorted(share / share[-1], [0.025, 0.975])
    low, high = tried[np.minimum(places, len(tried) - 1)].tolist()
    return Population(mean, covariance, float(tried[best]), (low, high))


def told_of_mean(values: Floats, along: Floats, turned: Floats, spread: float) -> tuple[Floats, Floats]:
    """What each unit tells of the mean of a population, its own departure from it eliminated: information (n, q, q) and
    score (n, q), from the ``modes`` of what it tells of its own coefficients."""
    kept, back = 1.0 / (1.0 + spread**2 * values), np.swapaxes(turned, 1, 2)
    return back @ ((kept * values)[:, :, None] * turned), (back @ (kept * along)[:, :, None])[:, :, 0]
