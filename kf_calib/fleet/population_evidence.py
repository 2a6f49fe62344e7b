"""The evidence that coefficients are each unit's own, drawn about the mean of a population (random effects).

It is exact for normal coefficients of a given spread, and averaged over the spread and the ratio of the mean to it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kf_calib.fleet.campaign import Blocks, Group
from kf_calib.fleet.evidence import log_evidence, log_evidence_of_modes, log_mean, modes, sizes
from kf_calib.fleet.pooled_terms import Common, PooledTerms, Sums, shares_of

_LEAST = 0.25  # sigma of one run: the smallest spread that is expected
_RATIOS = np.array([0.0, 1.0, 3.0])  # of the mean of a population to its spread


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
