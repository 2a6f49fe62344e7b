"""What units (or runs) tell of coefficients that are each one's own, beside those that all have in common.

Nothing is supposed of the own coefficients of any other unit while those of one are looked at: the common ones are
those that fit when the coefficients in question are free in every unit, and what is uncertain of them is counted. So an
error of the bench that was fitted first takes nothing away from the one unit that differs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import Floats, Mask
from kf_calib.fleet.campaign import Blocks, Group
from kf_calib.fleet.evidence import FLAT, posterior
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
        gains = np.linalg.solve(_not_singular(info), np.concatenate([across, score[:, :, None]], axis=2))
        lost = np.einsum("nqi,nqj->ij", across, gains)
        total = terms.sums(blocks)
        common = Sums(total.info - lost[:, :-1], total.score - lost[:, -1])
        return cls(UnitInformation(blocks.labels, info, score), across, common, terms.prior)

    @classmethod
    def joined(cls, parts: Sequence[UnitsAndCommon]) -> UnitsAndCommon:
        """All of several parts."""
        units = [unit for part in parts for unit in part.of_units.units]
        info, score = (
            np.concatenate(each) for each in zip(*((p.of_units.info, p.of_units.score) for p in parts), strict=True)
        )
        common = sum((part.common for part in parts[1:]), parts[0].common)
        return cls(
            UnitInformation(units, info, score), np.concatenate([p.across for p in parts]), common, parts[0].prior
        )

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
        info, score = _not_singular(self.of_units.info), self.of_units.score
        gains = np.linalg.solve(info, np.concatenate([self.across, score[:, :, None]], axis=2))
        lost = np.einsum("nqi,nqj->ij", self.across, gains)
        without = Sums(self.common.info + lost[:, :-1], self.common.score + lost[:, -1])
        together = _fit(self.common, self.prior) + _fits(info, score) - _fit(without, self.prior)
        apart = self.integrated()
        return _fits(_not_singular(apart.info), apart.score) - together


def _fit(sums: Sums, prior: Floats) -> float:
    """Return the log of how much likelier coefficients make the readings."""
    return 0.5 * float(sums.score @ posterior(sums.info, sums.score, prior)[0])


def _fits(info: Floats, score: Floats) -> float:
    """Return the same of own coefficients (n, q) without a prior."""
    return 0.5 * float(np.sum(score * np.linalg.solve(info, score[:, :, None])[:, :, 0]))


def _not_singular(info: Floats) -> Floats:
    """Return information that knows next to nothing of what no reading shows."""
    return info + np.eye(info.shape[-1]) / FLAT**2


def _added(values: Floats, places: Sequence[int], count: int) -> Floats:
    """Return sums (count, ...) of the values (n, ...) at each place."""
    total = np.zeros((count, *values.shape[1:]))
    np.add.at(total, places, values)
    return total
