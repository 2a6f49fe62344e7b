"""Detection of rest from the platform angles: when the platform is still, and when exactly it arrived and left.

Angles determine a motion only to within their sampling period, and a slew that begins and ends gently stays within any
tolerance for some time. The remaining motion is detected from the messages of the dwell itself and from the readings.
Noisy angles (``encoder_noise``) have more than the stated tolerance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import Floats, Mask, Times
from kf_calib.bench.bench import mean_pose, pose_distance
from kf_calib.bench.streams import SECOND_NS, Stream
from kf_calib.dwells.encoder_noise import distance_sigma, encoder_sigma
from kf_calib.dwells.limits import CURVE, FEWEST_COMPARED, SIGMAS
from kf_calib.errors import InputError, check_number

READING_WINDOW_NS = SECOND_NS // 4
"""Length of the windows of readings whose means show a motion."""
_CREEPING_NS = 10 * SECOND_NS  # creep that lasts longer than this is taken as permanent
_LARGEST_DEG = 5.0  # largest tolerance; at it, a platform turning at 10 deg/s would count as still
_PARTS = 8  # number of parts of a block whose mean poses are compared

HISTORY = CURVE + 2
"""Number of messages before those of ``Stillness.history_ns`` that are needed if messages are infrequent."""


@dataclass(frozen=True)
class Stillness:
    """The tolerance and window by which intervals are judged, and the margins left out after an arrival and before a
    departure."""

    tolerance_deg: float = 0.05
    window_s: float = 0.5
    settle_s: float = 1.0
    lead_s: float = 0.25

    def __post_init__(self) -> None:
        check_number("tolerance_deg (--still-deg)", self.tolerance_deg, above=True)
        if self.tolerance_deg > _LARGEST_DEG:
            raise InputError(
                f"a platform that turns by {self.tolerance_deg:g} deg in half a second does not stand still: give "
                f"--still-deg (tolerance_deg) above 0 and up to {_LARGEST_DEG:g}."
            )
        check_number("window_s", self.window_s, above=True)
        check_number("settle_s (--settle-s)", self.settle_s)
        check_number("lead_s", self.lead_s)

    @property
    def tolerance_rad(self) -> float:
        """The tolerance in rad."""
        return math.radians(self.tolerance_deg)

    @property
    def rest_rad(self) -> float:
        """A fiftieth of the tolerance, within which the platform counts as fully at rest."""
        return self.tolerance_rad / 50.0

    @property
    def window_ns(self) -> int:
        """The window in ns."""
        return round(self.window_s * SECOND_NS)

    @property
    def settle_ns(self) -> int:
        """The margin after an arrival in ns."""
        return round(self.settle_s * SECOND_NS)

    @property
    def lead_ns(self) -> int:
        """The margin before a departure in ns."""
        return round(self.lead_s * SECOND_NS)

    @property
    def _compared_ns(self) -> int:
        """Time before a message over which others tell the pose that it is compared with, ns: four windows."""
        return FEWEST_COMPARED * self.window_ns

    @property
    def history_ns(self) -> int:
        """Time before an interval from which on messages are needed to judge it, ns."""
        return _CREEPING_NS + self._compared_ns + 2 * self.window_ns

    def is_dwell(self, length_ns: int) -> bool:
        """Whether a rest that readings alone show is long enough for a dwell: as the messages that tell a pose."""
        return length_ns >= self._compared_ns

    def allowed_rad(self, noise_rad: Floats | float) -> Floats:
        """Largest distance, rad, of two messages of a platform at rest, whose noise is ``noise_rad``: the tolerance, or
        what two may be apart of which each is as far off as chance allows."""
        largest = max(self.tolerance_rad, math.radians(_LARGEST_DEG))
        return np.clip(2.0 * SIGMAS * np.asarray(noise_rad), self.tolerance_rad, largest)

    def intervals(
        self, times: Times, poses: Floats, is_quaternion: bool, complete: Mask, covered_ns: int, noise_rad: Floats
    ) -> tuple[Mask, int]:
        """Mask (m - 1,) of the intervals between consecutive messages that are still, and the end of the last still
        window.

        An interval is still if it lies in a window in which neither a step nor the difference between the ends exceeds
        what is allowed (``allowed_rad``).

        - complete (m,): whether the window that begins with each message is complete.
        - covered_ns: end of the last window that was judged as still before.
        - noise_rad (m,): noise of the messages.
        """
        allowed = self.allowed_rad(noise_rad)
        ends = np.minimum(np.searchsorted(times, times + self.window_ns), len(times) - 1)
        steps = pose_distance(poses[1:], poses[:-1], is_quaternion) <= allowed[:-1]
        broken = np.concatenate([[0], np.cumsum(~steps)])
        rest = pose_distance(poses[ends], poses, is_quaternion) <= allowed
        rest &= (broken[ends] == broken) & complete & (ends > np.arange(len(ends)))
        reach = np.maximum.accumulate(np.where(rest, times[ends], covered_ns))
        return (reach[:-1] > times[:-1]) & steps, int(reach[-1])

    def departure_ns(self, pose: Stream, is_quaternion: bool, arrived_ns: int, end_ns: int) -> int:
        """Stamp, ns, at which the platform began to leave a dwell that lasts from ``arrived_ns`` to ``end_ns``.

        Because the angles are sampled, it may have left up to one sampling period earlier than they show.
        """
        leaving = self.creeping_from(pose, is_quaternion, arrived_ns, end_ns)
        if leaving is None:
            return end_ns
        early_ns, standing_ns = pose.time_ns[max(leaving - 2, 0)], pose.time_ns[max(leaving - 1, 0)]
        period_ns = min(int(standing_ns - early_ns), self._compared_ns)
        return max(int(standing_ns) - max(period_ns - self.lead_ns, 0), arrived_ns)

    def creeping_from(self, pose: Stream, is_quaternion: bool, arrived_ns: int, until_ns: int) -> int | None:
        """Index of the message from which on the platform has been creeping until ``until_ns``, in a dwell since
        ``arrived_ns``.

        None if the platform is at rest, or if it has been creeping for so long that this is taken as permanent.
        """
        arrived, last = np.searchsorted(pose.time_ns, (arrived_ns, until_ns + 1)).tolist()
        begin = last
        for span_ns in (self.window_ns, _CREEPING_NS + self.window_ns):  # the short span suffices most of the time
            first_judged = max(int(np.searchsorted(pose.time_ns, until_ns - span_ns)), arrived)
            first = int(np.searchsorted(pose.time_ns, until_ns - span_ns - self._compared_ns))
            first = max(min(first, first_judged - HISTORY), arrived)
            if last - first_judged < 1 or last - first < HISTORY:
                return None
            away = self._deviates(pose[first:last], is_quaternion)
            deviating = first_judged + np.flatnonzero(away[first_judged - first :])
            lasts_ns = int(pose.time_ns[last - 1] - pose.time_ns[first])
            step = max(1, round(self.window_ns * (last - 1 - first) / lasts_ns))
            if not deviating.size or last - 1 - deviating[-1] > step:
                return None
            breaks = np.flatnonzero(np.diff(deviating) > step)
            begin = int(deviating[breaks[-1] + 1 if breaks.size else 0])
        return begin if pose.time_ns[last - 1] - pose.time_ns[begin] <= _CREEPING_NS else None

    def _deviates(self, pose: Stream, is_quaternion: bool) -> Mask:
        """Return a mask (m,) of the messages that show the platform away from rest.

        A message is compared with the mean of those one to four windows before it, and is away if it differs by more
        than ``rest_rad`` and four sigma of the encoder. If messages are infrequent, the few before it are used. The
        first messages are not judged.
        """
        times, relative = pose.time_ns, pose.values - pose.values[0]
        ends = np.minimum(np.searchsorted(times, times - self.window_ns), np.maximum(np.arange(len(times)) - 1, 0))
        starts = np.minimum(np.searchsorted(times, times - self._compared_ns), np.maximum(ends - CURVE, 0))
        sums, counts = _cumulative_sums(relative), (ends - starts)[:, None]
        means = (sums[ends] - sums[starts]) / np.maximum(counts, 1)
        curvature, seen = _cumulative_sums(np.diff(relative, 2, axis=0) ** 2), np.maximum(ends - starts - 2, 0)
        variance = (curvature[starts + seen] - curvature[starts]) / (6.0 * np.maximum(seen, 1))[:, None]
        sigma = distance_sigma(np.sqrt(np.maximum(variance, 0.0)), is_quaternion)
        allowed = np.maximum(self.rest_rad, 4.0 * sigma)
        distance = pose_distance(pose.values, means + pose.values[0], is_quaternion)
        return (distance > allowed) & (seen > 0)

    def rest_ns(self, pose: Stream, is_quaternion: bool, arrived_ns: int, until_ns: int) -> tuple[int, bool]:
        """Stamp, ns, at which the platform came to rest in a dwell since ``arrived_ns``, and whether this is certain by
        ``until_ns``.

        A message shows the platform at rest if it agrees with the mean of the messages in the following two settling
        margins, to within ``rest_rad`` or four sigma of the encoder. A dwell that creeps throughout is used from its
        arrival, and so is one whose messages are farther apart than these margins.
        """
        first, last = np.searchsorted(pose.time_ns, (arrived_ns, until_ns)).tolist()
        times, poses, span_ns = pose.time_ns[first:last], pose.values[first:last], 2 * self.settle_ns
        for k, end_index in enumerate(np.searchsorted(times, times + span_ns, side="right").tolist()):
            if times[k] > arrived_ns + _CREEPING_NS:
                break
            at_ns, end = int(times[k]) if k else arrived_ns, max(end_index, k + 1 + CURVE)
            if times[k] + span_ns > until_ns or end > len(times):
                return at_ns, False
            following = poses[k + 1 : end]
            sigma = distance_sigma(encoder_sigma(following), is_quaternion)
            allowed = max(self.rest_rad, 4.0 * float(sigma))
            distance = pose_distance(poses[k], mean_pose(following), is_quaternion)
            if distance <= allowed or np.diff(times[k:end]).max() > span_ns:
                return at_ns, True
        return arrived_ns, True

    def creeps(self, poses: Floats, is_quaternion: bool) -> bool:
        """Tell whether the messages (n, k) of a block vary by more than noise about one pose, from the means of its
        parts."""
        poses = 2.0 * poses if is_quaternion else poses  # the angle of a rotation is twice that in its quaternion
        count, spread = len(poses), np.ptp(poses, axis=0).max()
        if count < 2 or spread <= self.rest_rad:
            return False
        if spread > max(self.tolerance_rad, 8.0 * float(encoder_sigma(poses).max())):
            return True
        parts = np.array_split(poses, min(_PARTS, count))
        means = np.array([part.mean(axis=0) for part in parts])
        sigma = np.sqrt(np.mean(np.diff(poses, axis=0) ** 2, axis=0) / 2.0 * len(parts) / count)
        deviation = np.abs(means - np.median(means, axis=0))
        return bool((deviation > np.maximum(self.rest_rad, 8.0 * sigma)).any())

    def moved_between(self, accel: Stream, begin_ns: int, end_ns: int, gravity_mps2: float) -> tuple[int, int]:
        """Stamps, ns, of the beginning and the end of a motion without angles, from the readings between two poses.

        The readings are averaged over windows of a quarter of a second. The old dwell ends where the averages leave its
        level, and the new one begins where they reach their final level, first to a coarse limit and then to three
        sigma.
        """
        part = slice(*np.searchsorted(accel.time_ns, (begin_ns, end_ns)))
        times, values = accel.time_ns[part], accel.values[part]
        size = max(FEWEST_COMPARED, int(np.searchsorted(times, begin_ns + READING_WINDOW_NS)))
        count = len(times) // size
        if count < FEWEST_COMPARED:
            return begin_ns, end_ns
        shaped = values[: count * size].reshape(count, size, 3)
        means, scatter = shaped.mean(axis=1), np.median(shaped.std(axis=1), axis=0)
        coarse = SIGMAS * scatter + 1e-3 * gravity_mps2
        fine = 3.0 * scatter / math.sqrt(size) + self.rest_rad * gravity_mps2
        both_ways = means, means[::-1]
        count_before, count_after = (_windows_at_first_level(each, coarse, fine) for each in both_ways)
        leave = begin_ns if count_before < 2 else int(times[(count_before - 1) * size])
        arrive = end_ns if count_after < 2 else int(times[(count - count_after + 1) * size])
        return leave, max(arrive, leave)

    def arrival_felt_ns(self, accel: Stream, since_ns: int, arrival_ns: int, gravity_mps2: float) -> int:
        """Stamp, ns, at which the readings reached the level that they have just after an arrival.

        Only readings since ``since_ns``, the last angle before the arrival, are considered. The level is the mean over
        half a window, which begins a quarter of a window after the arrival.
        """
        quarter_ns = self.window_ns // 4
        stamps = since_ns, arrival_ns + quarter_ns, arrival_ns + 3 * quarter_ns
        first, settled_from, end = np.searchsorted(accel.time_ns, stamps)
        if settled_from == end:
            return arrival_ns
        settled = accel.values[settled_from:end]
        allowed = SIGMAS * float(settled.std(axis=0).max()) + self.rest_rad * gravity_mps2
        deviation = np.abs(accel.values[first:settled_from] - settled.mean(axis=0)).max(axis=1, initial=0.0)
        unsettled = np.flatnonzero(deviation > allowed)
        if not unsettled.size:
            return arrival_ns
        moving_ns, standing_ns = accel.time_ns[first + unsettled[-1] :][:2].tolist()
        return (moving_ns + standing_ns) // 2


def _cumulative_sums(values: Floats) -> Floats:
    """Return the cumulative sums (n + 1, k) of values (n, k), beginning with zero."""
    return np.cumsum(np.concatenate([np.zeros((1, values.shape[1])), values]), axis=0)


def _windows_at_first_level(means: Floats, coarse: Floats, fine: Floats) -> int:
    """Return the number of windows, from the first on, in which the mean readings (n, 3) show the platform at its first
    position.

    It is 0 if they never leave that level and therefore cannot tell.
    """
    at_first_level = np.all(np.abs(means - means[0]) <= coarse, axis=1)
    if at_first_level.all():
        return 0
    first_means = means[: int(np.argmin(at_first_level))]
    still = np.flatnonzero(np.all(np.abs(first_means - np.median(first_means, axis=0)) <= fine, axis=1))
    return int(still[-1]) + 1 if still.size else 0
