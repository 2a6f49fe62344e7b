"""What a run needs next: an orientation and how long to stay there, or the end, from what is known of it so far.

A run begins with an opening: orientations that are spread, so that the model can be judged. How long it stays in each
is its share of the targets. From then on it goes where the sigmas fall most per second; while the model is rejected,
where the explanations differ most, or where a repetition tells noise from an effect. It ends when all targets are
reached, with a return to its first orientation (drift), or when a missing effect is named beyond doubt.

The last dwell closes, and is judged, while the platform moves on: a suggestion counts on what the stays that are not
judged yet will bring to the sigmas, and takes no verdict from them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench
from kf_calib.design.gimbal_limits import PEAK_OVER_MEAN, GimbalLimits, Timing, can_be_reached, order, wrap
from kf_calib.design.next_orientation import Outlook, SlewTimes, poses_within
from kf_calib.errors import InputError
from kf_calib.estimation.cross_validation import SAME_POSE_DEG
from kf_calib.online.status import Judgement
from kf_calib.support.text import listing

Purpose = Literal["opening", "sharpen", "tell apart", "repeat", "return", "end"]
Ended = Literal["", "targets", "named", "disagrees", "orientations", "budget"]

_FIRST_S = 8.0  # of readings in the first stays, before the noise is known
_UNREACHABLE = 1e-12  # target of each sigma, in rad, 1 and g, where none is set: there is always more to gain
_BEYOND = 12  # orientations at most, after all targets are reached, to find out what is missing


@dataclass(frozen=True)
class Itinerary:
    """How a run is to be driven.

    bench: with its limits. slew_times: of its gimbals. opening: number of orientations to begin with. most: number of
    orientations after which the run ends in any case. stay_s: of readings in each orientation where no target is set;
    longest_s: at most. ends_when_named: end when the missing effect is named, else go on to the targets.
    """

    bench: Bench
    slew_times: SlewTimes = field(default_factory=SlewTimes)
    opening: int = 12
    most: int = 60
    stay_s: float = 30.0
    longest_s: float = 96.0
    ends_when_named: bool = True

    @cached_property
    def limits(self) -> GimbalLimits:
        """What the bench can take, by its description."""
        return GimbalLimits.of(self.bench)

    def getting_there_s(self, here: Floats, pose: Floats) -> float:
        """What going from one pose (k,) to another, rad, takes beside the readings that count, s.

        A stay that is to tell effects apart lasts no less: where white noise is left, half of the time is then used.
        """
        return float(self.slew_times.slews_s(here, pose)) + self.slew_times.overhead_s

    @cached_property
    def opening_poses(self) -> Floats:
        """The orientations (n, k) to begin with, rad, in the order of short slews.

        Each has the direction of gravity that is farthest from those before it, and all gimbals turn: what depends on
        angles that do not move gravity shows, too. Raises InputError where the limits leave none.
        """
        poses = poses_within(self.limits)
        if not len(poses):
            raise InputError("no orientation is within the limits and outside the forbidden zones: widen them.")
        force = self.bench.specific_force(np.zeros(len(poses)), poses)
        up, chosen = force / np.linalg.norm(force, axis=1, keepdims=True), [0]
        nearest = np.arccos(np.clip(up @ up[0], -1.0, 1.0))
        while len(chosen) < min(self.opening, len(poses)):
            chosen.append(int(np.argmax(nearest)))
            nearest = np.minimum(nearest, np.arccos(np.clip(up @ up[chosen[-1]], -1.0, 1.0)))
        timing = Timing(self.stay_s, PEAK_OVER_MEAN * self.slew_times.rate_degps, 0.3)
        in_order = order(poses[chosen], force[chosen], timing, self.limits, np.zeros(poses.shape[1]))
        return poses[chosen][in_order]


@dataclass(frozen=True)
class Suggestion:
    """Where to go next, and why.

    gimbal_deg: empty where the run is to end. stay_s: for how long, of readings that count. sigma (12,): expected
    after it; NaN where it is not known. ended: why the run is to end.
    """

    purpose: Purpose
    why: str
    gimbal_deg: tuple[float, ...] = ()
    stay_s: float = 0.0
    sigma: Floats = field(default_factory=lambda: np.full(12, np.nan))
    ended: Ended = ""


@dataclass(frozen=True)
class Visited:
    """The dwells of a run: their poses (k,), rad, and seconds of readings; the first ``judged`` of them are judged."""

    stays: Sequence[tuple[Floats, float]]
    judged: int

    def has(self, pose: Floats) -> bool:
        """Whether the platform has been there."""
        return any(_same(pose, other) for other, _ in self.stays)

    @property
    def pending(self) -> Sequence[tuple[Floats, float]]:
        """The dwells that are not judged yet."""
        return self.stays[self.judged :]


def suggest(itinerary: Itinerary, visited: Visited, judgement: Judgement | None) -> Suggestion:
    """What comes after the dwells so far, the last of which is the open one.

    judgement: the latest (None: there is none yet).
    """
    outlook = None if judgement is None else _outlook(itinerary, visited, judgement)
    is_reached = outlook is not None and judgement is not None and judgement.reached(outlook.sigma)
    if judgement is not None and (end := _end(itinerary, visited, judgement, is_reached)) is not None:
        return end
    left = [pose for pose in itinerary.opening_poses if not visited.has(pose)]
    if left:
        return _opening(itinerary, np.array(left), outlook, judgement)
    if outlook is None or judgement is None:
        return Suggestion("end", "nothing could be judged of the run so far", ended="disagrees")
    if judgement.alarm:
        return _telling_apart(itinerary, visited, judgement, outlook)
    if is_reached:
        first = tuple(np.degrees(visited.stays[0][0]).tolist())
        stay_s = max(visited.stays[0][1], STAY_LEAST_S)
        return Suggestion("return", "back to the first orientation: what has changed since is drift", first, stay_s)
    return _sharpening(itinerary, outlook, judgement)


STAY_LEAST_S = 2.0
"""Shortest stay, s of readings."""


def _outlook(itinerary: Itinerary, visited: Visited, judgement: Judgement) -> Outlook:
    wanted = np.where(np.isfinite(judgement.wanted), judgement.aims, np.inf)
    if not np.isfinite(judgement.wanted).any():
        gravity = judgement.result.bench.gravity_mps2
        wanted = _UNREACHABLE * np.array([gravity if u == "m/s^2" else 1.0 for u in paper_parameters.UNITS])
    return Outlook(
        judgement.result.fit, wanted, visited.pending or visited.stays[-1:], itinerary.limits, itinerary.slew_times
    )


def _end(itinerary: Itinerary, visited: Visited, judgement: Judgement, is_reached: bool) -> Suggestion | None:
    """Return the end of the run where it has come."""
    count = len(visited.stays)
    is_settled = judgement.alarm and judgement.snapshot.settled and judgement.diagnosis.sure
    if is_settled and itinerary.ends_when_named:
        named = listing(judgement.diagnosis.missing)
        return Suggestion("end", f"the missing effect is named: {named}", ended="named")
    is_back = _same(visited.stays[0][0], visited.stays[-1][0])
    if is_reached and not judgement.alarm and count > itinerary.opening and is_back:
        return Suggestion("end", "every target is reached, and the model agrees", ended="targets")
    if count >= itinerary.most:
        return Suggestion("end", f"{count} orientations were visited, as many as allowed", ended="orientations")
    if is_reached and judgement.alarm and count >= itinerary.opening + _BEYOND:
        why = "every target is reached; the model disagrees, and further orientations did not tell what is missing"
        return Suggestion("end", why, ended="disagrees")
    return None


def _opening(itinerary: Itinerary, left: Floats, outlook: Outlook | None, judgement: Judgement | None) -> Suggestion:
    """Return the next orientation of the opening, with its share of the targets."""
    stay_s = _FIRST_S
    has_targets = judgement is not None and bool(np.isfinite(judgement.wanted).any())
    if not has_targets and judgement is not None:
        stay_s = itinerary.stay_s
    elif outlook is not None and judgement is not None and np.isfinite(judgement.result.noise.sigma_mps2).all():
        stay_s = outlook.share_s(left)
    here = None if outlook is None else outlook.pending[-1][0]
    free = left if here is None else left[can_be_reached(itinerary.limits, here, left)]
    pose = free[0] if len(free) else left[0]
    why = f"{len(left)} more to begin with: spread over the sphere, so that the model can be judged"
    return Suggestion("opening", why, _in_deg(pose), min(stay_s, itinerary.longest_s))


def _telling_apart(itinerary: Itinerary, visited: Visited, judgement: Judgement, outlook: Outlook) -> Suggestion:
    """Return the orientation that tells the explanations apart; a repetition where noise is one of them."""
    diagnosis, usual_s = judgement.diagnosis, float(np.median([seconds for _, seconds in visited.stays]))
    here, pending = visited.stays[-1][0], visited.pending
    again = _to_repeat(visited, judgement) if diagnosis.noise or diagnosis.as_scatter else None
    if again is not None and can_be_reached(itinerary.limits, here, again[None])[0]:
        why = "again where the model disagrees most: noise will not repeat, an effect will"
        return Suggestion("repeat", why, _in_deg(again), max(usual_s, itinerary.getting_there_s(here, again)))
    if judgement.advice is not None:
        advice, why = judgement.advice
        pose = np.radians(advice.gimbal_deg)
        is_new = not any(_same(pose, other) for other, _ in pending)
        if is_new and can_be_reached(itinerary.limits, here, pose[None])[0]:
            stay_s = max(usual_s, itinerary.getting_there_s(here, pose), advice.stay_s or 0.0)
            return Suggestion("tell apart", why, _in_deg(pose), min(stay_s, itinerary.longest_s))
    further = _sharpening(itinerary, outlook, judgement)
    if not further.gimbal_deg:
        return further
    stay_s = max(further.stay_s, usual_s, itinerary.getting_there_s(here, np.radians(further.gimbal_deg)))
    return replace(further, purpose="tell apart", stay_s=min(stay_s, itinerary.longest_s))


def _to_repeat(visited: Visited, judgement: Judgement) -> Floats | None:
    """Return the pose of the judged dwell that disagrees most, where it was visited once and is not the present."""
    poses = [visit.dwell.recorded_pose for visit in judgement.diagnosis.before.visits]
    number = judgement.disagreeing[0] - 1
    pose = poses[min(number, len(poses) - 1)]
    times = sum(_same(pose, other) for other, _ in visited.stays)
    return pose if times == 1 and not _same(pose, visited.stays[-1][0]) else None


def _sharpening(itinerary: Itinerary, outlook: Outlook, judgement: Judgement) -> Suggestion:
    """Return the stay with the largest gain per second."""
    has_targets = bool(np.isfinite(judgement.wanted).any())
    stay = outlook.best() if has_targets else outlook.best([itinerary.stay_s])
    if stay is None:
        return Suggestion("end", "no other orientation can be reached within the limits", ended="orientations")
    worst = int(np.argmax(np.where(np.isfinite(outlook.wanted), outlook.sigma / outlook.wanted, 0.0)))
    name, factor = paper_parameters.SYMBOLS[worst], stay.sigma[worst] / outlook.sigma[worst]
    why = f"the most per second: lowers sigma of {name} to {factor:.2f} of its value in {stay.seconds:.0f} s"
    return Suggestion("sharpen", why, _in_deg(stay.pose), min(stay.stay_s, itinerary.longest_s), stay.sigma)


def _same(one: Floats, other: Floats) -> bool:
    return bool(np.abs(wrap(one - other)).max() < np.radians(SAME_POSE_DEG))


def _in_deg(pose: Floats) -> tuple[float, ...]:
    return tuple((np.degrees(pose).round(4) + 0.0).tolist())
