"""Segmentation of the raw streams into dwells, the stretches in which the platform stands still, as samples arrive.

Whether the platform stands still is decided from its angles (``stationarity``). Where no angles were recorded during a
motion, so that two consecutive messages are far apart in time and in angle, the accelerometer readings decide when the
first dwell ended and the second began. There may be no dwell at all between such messages, because the platform may
have moved slowly all the time while few angle messages arrived.

Samples of a slew are not used in the static fit. Neither are those of the first ``settle_s`` after each arrival and of
the last ``lead_s`` before each departure; in short dwells these margins are at most a third and a tenth of the dwell.
The result does not depend on how the streams were divided into batches.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import overload

import numpy as np

from kf_calib.bench.arrays import Floats, Mask, Times
from kf_calib.bench.bench import Bench, interpolate_pose, mean_pose, pose_distance, unwrap_pose
from kf_calib.bench.streams import LAST_NS, MOST_KEPT, SECOND_NS, Batch, Source, Stream
from kf_calib.dwells.blocks import (
    BLOCK_SAMPLES,
    LARGEST,
    LARGEST_MPS2,
    Block,
    Curve,
    DwellEvent,
    OpenDwell,
    SampleCounts,
    StampOrder,
    carry_on,
    within,
)
from kf_calib.dwells.encoder_noise import EncoderNoise, distance_sigma, encoder_sigma
from kf_calib.dwells.limits import CURVE, FEWEST_READINGS, SIGMAS
from kf_calib.dwells.stationarity import HISTORY, Stillness
from kf_calib.errors import InputError

_HOLD_NS = SECOND_NS  # a reading up to this far outside the first or last angle still gets that angle


@dataclass
class Segmenter:
    """Cuts batches into blocks of dwells: call ``push`` with each batch and ``finish`` at the end.

    If ``slews`` is set, blocks of the motions between dwells are also returned, provided that angles were recorded
    during them.
    """

    bench: Bench
    stillness: Stillness = field(default_factory=Stillness)
    counts: SampleCounts = field(default_factory=SampleCounts)
    slews: bool = False

    def __post_init__(self) -> None:
        if self.slews and not self.bench.axes:
            raise InputError(
                "slews are evaluated from gimbal angles, and this recording has attitude quaternions: record "
                "/platform/angles, or leave out the effects that show in slews only."
            )
        self.first_ns: int | None = None
        self.dwell_count = 0  # number of dwells that have begun, and the number of the latest
        self._accel, self._first = Stream.empty(3), np.empty((0, 3))
        self._pose = Stream.empty(self.bench.pose_width)
        self._turns = np.empty((0, len(self.bench.axes) or 1))  # whole turns that were added to each recorded pose
        self._noise, self._noise_rad = EncoderNoise(not self.bench.axes), np.empty(0)  # of each recorded pose
        self._early_poses = list[Stream]()  # recorded poses later than the readings so far, or too few for their noise
        self._last_recorded: tuple[Floats, Floats] | None = None  # the last recorded pose and its turns
        self._temperature = Stream.empty(1)
        self._orders = (StampOrder(), StampOrder(), StampOrder())
        self._decided_ns: int | None = None  # intervals of poses before this stamp have been judged
        self._cover_ns = -LAST_NS  # end of the latest window that was judged as still
        self._dwell: OpenDwell | None = None
        self._encoder_rad = 0.0  # noise of an angle message, estimated in the last dwell
        self._begun = False

    def push(self, batch: Batch) -> Iterator[Block]:
        """Yield the blocks that are complete once this batch is known."""
        self._take(batch)
        yield from self._advance(final=False)

    def finish(self) -> Iterator[Block]:
        """Yield the blocks that are still open at the end of the streams."""
        accel, pose, temperature = (order.flush() for order in self._orders)
        self._take(Batch(accel, pose, temperature), final=True)
        yield from self._advance(final=True)

    @property
    def standing(self) -> int | None:
        """Number of the open dwell; None if the platform moves or is not yet known to stand still."""
        return None if self._dwell is None else self._dwell.number

    @property
    def arrival_s(self) -> float:
        """Time of arrival of the open dwell, s since the first sample; NaN if no dwell is open."""
        return math.nan if self._dwell is None else self._elapsed_s(self._dwell.arrival_ns)

    @overload
    def _elapsed_s(self, stamp_ns: int) -> float: ...
    @overload
    def _elapsed_s(self, stamp_ns: Times) -> Floats: ...
    def _elapsed_s(self, stamp_ns: int | Times) -> float | Floats:
        """Return the time since the first reading, s."""
        assert self.first_ns is not None
        return (stamp_ns - self.first_ns) / SECOND_NS

    def waiting(self) -> list[Block]:
        """The readings of the open dwell that do not yet fill a block, as a block; the segmenter is not changed."""
        horizon = self._horizon(final=False)
        if self._dwell is None or horizon is None:
            return []
        aside = copy.copy(self)
        aside.counts, aside._dwell = SampleCounts(), replace(self._dwell)
        return list(aside._emit(horizon, closing=True))

    def _take(self, batch: Batch, final: bool = False) -> None:
        """Add a batch to the samples that wait to be judged; at the end it consists of samples that were held back
        before."""
        if not final:
            self.counts.read += len(batch.accel)
        self._take_readings(batch.accel)
        if final:
            lasted_ns = (self._orders[0].last_ns or 0) - (self.first_ns or 0)
            self.counts.look_for_trouble(self._first, lasted_ns / SECOND_NS)
        self._take_poses(batch.pose, final)
        if len(batch.temperature):
            warm = batch.temperature
            readable = within(warm.values, LARGEST)
            if readable is not None:
                self.counts.temperatures_dropped += int((~readable).sum())
                warm = warm[readable]
            self._temperature += self._orders[2](warm)

    def _take_readings(self, accel: Stream) -> None:
        """Drop unusable readings and add the others to those that wait."""
        if not len(accel):
            return
        readable = within(accel.values, LARGEST_MPS2)
        if readable is not None:
            too_large = int(np.isfinite(accel.values[~readable]).all(axis=1).sum())
            self.counts.too_large += too_large
            self.counts.not_finite += int((~readable).sum()) - too_large
            accel = accel[readable]
        accel = self._orders[0](accel, self.counts, self.first_ns)
        if self.first_ns is None and len(accel):
            self.first_ns = int(accel.time_ns[0])
        if len(self._first) < BLOCK_SAMPLES:
            self._first = np.concatenate([self._first, accel.values[: BLOCK_SAMPLES - len(self._first)]])
        self._accel += accel

    def _take_poses(self, pose: Stream, final: bool) -> None:
        """Add the poses up to the time of the latest reading; later ones wait in ``_early_poses``.

        Arrivals and departures are judged from poses and readings together, and the result must not depend on which
        stream was delivered first.
        """
        if len(pose):
            usable, counts = self._usable(pose.values), SampleCounts()
            pose = self._orders[1](pose[usable], counts)
            self.counts.poses += len(pose)
            self.counts.poses_dropped += int((~usable).sum()) + counts.repeated + counts.backward + counts.leaping
            if self.bench.axes:
                self.counts.farthest_rad = max(self.counts.farthest_rad, float(np.abs(pose.values).max(initial=0.0)))
        self._early_poses += [pose] if len(pose) else []
        reached_ns = LAST_NS if final else self._orders[0].last_ns
        if not self._early_poses or reached_ns is None or self._early_poses[0].time_ns[0] > reached_ns:
            return
        pose = Stream.joined(self._early_poses)
        reached = int(np.searchsorted(pose.time_ns, reached_ns, side="right"))
        if not final and self._noise.waits_for_more(pose[:reached]):
            self._early_poses = [pose]
            return
        pose, self._early_poses = pose[:reached], [pose[reached:]] if reached < len(pose) else []
        continuous, turns = unwrap_pose(pose.values, not self.bench.axes, self._last_recorded)
        self._last_recorded = pose.values[-1], turns[-1]
        pose = Stream(pose.time_ns, continuous)
        noise_rad = self._noise.of_next(pose)
        self.counts.noise_rad = max(self.counts.noise_rad, float(noise_rad.max(initial=0.0)))
        self._pose, self._noise_rad = self._pose + pose, np.concatenate([self._noise_rad, noise_rad])
        self._turns = np.concatenate([self._turns, turns])

    def _usable(self, poses: Floats) -> Mask:
        """Return a mask (m,) of usable poses: finite angles of possible size, or quaternions of nearly unit length."""
        readable = within(poses, LARGEST)
        readable = np.ones(len(poses), bool) if readable is None else readable
        if self.bench.axes:
            return readable
        return readable & (np.abs(np.linalg.norm(np.where(readable[:, None], poses, 0.0), axis=1) - 1.0) < 0.01)

    def _advance(self, final: bool) -> Iterator[Block]:
        """Process the arrivals and departures that can be judged by now and yield the blocks that become complete."""
        for stamp, event, settles in self._judge(final):
            if event is DwellEvent.ARRIVE:
                arrival_felt_ns = self._arrival_felt_ns(stamp)
                yield from self._slew(stamp)
                self._discard(stamp)
                self.dwell_count += 1
                settling_ns = None if settles else 0
                self._dwell = OpenDwell(
                    self.dwell_count, stamp, arrival_felt_ns, self._next_pose_ns(stamp), settling_ns
                )
            else:
                lead_ns = min(self.stillness.lead_ns, (stamp - self._dwell.arrival_ns) // 10) if self._dwell else 0
                yield from self._emit(stamp - lead_ns, closing=True, departed=True)
                self._dwell = None
        horizon = self._horizon(final)
        if horizon is None:
            return
        if self._dwell is not None:
            if final:
                yield from self._emit(horizon, closing=True)
            elif self._dwell.settling_ns is None or len(self._accel) >= BLOCK_SAMPLES:  # otherwise no block is complete
                yield from self._emit(min(horizon, self._resting_ns()), closing=False)
        elif final or not self._slewing():  # readings from the last angle before an arrival on may still be needed
            before = int(np.searchsorted(self._pose.time_ns, self._decided_ns or horizon)) - 1
            self._discard(horizon if final or before < 0 else min(horizon, int(self._pose.time_ns[before])))
        self._forget()
        if final:
            self.counts.without_pose += len(self._accel)
            self._accel = Stream.empty(3)

    def _judge(self, final: bool) -> list[tuple[int, DwellEvent, bool]]:
        """Return the arrivals and departures that can be judged by now: (stamp, event, whether the dwell has to
        settle)."""
        times, poses = self._pose.time_ns, self._pose.values
        start = 0 if self._decided_ns is None else int(np.searchsorted(times, self._decided_ns))
        times, poses, noise_rad = times[start:], poses[start:], self._noise_rad[start:]
        if len(times) < 2:
            return self._lone_pose(times) if final else []
        complete = times + self.stillness.window_ns <= times[-1]
        count = len(times) - 1 if final else int(complete[:-1].sum())
        if count == 0:
            return []
        complete |= final
        still, self._cover_ns = self.stillness.intervals(
            times, poses, not self.bench.axes, complete, self._cover_ns, noise_rad
        )
        still = still[:count]
        events = self._events(times, still)
        self._decided_ns = int(times[count])
        return events

    def _lone_pose(self, times: Times) -> list[tuple[int, DwellEvent, bool]]:
        """Return an arrival before all readings if the run has a single pose message, so that it is one dwell."""
        if self._begun or not len(times) or not len(self._accel):
            return []
        self._begun, self._decided_ns = True, int(times[0])
        return [(int(min(self._accel.time_ns[0], times[0])), DwellEvent.ARRIVE, False)]

    def _events(self, times: Times, still: Mask) -> list[tuple[int, DwellEvent, bool]]:
        """Return the arrivals and departures in consecutive intervals between poses, of which ``still`` tells whether
        each is still."""
        in_dwell, events = self._dwell is not None, list[tuple[int, DwellEvent, bool]]()
        arrived_ns = self._dwell.arrival_ns if self._dwell else 0
        unresolved = ~still & (np.diff(times[: len(still) + 1]) > self.stillness.window_ns)
        after_unresolved = np.concatenate([[False], unresolved[:-1]])
        changes = np.flatnonzero(np.diff(still, prepend=in_dwell) | unresolved | after_unresolved)
        for j in changes:
            begin, end = int(times[j]), int(times[j + 1])
            if still[j] and not in_dwell:
                first = not self._begun and j == 0  # no: the run began amid a slew
                arrived_ns, in_dwell = begin - (_HOLD_NS if first else 0), True
                events.append((arrived_ns, DwellEvent.ARRIVE, not first))
            elif unresolved[j]:
                leave, arrive = self.stillness.moved_between(self._accel, begin, end, self.bench.gravity_mps2)
                if not in_dwell and self.stillness.is_dwell(leave - begin):
                    arrived_ns, in_dwell = begin - (0 if self._begun else _HOLD_NS), True
                    events.append((arrived_ns, DwellEvent.ARRIVE, False))
                if in_dwell:
                    events.append((self._departed_ns(arrived_ns, leave), DwellEvent.LEAVE, False))
                arrived_ns, in_dwell = arrive, self.stillness.is_dwell(end - arrive)
                if in_dwell:
                    events.append((arrive, DwellEvent.ARRIVE, True))
            elif not still[j] and in_dwell:
                events.append((self._departed_ns(arrived_ns, begin), DwellEvent.LEAVE, False))
                in_dwell = False
            self._begun = True
        self._begun |= len(still) > 0
        return events

    def _departed_ns(self, arrived_ns: int, end_ns: int) -> int:
        """Return when the platform began to leave a dwell that lasts from ``arrived_ns`` to ``end_ns`` by its
        angles."""
        return self.stillness.departure_ns(self._pose, not self.bench.axes, arrived_ns, end_ns)

    def _arrival_felt_ns(self, arrival_ns: int) -> int:
        """Return the time of an arrival as the readings show it.

        The angles give the arrival only to within their sampling period, and too early if a slew ends gently.
        """
        last = int(np.searchsorted(self._pose.time_ns, arrival_ns)) - 1
        if last < 0:
            return arrival_ns
        since_ns = int(self._pose.time_ns[last])
        return self.stillness.arrival_felt_ns(self._accel, since_ns, arrival_ns, self.bench.gravity_mps2)

    def _next_pose_ns(self, stamp: int) -> int:
        """Return the stamp of the first pose message at or after an arrival, with which the poses of the dwell
        begin."""
        index = int(np.searchsorted(self._pose.time_ns, stamp))
        return int(self._pose.time_ns[min(index, len(self._pose) - 1)])

    def _horizon(self, final: bool) -> int | None:
        """Return the stamp before which readings can be released; None if none can be yet."""
        if self._decided_ns is None:
            if not final and len(self._accel) <= MOST_KEPT:
                return None
            return int(self._accel.time_ns[-1]) + 1 if len(self._accel) else None
        if final:
            return int(self._pose.time_ns[-1]) + _HOLD_NS if len(self._pose) > 1 else LAST_NS
        return self._decided_ns - self.stillness.lead_ns - self.stillness.window_ns

    def _resting_ns(self) -> int:
        """Return the stamp before which the readings of the open dwell cannot belong to a slew that may have begun."""
        assert self._dwell is not None and self._decided_ns is not None
        last = int(np.searchsorted(self._pose.time_ns, self._decided_ns))
        until_ns = self._departed_ns(self._dwell.arrival_ns, self._decided_ns)
        return min(until_ns, int(self._pose.time_ns[max(last - 1, 0)])) - self.stillness.lead_ns

    def _discard(self, until_ns: int) -> None:
        """Drop and count the readings before ``until_ns``, during which the platform moved or no angle was known."""
        count = int(np.searchsorted(self._accel.time_ns, until_ns))
        first_pose = int(self._pose.time_ns[0]) if len(self._pose) and not self.dwell_count else -LAST_NS
        early = int(np.searchsorted(self._accel.time_ns[:count], first_pose - _HOLD_NS))
        self.counts.without_pose += early
        self.counts.moving += count - early
        self._accel = self._accel[count:]

    def _slewing(self) -> bool:
        """Tell whether the waiting readings may belong to a slew that will be used."""
        return self.slews and self.dwell_count > 0 and len(self._accel) <= MOST_KEPT

    def _slew(self, arrival_ns: int) -> Iterator[Block]:
        """Yield blocks of the readings between the last dwell and an arrival.

        Nothing is yielded unless angles were recorded over the whole slew, no farther apart than the window of
        ``stillness`` in time and a quarter of the motion in angle.
        """
        count = int(np.searchsorted(self._accel.time_ns, arrival_ns))
        if not self._slewing() or count < FEWEST_READINGS:
            return
        accel, window_ns = self._accel[:count], self.stillness.window_ns
        begin_ns, end_ns = int(accel.time_ns[0]), int(accel.time_ns[-1])
        around = slice(*np.searchsorted(self._pose.time_ns, (begin_ns - window_ns, arrival_ns + window_ns + 1)))
        times, poses = self._pose.time_ns[around], self._pose.values[around]
        if len(times) < 4 or times[0] > begin_ns or times[-1] < end_ns or np.diff(times).max() > window_ns:
            return
        if np.abs(np.diff(poses, axis=0)).max() > np.ptp(poses, axis=0).max() / 4.0:  # too few messages
            return
        curve = Curve.through(self.bench, self._elapsed_s(times), poses)
        elapsed_s, temperature_c = self._elapsed_s(accel.time_ns), carry_on(self._temperature, accel.time_ns)
        slew = Block(
            self.dwell_count,
            float(elapsed_s[0]),
            elapsed_s,
            accel.values,
            curve.angles(elapsed_s),
            temperature_c,
            curve,
        )
        for part in np.array_split(np.arange(count), -(-count // BLOCK_SAMPLES)):
            yield slew[part]
        self.counts.slewing += count
        self._accel = self._accel[count:]

    def _emit(self, until_ns: int, closing: bool, departed: bool = False) -> Iterator[Block]:
        """Yield blocks of the open dwell from its readings before ``until_ns``; the last block may be short if the
        dwell closes.

        ``departed``: the dwell closes because the platform left. A dwell that is short because the run ends is not
        reported as too short.
        """
        assert self._dwell is not None
        dwell, settle_ns = self._dwell, self.stillness.settle_ns
        if dwell.settling_ns is None:
            rest_ns, certain = self.stillness.rest_ns(self._pose, not self.bench.axes, dwell.arrival_ns, until_ns)
            length_ns = until_ns - rest_ns
            if not closing and (not certain or length_ns < 3 * settle_ns):
                return
            dwell.settling_ns = rest_ns - dwell.arrival_ns + min(settle_ns, length_ns // 3)
            if settle_ns > length_ns // 3 and departed:
                self.counts.short_dwells += 1
                self.counts.least_settling_s = min(self.counts.least_settling_s, length_ns // 3 / SECOND_NS)
        count = int(np.searchsorted(self._accel.time_ns, until_ns))
        first = min(int(np.searchsorted(self._accel.time_ns, dwell.arrival_ns + dwell.settling_ns)), count)
        if closing and dwell.pose is None and self._encoder_noise_unknown(self._accel.time_ns[first:count]):
            first = count
        self.counts.settling += first
        while count - first >= BLOCK_SAMPLES or (closing and count > first):
            size = min(BLOCK_SAMPLES, count - first)
            yield self._block(self._accel[first : first + size])
            first += size
        self._accel = self._accel[first:]

    def _encoder_noise_unknown(self, times: Times) -> bool:
        """Tell whether an encoder is noisy and has so few messages during these readings that its noise cannot be
        estimated."""
        if not len(times) or self._encoder_rad <= self.stillness.rest_rad:
            return False
        return int(np.diff(np.searchsorted(self._pose.time_ns, (times[0], times[-1])))[0]) < CURVE

    def _block(self, accel: Stream) -> Block:
        """Make a block of the open dwell from these readings."""
        assert self._dwell is not None
        self.counts.used += len(accel)
        arrivals_ns = self._dwell.arrival_ns, self._dwell.arrival_felt_ns
        arrival_s, arrival_felt_s = (max(self._elapsed_s(stamp_ns), 0.0) for stamp_ns in arrivals_ns)
        pose, temperature_c = self._block_pose(accel.time_ns), carry_on(self._temperature, accel.time_ns)
        return Block(
            self._dwell.number, arrival_s, self._elapsed_s(accel.time_ns), accel.values, pose, temperature_c,
            arrival_felt_s=arrival_felt_s, pose_sigma_rad=self._dwell.pose_sigma_rad, turns=self._dwell_turns(),
        )  # fmt: skip

    def _dwell_turns(self) -> tuple[int, ...]:
        """Return the whole turns of the open dwell, taken from its first pose."""
        assert self._dwell is not None
        if self._dwell.turns is None:
            first = int(np.searchsorted(self._pose.time_ns, self._dwell.first_pose_ns))
            self._dwell.turns = tuple(map(int, self._turns[first])) if self.bench.axes else ()
        return self._dwell.turns

    def _block_pose(self, accel_ns: Times) -> Floats:
        """Return the pose of a block: (1, k) if the platform stands still, (n, k) if it creeps."""
        assert self._dwell is not None
        times, poses = self._pose.time_ns, self._pose.values
        first_of_dwell = int(np.searchsorted(times, self._dwell.first_pose_ns))
        first = max(int(np.searchsorted(times, accel_ns[0])), first_of_dwell)
        last = max(int(np.searchsorted(times, accel_ns[-1], side="right")), first_of_dwell)
        if first == last:  # no message inside the block: take the latest one before it, or the first of the dwell
            first = max(first - 1, first_of_dwell)
            last = first + 1
        inside = poses[first:last]
        if not self.stillness.creeps(inside, not self.bench.axes):
            return self._standing_pose(inside)
        turned_rad = float(pose_distance(inside[-1], inside[0], not self.bench.axes))
        self.counts.turned_deg = max(self.counts.turned_deg, math.degrees(turned_rad))
        around = slice(max(first - 1, first_of_dwell), last + 1)
        return interpolate_pose(accel_ns, times[around], poses[around], not self.bench.axes)

    def _standing_pose(self, inside: Floats) -> Floats:
        """Return the pose (1, k) of the dwell; it is replaced only if a block's mean differs from it by more than the
        encoder's noise.

        A platform at rest has a single pose, which makes the columns of its dwell constant to the last bit.
        """
        assert self._dwell is not None
        mean = mean_pose(inside)[None, :]
        dwell_pose = self._dwell.pose
        allowed = SIGMAS * inside.std(axis=0) / np.sqrt(len(inside)) + 1e-9
        if dwell_pose is None or (np.abs(mean - dwell_pose) > allowed).any():
            sigma = self._sigma_of_angle(inside)
            self._dwell.pose, self._dwell.pose_sigma_rad = mean, sigma / math.sqrt(len(inside))
            self._encoder_rad = sigma or self._encoder_rad
            return mean
        return dwell_pose

    def _sigma_of_angle(self, inside: Floats) -> float:
        """Return the noise of an angle in these messages (n, k), rad, alike for all; about each of three axes, where
        they are attitudes."""
        sigma = encoder_sigma(inside)
        if self.bench.axes:
            return float(np.sqrt(np.mean(sigma**2)))
        return float(distance_sigma(sigma, True)) / math.sqrt(3.0)

    def _forget(self) -> None:
        """Drop the poses and temperatures that no waiting reading needs."""
        oldest = int(self._accel.time_ns[0]) if len(self._accel) else (self._decided_ns or 0)
        oldest = min(oldest, (self._decided_ns or oldest) - self.stillness.history_ns)
        if self.slews:  # the curve of a slew begins one window before the slew
            oldest -= self.stillness.window_ns + self.stillness.lead_ns
        needed = slice(max(int(np.searchsorted(self._pose.time_ns, oldest)) - HISTORY, 0), None)
        self._pose, self._turns, self._noise_rad = self._pose[needed], self._turns[needed], self._noise_rad[needed]
        self._temperature = self._temperature[max(int(np.searchsorted(self._temperature.time_ns, oldest)) - 2, 0) :]


def dwell_blocks(source: Source, segmenter: Segmenter) -> Iterator[Block]:
    """Yield all blocks of a source, in order."""
    for batch in source:
        yield from segmenter.push(batch)
    yield from segmenter.finish()
