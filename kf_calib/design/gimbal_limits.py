"""The orientations that a bench can take: limits of its gimbals, forbidden zones, and a grid or a list of positions.

Angles are between -180 and 180 deg, and a gimbal moves from one to the next without crossing 180 deg, as a simulated
bench does. ``poses`` are (n, k), rad.

Ways of the gimbals from one orientation to another that enter no forbidden zone, whatever the gimbals' rates are.

Gimbals that are told to go begin together and end when each is there: on the way the platform may be anywhere in the
box of angles between the two orientations. A way is free if that whole box, with a margin for overshoot, is. Where it
is not, the gimbals may go one after the other.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from kf_calib.bench.arrays import Floats, Mask
from kf_calib.bench.bench import Bench, axis_names
from kf_calib.bench.keys import Range, limits_of, zones_of
from kf_calib.errors import InputError

_POSES = 4096


@dataclass(frozen=True)
class Reach:
    """The limits of a bench.

    - limits_deg: range of each limited gimbal, by its number from 0.
    - zones_deg: forbidden boxes, each given by ranges of some gimbals.
    - grid_deg: angles have to be multiples of it; positions_deg: the possible poses. If both are None, any angle is
      possible.
    """

    bench: Bench
    limits_deg: Mapping[int, Range] = field(default_factory=dict[int, Range])
    zones_deg: Sequence[Mapping[int, Range]] = ()
    grid_deg: float | None = None
    positions_deg: Sequence[Sequence[float]] | None = None

    @classmethod
    def of(cls, bench: Bench) -> Reach:
        """The limits that the description of the bench states."""
        names = axis_names(bench.axes)
        return cls(bench, limits_of(bench.limits_deg, names), zones_of(bench.forbidden_deg, names))

    @property
    def continuous(self) -> bool:
        """Whether angles are not restricted to a grid or a list."""
        return self.grid_deg is None and self.positions_deg is None

    @property
    def free(self) -> bool:
        """Whether there is no restriction other than the axes."""
        return self.continuous and not self.limits_deg and not self.zones_deg

    @cached_property
    def bounds(self) -> Floats:
        """Lowest and highest angle (k, 2) of each gimbal, rad."""
        return np.radians([self.limits_deg.get(j, (-180.0, 180.0)) for j in range(len(self.bench.axes))])

    @cached_property
    def candidates(self) -> Floats:
        """Allowed poses (n, k) to choose from, the least rotated first; raises InputError if there are none."""
        if self.positions_deg is not None:
            poses = np.radians(np.asarray(self.positions_deg, float))
        else:
            axis_angles = [self._values(j) for j in range(len(self.bench.axes))]
            total = math.prod(map(len, axis_angles))
            if total > 200_000:
                raise InputError(f"a grid of {self.grid_deg:g} deg has {total} orientations: take a coarser one.")
            poses = np.stack(np.meshgrid(*axis_angles, indexing="ij"), axis=-1).reshape(-1, len(axis_angles))
        poses = poses[self.allowed(poses)]
        if not len(poses):
            raise InputError("no orientation is left within the limits and outside the forbidden zones: widen them.")
        return poses[np.argsort(np.abs(poses).sum(axis=1).round(9), kind="stable")]

    def _values(self, j: int) -> Floats:
        """Return the candidate angles of one gimbal, rad."""
        low, high = self.bounds[j]
        if self.grid_deg is not None:
            step = math.radians(self.grid_deg)
            values: Floats = step * np.arange(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)
            if j not in self.limits_deg and len(values) > 1 and abs(values[-1] - values[0] - 2.0 * np.pi) < 1e-9:
                return values[:-1]  # -180 and 180 deg are the same
            return values
        count = int(_POSES ** (1.0 / len(self.bench.axes)) + 1e-9)
        if j not in self.limits_deg:
            return np.asarray((np.arange(count) - count // 2) * (2.0 * np.pi / count), np.float64)
        values = np.append(np.linspace(low, high, count), np.clip(0.0, low, high))
        return np.unique(values)

    def allowed(self, poses: Floats) -> Mask:
        """Mask (n,) of the poses (n, k) that are within the limits and in no forbidden zone."""
        low, high = self.bounds.T
        inside = ((poses >= low - 1e-9) & (poses <= high + 1e-9)).all(axis=1)
        for zone in self.zones_deg:
            there = np.ones(len(poses), bool)
            for j, ends in zone.items():
                begin, end = np.radians(ends)
                there &= (poses[:, j] - begin) % (2.0 * np.pi) <= end - begin
            inside &= ~there
        return inside

    def rooms(self, poses: Floats) -> Floats:
        """A box of allowed poses about each allowed pose (n, k), as (n, k, 2); gimbals without limits may go full
        circle in it."""
        bounds = np.repeat(self.bounds[None], len(poses), axis=0)
        bounds[:, [j for j in range(poses.shape[1]) if j not in self.limits_deg]] = [-np.inf, np.inf]
        for room, pose in zip(bounds, poses, strict=True):
            for zone in self.zones_deg:
                away = {j: _aside(pose[j], np.radians(ends)) for j, ends in zone.items()}
                j = max(away, key=lambda each: min(away[each]))
                below, above = away[j]  # upwards to the zone's beginning, downwards to its end
                room[j] = max(room[j, 0], pose[j] - above + 1e-9), min(room[j, 1], pose[j] + below - 1e-9)
        return bounds

    def crosses(self, start: Floats, end: Floats) -> Mask:
        """Mask of the straight ways from ``start`` (..., k) to ``end`` (..., k) that lead through a forbidden zone."""
        hit = np.zeros(np.broadcast_shapes(start.shape, end.shape)[:-1], bool)
        step = end - start
        for zone in self.zones_deg:
            for round_deg in (-360.0, 0.0, 360.0) if all(j not in self.limits_deg for j in zone) else (0.0,):
                enter, leave = np.zeros(hit.shape), np.ones(hit.shape)
                for j, ends in zone.items():
                    low, high = np.radians(np.array(ends) + round_deg)
                    still = np.abs(step[..., j]) < 1e-12
                    share = np.where(still, 1.0, step[..., j])
                    one, other = (low - start[..., j]) / share, (high - start[..., j]) / share
                    outside = still & ((start[..., j] < low) | (start[..., j] > high))
                    first = np.where(still, np.where(outside, np.inf, -np.inf), np.minimum(one, other))
                    enter = np.maximum(enter, first)
                    leave = np.minimum(leave, np.where(still, np.inf, np.maximum(one, other)))
                hit |= enter <= leave
        return hit


def _aside(angle: float, zone: Floats) -> tuple[float, float]:
    """Return how far an angle may increase before a zone begins, and how far decrease before it ends; negative
    inside."""
    below, above = (zone[0] - angle) % (2.0 * np.pi), (angle - zone[1]) % (2.0 * np.pi)
    inside = (angle - zone[0]) % (2.0 * np.pi) <= zone[1] - zone[0]
    return (-1.0, -1.0) if inside else (float(below), float(above))


def wrap(poses: Floats) -> Floats:
    """Angles wrapped to the range from -180 to 180 deg, rad."""
    return np.pi - (np.pi - poses) % (2.0 * np.pi)


MARGIN_DEG = 1.0
"""By how much the platform may overshoot and stay out of a zone."""

_TURNS = (-2.0 * np.pi, 0.0, 2.0 * np.pi)


def is_free(reach: Reach, start: Floats, end: Floats) -> Mask:
    """Mask (m,) of the ends (m, k), rad, to which all gimbals may go at once from ``start`` (k,) or (m, k), rad."""
    margin = np.radians(MARGIN_DEG)
    low, high = np.minimum(start, end) - margin, np.maximum(start, end) + margin
    free = np.ones(len(end), bool)
    for zone in reach.zones_deg:
        inside = np.ones(len(end), bool)
        for j, ends_deg in zone.items():
            begin, stop = np.radians(ends_deg)
            turns = [(low[:, j] <= stop + turn) & (high[:, j] >= begin + turn) for turn in _TURNS]
            inside &= np.any(turns, axis=0)
        free &= ~inside
    return free


def route(reach: Reach, start: Floats, end: Floats) -> list[Floats] | None:
    """The orientations (k,), rad, to go to one after the other, the last of them ``end``; None where no way is free.

    start, end (k,): rad. It is the end alone where all gimbals may go at once.
    """
    if not reach.allowed(end[None])[0]:
        return None
    if is_free(reach, start, end[None])[0]:
        return [end]
    for order in itertools.permutations(range(len(start))):
        stations = _stations(start, end[None], order)
        if all(is_free(reach, before, after)[0] for before, after in itertools.pairwise(stations)):
            distinct = [station[0] for k, station in enumerate(stations[1:]) if (station != stations[k]).any()]
            return distinct or [end]
    return None


def can_be_reached(reach: Reach, start: Floats, ends: Floats) -> Mask:
    """Mask (m,) of the ends (m, k), rad, to which ``route`` finds a way from ``start`` (k,), rad."""
    reached = is_free(reach, start, ends)
    if not reached.all():
        for order in itertools.permutations(range(len(start))):
            stations = _stations(start, ends, order)
            legs = [is_free(reach, before, after) for before, after in itertools.pairwise(stations)]
            reached |= np.all(legs, axis=0)
    return reached & reach.allowed(ends)


def _stations(start: Floats, ends: Floats, order: tuple[int, ...]) -> list[Floats]:
    """Return the orientations (m, k) at the beginning and after each gimbal has gone, in this order."""
    stations = [np.repeat(start[None], len(ends), axis=0)]
    for j in order:
        following = stations[-1].copy()
        following[:, j] = ends[:, j]
        stations.append(following)
    return stations
