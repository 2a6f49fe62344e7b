"""The order of stamps in a stream, and the arrivals and departures that delimit dwells."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from kf_calib.bench.arrays import Floats, Times
from kf_calib.bench.streams import Stream
from kf_calib.dwells.blocks import Tally

SECOND_NS = 1_000_000_000
_LEAP_NS = 10 * SECOND_NS  # a stamp this far ahead is damaged if the next one is earlier


class StampOrder:
    """Keeps the samples of a stream whose stamps increase, and counts the others."""

    def __init__(self) -> None:
        self.last_ns: int | None = None
        self._held_back = Stream.empty(0)
        self._ended = False

    def __call__(self, stream: Stream, tally: Tally | None = None, first_ns: int | None = None) -> Stream:
        if self._held_back.time_ns.size:
            stream, self._held_back = self._held_back + stream, Stream.empty(0)
        if not len(stream):
            return stream
        begun = 1 if self.last_ns is None else stream.time_ns[0] - self.last_ns
        steps = np.diff(stream.time_ns)
        if min(begun, steps.min(initial=1)) > 0 and max(begun, steps.max(initial=1)) < _LEAP_NS:
            self.last_ns = int(stream.time_ns[-1])
            return stream
        return self._one_by_one(stream, tally or Tally(), first_ns)

    def _one_by_one(self, stream: Stream, tally: Tally, first_ns: int | None) -> Stream:
        """Check the stamps one at a time, as needed where one is out of order or far ahead."""
        stamps: list[int] = stream.time_ns.tolist()
        keep = np.zeros(len(stamps), bool)
        for i, stamp in enumerate(stamps):
            if self.last_ns is not None and stamp <= self.last_ns:
                if stamp == self.last_ns:
                    tally.repeated += 1
                else:
                    tally.backward += 1
                    if tally.first_backward_s is None:
                        tally.first_backward_s = (self.last_ns - (first_ns or stamps[0])) / SECOND_NS
                continue
            if self.last_ns is not None and stamp - self.last_ns >= _LEAP_NS:
                if i + 1 == len(stamps) and not self._ended:  # the next stamp tells a gap from damage
                    self._held_back = stream[i:]
                    break
                if i + 1 < len(stamps) and stamps[i + 1] < stamp:
                    tally.leaping += 1
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
