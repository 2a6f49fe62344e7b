"""What units (or runs) tell of coefficients that are each one's own, beside those that all have in common.

Nothing is supposed of the own coefficients of any other unit while those of one are looked at: the common ones are
those that fit when the coefficients in question are free in every unit, and what is uncertain of them is counted. So an
error of the bench that was fitted first takes nothing away from the one unit that differs.

The mean of a population of units and the spread of their coefficients about it are random effects. The spread is
estimated by restricted likelihood (REML), in which the mean and what all runs have in common are unknown without any
prior. Its interval is that of the misfit Q of the units to their mean: Q of the true spread is distributed as
chi-squared, whatever the mean and however few the units (Q-profile, W. Viechtbauer, 2007).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from kf_calib.bench.arrays import Floats, Mask
from kf_calib.fleet.campaign import (
    FLAT,
    SEEN,
    STEP,
    Blocks,
    Group,
    log_evidence,
    log_evidence_of_modes,
    modes,
    posterior,
    sizes,
)
from kf_calib.fleet.pooled_terms import PooledTerms, Sums, shares_of


@dataclass(frozen=True)
class UnitInformation:
    """What units tell of their own coefficients of one effect, in ``Group.sigma``.

    units (n,): their names. info (n, q, q), score (n, q).
    """

    units: Sequence[str]
    info: Floats
    score: Floats

    def only(self, kept: Mask) -> UnitInformation:
        """Some of them."""
        units = [unit for unit, here in zip(self.units, kept.tolist(), strict=True) if here]
        return UnitInformation(units, self.info[kept], self.score[kept])

    def estimates(self) -> list[tuple[Floats, Floats]]:
        """The coefficients (q,) of each with their covariance (q, q), from what it tells itself and nothing else."""
        flat = np.full(self.score.shape[1], FLAT)
        return [posterior(info, score, flat) for info, score in zip(self.info, self.score, strict=True)]


@dataclass(frozen=True)
class UnitsAndCommon:
    """The same together with the common coefficients of other terms.

    - of_units: with all common coefficients at zero. across (n, q, j): its information in common with these.
    - common: what is known of the common coefficients where the own ones are free in every unit. prior (j,): of them.
    """

    of_units: UnitInformation
    across: Floats
    common: Sums
    prior: Floats

    @classmethod
    def of(cls, group: Group, terms: PooledTerms, blocks: Blocks) -> UnitsAndCommon:
        """What blocks tell, of which what is their own by other terms has been eliminated."""
        of_group, columns = group.columns, [each.column for each in terms.common]
        info, score = blocks.info[:, of_group, of_group].copy(), blocks.score[:, of_group].copy()  # no views of all
        across = blocks.info[:, of_group][:, :, columns] * shares_of(terms.common, blocks)[:, None, :]
        own = UnitInformation(blocks.labels, info, score)
        return cls(own, across, terms.sums(blocks) - _taken(own, across), terms.prior)

    @classmethod
    def joined(cls, parts: Sequence[UnitsAndCommon]) -> UnitsAndCommon:
        """All of several parts."""
        units = [unit for part in parts for unit in part.of_units.units]
        arrays = zip(*((part.of_units.info, part.of_units.score, part.across) for part in parts), strict=True)
        info, score, across = map(np.concatenate, arrays)
        common = sum((part.common for part in parts[1:]), parts[0].common)
        return cls(UnitInformation(units, info, score), across, common, parts[0].prior)

    def by_unit(self) -> UnitsAndCommon:
        """With one entry for each unit, where a repair of the bench or another bench has parted its runs."""
        names = list(dict.fromkeys(self.of_units.units))
        numbers = {unit: k for k, unit in enumerate(names)}
        places = [numbers[unit] for unit in self.of_units.units]
        info, score, across = (
            _added(each, places, len(names)) for each in (self.of_units.info, self.of_units.score, self.across)
        )
        return UnitsAndCommon(UnitInformation(names, info, score), across, self.common, self.prior)

    def integrated(self) -> UnitInformation:
        """What each unit tells where nothing is known of the common coefficients but what all units tell of them."""
        mean, covariance = posterior(self.common.info, self.common.score, self.prior)
        unsure = self.across @ covariance @ np.swapaxes(self.across, 1, 2)
        kept = np.linalg.solve(_not_singular(self.of_units.info + unsure), self.of_units.info)
        score = self.of_units.score - self.across @ mean
        info = self.of_units.info @ kept
        return UnitInformation(
            self.of_units.units, 0.5 * (info + np.swapaxes(info, 1, 2)), np.einsum("npq,np->nq", kept, score)
        )

    def explained_by_common(self) -> float:
        """By how much less all units together speak for own coefficients than each by itself: the log of likelihoods.

        Without own coefficients, the common ones change to explain what they can of what is alike in units. What each
        unit by itself tells knows nothing of that.
        """
        without = self.common + _taken(self.of_units, self.across)
        together = _fit(self.common, self.prior) + _fits(self.of_units) - _fit(without, self.prior)
        return _fits(self.integrated()) - together


def _taken(own: UnitInformation, across: Floats) -> Sums:
    """Return what own coefficients that are free take of what units tell of the common ones."""
    gains = np.linalg.solve(_not_singular(own.info), np.concatenate([across, own.score[:, :, None]], axis=2))
    taken = np.einsum("nqi,nqj->ij", across, gains)
    return Sums(taken[:, :-1], taken[:, -1])


def _fit(sums: Sums, prior: Floats) -> float:
    """Return the log of how much likelier coefficients make the readings."""
    return 0.5 * float(sums.score @ posterior(sums.info, sums.score, prior)[0])


def _fits(own: UnitInformation) -> float:
    """Return the same of own coefficients without a prior."""
    return 0.5 * float(np.sum(own.score * np.linalg.solve(_not_singular(own.info), own.score[:, :, None])[:, :, 0]))


def _not_singular(info: Floats) -> Floats:
    """Return information that knows next to nothing of what no reading shows."""
    return info + np.eye(info.shape[-1]) / FLAT**2


def _added(values: Floats, places: Sequence[int], count: int) -> Floats:
    """Return sums (count, ...) of the values (n, ...) at each place."""
    total = np.zeros((count, *values.shape[1:]))
    np.add.at(total, places, values)
    return total


_NARROW, _WIDE = 0.02, 1e6  # sigma of one run: the smallest spread that is told from none, and a larger one than any
_ABOVE = (0.025, 0.975)  # probability that chi-squared is above that at the lower and the upper end of the interval


@dataclass(frozen=True)
class Population:
    """Mean (q,) of a population with its covariance (q, q), and the spread about it with its 95 % interval."""

    mean: Floats
    covariance: Floats
    spread: float
    spread_interval: tuple[float, float]


def population(information: UnitsAndCommon, members: Mask, largest: float) -> Population | None:
    """The population of some units; None where they are too few to have a spread.

    members (n,): who is of it; nothing is supposed of the others. largest: the largest likeliest spread.
    """
    misfits = _Misfits(information, members)
    if misfits.freedom < 1:
        return None
    spread = misfits.likeliest(largest)
    mean, covariance = misfits.mean(spread)
    low, high = misfits.interval()
    return Population(mean, covariance, spread, (low, high))


class _Misfits:
    """How well units fit to their common mean, for every spread about it."""

    def __init__(self, told: UnitsAndCommon, members: Mask) -> None:
        self._common = told.common
        self._values, self._along, self._turned = modes(told.of_units.info[members], told.of_units.score[members])
        self._seen = self._values > SEEN * self._values.max(initial=0.0)
        self._rows = self._turned @ told.across[members]
        self._coefficients = told.of_units.score.shape[1]
        self._prior = np.concatenate([np.full(self._coefficients, FLAT), told.prior])

    @cached_property
    def freedom(self) -> int:
        """Degrees of freedom of the misfit: what units tell, less the mean and what this takes of the common ones."""
        ranks = [int(np.linalg.matrix_rank(info, hermitian=True, rtol=SEEN)) if info.size else 0
                 for info in (self._common.info, self._sums(0.0).info)]  # fmt: skip
        return int(self._seen.sum()) + ranks[0] - ranks[1]

    def likeliest(self, largest: float) -> float:
        """The spread of the largest likelihood: the best of a grid, and then the best near that."""
        from scipy.optimize import minimize_scalar

        tried = [0.0, *sizes(_NARROW, largest).tolist(), largest * STEP]
        best = int(np.argmax([self.log_likelihood(each) for each in tried[:-1]]))
        near = tried[max(best - 1, 0)], tried[best + 1]
        refined: Any = minimize_scalar(lambda spread: -self.log_likelihood(spread), bounds=near, method="bounded")
        return float(refined.x) if -refined.fun > self.log_likelihood(tried[best]) else tried[best]

    def log_likelihood(self, spread: float) -> float:
        """Restricted, but for a constant."""
        sums = self._sums(spread)
        apart = log_evidence_of_modes(self._values, self._along, spread).sum()
        return float(apart + log_evidence(sums.info, sums.score, self._prior))

    def mean(self, spread: float) -> tuple[Floats, Floats]:
        """The mean (q,) with its covariance (q, q), the common coefficients being uncertain, too."""
        sums, own = self._sums(spread), slice(self._coefficients)
        covariance = np.asarray(np.linalg.inv(sums.info + np.diag(self._prior**-2)), float)
        return (covariance @ sums.score)[own], covariance[own, own]

    def interval(self) -> tuple[float, float]:
        """The spreads at which the misfit is neither too large nor too small, with 95 % probability."""
        from scipy.special import chdtri

        low, high = (self._spread_of(float(chdtri(self.freedom, above))) for above in _ABOVE)
        return low, high

    def _spread_of(self, misfit: float) -> float:
        """Return the spread at which the misfit is this; 0 where it is smaller without any."""
        from scipy.optimize import brentq

        ends = math.log(_NARROW * _NARROW), math.log(_WIDE)
        if self._misfit(math.exp(ends[0])) <= misfit:
            return 0.0
        if self._misfit(math.exp(ends[1])) >= misfit:
            return math.exp(ends[1])  # units that lie farther apart than anything
        root: Any = brentq(lambda log_spread: self._misfit(math.exp(log_spread)) - misfit, *ends, xtol=1e-4)
        return math.exp(root)

    def _misfit(self, spread: float) -> float:
        """Return chi-squared of the units about their mean, beside that of the common coefficients alone."""
        sums, count = self._sums(spread), self._coefficients
        whole = float(np.sum(self._left(spread) * self._along**2))
        explained = sums.score @ np.linalg.solve(sums.info + np.diag(self._prior**-2), sums.score)
        before = self._common.info + np.diag(self._prior[count:] ** -2)
        return whole - float(explained) + float(self._common.score @ np.linalg.solve(before, self._common.score))

    def _left(self, spread: float) -> Floats:
        """Return the square (n, q) of the variance of an estimate over that variance and the spread's together."""
        values = np.where(self._seen, self._values, 1.0)
        return np.where(self._seen, 1.0 / (values * (1.0 + spread**2 * values)), 0.0)

    def _sums(self, spread: float) -> Sums:
        """Return what units tell of the mean and the common coefficients, their departures from the mean eliminated."""
        info, score = told_of_mean(self._values, self._along, self._turned, spread)
        kept = 1.0 / (1.0 + spread**2 * self._values)
        across = np.einsum("nkq,nk,nkj->qj", self._turned, kept, self._rows)
        weighed = self._left(spread)[:, :, None] * self._rows
        common = self._common.info + np.einsum("nki,nkj->ij", weighed, self._rows)
        along = self._common.score + np.einsum("nkj,nk->j", weighed, self._along)
        both = np.block([[info.sum(axis=0), across], [across.T, common]])
        return Sums(both, np.concatenate([score.sum(axis=0), along]))


def told_of_mean(values: Floats, along: Floats, turned: Floats, spread: float) -> tuple[Floats, Floats]:
    """What each unit tells of the mean of a population, its own departure from it eliminated: information (n, q, q) and
    score (n, q), from the ``modes`` of what it tells of its own coefficients."""
    kept, back = 1.0 / (1.0 + spread**2 * values), np.swapaxes(turned, 1, 2)
    return back @ ((kept * values)[:, :, None] * turned), (back @ (kept * along)[:, :, None])[:, :, 0]
