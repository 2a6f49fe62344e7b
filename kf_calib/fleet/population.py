"""The mean of a population of units and the spread of their coefficients about it (random effects).

The spread is estimated by restricted likelihood (REML), in which the mean and what all runs have in common are unknown
without any prior. Its interval is that of the misfit Q of the units to their mean: Q of the true spread is distributed
as chi-squared, whatever the mean and however few the units (Q-profile, W. Viechtbauer, 2007).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from kf_calib.bench.arrays import Floats, Mask
from kf_calib.fleet.evidence import FLAT, STEP, log_evidence, log_evidence_of_modes, modes, sizes
from kf_calib.fleet.own_coefficients import UnitsAndCommon
from kf_calib.fleet.pooled_terms import Sums

_NARROW, _WIDE = 0.02, 1e6  # sigma of one run: the smallest spread that is told from none, and a larger one than any
_SEEN = 1e-6  # of the largest information of a unit: what is less counts as not seen
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
        self._seen = self._values > _SEEN * self._values.max(initial=0.0)
        self._rows = self._turned @ told.across[members]
        self._coefficients = told.of_units.score.shape[1]
        self._prior = np.concatenate([np.full(self._coefficients, FLAT), told.prior])

    @cached_property
    def freedom(self) -> int:
        """Degrees of freedom of the misfit: what units tell, less the mean and what this takes of the common ones."""
        ranks = [int(np.linalg.matrix_rank(info, hermitian=True, rtol=_SEEN)) if info.size else 0
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

        if self._misfit(0.0) <= misfit:
            return 0.0
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
