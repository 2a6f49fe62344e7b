"""The order of stamps, and what the platform angles tell of a dwell: arrival, departure."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from kf_calib.bench.arrays import Floats, Times
from kf_calib.bench.streams import Stream
from kf_calib.dwells.blocks import Tally

SECOND_NS = 1_000_000_000
_LEAP_NS = 10 * SECOND_NS  # a stamp this far ahead, with the next one behind it, is a damaged stamp


class StampOrder:
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
                        tally.first_backward_s = (self.last_ns - (first_ns or stamps[0])) / SECOND_NS
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


class DwellEvent(Enum):
    LEAVE = 0
    ARRIVE = 1


@dataclass
class OpenDwell:
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


def carry_on(slow: Stream, at_ns: Times) -> Floats:
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
