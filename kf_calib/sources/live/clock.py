"""The bench's clock: where it is set or starts again, stamps go on from the last; where it stands still, it is said.

Without this, all readings after a restart would be stamped before those that came, and left out of the evaluation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from kf_calib.bench.arrays import Mask, Times
from kf_calib.bench.streams import LEAP_NS, SECOND_NS, Batch, Stream

_BACK_NS = 5 * SECOND_NS  # less is a late sample, or a bench that sends its last readings again after a lost link
_SET_NS = 86_400 * SECOND_NS  # no pause is as long as this: the clock was set
_BREAK_S = 1.0  # at least, before the new stamps: angles that came a little late are still in order
_PERSISTS = 5  # readings that agree with each other tell a clock that was set from damaged stamps


@dataclass(frozen=True)
class Restart:
    """The clock was set, or started again, after the reading of stamp ``after_ns``.

    by_ns: how far its stamps jumped. shift_ns: what is added to them from ``begin_ns``, the first of them, on.
    """

    after_ns: int
    begin_ns: int
    by_ns: int
    shift_ns: int

    @property
    def reason(self) -> str:
        way = "back" if self.by_ns < 0 else "ahead"
        return f"the bench's clock jumped {way} by {abs(self.by_ns) / SECOND_NS:.1f} s"


class Clock:
    """Stamps of all streams on one line of time, from those of a clock that may be set during the run.

    The readings tell that it was; angles and temperatures follow. restarts: in order. left_out: readings that an
    evaluation leaves out, since their stamp is damaged, or no later than one before them.
    """

    def __init__(self) -> None:
        self.restarts = list[Restart]()
        self.left_out = 0
        self._held = Stream.empty(3)  # the clock may have been set before these
        self._first: Stream | None = None
        self._last_ns: int | None = None
        self._reached_ns = -(1 << 62)
        self._came_s = 0.0
        self._is_repeating = False
        self._unmoved = 0
        self._shifts = [0]
        self._others = (_Follower(), _Follower())

    @property
    def trouble(self) -> str:
        """What is wrong with the clock, or was last; "" where it always went on."""
        if self._first is None or self._last_ns is None:
            return ""
        first_ns = int(self._first.time_ns[0])
        if self._unmoved >= _PERSISTS:
            return (
                f"the bench's clock stands still at {(self._last_ns - first_ns) / SECOND_NS:.3f} s after the first "
                "reading; what comes is recorded and left out of the evaluation"
            )
        if not self.restarts:
            return ""
        last, count = self.restarts[-1], len(self.restarts)
        times = f" (it was set {count} times in all)" if count > 1 else ""
        return (
            f"{last.reason}, {(last.after_ns - first_ns) / SECOND_NS:.3f} s after the first reading{times}; the new "
            "stamps are counted on from the last one"
        )

    def push(self, batch: Batch, now_s: float) -> Batch:
        """The samples by their new stamps; now_s: when they came, the same for all where that says nothing."""
        accel = self._readings(self._held + batch.accel, now_s, final=False)
        pose, temperature = (
            follow(stream, self._shifts, self._last_ns)
            for follow, stream in zip(self._others, (batch.pose, batch.temperature), strict=True)
        )
        return Batch(accel, pose, temperature)

    def rest(self) -> Batch:
        """The readings that wait for the next to tell whether the clock was set."""
        return Batch(self._readings(self._held, self._came_s, final=True), self._others[0].none)

    def _readings(self, stream: Stream, now_s: float, final: bool) -> Stream:
        self._held = stream[:0]
        if not len(stream):
            return stream
        self._first = stream[:1] if self._first is None else self._first
        stamps, sound = stream.time_ns + self._shifts[-1], np.ones(len(stream), bool)
        if _fit(np.diff(stamps, prepend=stamps[0] if self._last_ns is None else self._last_ns)).all():
            self._last_ns, self._came_s, self._is_repeating = int(stamps[-1]), now_s, False
        else:
            stamps, sound = self._one_by_one(stream, now_s, final)
        self._count(stamps[sound])
        self.left_out += int((~sound).sum())
        return Stream(stamps, stream.values[: len(stamps)])

    def _one_by_one(self, stream: Stream, now_s: float, final: bool) -> tuple[Times, Mask]:
        """The new stamps and which of them follow each other, up to a reading of which the next ones have to tell."""
        raw: list[int] = stream.time_ns.tolist()
        stamps, sound = np.empty_like(stream.time_ns), np.zeros(len(raw), bool)
        for i, stamp_ns in enumerate(raw):
            if not self._follows(stamp_ns + self._shifts[-1]) and not self._repeats(stream[i : i + 1]):
                agreeing, needed = self._agreeing(raw[i : i + _PERSISTS])
                is_last = i + agreeing == len(raw)
                if agreeing >= needed or (final and is_last and self._is_pause(stamp_ns)):
                    self._go_on_at(stamp_ns, now_s)
                elif is_last and not final:
                    self._held = stream[i:]
                    return stamps[:i], sound[:i]
            stamps[i] = stamp_ns + self._shifts[-1]
            sound[i] = self._follows(int(stamps[i]))  # a damaged stamp stays as it is
            if sound[i]:
                self._last_ns, self._came_s, self._is_repeating = int(stamps[i]), now_s, False
        return stamps, sound

    def _follows(self, stamp: int) -> bool:
        return self._last_ns is None or bool(_fit(np.array(stamp - self._last_ns)))

    def _is_pause(self, raw: int) -> bool:
        return self._last_ns is not None and 0 < raw + self._shifts[-1] - self._last_ns < _SET_NS

    def _agreeing(self, raw: list[int]) -> tuple[int, int]:
        """How many of these stamps, from the first on, go on from each other and not from the last, and how many have
        to for a clock that was set; after a pause one more is enough."""
        longest_ns, needed = (_SET_NS, 2) if self._is_pause(raw[0]) else (LEAP_NS, _PERSISTS)
        count = 1
        for before, stamp in pairwise(raw):
            if not -_BACK_NS < stamp - before < longest_ns or self._follows(stamp + self._shifts[-1]):
                break
            count += 1
        return count, needed

    def _repeats(self, reading: Stream) -> bool:
        """Whether the bench sends again what it has sent, from its first reading on: no clock was set."""
        assert self._first is not None
        self._is_repeating |= bool(
            reading.time_ns[0] == self._first.time_ns[0] and (reading.values == self._first.values).all()
        )
        return self._is_repeating

    def _go_on_at(self, raw: int, now_s: float) -> None:
        """The stamps go on here: after a pause as they are, else close behind the last."""
        assert self._last_ns is not None
        if self._is_pause(raw):
            self._last_ns = raw + self._shifts[-1]
            return
        step = raw + self._shifts[-1] - self._last_ns
        begin = self._last_ns + round(max(now_s - self._came_s, _BREAK_S) * SECOND_NS)
        self.restarts.append(Restart(self._last_ns, begin, step, begin - raw))
        self._shifts.append(begin - raw)
        self._last_ns = begin

    def _count(self, stamps: Times) -> None:
        if not len(stamps):
            return
        steps = np.diff(stamps, prepend=self._reached_ns)
        moved = np.flatnonzero(steps)
        self._unmoved = len(steps) - 1 - int(moved[-1]) if len(moved) else self._unmoved + len(steps)
        before = np.maximum.accumulate(np.concatenate([[self._reached_ns], stamps]))
        self.left_out += int((stamps <= before[:-1]).sum())
        self._reached_ns = int(before[-1])


class _Follower:
    """The stamps of a stream beside the readings, each of which may have come before or after theirs."""

    def __init__(self) -> None:
        self.none = Stream.empty(0)
        self._last_ns: int | None = None
        self._shift = 0

    def __call__(self, stream: Stream, shifts: list[int], reached_ns: int | None) -> Stream:
        """reached_ns: of the readings, by their new stamps; shifts: of all times the clock was set."""
        self.none = stream[:0]
        if not len(stream):
            return stream
        stamps = stream.time_ns + self._shift
        if self._last_ns is not None and _fit(np.diff(stamps, prepend=self._last_ns)).all():
            self._last_ns = int(stamps[-1])
            return Stream(stamps, stream.values)
        raw: list[int] = stream.time_ns.tolist()
        return Stream(np.array([self._stamp(own, shifts, reached_ns) for own in raw], np.int64), stream.values)

    def _stamp(self, raw: int, shifts: list[int], reached_ns: int | None) -> int:
        stamp = raw + self._shift
        if reached_ns is None or (self._last_ns is not None and _fit(np.array(stamp - self._last_ns))):
            self._last_ns = stamp
            return stamp
        shift = min([self._shift, *shifts], key=lambda shift: abs(raw + shift - reached_ns))
        if self._last_ns is None or abs(raw + shift - reached_ns) <= abs(self._last_ns - reached_ns):
            self._shift, self._last_ns = shift, raw + shift
            return raw + shift
        return stamp  # damaged, or the readings have not shown yet that the clock was set


def _fit(steps: Times) -> Mask:
    """Which steps from stamp to stamp are those of a clock that goes on."""
    return (steps > -_BACK_NS) & (steps < LEAP_NS)


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
