"""Blocks of readings of one dwell, and the count of what became of all readings.

The angles and the angular rate of the platform during a slew, from its angle messages.

Messages are infrequent (about 10 Hz). A cubic spline through them gives angles and speeds at the readings. Straight
lines between them would be off by their sagitta and would have no acceleration.

The order of stamps in a stream, and the arrivals and departures that delimit dwells, come before.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from kf_calib.bench.arrays import Floats, Indices, Mask, Times, crossed
from kf_calib.bench.bench import Bench, turn
from kf_calib.bench.streams import LEAP_NS, SECOND_NS, Stream
from kf_calib.dwells.limits import CURVE
from kf_calib.dwells.stationarity import Stillness

BLOCK_SAMPLES = 4000
"""Largest number of samples of a block. A block then fits into the cache; the number is not a power of two because
columns at such distances evict each other from it."""
PIECE_RAD = np.radians(2.0)
PIECE_S = 0.2


@dataclass(frozen=True)
class Curve:
    """The gimbal angles of one slew as functions of elapsed time, s: ``angles`` (n,) -> (n, k), rad, ``speeds``, rad/s,
    and their ``changes``, rad/s^2."""

    bench: Bench
    angles: Callable[[Floats], Floats]
    speeds: Callable[[Floats], Floats]
    changes: Callable[[Floats], Floats]

    @classmethod
    def through(cls, bench: Bench, elapsed_s: Floats, pose: Floats) -> Curve:
        """The curve through angle messages ``pose`` (m, k) at times ``elapsed_s`` (m,), m > 3."""
        from scipy.interpolate import CubicSpline

        spline = CubicSpline(elapsed_s, pose)
        return cls(bench, spline, spline.derivative(), spline.derivative(2))

    def rate(self, elapsed_s: Floats) -> Floats:
        """Angular rate omega (n, 3), rad/s, of the platform relative to the bench, in the platform frame.

        It follows from gimbal to gimbal, outer to inner: w_k = R_k^T w_(k-1) + axis_k dq_k/dt.
        """
        angles, speeds, omega = self.angles(elapsed_s), self.speeds(elapsed_s), np.zeros((len(elapsed_s), 3))
        for k, axis in enumerate(self.bench.axes):
            omega = turn(omega, np.array(axis), -angles[:, k]) + speeds[:, k, None] * np.array(axis)
        return omega

    def rate_change(self, elapsed_s: Floats) -> Floats:
        """Angular acceleration domega/dt (n, 3), rad/s^2, in the platform frame.

        dw_k/dt = R_k^T dw_(k-1)/dt + R_k^T w_(k-1) x axis_k dq_k/dt + axis_k d^2q_k/dt^2.
        """
        angles, speeds, changes = self.angles(elapsed_s), self.speeds(elapsed_s), self.changes(elapsed_s)
        omega, change = np.zeros((2, len(elapsed_s), 3))
        for k, axis in enumerate(map(np.array, self.bench.axes)):
            omega, change = turn(omega, axis, -angles[:, k]), turn(change, axis, -angles[:, k])
            change = change + crossed(omega, speeds[:, k, None] * axis) + changes[:, k, None] * axis
            omega = omega + speeds[:, k, None] * axis
        return change

    def cuts(self, elapsed_s: Floats) -> list[int]:
        """Indices at which readings at times ``elapsed_s`` (n,) are cut into pieces of at most about 2 deg and 0.2 s
        and at least 3 readings."""
        speed = np.linalg.norm(self.rate(elapsed_s), axis=1)
        steps = np.diff(elapsed_s, prepend=elapsed_s[:1])
        passed = np.cumsum(steps * (speed / PIECE_RAD + 1.0 / PIECE_S))
        edges = [0]
        for edge in np.searchsorted(passed, np.arange(1.0, passed[-1])).tolist():
            if edge - edges[-1] >= CURVE and len(elapsed_s) - edge >= CURVE:
                edges.append(edge)
        return [*edges, len(elapsed_s)]


LARGEST_MPS2 = 1e12
"""Readings beyond this are dropped. Counts of a 32-bit converter are below it, so that the check of the unit sees
them."""
LARGEST = 1e6
"""Angles in rad and temperatures in degC beyond this are dropped; of 160 000 turns a double keeps 1e-10 rad."""
_ALTERNATING = 0.2  # squares of every second step over those of every step, which noise makes equal
_PERIODS_S = (2e-5, 0.5)  # of accelerometers
_TURNING_DEG = 1.0  # within one block; a platform that only creeps turns by less


@dataclass(frozen=True, slots=True)
class Block:
    """Up to ``BLOCK_SAMPLES`` consecutive readings of one dwell, or of the slew that ended it.

    - dwell: number of the dwell, counted from 1.
    - arrival_s: its arrival according to the angles.
    - arrival_felt_s: its arrival according to the readings, from which settling is counted; None if the readings do not
      show it.
    - elapsed_s (n,): time since the first sample of the recording.
    - accel_mps2 (n, 3): the readings.
    - pose (1, k): the mean pose if the platform stands still; (n, k) if it creeps.
    - temperature_c (n,): NaN where it was not measured.
    """

    dwell: int
    arrival_s: float
    elapsed_s: Floats
    accel_mps2: Floats
    pose: Floats
    temperature_c: Floats
    curve: Curve | None = None
    """The course of the angles in a slew; None in a dwell."""
    variance_mps2_2: Floats | None = None
    """Variance (n, 3) of the readings in each average, if the block holds averages."""
    readings_per_row: int = 1
    """Number of readings that each row stands for."""
    arrival_felt_s: float | None = None
    pose_sigma_rad: float = 0.0
    """Standard deviation of the pose due to noise of the angles."""
    turns: tuple[int, ...] = ()
    """Whole turns of each gimbal by which ``pose`` goes beyond the angles as recorded; () for quaternions."""

    def __getitem__(self, rows: Indices | Mask) -> Block:
        variance = self.variance_mps2_2
        return replace(
            self, elapsed_s=self.elapsed_s[rows], accel_mps2=self.accel_mps2[rows],
            pose=self.pose if len(self.pose) == 1 else self.pose[rows], temperature_c=self.temperature_c[rows],
            variance_mps2_2=None if variance is None else variance[rows],
        )  # fmt: skip


@dataclass
class SampleCounts:
    """Counts of what became of every sample that was read; ``sentences`` reports those that a user should know.

    - slewing: readings of slews that were used; moving: readings not used because the platform moved.
    - short_dwells: dwells too short for the whole margin after the arrival; least_settling_s: the shortest margin used.
    - turned_deg: largest rotation of the platform within a block that counts as still.
    - noise_rad: largest noise of angles from message to message, by which more than the tolerance counts as still.
    - restless: why no dwell would be found, as far as stamps and readings tell, and what to do; known at the end.
    """

    read: int = 0
    used: int = 0
    slewing: int = 0
    moving: int = 0
    settling: int = 0
    not_finite: int = 0
    too_large: int = 0
    repeated: int = 0
    backward: int = 0
    leaping: int = 0
    without_pose: int = 0
    poses: int = 0
    poses_dropped: int = 0
    temperatures_dropped: int = 0
    gated: int = 0
    farthest_rad: float = 0.0
    first_backward_s: float | None = None
    short_dwells: int = 0
    least_settling_s: float = math.inf
    turned_deg: float = 0.0
    noise_rad: float = 0.0
    restless: str = ""

    def look_for_trouble(self, first: Floats, lasted_s: float) -> None:
        """Say in ``restless`` what the first readings (n, 3), and how long all lasted, tell of a run without dwells."""
        period_s = lasted_s / max(self.read - 1, 1)
        step, double_step = (float(np.sum((first[lag:] - first[:-lag]) ** 2)) for lag in (1, 2))
        if self.repeated + self.backward > 0.1 * self.read:
            self.restless = (
                f"the stamps of {self.repeated} repeat the one before and those of {self.backward} jump back, so that "
                "these are dropped: name another column or topic for the time, or give the rate of the rows of a text "
                "by --rate"
            )
        elif double_step < _ALTERNATING * step:
            self.restless = (
                "each reading is more like the next but one than like the next, as of two sensors that take turns: "
                "choose one, by --where COLUMN=VALUE or its topic"
            )
        elif lasted_s and not _PERIODS_S[0] < period_s < _PERIODS_S[1]:
            self.restless = (
                f"the readings are {period_s:.3g} s apart by their stamps: if these are in a unit that is a thousand "
                "times smaller or larger, say so, for example by --column 'THEIRS=time_ms'"
            )

    def sentences(self) -> list[str]:
        """One sentence for each kind of sample that was dropped or rejected."""
        backward_s = self.first_backward_s or 0.0
        sentence_of = {
            "not_finite": "readings that were not finite (NaN or infinite), dropped: {}.",
            "too_large": f"readings beyond {LARGEST_MPS2:.0e} m/s^2, which nothing can read, dropped: {{}}.",
            "repeated": "readings that repeated the stamp before them, dropped: {}.",
            "backward": f"readings whose stamps jumped back (first at {backward_s:.3f} s), dropped: {{}}.",
            "leaping": "readings with a stamp far ahead of their neighbours, dropped: {}.",
            "without_pose": "readings with no platform angle within 1 s of them, dropped: {}.",
            "poses_dropped": f"angle messages not finite, beyond {LARGEST:.0e} rad, out of order of time or no "
            "unit quaternion, dropped: {}.",
            "temperatures_dropped": f"temperatures not finite or beyond {LARGEST:.0e} degC, dropped: {{}}.",
            "gated": "outlying readings (innovation gate), rejected: {}; --no-gate keeps them.",
        }
        return [text.format(getattr(self, key)) for key, text in sentence_of.items() if getattr(self, key)]

    def unmet_settings(self, stillness: Stillness) -> list[str]:
        """One sentence for each setting that could not be followed."""
        sentences, one = list[str](), self.short_dwells == 1
        if self.short_dwells:
            sentences.append(
                f"{self.short_dwells} dwell{' is' if one else 's are'} too short to leave out {stillness.settle_s:g} s "
                f"after {'its' if one else 'each'} arrival (--settle-s): a third of {'it' if one else 'each'} was left "
                f"out, {'' if one else 'of the shortest '}{self.least_settling_s:.3g} s."
            )
        allowed_deg = math.degrees(stillness.allowed_rad(self.noise_rad))
        if allowed_deg > stillness.tolerance_deg:
            sentences.append(
                f"the angles scatter by {math.degrees(self.noise_rad):.2g} deg (one sigma) from one message to the "
                f"next, so that up to {allowed_deg:.2g} deg in half a second count as standing still, in place of "
                f"{stillness.tolerance_deg:g} (--still-deg)."
            )
        if self.turned_deg > _TURNING_DEG:
            sentences.append(
                f"the platform turns by {self.turned_deg:.3g} deg in what counts as standing still (--still-deg "
                f"{stillness.tolerance_deg:g}): where that is a slew, lower --still-deg."
            )
        return sentences


def within(values: Floats, largest: float) -> Mask | None:
    """Mask of the rows (m, k) whose values are all finite and at most ``largest``; None if all rows are."""
    size = np.abs(values)
    return None if size.max(initial=0.0) <= largest else np.asarray((size <= largest).all(axis=1))


class StampOrder:
    """Keeps the samples of a stream whose stamps increase, and counts the others."""

    def __init__(self) -> None:
        self.last_ns: int | None = None
        self._held_back = Stream.empty(0)
        self._ended = False

    def __call__(self, stream: Stream, counts: SampleCounts | None = None, first_ns: int | None = None) -> Stream:
        if self._held_back.time_ns.size:
            stream, self._held_back = self._held_back + stream, Stream.empty(0)
        if not len(stream):
            return stream
        begun = 1 if self.last_ns is None else stream.time_ns[0] - self.last_ns
        steps = np.diff(stream.time_ns)
        if min(begun, steps.min(initial=1)) > 0 and max(begun, steps.max(initial=1)) < LEAP_NS:
            self.last_ns = int(stream.time_ns[-1])
            return stream
        return self._one_by_one(stream, counts or SampleCounts(), first_ns)

    def _one_by_one(self, stream: Stream, counts: SampleCounts, first_ns: int | None) -> Stream:
        """Check the stamps one at a time, as needed where one is out of order or far ahead."""
        stamps: list[int] = stream.time_ns.tolist()
        keep = np.zeros(len(stamps), bool)
        for i, stamp in enumerate(stamps):
            if self.last_ns is not None and stamp <= self.last_ns:
                if stamp == self.last_ns:
                    counts.repeated += 1
                else:
                    counts.backward += 1
                    if counts.first_backward_s is None:
                        counts.first_backward_s = (self.last_ns - (first_ns or stamps[0])) / SECOND_NS
                continue
            if self.last_ns is not None and stamp - self.last_ns >= LEAP_NS:
                if i + 1 == len(stamps) and not self._ended:  # the next stamp tells a gap from damage
                    self._held_back = stream[i:]
                    break
                if i + 1 < len(stamps) and stamps[i + 1] < stamp:
                    counts.leaping += 1
                    continue
            keep[i] = True
            self.last_ns = stamp
        return stream[keep]

    def flush(self) -> Stream:
        """Return the samples that were held back at the end of the stream; they have to be passed through once more."""
        self._ended = True
        held, self._held_back = self._held_back, Stream.empty(0)
        return held


class DwellEvent(Enum):
    """What happens at a stamp: the platform leaves a dwell or arrives in one."""

    LEAVE = 0
    ARRIVE = 1


@dataclass
class OpenDwell:
    """The open dwell.

    - number: its number, counted from 1.
    - arrival_ns: its arrival according to the angles.
    - arrival_felt_ns: its arrival according to the readings, from which settling is counted.
    - first_pose_ns: stamp of the first pose message that belongs to it.
    - settling_ns: length of the margin left out after the arrival; None while it is not known whether the dwell is long
      enough for the whole margin.
    - pose (1, k): mean pose from the messages of its first block; pose_sigma_rad: its uncertainty.
    - turns: whole turns by which its poses go beyond the angles as recorded.
    """

    number: int
    arrival_ns: int
    arrival_felt_ns: int
    first_pose_ns: int
    settling_ns: int | None
    pose: Floats | None = None
    pose_sigma_rad: float = 0.0
    turns: tuple[int, ...] | None = None


def carry_on(slow: Stream, at_ns: Times) -> Floats:
    """A slowly varying quantity at ``at_ns`` (n,), extrapolated from its last two samples; NaN before the first sample.

    The line through the last two samples is followed for as long as they lie apart, and the value is held afterwards.
    This does not wait for the next sample, and avoids the delay of half a sampling period that holding the last value
    has.
    """
    if not len(slow):
        return np.full(len(at_ns), np.nan)
    counts = np.diff(np.searchsorted(at_ns, slow.time_ns), prepend=0, append=len(at_ns))  # before the first, after each
    begins_ns, levels = np.append(0, slow.time_ns), np.append(np.nan, slow.values[:, 0])
    steps_ns = np.append([1, 1], np.diff(slow.time_ns))
    rises = np.where(steps_ns > 0, np.append([0.0, 0.0], np.diff(slow.values[:, 0])), 0.0)
    begin_ns, level, step_ns, rise = (
        np.repeat(each, counts) for each in (begins_ns, levels, np.maximum(steps_ns, 1), rises)
    )
    return level + np.minimum((at_ns - begin_ns) / step_ns, 1.0) * rise
