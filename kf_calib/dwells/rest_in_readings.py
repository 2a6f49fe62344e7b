"""Dwells found in the readings alone, where no angles are used: stretches in which neither their scatter nor their mean
shows a motion.

The readings are cut into windows of a quarter of a second. The noise is that of the quiet windows: the lower quartile
of their variances, which are chi-squared distributed where the sensor rests. A window is still if its variance is
within what that noise leaves to chance, and a dwell goes on as long as the mean differs from that of the still window
before by no more than six sigma and the tolerance of ``Stillness``. One window that is not still, as by an outlier,
does not end a dwell.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from kf_calib.bench.arrays import Floats, Ints
from kf_calib.bench.streams import Batch, Stream
from kf_calib.dwells.blocks import Block
from kf_calib.dwells.dwell_events import SECOND_NS, carry_on
from kf_calib.dwells.segmenter import BLOCK_SAMPLES, Segmenter

_WINDOW_NS = SECOND_NS // 4
_FEWEST = 4  # readings of a window
_LEAST_WINDOWS = 4  # of a dwell
_ALLOWED = 1.5  # correlated noise has fewer degrees of freedom than readings
_SIGMAS = 6.0
_LEAST_G, _MOST_G = 1e-5, 0.05  # scatter that is never, and always, called a motion, in g
_UP = np.array([[0.0, 0.0, 0.0, 1.0]])  # stands for an attitude that is not known


class RestSegmenter(Segmenter):
    """Cuts readings into dwells by themselves; as the noise is that of the whole run, ``finish`` yields all blocks."""

    def push(self, batch: Batch) -> Iterator[Block]:
        """Keep the readings of a batch until the end."""
        self._take(Batch(batch.accel, Stream.empty(4), batch.temperature))
        yield from ()

    def finish(self) -> Iterator[Block]:
        """Yield the blocks of all dwells."""
        accel, _, temperature = (order.flush() for order in self._orders)
        self._take(Batch(accel, Stream.empty(4), temperature), final=True)
        accel, done = self._accel, 0
        for begin, end in self._dwells(accel):
            used = self._settled(accel, begin, end)
            self.tally.moving += begin - done
            self.tally.settling += used.start - begin + end - used.stop
            self.dwell_count += 1
            yield from self._blocks(accel, begin, used)
            done = end
        self.tally.moving += len(accel) - done

    def _dwells(self, accel: Stream) -> Iterator[tuple[int, int]]:
        """Yield the first reading of each dwell and the one after its last."""
        edges = _window_edges(accel)
        if len(edges) < _LEAST_WINDOWS + 1:
            return
        means, variances, counts = _moments(accel.values, edges)
        least = (_LEAST_G * self.bench.gravity_mps2) ** 2
        most, freedom = (_MOST_G * self.bench.gravity_mps2) ** 2, 3 * (int(counts[0]) - 1)
        noise = min(np.quantile(variances.sum(axis=1), 0.25) / _chi_squared(-0.674, freedom), most) + least
        still = variances.sum(axis=1) <= _ALLOWED * _chi_squared(5.0, freedom) * noise
        allowed = _SIGMAS * np.sqrt(noise / counts) + self.stillness.tolerance_rad * self.bench.gravity_mps2
        for first, last in _runs(np.flatnonzero(still), means, np.sqrt(2.0) * allowed):
            inside = np.arange(first, last)
            near = np.linalg.norm(means[inside] - np.median(means[inside], axis=0), axis=1) <= 2.0 * allowed[inside]
            kept = inside[near]
            if near.mean() > 0.5 and len(kept) >= _LEAST_WINDOWS:
                yield int(edges[kept[0]]), int(edges[kept[-1] + 1])

    def _settled(self, accel: Stream, begin: int, end: int) -> slice:
        """Return the readings of a dwell that are used, those within its margins left out."""
        begin_ns, end_ns = int(accel.time_ns[begin]), int(accel.time_ns[end - 1])
        length_ns = end_ns - begin_ns
        settle_ns = min(self.stillness.settle_ns, length_ns // 3) if begin else 0
        if begin and settle_ns < self.stillness.settle_ns:
            self.tally.short_dwells += 1
            self.tally.least_settling_s = min(self.tally.least_settling_s, settle_ns / SECOND_NS)
        lead_ns = min(self.stillness.lead_ns, length_ns // 10) if end < len(accel) else -1
        first, last = np.searchsorted(accel.time_ns, (begin_ns + settle_ns, end_ns - lead_ns)).tolist()
        return slice(first, last)

    def _blocks(self, accel: Stream, begin: int, used: slice) -> Iterator[Block]:
        """Yield the blocks of one dwell, whose attitude is not known."""
        assert self.first_ns is not None
        arrival_s = (int(accel.time_ns[begin]) - self.first_ns) / SECOND_NS
        for first in range(used.start, used.stop, BLOCK_SAMPLES):
            part = accel[first : min(first + BLOCK_SAMPLES, used.stop)]
            self.tally.used += len(part)
            elapsed_s = (part.time_ns - self.first_ns) / SECOND_NS
            warm = carry_on(self._temperature, part.time_ns)
            yield Block(self.dwell_count, arrival_s, elapsed_s, part.values, _UP, warm)


def _window_edges(accel: Stream) -> Ints:
    """Return the index of the first reading of each window, and at last the number of readings; the last is longer."""
    if len(accel) < 2 * _FEWEST:
        return np.zeros(0, np.int64)
    period_ns = float(np.median(np.diff(accel.time_ns)))
    size = max(_FEWEST, round(_WINDOW_NS / max(period_ns, 1.0)))
    return np.append(np.arange(len(accel) // size) * size, len(accel))


def _moments(values: Floats, edges: Ints) -> tuple[Floats, Floats, Ints]:
    """Return means (m, 3) and variances (m, 3) of the readings in each window, and their numbers (m,)."""
    counts = np.diff(edges)
    means = np.add.reduceat(values, edges[:-1], axis=0) / counts[:, None]
    squares = np.add.reduceat((values - np.repeat(means, counts, axis=0)) ** 2, edges[:-1], axis=0)
    return means, squares / (counts - 1)[:, None], counts


def _chi_squared(normal: float, freedom: int) -> float:
    """Return the quantile of chi-squared, divided by its degrees of freedom, at that of a normal variable (Wilson and
    Hilferty)."""
    spread = 2.0 / (9.0 * freedom)
    return (1.0 - spread + normal * spread**0.5) ** 3


def _runs(still: Ints, means: Floats, allowed: Floats) -> Iterator[tuple[int, int]]:
    """Yield first and last + 1 of each run of ``still`` windows, with at most one other between two of them, whose
    means move by no more than is ``allowed``."""
    if not still.size:
        return
    apart = np.linalg.norm(np.diff(means[still], axis=0), axis=1) > allowed[still[1:]]
    for own in np.split(still, np.flatnonzero(apart | (np.diff(still) > 2)) + 1):
        yield int(own[0]), int(own[-1]) + 1
