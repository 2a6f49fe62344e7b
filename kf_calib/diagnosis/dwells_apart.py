"""Dwells that are off, each by any amount and with readings that change in any way: a pose mistyped, a door slammed.

One is off by a turn of one gimbal, or by any offsets of the three accelerometers; either is as likely.

They are searched one after another, each next one by what the dwells without those before it tell: two that are off by
as much hide each other. Each has the prior probability of one. In the noise that was stated alone, for in noise as
large as they are off any dwell is as good as any other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import IN_CACHE, Floats, portions
from kf_calib.diagnosis.hypothesis_table import PRIOR
from kf_calib.diagnosis.in_noises import InNoises, Spanned
from kf_calib.diagnosis.noise_sizes import NoiseSizes
from kf_calib.diagnosis.run_terms import log_bayes_of_any_size
from kf_calib.diagnosis.within_rows import Courses

_MOST = 0.25  # share of the dwells
_MASKED = 3  # dwells that may hide each other


@dataclass(frozen=True)
class DwellsApart:
    """The search in one run.

    rows: of the run, with all that is in the model. courses: what it leaves of the readings within dwells. noises: the
    rows in the noises of each family; sizes: these.
    """

    rows: Spanned
    courses: Courses
    noises: Sequence[InNoises]
    sizes: NoiseSizes

    def rows_of_dwells(self) -> list[tuple[float, tuple[int, ...]]]:
        """Log evidence, with its prior, that some dwells are off, and which, the clearest first: of each dwell alone,
        and of several."""
        chosen, before = list[int](), np.concatenate([of_family.logs for of_family in self.noises])
        rows: list[tuple[float, tuple[int, ...]]] = [(-math.inf, ())]
        while len(chosen) < min(max(len(self.rows) * _MOST, 1.0), len(max(rows)[1]) + _MASKED):
            try:
                of_dwells = self._log_bayes(chosen)
            except np.linalg.LinAlgError:
                break
            evidence = np.logaddexp.reduce(self.sizes.evidence(before + of_dwells), axis=1)
            in_none = before[0] + of_dwells[:, 0]
            in_none[chosen] = -math.inf
            k = int(np.argmax(in_none))
            some = [k] if chosen else range(len(self.rows))  # any of them may be the one
            log_prior = (len(chosen) + 1) * self._log_prior
            rows += [(float(evidence[j]) + log_prior, (*chosen, j)) for j in some]
            chosen, before = [*chosen, k], before + of_dwells[k]
        return rows[1:]

    @property
    def _log_prior(self) -> float:
        """The log of the prior probability that one certain dwell is off."""
        return math.log(PRIOR["dwell"] / len(self.rows))

    def _log_bayes(self, without: Sequence[int]) -> Floats:
        """Return log Bayes factors (D, noises) of changes of each dwell, as the dwells without some of them tell."""
        changes = self.courses.log_bayes(math.exp(self._log_prior))
        most = max(IN_CACHE // (8 * len(self.rows)), 1)  # sizes of noise at once
        means = [
            self._of_means(*of_family.dwells(self.rows, without, part))
            for of_family in self.noises
            for part in portions(len(of_family), most)
        ]
        return np.concatenate(means).T + np.logaddexp(0.0, changes)[:, None] - math.log(2.0)

    def _of_means(self, gram: Floats, along: Floats, largest: Floats) -> Floats:
        """Return log Bayes factors (K, D) of changes of the mean of each dwell: gram (K, D, 3, 3), along (K, D, 3), and
        the largest squares (K, D) before the model was subtracted."""
        offsets = log_bayes_of_any_size(gram, along, largest)
        if not self.sizes.turns:
            return offsets
        of_turns = [
            log_bayes_of_any_size(
                turn.swapaxes(1, 2) @ gram @ turn,
                (along[:, :, None] @ turn)[:, :, 0],
                largest * np.sum(turn**2, axis=(1, 2)),
            )
            for turn in (of_gimbal[..., None] for of_gimbal in self.sizes.turns.values())
        ]
        of_one = np.logaddexp.reduce(of_turns) - math.log(len(of_turns))
        return np.logaddexp(offsets, of_one) - math.log(2.0)
