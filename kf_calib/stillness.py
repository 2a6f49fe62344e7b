"""When the platform counts as still, and when exactly it came to rest and left: from its angles, and from the readings.

Angles tell of a motion to their period only, and a slew that begins and ends gently is within any tolerance for some
time: what is left over is looked for in the messages of the dwell itself, and in the readings.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kf_calib.bench import mean_pose, pose_distance
from kf_calib.samples import Floats, Mask, Stream, Times

_SECOND_NS = 1_000_000_000
_LAST, _BEFORE = 3, 4  # messages at the end of a dwell that may have crept away, and before them: at least
_CREEPING_NS = 15 * _SECOND_NS  # from when on a platform that still creeps is taken as one that goes on so
_PARTS = 8  # of a block, whose mean poses are compared

HISTORY = _LAST + _BEFORE
"""Messages before the last ones judged that a departure may be held against."""


@dataclass(frozen=True)
class Stillness:
    """Tolerance and window by which intervals are judged, margins that are left out after an arrival and before a
    departure."""

    tolerance_deg: float = 0.05
    window_s: float = 0.5
    settle_s: float = 1.0
    lead_s: float = 0.25

    @property
    def tolerance_rad(self) -> float:
        return math.radians(self.tolerance_deg)

    @property
    def rest_rad(self) -> float:
        """Within which a platform is at rest, as far as a good encoder can tell: a fiftieth of the tolerance."""
        return self.tolerance_rad / 50.0

    @property
    def window_ns(self) -> int:
        return round(self.window_s * _SECOND_NS)

    @property
    def settle_ns(self) -> int:
        return round(self.settle_s * _SECOND_NS)

    @property
    def lead_ns(self) -> int:
        return round(self.lead_s * _SECOND_NS)

    def intervals(
        self, times: Times, poses: Floats, is_quaternion: bool, known: Mask, covered_ns: int
    ) -> tuple[Mask, int]:
        """Which intervals between consecutive messages are still, (m - 1,) bool, and how far a still window reaches.

        Still is what lies in a window over which no step and no difference of ends exceeds the tolerance. known (m,):
        the window that begins with a message is over; covered_ns: how far one judged earlier reaches.
        """
        ends = np.minimum(np.searchsorted(times, times + self.window_ns), len(times) - 1)
        steps = pose_distance(poses[1:], poses[:-1], is_quaternion) <= self.tolerance_rad
        broken = np.concatenate([[0], np.cumsum(~steps)])
        rest = pose_distance(poses[ends], poses, is_quaternion) <= self.tolerance_rad
        rest &= (broken[ends] == broken) & known & (ends > np.arange(len(ends)))
        reach = np.maximum.accumulate(np.where(rest, times[ends], covered_ns))
        return (reach[:-1] > times[:-1]) & steps, int(reach[-1])

    def departure_ns(self, pose: Stream, is_quaternion: bool, arrived_ns: int, end_ns: int) -> int:
        """When, in the last window of a dwell from ``arrived_ns`` to ``end_ns``, the platform began to creep away.

        The last messages are held against the mean of the two windows before them, to ``rest_rad`` or four sigma of
        the encoder. Where messages are seldom, a few count and not a window.
        """
        times, poses, window_ns = pose.time_ns, pose.values, self.window_ns
        first, middle, last = np.searchsorted(times, (end_ns - 3 * window_ns, end_ns - window_ns, end_ns + 1)).tolist()
        middle = min(middle, max(last - _LAST, 0))
        first = max(min(first, middle - _BEFORE), int(np.searchsorted(times, arrived_ns)))
        if middle - first < 2 or last <= middle:
            return end_ns
        away = np.flatnonzero(~self._alike(poses[middle:last], poses[first:middle], is_quaternion))
        if not away.size:
            return end_ns
        standing_ns, moving_ns = times[max(middle + away[0] - 1, first) :][:2].tolist()
        # it may have left, by what angles cannot tell, as long before as messages lie apart
        return max(standing_ns - max(moving_ns - standing_ns - self.lead_ns, 0), arrived_ns)

    def rest_ns(self, pose: Stream, is_quaternion: bool, arrived_ns: int, until_ns: int) -> int:
        """When, in a dwell from ``arrived_ns`` on that is known until ``until_ns``, the platform had come to rest.

        A message is of a platform at rest where it agrees with the mean of those of the next two margins for settling,
        to ``rest_rad`` or four sigma of them; the last two margins cannot be judged. A dwell that creeps all along is
        used from its arrival.
        """
        first, last = np.searchsorted(pose.time_ns, (arrived_ns, until_ns)).tolist()
        times, poses = pose.time_ns[first:last], pose.values[first:last]
        for k, end in enumerate(np.searchsorted(times, times + 2 * self.settle_ns, side="right").tolist()):
            if end == k + 1 or times[k] > arrived_ns + _CREEPING_NS:
                break
            judged = times[k] + 2 * self.settle_ns <= until_ns
            if not judged or self._alike(poses[k : k + 1], poses[k + 1 : end], is_quaternion)[0]:
                return int(times[k]) if k else arrived_ns
        return arrived_ns

    def _alike(self, poses: Floats, resting: Floats, is_quaternion: bool) -> Mask:
        """Which poses (m, k) are the mean of those (n, k) of a platform at rest."""
        allowed = max(self.rest_rad, 4.0 * float(resting.std(axis=0).max()))
        return pose_distance(poses, mean_pose(resting), is_quaternion) <= allowed

    def creeps(self, poses: Floats) -> bool:
        """Whether the messages (n, k) of a block tell of more than noise about one pose: by the means of its parts."""
        count, spread = len(poses), np.ptp(poses, axis=0).max()
        if count < 2 or spread <= self.rest_rad:
            return False
        if spread > self.tolerance_rad:
            return True
        parts = np.array_split(poses, min(_PARTS, count))
        means = np.array([part.mean(axis=0) for part in parts])
        sigma = np.sqrt(np.mean(np.diff(poses, axis=0) ** 2, axis=0) / 2.0 * len(parts) / count)
        apart = np.abs(means - np.median(means, axis=0))
        return bool((apart > np.maximum(self.rest_rad, 5.0 * sigma)).any())

    def moved_between(self, accel: Stream, begin_ns: int, end_ns: int, gravity_mps2: float) -> tuple[int, int]:
        """When a motion without angles began and ended, from the readings between two poses.

        The readings are averaged over windows of a quarter of a second. The old dwell lasts while they stay at its
        level, the new one reaches back as far as they are at the level they end on; then as far as they are there to
        three sigma.
        """
        part = slice(*np.searchsorted(accel.time_ns, (begin_ns, end_ns)))
        times, values = accel.time_ns[part], accel.values[part]
        size = max(4, int(np.searchsorted(times, begin_ns + _SECOND_NS // 4)))
        count = len(times) // size
        if count < 4:
            return begin_ns, end_ns
        shaped = values[: count * size].reshape(count, size, 3)
        means, scatter = shaped.mean(axis=1), np.median(shaped.std(axis=1), axis=0)
        coarse = 6.0 * scatter + 1e-3 * gravity_mps2
        fine = 3.0 * scatter / math.sqrt(size) + self.rest_rad * gravity_mps2
        old, new = _standing(means, coarse, fine), _standing(means[::-1], coarse, fine)
        leave = begin_ns if old < 2 else int(times[(old - 1) * size])
        arrive = end_ns if new < 2 else int(times[(count - new + 1) * size])
        return leave, max(arrive, leave)

    def felt_ns(self, accel: Stream, since_ns: int, arrival_ns: int, gravity_mps2: float) -> int:
        """When, since the last angle before an arrival, the readings came to the level they have just after it.

        That level is of half a window, which begins a quarter of it after the arrival and is over before this is
        judged.
        """
        quarter_ns = self.window_ns // 4
        stamps = since_ns, arrival_ns + quarter_ns, arrival_ns + 3 * quarter_ns
        first, there, end = np.searchsorted(accel.time_ns, stamps)
        if there == end:
            return arrival_ns
        settled = accel.values[there:end]
        allowed = 6.0 * float(settled.std(axis=0).max()) + self.rest_rad * gravity_mps2
        apart = np.abs(accel.values[first:there] - settled.mean(axis=0)).max(axis=1, initial=0.0)
        away = np.flatnonzero(apart > allowed)
        if not away.size:
            return arrival_ns
        moving_ns, standing_ns = accel.time_ns[first + away[-1] :][:2].tolist()
        return (moving_ns + standing_ns) // 2


def _standing(means: Floats, coarse: Floats, fine: Floats) -> int:
    """In how many windows, from the first on, the means (n, 3) of readings say that the platform stood where it did;
    none where they never leave that level, and cannot tell."""
    near = np.all(np.abs(means - means[0]) <= coarse, axis=1)
    if near.all():
        return 0
    own = means[: int(np.argmin(near))]
    still = np.flatnonzero(np.all(np.abs(own - np.median(own, axis=0)) <= fine, axis=1))
    return int(still[-1]) + 1 if still.size else 0
