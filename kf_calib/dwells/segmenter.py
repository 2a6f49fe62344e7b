"""Dwells: the stretches in which the platform stands still, cut from the raw streams as they arrive.

What is still is judged on the platform angles (``stationarity``). Where angles are absent during a motion (two messages
far apart in time and in angle) the readings decide where the one dwell ended and the next began, if they rest at all: a
slew may be slow for messages that are seldom. Samples of a slew stay in the recording and out of the static fit; so do
``settle_s`` after each arrival and ``lead_s`` before each departure (of short dwells no more than a third and a tenth).
What comes out does not depend on how the streams were chopped into batches.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np

from kf_calib.bench.arrays import Floats, Mask, Times
from kf_calib.bench.bench import Bench, interpolate_pose, mean_pose, pose_distance, unwrap_pose
from kf_calib.bench.streams import Batch, Source, Stream
from kf_calib.dwells.blocks import LARGEST_C, LARGEST_MPS2, LARGEST_RAD, Block, Tally, within
from kf_calib.dwells.slew_kinematics import Curve
from kf_calib.dwells.stationarity import HISTORY, Stillness, encoder_sigma
from kf_calib.errors import InputError

BLOCK_SAMPLES = 4000
"""Samples of one block at the most: few enough for the cache; no power of two, whose columns would evict each other."""

_SECOND_NS = 1_000_000_000
_LAST_NS = 1 << 62  # after every stamp
_HOLD_NS = _SECOND_NS  # a reading up to this far outside the first or last angle still gets that angle
_LEAP_NS = 10 * _SECOND_NS  # a stamp this far ahead, with the next one behind it, is a damaged stamp
_SLEW_READINGS = 8  # of a slew, at least
_REST_NS = 2 * _SECOND_NS  # a dwell that readings alone tell of, between angles that differ, lasts at least
_PENDING_SAMPLES = 1 << 22  # readings that may wait for an angle; 32 B each
_SURE = 3  # messages: of fewer the noise of an encoder cannot be taken


class _Order:
    """Keeps the samples of a stream whose stamps advance; counts the others."""

    def __init__(self) -> None:
        self.last_ns: int | None = None
        self._held = Stream.empty(0)
        self._ended = False

    def __call__(self, stream: Stream, tally: Tally | None = None, first_ns: int | None = None) -> Stream:
        if self._held.time_ns.size:
            stream, self._held = self._held + stream, Stream.empty(0)
        if not len(stream):
            return stream
        begun = 1 if self.last_ns is None else stream.time_ns[0] - self.last_ns
        steps = np.diff(stream.time_ns)
        if min(begun, steps.min(initial=1)) > 0 and max(begun, steps.max(initial=1)) < _LEAP_NS:
            self.last_ns = int(stream.time_ns[-1])
            return stream
        return self._one_by_one(stream, tally or Tally(), first_ns)

    def _one_by_one(self, stream: Stream, tally: Tally, first_ns: int | None) -> Stream:
        stamps: list[int] = stream.time_ns.tolist()
        keep = np.zeros(len(stamps), bool)
        for i, stamp in enumerate(stamps):
            if self.last_ns is not None and stamp <= self.last_ns:
                if stamp == self.last_ns:
                    tally.repeated += 1
                else:
                    tally.backward += 1
                    if tally.first_backward_s is None:
                        tally.first_backward_s = (self.last_ns - (first_ns or stamps[0])) / _SECOND_NS
                continue
            if self.last_ns is not None and stamp - self.last_ns >= _LEAP_NS:
                if i + 1 == len(stamps) and not self._ended:  # only the next stamp can tell a gap from a damaged stamp
                    self._held = stream[i:]
                    break
                if i + 1 < len(stamps) and stamps[i + 1] < stamp:
                    tally.leaping += 1
                    continue
            keep[i] = True
            self.last_ns = stamp
        return stream[keep]

    def flush(self) -> Stream:
        """What was held back at the end of the stream; to be passed through once more."""
        self._ended = True
        held, self._held = self._held, Stream.empty(0)
        return held


class _Event(Enum):
    LEAVE = 0
    ARRIVE = 1


@dataclass
class _Dwell:
    """The open dwell: its number, its arrival, and the first pose message that belongs to it.

    felt_ns: the arrival as the readings tell it; what settles counts from there.
    settling_ns: what is left out after the arrival; None while the dwell may still be too short for the whole margin.
    pose (1, k): where the platform stands, from the messages of the dwell's first block; pose_sigma_rad: of these.
    turns: by which its poses go beyond the angles as they were recorded.
    """

    number: int
    arrival_ns: int
    felt_ns: int
    first_pose_ns: int
    settling_ns: int | None
    pose: Floats | None = None
    pose_sigma_rad: float = 0.0
    turns: tuple[int, ...] | None = None


@dataclass
class Segmenter:
    """Cuts batches into blocks of dwells; ``push`` what has arrived, then ``finish``.

    slews: blocks of the motions from dwell to dwell, too, as far as angles were recorded in them.
    """

    bench: Bench
    stillness: Stillness = field(default_factory=Stillness)
    tally: Tally = field(default_factory=Tally)
    slews: bool = False

    def __post_init__(self) -> None:
        if self.slews and not self.bench.axes:
            raise InputError(
                "slews are evaluated from gimbal angles, and this recording has attitude quaternions: record "
                "/platform/angles, or leave out the effects that show in slews only."
            )
        self.first_ns: int | None = None
        self.dwell_count = 0  # so many have begun; that is also the number of the latest
        self._accel = Stream.empty(3)
        self._pose = Stream.empty(self.bench.pose_width)
        self._turns = np.empty((0, len(self.bench.axes) or 1))  # by which each pose goes beyond what was recorded
        self._early = list[Stream]()  # poses, as recorded, that the readings have not reached
        self._before: tuple[Floats, Floats] | None = None  # the last pose as recorded, and its turns
        self._temperature = Stream.empty(1)
        self._orders = (_Order(), _Order(), _Order())
        self._decided_ns: int | None = None  # intervals of poses before this stamp have been judged
        self._cover_ns = -_LAST_NS  # a still window judged earlier reaches to here
        self._dwell: _Dwell | None = None
        self._encoder_rad = 0.0  # noise of a message, as the dwell before showed it
        self._begun = False

    def push(self, batch: Batch) -> Iterator[Block]:
        """Blocks that are complete once this batch is known."""
        self._take(batch)
        yield from self._advance(final=False)

    def finish(self) -> Iterator[Block]:
        """The blocks still open at the end of the streams."""
        accel, pose, temperature = (order.flush() for order in self._orders)
        self._take(Batch(accel, pose, temperature), final=True)
        yield from self._advance(final=True)

    @property
    def standing(self) -> int | None:
        """Number of the dwell that is open; None while the platform moves, or is not known to stand."""
        return None if self._dwell is None else self._dwell.number

    @property
    def arrival_s(self) -> float:
        """When the open dwell began, since the first sample; NaN where none is open."""
        if self._dwell is None or self.first_ns is None:
            return math.nan
        return (self._dwell.arrival_ns - self.first_ns) / _SECOND_NS

    def waiting(self) -> list[Block]:
        """The readings of the open dwell that wait for their block to fill, in a block that is not taken from it."""
        horizon = self._horizon(final=False)
        if self._dwell is None or horizon is None:
            return []
        aside = copy.copy(self)
        aside.tally, aside._dwell = Tally(), replace(self._dwell)
        return list(aside._emit(horizon, closing=True))

    def _take(self, batch: Batch, final: bool = False) -> None:
        """Add a batch to what waits to be judged; in the end, what was held back comes a second time."""
        if not final:
            self.tally.read += len(batch.accel)
            batch = replace(batch, accel=Stream(batch.accel.time_ns, self.bench.readings(batch.accel.values)))
        self._take_readings(batch.accel)
        self._take_poses(batch.pose, final)
        if len(batch.temperature):
            warm = batch.temperature
            readable = within(warm.values, LARGEST_C)
            if readable is not None:
                self.tally.temperatures_dropped += int((~readable).sum())
                warm = warm[readable]
            self._temperature += self._orders[2](warm)

    def _take_readings(self, accel: Stream) -> None:
        if not len(accel):
            return
        readable = within(accel.values, LARGEST_MPS2)
        if readable is not None:
            too_large = int(np.isfinite(accel.values[~readable]).all(axis=1).sum())
            self.tally.too_large += too_large
            self.tally.not_finite += int((~readable).sum()) - too_large
            accel = accel[readable]
        accel = self._orders[0](accel, self.tally, self.first_ns)
        if self.first_ns is None and len(accel):
            self.first_ns = int(accel.time_ns[0])
        self._accel += accel

    def _take_poses(self, pose: Stream, final: bool) -> None:
        """Poses wait for the readings: when a platform came and left is judged by both, and must not depend on which
        of them was ahead on the way here. ``_early`` has those that came too soon."""
        if len(pose):
            sound, counts = self._sound(pose.values), Tally()
            pose = self._orders[1](pose[sound], counts)
            self.tally.poses += len(pose)
            self.tally.poses_dropped += int((~sound).sum()) + counts.repeated + counts.backward + counts.leaping
            if self.bench.axes:
                self.tally.farthest_rad = max(self.tally.farthest_rad, float(np.abs(pose.values).max(initial=0.0)))
        self._early += [pose] if len(pose) else []
        reached_ns = _LAST_NS if final else self._orders[0].last_ns
        if not self._early or reached_ns is None or self._early[0].time_ns[0] > reached_ns:
            return
        pose = Stream.joined(self._early)
        reached = int(np.searchsorted(pose.time_ns, reached_ns, side="right"))
        pose, self._early = pose[:reached], [pose[reached:]] if reached < len(pose) else []
        continuous, turns = unwrap_pose(pose.values, not self.bench.axes, self._before)
        self._before = pose.values[-1], turns[-1]
        self._pose += Stream(pose.time_ns, continuous)
        self._turns = np.concatenate([self._turns, turns])

    def _sound(self, poses: Floats) -> Mask:
        """Which poses can be used, (m,) bool: angles that can be, and quaternions of nearly unit length."""
        readable = within(poses, LARGEST_RAD)
        readable = np.ones(len(poses), bool) if readable is None else readable
        if self.bench.axes:
            return readable
        return readable & (np.abs(np.linalg.norm(np.where(readable[:, None], poses, 0.0), axis=1) - 1.0) < 0.01)

    def _advance(self, final: bool) -> Iterator[Block]:
        for stamp, event, settles in self._judge(final):
            if event is _Event.ARRIVE:
                felt_ns = self._felt_ns(stamp)
                yield from self._slew(stamp)
                self._discard(stamp)
                self.dwell_count += 1
                settling_ns = None if settles else 0
                self._dwell = _Dwell(self.dwell_count, stamp, felt_ns, self._next_pose_ns(stamp), settling_ns)
            else:
                lead_ns = min(self.stillness.lead_ns, (stamp - self._dwell.arrival_ns) // 10) if self._dwell else 0
                yield from self._emit(stamp - lead_ns, closing=True, left=True)
                self._dwell = None
        horizon = self._horizon(final)
        if horizon is None:
            return
        if self._dwell is not None:
            if final:
                yield from self._emit(horizon, closing=True)
            elif self._dwell.settling_ns is None or len(self._accel) >= BLOCK_SAMPLES:  # else there is nothing to do
                yield from self._emit(min(horizon, self._resting_ns()), closing=False)
        elif final or not self._slewing():  # an arrival may be felt since the last angle before it
            before = int(np.searchsorted(self._pose.time_ns, self._decided_ns or horizon)) - 1
            self._discard(horizon if final or before < 0 else min(horizon, int(self._pose.time_ns[before])))
        self._forget()
        if final:
            self.tally.without_pose += len(self._accel)
            self._accel = Stream.empty(3)

    def _judge(self, final: bool) -> list[tuple[int, _Event, bool]]:
        """Arrivals and departures in the pose intervals that can be judged by now: (stamp, event, has to settle)."""
        times, poses = self._pose.time_ns, self._pose.values
        start = 0 if self._decided_ns is None else int(np.searchsorted(times, self._decided_ns))
        times, poses = times[start:], poses[start:]
        if len(times) < 2:
            return self._lone_pose(times) if final else []
        known = times + self.stillness.window_ns <= times[-1]
        count = len(times) - 1 if final else int(known[:-1].sum())
        if count == 0:
            return []
        known |= final
        still, self._cover_ns = self.stillness.intervals(times, poses, not self.bench.axes, known, self._cover_ns)
        still = still[:count]
        events = self._events(times, still)
        self._decided_ns = int(times[count])
        return events

    def _lone_pose(self, times: Times) -> list[tuple[int, _Event, bool]]:
        """A single pose message makes one dwell of all the readings around it."""
        if self._begun or not len(times) or not len(self._accel):
            return []
        self._begun, self._decided_ns = True, int(times[0])
        return [(int(min(self._accel.time_ns[0], times[0])), _Event.ARRIVE, False)]

    def _events(self, times: Times, still: Mask) -> list[tuple[int, _Event, bool]]:
        in_dwell, events = self._dwell is not None, list[tuple[int, _Event, bool]]()
        arrived_ns = self._dwell.arrival_ns if self._dwell else 0
        unresolved = ~still & (np.diff(times[: len(still) + 1]) > self.stillness.window_ns)
        after_unresolved = np.concatenate([[False], unresolved[:-1]])
        changes = np.flatnonzero(np.diff(still, prepend=in_dwell) | unresolved | after_unresolved)
        for j in changes:
            begin, end = int(times[j]), int(times[j + 1])
            if still[j] and not in_dwell:
                first = not self._begun
                arrived_ns, in_dwell = begin - (_HOLD_NS if first else 0), True
                events.append((arrived_ns, _Event.ARRIVE, not first))
            elif unresolved[j]:
                leave, arrive = self.stillness.moved_between(self._accel, begin, end, self.bench.gravity_mps2)
                if not in_dwell and leave - begin >= _REST_NS:
                    arrived_ns, in_dwell = begin - (0 if self._begun else _HOLD_NS), True
                    events.append((arrived_ns, _Event.ARRIVE, False))
                if in_dwell:
                    events.append((self._departed_ns(arrived_ns, leave), _Event.LEAVE, False))
                arrived_ns, in_dwell = arrive, end - arrive >= _REST_NS
                if in_dwell:
                    events.append((arrive, _Event.ARRIVE, True))
            elif not still[j] and in_dwell:
                events.append((self._departed_ns(arrived_ns, begin), _Event.LEAVE, False))
                in_dwell = False
            self._begun = True
        return events

    def _departed_ns(self, arrived_ns: int, end_ns: int) -> int:
        return self.stillness.departure_ns(self._pose, not self.bench.axes, arrived_ns, end_ns)

    def _felt_ns(self, arrival_ns: int) -> int:
        """When an arrival was felt: angles tell it to their period only, and too early where a slew ends gently."""
        last = int(np.searchsorted(self._pose.time_ns, arrival_ns)) - 1
        if last < 0:
            return arrival_ns
        since_ns = int(self._pose.time_ns[last])
        return self.stillness.felt_ns(self._accel, since_ns, arrival_ns, self.bench.gravity_mps2)

    def _next_pose_ns(self, stamp: int) -> int:
        """The first pose message at or after an arrival: the dwell's own poses start there."""
        index = int(np.searchsorted(self._pose.time_ns, stamp))
        return int(self._pose.time_ns[min(index, len(self._pose) - 1)])

    def _horizon(self, final: bool) -> int | None:
        """Readings before this stamp can be released."""
        if self._decided_ns is None:
            if not final and len(self._accel) <= _PENDING_SAMPLES:
                return None
            return int(self._accel.time_ns[-1]) + 1 if len(self._accel) else None
        if final:
            return int(self._pose.time_ns[-1]) + _HOLD_NS if len(self._pose) > 1 else _LAST_NS
        return self._decided_ns - self.stillness.lead_ns - self.stillness.window_ns

    def _resting_ns(self) -> int:
        """Readings of the open dwell before this stamp are not those of a slew that may have begun."""
        assert self._dwell is not None and self._decided_ns is not None
        last = int(np.searchsorted(self._pose.time_ns, self._decided_ns))
        until_ns = self._departed_ns(self._dwell.arrival_ns, self._decided_ns)
        return min(until_ns, int(self._pose.time_ns[max(last - 1, 0)])) - self.stillness.lead_ns

    def _discard(self, until_ns: int) -> None:
        """Drop the readings before ``until_ns``: the platform was moving, or no angle was known."""
        count = int(np.searchsorted(self._accel.time_ns, until_ns))
        first_pose = int(self._pose.time_ns[0]) if len(self._pose) and not self.dwell_count else -_LAST_NS
        early = int(np.searchsorted(self._accel.time_ns[:count], first_pose - _HOLD_NS))
        self.tally.without_pose += early
        self.tally.moving += count - early
        self._accel = self._accel[count:]

    def _slewing(self) -> bool:
        """Whether readings wait for the end of a slew, to be used."""
        return self.slews and self.dwell_count > 0 and len(self._accel) <= _PENDING_SAMPLES

    def _slew(self, arrival_ns: int) -> Iterator[Block]:
        """Blocks of the readings between the last dwell and an arrival, if angles came all the way, no farther
        apart than half a second and a quarter of the way."""
        count = int(np.searchsorted(self._accel.time_ns, arrival_ns))
        if not self._slewing() or count < _SLEW_READINGS or self.first_ns is None:
            return
        accel, window_ns = self._accel[:count], self.stillness.window_ns
        begin_ns, end_ns = int(accel.time_ns[0]), int(accel.time_ns[-1])
        around = slice(*np.searchsorted(self._pose.time_ns, (begin_ns - window_ns, arrival_ns + window_ns + 1)))
        times, poses = self._pose.time_ns[around], self._pose.values[around]
        if len(times) < 4 or times[0] > begin_ns or times[-1] < end_ns or np.diff(times).max() > window_ns:
            return
        if np.abs(np.diff(poses, axis=0)).max() > np.ptp(poses, axis=0).max() / 4.0:  # too fast for its messages
            return
        curve = Curve.through(self.bench, (times - self.first_ns) / _SECOND_NS, poses)
        warm, elapsed_s = _carried_on(self._temperature, accel.time_ns), (accel.time_ns - self.first_ns) / _SECOND_NS
        for part in np.array_split(np.arange(count), -(-count // BLOCK_SAMPLES)):
            own = elapsed_s[part]
            yield Block(
                self.dwell_count, float(elapsed_s[0]), own, accel.values[part], curve.angles(own), warm[part], curve
            )
        self.tally.slewing += count
        self._accel = self._accel[count:]

    def _emit(self, until_ns: int, closing: bool, left: bool = False) -> Iterator[Block]:
        """Blocks of the open dwell from the readings before ``until_ns``; a last short one when it closes.

        left: it closes because the platform has left; a dwell in which a run ends is short by no choice.
        """
        assert self._dwell is not None
        dwell, settle_ns = self._dwell, self.stillness.settle_ns
        if dwell.settling_ns is None:
            rest_ns, judged = self.stillness.rest_ns(self._pose, not self.bench.axes, dwell.arrival_ns, until_ns)
            length_ns = until_ns - rest_ns
            if not closing and (not judged or length_ns < 3 * settle_ns):
                return
            dwell.settling_ns = rest_ns - dwell.arrival_ns + min(settle_ns, length_ns // 3)
            if settle_ns > length_ns // 3 and left:
                self.tally.short_dwells += 1
                self.tally.least_settling_s = min(self.tally.least_settling_s, length_ns // 3 / _SECOND_NS)
        count = int(np.searchsorted(self._accel.time_ns, until_ns))
        first = min(int(np.searchsorted(self._accel.time_ns, dwell.arrival_ns + dwell.settling_ns)), count)
        if closing and dwell.pose is None and self._is_unsure(self._accel.time_ns[first:count]):
            first = count
        self.tally.settling += first
        while count - first >= BLOCK_SAMPLES or (closing and count > first):
            size = min(BLOCK_SAMPLES, count - first)
            yield self._block(self._accel[first : first + size])
            first += size
        self._accel = self._accel[first:]

    def _is_unsure(self, times: Times) -> bool:
        """Whether there are so few messages of a noisy encoder to these readings that they do not tell its noise."""
        if not len(times) or self._encoder_rad <= self.stillness.rest_rad:
            return False
        return int(np.diff(np.searchsorted(self._pose.time_ns, (times[0], times[-1])))[0]) < _SURE

    def _block(self, accel: Stream) -> Block:
        assert self._dwell is not None and self.first_ns is not None
        self.tally.used += len(accel)
        elapsed_s = (accel.time_ns - self.first_ns) / _SECOND_NS
        arrival_s, felt_s = (
            max((stamp - self.first_ns) / _SECOND_NS, 0.0) for stamp in (self._dwell.arrival_ns, self._dwell.felt_ns)
        )
        pose, warm = self._block_pose(accel.time_ns), _carried_on(self._temperature, accel.time_ns)
        return Block(
            self._dwell.number, arrival_s, elapsed_s, accel.values, pose, warm, felt_s=felt_s,
            pose_sigma_rad=self._dwell.pose_sigma_rad, turns=self._dwell_turns(),
        )  # fmt: skip

    def _dwell_turns(self) -> tuple[int, ...]:
        """Of the open dwell, by its first pose."""
        assert self._dwell is not None
        if self._dwell.turns is None:
            first = int(np.searchsorted(self._pose.time_ns, self._dwell.first_pose_ns))
            self._dwell.turns = tuple(map(int, self._turns[first])) if self.bench.axes else ()
        return self._dwell.turns

    def _block_pose(self, accel_ns: Times) -> Floats:
        assert self._dwell is not None
        times, poses = self._pose.time_ns, self._pose.values
        own = int(np.searchsorted(times, self._dwell.first_pose_ns))
        first = max(int(np.searchsorted(times, accel_ns[0])), own)
        last = max(int(np.searchsorted(times, accel_ns[-1], side="right")), own)
        if first == last:  # no message inside the block: the latest of this dwell before it, else its first
            first = max(first - 1, own)
            last = first + 1
        inside = poses[first:last]
        if not self.stillness.creeps(inside):
            return self._standing_pose(inside)
        turned_rad = float(pose_distance(inside[-1], inside[0], not self.bench.axes))
        self.tally.turned_deg = max(self.tally.turned_deg, math.degrees(turned_rad))
        around = slice(max(first - 1, own), last + 1)
        return interpolate_pose(accel_ns, times[around], poses[around], not self.bench.axes)

    def _standing_pose(self, inside: Floats) -> Floats:
        """The dwell's pose (1, k); taken anew only where a block's mean has left it by more than the encoder's noise.

        A platform that stands still has one pose: the columns of its dwell are then constant to the last bit.
        """
        assert self._dwell is not None
        mean = mean_pose(inside)[None, :]
        known = self._dwell.pose
        allowed = 6.0 * inside.std(axis=0) / np.sqrt(len(inside)) + 1e-9
        if known is None or (np.abs(mean - known) > allowed).any():
            sigma = float(np.sqrt(np.mean(encoder_sigma(inside) ** 2)))
            self._dwell.pose, self._dwell.pose_sigma_rad = mean, sigma / math.sqrt(len(inside))
            self._encoder_rad = sigma or self._encoder_rad
            return mean
        return known

    def _forget(self) -> None:
        """Drop poses and temperatures that no pending reading needs."""
        oldest = int(self._accel.time_ns[0]) if len(self._accel) else (self._decided_ns or 0)
        oldest = min(oldest, (self._decided_ns or oldest) - self.stillness.history_ns)
        if self.slews:  # a slew's curve begins a window before it
            oldest -= self.stillness.window_ns + self.stillness.lead_ns
        kept = slice(max(int(np.searchsorted(self._pose.time_ns, oldest)) - HISTORY, 0), None)
        self._pose, self._turns = self._pose[kept], self._turns[kept]
        self._temperature = self._temperature[max(int(np.searchsorted(self._temperature.time_ns, oldest)) - 2, 0) :]


def _carried_on(slow: Stream, at_ns: Times) -> Floats:
    """A slow quantity at ``at_ns`` (n,): the line through its last two samples, for as long as they lie apart.

    Nothing waits for the next sample, and holding the last would be late by half their distance. NaN before the first.
    """
    if not len(slow):
        return np.full(len(at_ns), np.nan)
    counts = np.diff(np.searchsorted(at_ns, slow.time_ns), prepend=0, append=len(at_ns))  # before the first, of each
    begins_ns, levels = np.append(0, slow.time_ns), np.append(np.nan, slow.values[:, 0])
    steps_ns = np.append([1, 1], np.diff(slow.time_ns))
    rises = np.where(steps_ns > 0, np.append([0.0, 0.0], np.diff(slow.values[:, 0])), 0.0)
    begin_ns, level, step_ns, rise = (
        np.repeat(each, counts) for each in (begins_ns, levels, np.maximum(steps_ns, 1), rises)
    )
    return level + np.minimum((at_ns - begin_ns) / step_ns, 1.0) * rise


def dwell_blocks(source: Source, segmenter: Segmenter) -> Iterator[Block]:
    """All blocks of a source, in order."""
    for batch in source:
        yield from segmenter.push(batch)
    yield from segmenter.finish()
