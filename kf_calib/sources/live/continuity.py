"""The order of samples: what is missing in it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kf_calib.bench.arrays import Times

_ENOUGH = 16  # steps that give a period
_REMEMBERED = 256


class Continuity:
    """Gaps in the stamps of readings, and how many readings they have room for.

    A step is a gap where it exceeds the median step by half, or by eight robust deviations where stamps jitter.
    Readings stamped as they arrive come in bursts: then one is a gap that exceeds the longest of the last by half.
    Readings that were only held up follow the gap less than half a period apart: by so many fewer are missing.
    """

    def __init__(self) -> None:
        self.gaps = 0
        self.last_ns: int | None = None
        self._steps = self._unjudged = np.empty(0, np.int64)
        self._since = 0
        self._period_ns = self._limit_ns = 0.0
        self._is_cut = False
        self._settled, self._owed = 0, 0.0  # missing for good; of the last gap, while readings may still catch up

    @property
    def missing(self) -> int:
        return self._settled + round(self._owed)

    def cut(self) -> None:
        """The link broke here: whatever the next stamp is, there is a gap before it."""
        self._is_cut = True

    def add(self, time_ns: Times, begins: Sequence[int] = ()) -> None:
        """The stamps (n,) of further readings. begins: those of them where the bench's clock was set: each is a gap,
        and how many readings it had room for is not known."""
        if not len(time_ns):
            return
        steps = np.diff(time_ns, prepend=time_ns[0] if self.last_ns is None else self.last_ns)
        is_known = ~np.isin(time_ns, begins)
        is_known[0] &= self.last_ns is not None
        self.gaps += len(begins)
        self._is_cut &= not begins
        steps = steps[is_known]
        self.last_ns = int(time_ns[-1])
        if self._is_cut and len(steps):
            self._is_cut = False
            self.gaps += int(not 0.0 < self._limit_ns < steps[0])  # else it counts itself
        self._unjudged = np.concatenate([self._unjudged, steps])
        self._judge()
        self._learn(steps)
        self._judge()  # those that came before enough was known

    def _judge(self) -> None:
        if not (self._limit_ns and len(self._unjudged)):
            return
        steps, self._unjudged = self._unjudged, self._unjudged[:0]
        if not self._owed and 0.5 * self._period_ns <= steps.min() and steps.max() <= self._limit_ns:
            return  # as nearly all of them are
        room = steps / self._period_ns - 1.0
        is_gap, is_hurried = steps > self._limit_ns, steps < 0.5 * self._period_ns
        self.gaps += int(is_gap.sum())
        claims = np.where(is_hurried, room, np.where(is_gap, np.rint(room), 0.0))
        starts = np.concatenate([[0], 1 + np.flatnonzero(~is_hurried)])
        *settled, self._owed = np.maximum(np.add.reduceat(np.concatenate([[self._owed], claims]), starts), 0.0).tolist()
        self._settled += sum(map(round, settled))

    def _learn(self, steps: Times) -> None:
        known = len(self._steps)
        self._steps = np.concatenate([self._steps, steps])[-_REMEMBERED:]
        self._since += len(steps)
        if len(self._steps) < _ENOUGH or (known >= _ENOUGH and self._since < _REMEMBERED):
            return
        forward = self._steps[self._steps > 0]
        if len(forward):
            self._since = 0
            median_ns, mean_ns = (
                float(np.median(forward)),
                float(np.sort(forward)[: -(len(forward) // 50) or None].mean()),
            )
            jitter_ns = 1.48 * float(np.median(np.abs(forward - median_ns)))
            self._period_ns, self._limit_ns = median_ns, median_ns + max(0.5 * median_ns, 8.0 * jitter_ns)
            if median_ns < 0.5 * mean_ns:
                self._period_ns, self._limit_ns = float(forward.mean()), 1.5 * float(forward.max())
