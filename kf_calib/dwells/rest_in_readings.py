"""Dwells found in the readings alone, as they come: stretches in which neither their scatter nor their mean shows a
motion.

The readings are cut into windows of a quarter of a second. The noise is that of the quiet windows of the last five
minutes: the lower quartile of their variances, which are chi-squared distributed where the sensor rests. A window is
still if its variance is within what that noise leaves to chance. A dwell begins with a second of still windows of one
mean, within six sigma and the tolerance of ``Stillness``, and goes on as long as the windows agree with the one before
and with the mean so far. One window that is not still, as by an outlier, does not end a dwell. Where a motion that
begins gently, with the square of time, is seen in the last two seconds of a dwell, these are left out from its begin
on; so is the end of one in the first two.

Nothing is decided with readings that come later than half a second, so that a live run and the replay of its recording
find the same dwells, however the readings are divided into batches.

``dwell_summaries`` lists the dwells of a run before any of its readings is evaluated.
"""

from __future__ import annotations

import copy
import math
from bisect import bisect_left, insort
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench
from kf_calib.bench.streams import SECOND_NS, Batch, Source, Stream
from kf_calib.dwells.blocks import BLOCK_SAMPLES, Block, SampleCounts, carry_on
from kf_calib.dwells.limits import FEWEST_COMPARED, SAMPLE, SIGMAS
from kf_calib.dwells.segmenter import Segmenter, dwell_blocks
from kf_calib.dwells.stationarity import READING_WINDOW_NS, Stillness
from kf_calib.support.tail_probabilities import normal_quantile

_LEAST_WINDOWS = SECOND_NS // READING_WINDOW_NS  # of a dwell
_REMEMBERED = 1200  # windows whose variances tell the noise: five minutes
_EDGE = 8  # windows at either end of a dwell in which a motion is looked for; of a short dwell a third
_VARIANCE_MARGIN = 1.5  # correlated noise has fewer degrees of freedom than readings
_LEAST_G, _MOST_G = 1e-5, 0.05  # scatter that is never, and always, called a motion, in g
_ANY_ATTITUDE = np.array([[0.0, 0.0, 0.0, 1.0]])  # stands for an attitude that is not known


class RestSegmenter(Segmenter):
    """Cuts readings into dwells by themselves; poses are not looked at."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._size = 0  # readings of a window; 0 while it is not known
        self._dropped = 0  # readings that were released: the place of the first one that waits
        self._window_begin = 0  # place of the first reading that is in no window yet
        self._noise: _RestNoise | None = None
        self._run: _StillRun | None = None

    def push(self, batch: Batch) -> Iterator[Block]:
        """Yield the blocks that are complete once this batch is known."""
        self._take(Batch(batch.accel, Stream.empty(4), batch.temperature))
        yield from self._blocks_of_windows(final=False)

    def finish(self) -> Iterator[Block]:
        """Yield the blocks that are still open at the end of the readings."""
        accel, _, temperature = (order.flush() for order in self._orders)
        self._take(Batch(accel, Stream.empty(4), temperature), final=True)
        yield from self._blocks_of_windows(final=True)
        if self._run is not None:
            yield from self._close(self._run, departed=self._run.end < self._dropped + len(self._accel))
        self._skip_to(self._dropped + len(self._accel))

    @property
    def standing(self) -> int | None:
        """Number of the open dwell; None while it moves or is not yet known to rest."""
        return None if self._run is None else self._run.number

    @property
    def arrival_s(self) -> float:
        """Time of arrival in the open dwell, s since the first reading; NaN if no dwell is open."""
        if self._run is None or self._run.number is None:
            return math.nan
        return self._elapsed_s(self._run.arrival_ns)

    @property
    def rest_s(self) -> float:
        """For how long it has rested by now, s; 0 while it moves."""
        if self._run is None or self._run.number is None:
            return 0.0
        return (self._run.end_ns - self._run.arrival_ns) / SECOND_NS

    def waiting(self) -> list[Block]:
        """The readings of the open dwell that are in no block yet, as blocks; the segmenter is not changed."""
        if self._run is None or self._run.number is None:
            return []
        aside = copy.copy(self)
        aside.counts = SampleCounts()
        return list(aside._close(copy.copy(self._run), departed=True))

    def _blocks_of_windows(self, final: bool) -> Iterator[Block]:
        """Judge the windows that are whole by now and yield the blocks that become complete.

        The last window of a run also takes the readings that do not fill another one; therefore a window is judged only
        when the next one is complete.
        """
        for window in self._windows(final):
            assert self._noise is not None
            self._noise.add(window.variance)
            yield from self._add_window(window, *self._noise.bounds(window.end - window.begin))
        run = self._run
        if run is not None and run.number is not None:
            yield from self._whole_blocks(run)
        self._skip_to(self._window_begin if run is None else min(run.begin, self._window_begin))
        self._forget_temperatures()

    def _windows(self, final: bool) -> Iterator[_Window]:
        """Yield the windows that are new."""
        if not self._size and not self._knows_window_size(final):
            return
        values = self._accel.values[self._window_begin - self._dropped :]
        whole = max(len(values) // self._size - 1, 0) * self._size
        equal, rest = values[:whole].reshape(-1, self._size, 3), values[None, whole:]
        for parts in (equal, rest) if final and len(values) >= self._size else (equal,):
            means, variances = parts.mean(axis=1), parts.var(axis=1, ddof=1).sum(axis=1)
            for mean, variance in zip(means, variances.tolist(), strict=True):
                begin, self._window_begin = self._window_begin, self._window_begin + parts.shape[1]
                yield _Window(begin, self._window_begin, mean, variance)

    def _knows_window_size(self, final: bool) -> bool:
        """Settle how many readings a window has; tell whether that is known by now."""
        if len(self._accel) <= SAMPLE and not (final and len(self._accel) >= 2 * FEWEST_COMPARED):
            return False
        period_ns = float(np.median(np.diff(self._accel.time_ns[: SAMPLE + 1])))
        self._size = max(FEWEST_COMPARED, round(READING_WINDOW_NS / max(period_ns, 1.0)))
        self._noise = _RestNoise(self.bench.gravity_mps2, 3 * (self._size - 1))
        return True

    def _add_window(self, window: _Window, largest_variance: float, noise: float) -> Iterator[Block]:
        """Take one more window into the run of still windows, or end that run and yield its last blocks."""
        run, still = self._run, window.variance <= largest_variance
        tolerance = self.stillness.tolerance_rad * self.bench.gravity_mps2
        if run is not None and still and run.agrees(window, noise, tolerance):
            run.add(window, self._stamp(window.end - 1), noise)
            if run.number is None and run.count >= _LEAST_WINDOWS:
                self._begin(run, window, largest_variance)
        elif still or run is None or run.interrupted:
            if run is not None and run.number is not None:
                yield from self._close(run, departed=True)
            self._run = self._new_run(window) if still else None
        else:
            run.interrupted = True

    def _begin(self, run: _StillRun, latest: _Window, largest_variance: float) -> None:
        """Begin a dwell, unless its first windows are not still by what is known of the noise now."""
        if run.loudest > largest_variance:
            self._run = self._new_run(latest)
            return
        self._skip_to(run.begin)
        self.dwell_count += 1
        run.number = self.dwell_count

    def _new_run(self, first: _Window) -> _StillRun:
        """Return a run of one window."""
        stamps = self._stamp(first.begin), self._stamp(first.end - 1)
        return _StillRun(first.begin, first.end, *stamps, first.mean, first.mean, first.variance, [first])

    def _whole_blocks(self, run: _StillRun) -> Iterator[Block]:
        """Yield the whole blocks of the open dwell that no departure can take back."""
        settle_ns = self.stillness.settle_ns if run.begin else 0
        if run.end_ns - run.arrival_ns < 3 * settle_ns or run.arrived is None:
            return
        self._settle(run, settle_ns)
        end = min(self._index(run.end_ns - self.stillness.lead_ns), run.latest[0].begin)
        while end - self._dropped >= BLOCK_SAMPLES:
            yield self._next_block(run, BLOCK_SAMPLES)

    def _close(self, run: _StillRun, departed: bool) -> Iterator[Block]:
        """Yield the remaining blocks of a dwell; ``departed``: the platform left it, the run did not merely end."""
        self._run = None
        if run.number is None:
            return
        length_ns = run.end_ns - run.arrival_ns
        settle_ns = min(self.stillness.settle_ns, length_ns // 3) if run.begin else 0
        if run.begin and settle_ns < self.stillness.settle_ns:
            self.counts.short_dwells += 1
            self.counts.least_settling_s = min(self.counts.least_settling_s, settle_ns / SECOND_NS)
        self._settle(run, settle_ns)
        end = self._index(run.end_ns - min(self.stillness.lead_ns, length_ns // 10)) if departed else run.end
        end = min(end, run.departing) if departed else end
        while self._dropped < end:
            yield self._next_block(run, min(BLOCK_SAMPLES, end - self._dropped))
        self.counts.settling += run.end - self._dropped
        self._release(run.end - self._dropped)

    def _settle(self, run: _StillRun, settle_ns: int) -> None:
        """Release the readings of the margin after the arrival, once."""
        if run.settled:
            return
        run.settled = True
        arrived = run.ended_arrival if run.arrived is None else run.arrived
        count = max(self._index(run.arrival_ns + settle_ns), arrived if run.begin else 0) - self._dropped
        self.counts.settling += count
        self._release(count)

    def _next_block(self, run: _StillRun, count: int) -> Block:
        """Make a block of the next readings of a dwell, whose attitude is not known."""
        assert run.number is not None
        readings = self._accel[:count]
        self._release(count)
        self.counts.used += count
        times_s, temperature_c = self._elapsed_s(readings.time_ns), carry_on(self._temperature, readings.time_ns)
        return Block(
            run.number, self._elapsed_s(run.arrival_ns), times_s, readings.values, _ANY_ATTITUDE, temperature_c
        )

    def _skip_to(self, index: int) -> None:
        """Release and count the readings before a place that are in no dwell."""
        run = self._run
        if run is None or run.number is None:
            self.counts.moving += max(index - self._dropped, 0)
            self._release(max(index - self._dropped, 0))

    def _release(self, count: int) -> None:
        """Drop the first readings that wait."""
        self._accel, self._dropped = self._accel[count:], self._dropped + count

    def _index(self, stamp_ns: int) -> int:
        """Return the place of the first reading at or after a stamp."""
        return self._dropped + int(np.searchsorted(self._accel.time_ns, stamp_ns))

    def _stamp(self, index: int) -> int:
        """Return the stamp of a reading that waits."""
        return int(self._accel.time_ns[index - self._dropped])

    def _forget_temperatures(self) -> None:
        """Drop the temperatures that no waiting reading needs."""
        if len(self._accel):
            oldest = int(np.searchsorted(self._temperature.time_ns, self._accel.time_ns[0]))
            self._temperature = self._temperature[max(oldest - 2, 0) :]


def segmenter_of(
    bench: Bench, stillness: Stillness | None = None, counts: SampleCounts | None = None, slews: bool = False
) -> Segmenter:
    """The segmenter of a bench: by its angles, or by the readings alone where no angles are used."""
    kind = Segmenter if bench.angles else RestSegmenter
    return kind(bench, stillness or Stillness(), counts or SampleCounts(), slews and bench.angles)


@dataclass(frozen=True)
class _Window:
    """Places of the first reading and of the one after the last, their mean (3,), and the sum of their variances."""

    begin: int
    end: int
    mean: Floats
    variance: float


@dataclass
class _StillRun:
    """A run of still windows; a dwell once it has a number.

    begin, end: places of its first reading and of the one after its last. last, total (3,): mean of its last window,
    and sum of all means. loudest: the largest variance of its windows. first, latest: its windows at either end. noise:
    by how much their means may be off by chance. arrived: place where the arrival no longer shows; None while that is
    not known. interrupted: whether the window after it is not still. settled: whether the margin after the arrival is
    released.
    """

    begin: int
    end: int
    arrival_ns: int
    end_ns: int
    last: Floats
    total: Floats
    loudest: float
    first: list[_Window]
    latest: deque[_Window] = field(default_factory=lambda: deque[_Window](maxlen=_EDGE))
    noise: float = math.inf
    arrived: int | None = None
    count: int = 1
    number: int | None = None
    interrupted: bool = False
    settled: bool = False

    def agrees(self, window: _Window, noise: float, tolerance: float) -> bool:
        """Whether the mean of a window is near that of the window before, and near that of the run; noise: by how much
        a mean may be off by chance; tolerance: by how much it may move in the window of ``Stillness``."""
        moved, apart = window.mean - self.last, window.mean - self.total / self.count
        largest = math.sqrt(2.0) * noise + 0.5 * tolerance
        return bool(moved @ moved <= largest**2 and apart @ apart <= 4.0 * (noise + tolerance) ** 2)

    def add(self, window: _Window, end_ns: int, noise: float) -> None:
        """Add the next still window."""
        self.end, self.end_ns, self.last, self.interrupted = window.end, end_ns, window.mean, False
        self.total, self.count = self.total + window.mean, self.count + 1
        self.loudest, self.noise = max(self.loudest, window.variance), noise
        self.latest.append(window)
        if self.count <= 2 * _EDGE:
            self.first.append(window)
        if self.count == 3 * _EDGE:
            self.arrived = self.ended_arrival

    @property
    def ended_arrival(self) -> int:
        """Place of the first reading in which the arrival no longer shows."""
        edge = min(_EDGE, self.count // 3)
        windows, rest = self.first[:edge][::-1], self.first[edge : 2 * edge]
        moving = self._moving(windows, np.sum([each.mean for each in rest], axis=0), len(rest))
        return self.first[moving].begin

    @property
    def departing(self) -> int:
        """Place of the first reading in which the departure shows."""
        edge = min(_EDGE, self.count // 3)
        windows, before = [*self.latest][len(self.latest) - edge :], self.first[:edge]
        away = np.sum([each.mean for each in (*windows, *before)], axis=0)
        moving = self._moving(windows, self.total - away, self.count - 2 * edge)
        return windows[-moving].begin if moving else self.end

    def _moving(self, windows: Sequence[_Window], total: Floats, count: int) -> int:
        """Return how many of the last windows show a motion that begins there, or ends in the first.

        Where the squares (1, 4, ..., k^2) explain more of what the last k means are off the rest than chance, they are
        left out one by one until it is no more, and one besides. total (3,): sum of the means of the rest, of which
        there are ``count``.
        """
        away, moving = np.array([each.mean for each in windows]) - total / max(count, 1), 0
        for last in range(len(windows), 0, -1):
            shapes = [np.append(np.zeros(last - k), np.arange(1.0, k + 1.0) ** 2) for k in range(1, last + 1)]
            noise = self.noise / SIGMAS * np.array([math.sqrt(s @ s + s.sum() ** 2 / count) for s in shapes])
            if np.max(np.linalg.norm(np.array(shapes) @ away[:last], axis=1) / noise) < SIGMAS:
                break
            moving += 1
        return min(moving + 1, len(windows)) if moving else 0


@dataclass
class _RestNoise:
    """The noise of a sensor at rest, by the variances of the latest windows.

    freedom: degrees of freedom of a window's variance.
    """

    gravity_mps2: float
    freedom: int
    latest: deque[float] = field(default_factory=deque[float])
    ordered: list[float] = field(default_factory=list[float])

    def add(self, variance: float) -> None:
        """Take the variance of one more window, and forget the oldest."""
        self.latest.append(variance)
        insort(self.ordered, variance)
        if len(self.latest) > _REMEMBERED:
            del self.ordered[bisect_left(self.ordered, self.latest.popleft())]

    def bounds(self, count: int) -> tuple[float, float]:
        """The largest variance of a window that is still, and by how much its mean of ``count`` readings may be off."""
        rank = 0.25 * (len(self.ordered) - 1)
        low, high = self.ordered[math.floor(rank)], self.ordered[math.ceil(rank)]
        quartile = low + (rank - math.floor(rank)) * (high - low)
        least, most = (_LEAST_G * self.gravity_mps2) ** 2, (_MOST_G * self.gravity_mps2) ** 2
        noise = min(quartile / _chi_squared(normal_quantile(0.25), self.freedom), most) + least
        return _VARIANCE_MARGIN * _chi_squared(5.0, self.freedom) * noise, SIGMAS * math.sqrt(noise / count)


def _chi_squared(normal: float, freedom: int) -> float:
    """Return the quantile of chi-squared, divided by its degrees of freedom, at that of a normal variable (Wilson and
    Hilferty)."""
    spread = 2.0 / (9.0 * freedom)
    return (1.0 - spread + normal * spread**0.5) ** 3


@dataclass
class DwellSummary:
    """A dwell in a few numbers.

    - arrival_s: its arrival, since the first sample; lasts_s: how long its readings last.
    - pose: mean gimbal angles in rad, outer to inner, or attitude; empty without angles.
    - norm_mps2: length of the mean of its readings; up (3,): the unit vector along that mean.
    """

    number: int
    arrival_s: float
    lasts_s: float
    readings: int
    pose: tuple[float, ...]
    norm_mps2: float
    up: tuple[float, float, float]


def dwell_summaries(source: Source, on_progress: Callable[[float], None] = lambda _: None) -> list[DwellSummary]:
    """The dwells of a source, which is read to its end; raises what reading it raises."""
    dwells, totals = dict[int, DwellSummary](), dict[int, Floats]()
    segmenter = segmenter_of(source.bench)
    for block in dwell_blocks(source, segmenter):
        on_progress(source.fraction)
        if not len(block.elapsed_s) or block.curve is not None:
            continue
        pose = tuple(float(each) for each in np.asarray(block.pose)[0]) if source.bench.angles else ()
        new = DwellSummary(block.dwell, block.arrival_s, 0.0, 0, pose, math.nan, (0.0, 0.0, 0.0))
        dwell = dwells.setdefault(block.dwell, new)
        dwell.readings += len(block.elapsed_s)
        dwell.lasts_s = float(block.elapsed_s[-1]) - dwell.arrival_s
        totals[block.dwell] = totals.get(block.dwell, np.zeros(3)) + block.accel_mps2.sum(axis=0)
    for number, dwell in dwells.items():
        mean = totals[number] / dwell.readings
        dwell.norm_mps2 = float(np.linalg.norm(mean))
        x, y, z = (mean / max(dwell.norm_mps2, 1e-300)).tolist()
        dwell.up = x, y, z
    return list(dwells.values())
