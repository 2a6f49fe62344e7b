"""Differences of means of adjacent blocks, of all lengths at once, from readings as they come, in flat memory.

Each level of a cascade halves the rate: level j has the means of blocks of 2^j readings. From them come

- the overlapping Allan variance of clusters of m readings (IEEE Std 952-2020, annex C; NIST Special Publication 1065),

    sigma^2(m) = sum_k (x_{k+2m} - 2 x_{k+m} + x_k)^2 / (2 m^2 M),   x_k: sum of the first k readings, M terms,

  at m = 2^i. Up to ``EVERY`` readings k is every reading, as in the textbook; beyond, every m / ``EVERY`` readings, so
  that clusters of a week take no more memory than those of a second and have the same expectation.
- the Haar variance: the same where clusters do not overlap, half the mean square difference of the two halves of each
  block. Haar differences of all lengths and the means of the longest blocks are an orthogonal transform of readings.
- the means of blocks of the least length of which there are no more than ``EVERY``.

Readings come in stretches without a gap; no block and no difference reaches from one stretch into another.
"""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from kf_calib.bench.arrays import AT_ONCE, Floats, Ints

EVERY = 1024
"""Clusters of up to so many readings begin at every reading; longer ones at so many places of their own length.
Of a level no more block means are kept."""
FEWEST_CLUSTERS = 3
"""Clusters in the longest stretch from which a variance is told."""


class Variances(NamedTuple):
    """Sizes (m,) of clusters in readings, variances (m, c) of each channel, and the numbers of differences (m,)."""

    sizes: Ints
    variance: Floats
    counts: Ints


@dataclass
class _Level:
    """Means of blocks of 2^number readings, as they come; channels (c,) go first in all arrays.

    tail: the latest of them, which differences of later ones still need. half: a block that waits for the next.
    kept: their means, a list a stretch, as long as there are no more than ``EVERY``.
    """

    number: int
    channels: int
    squares: Floats = field(init=False)
    counts: Ints = field(init=False)
    haar_squares: Floats = field(init=False)
    haar_count: int = 0
    tail: Floats = field(init=False)
    half: Floats = field(init=False)
    waiting: list[Floats] = field(default_factory=list[Floats])
    waiting_count: int = 0
    kept: list[list[Floats]] | None = field(default_factory=list[list[Floats]])
    kept_count: int = 0

    def __post_init__(self) -> None:
        self.squares, self.counts = np.zeros((len(self.factors), self.channels)), np.zeros(len(self.factors), np.int64)
        self.haar_squares = np.zeros(self.channels)
        self.clear()

    @property
    def factors(self) -> list[int]:
        """Lengths of clusters, in blocks of this level."""
        return [2**i for i in range(EVERY.bit_length())] if self.number == 0 else [EVERY]

    def clear(self) -> None:
        """Forget what would join the next stretch to this one."""
        self.tail = self.half = np.zeros((self.channels, 0))

    def take(self, means: Floats) -> Floats:
        """Use the next block means (c, n); the means of pairs of them (c, n / 2) for the next level."""
        self._keep(means)
        self._add_differences(means)
        joined = np.concatenate([self.half, means], axis=1)
        pairs = joined[:, : joined.shape[1] // 2 * 2].reshape(self.channels, -1, 2)
        self.half = joined[:, pairs.shape[1] * 2 :]
        steps = pairs[:, :, 1] - pairs[:, :, 0]
        self.haar_squares += np.einsum("cn,cn->c", steps, steps)
        self.haar_count += pairs.shape[1]
        return pairs.mean(axis=2)

    def _keep(self, means: Floats) -> None:
        self.kept_count += means.shape[1]
        if self.kept is not None:
            if self.kept_count > EVERY:
                self.kept = None
            else:
                self.kept[-1].append(means)

    def _add_differences(self, means: Floats) -> None:
        """Add the second differences of the sums that end in one of these blocks."""
        joined = np.concatenate([self.tail, means], axis=1)
        old = self.tail.shape[1]
        sums = np.concatenate([np.zeros((self.channels, 1)), joined.cumsum(axis=1)], axis=1)
        for place, factor in enumerate(self.factors):
            first = max(0, old + 1 - 2 * factor)
            count = joined.shape[1] - 2 * factor + 1 - first
            if count <= 0:
                break
            second = sums[:, first + 2 * factor :] + sums[:, first : first + count]
            second -= 2.0 * sums[:, first + factor : first + factor + count]
            self.squares[place] += np.einsum("cn,cn->c", second, second)
            self.counts[place] += count
        self.tail = joined[:, max(0, joined.shape[1] - 2 * EVERY + 1) :].copy()


class BlockDifferences:
    """Takes readings of some channels, stretch by stretch, and has the statistics of the module's page of them.

    Memory: about 2000 numbers a channel and level, of which there are as many as binary digits in the number of
    readings, and 8 bytes a stretch.
    """

    def __init__(self, channels: int) -> None:
        self.channels = channels
        self.lengths = array("q")
        """Readings of each stretch."""
        self._levels = list[_Level]()
        self._origin: Floats | None = None
        self._is_open = False

    def __repr__(self) -> str:
        return f"<BlockDifferences: {self.count} readings of {self.channels} channels, {len(self.lengths)} stretches>"

    @property
    def count(self) -> int:
        """Readings so far."""
        return sum(self.lengths)

    def push(self, readings: Floats) -> None:
        """Take the next readings (n, c) of the stretch, or the first ones of one."""
        if not len(readings):
            return
        if not self._is_open:
            self._is_open = True
            self.lengths.append(0)
        origin = readings[0].copy() if self._origin is None else self._origin
        self._origin = origin  # sums of what is left are small, so that rounding is
        self.lengths[-1] += len(readings)
        for begin in range(0, len(readings), 4 * AT_ONCE):
            self._pass_on(0, np.ascontiguousarray((readings[begin : begin + 4 * AT_ONCE] - origin).T))

    def end_stretch(self) -> None:
        """What comes next does not follow on what came: there is a gap, or it is the end."""
        number = 0
        while number < len(self._levels):
            self._process(number)
            self._levels[number].clear()
            number += 1
        for level in self._levels:
            if level.kept is not None:
                level.kept.append([])
        self._is_open = False

    def allan(self) -> Variances:
        """The overlapping Allan variance, of clusters of which there is a pair at least."""
        rows = [(factor << level.number, level.squares[k] / (2.0 * factor**2 * level.counts[k]), level.counts[k])
                for level in self._levels for k, factor in enumerate(level.factors) if level.counts[k]]  # fmt: skip
        return self._table(rows)

    def haar(self) -> Variances:
        """The Haar variance of blocks of all lengths of which there is a pair at least."""
        rows = [(1 << level.number, level.haar_squares / (2.0 * level.haar_count), level.haar_count)
                for level in self._levels if level.haar_count]  # fmt: skip
        return self._table(rows)

    def block_means(self, level: int) -> tuple[int, list[Floats]]:
        """The means of the shortest blocks of 2^level readings or more of which all were kept, less those of the first
        reading: readings of a block, and (n, c) of each stretch that has two or more."""
        for own in self._levels[level:]:
            if own.kept is not None:
                stretches = [np.concatenate(each, axis=1).T for each in own.kept if each]
                return 1 << own.number, [each for each in stretches if len(each) > 1]
        return 1 << max(level, len(self._levels)), []

    def _table(self, rows: list[tuple[int, Floats, int]]) -> Variances:
        return Variances(
            np.array([size for size, _, _ in rows], np.int64),
            np.array([variance for _, variance, _ in rows]).reshape(-1, self.channels),
            np.array([count for _, _, count in rows], np.int64),
        )

    def _pass_on(self, number: int, means: Floats) -> None:
        """Have a level take means, at once or when there are enough."""
        if number == len(self._levels):
            level = _Level(number, self.channels)
            assert level.kept is not None
            level.kept.append([])
            self._levels.append(level)
        level = self._levels[number]
        level.waiting.append(means)
        level.waiting_count += means.shape[1]
        if level.waiting_count >= AT_ONCE:
            self._process(number)

    def _process(self, number: int) -> None:
        level = self._levels[number]
        if not level.waiting_count:
            return
        means = np.concatenate(level.waiting, axis=1)
        level.waiting, level.waiting_count = [], 0
        pairs = level.take(means)
        if pairs.shape[1]:
            self._pass_on(number + 1, pairs)
