"""The orientations that a bench can take: limits of its gimbals, forbidden zones, and a grid or a list of positions.

Angles are between -180 and 180 deg, and a gimbal moves from one to the next without crossing 180 deg, as a simulated
bench does. ``poses`` are (n, k), rad.

Ways of the gimbals from one orientation to another that enter no forbidden zone, whatever the gimbals' rates are.

Gimbals that are told to go begin together and end when each is there: on the way the platform may be anywhere in the
box of angles between the two orientations. A way is free if that whole box, with a margin for overshoot, is. Where it
is not, the gimbals may go one after the other.

Orientations are visited in an order in which slews are short, and time is uncorrelated with the direction of gravity. A
sensor drift that is linear in time is mistaken for a change of the parameters to the extent that the times of the
visits are correlated with the columns of the model. This is measured by the multiple correlation of the times with the
three components of the specific force, 0 to 1.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from kf_calib.bench.arrays import Floats, Ints, Mask, first_least
from kf_calib.bench.bench import Bench, axis_names
from kf_calib.bench.keys import Range, limits_of, zones_of
from kf_calib.errors import InputError

_POSES = 4096


@dataclass(frozen=True)
class GimbalLimits:
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
    def of(cls, bench: Bench) -> GimbalLimits:
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


def is_free(limits: GimbalLimits, start: Floats, end: Floats) -> Mask:
    """Mask (m,) of the ends (m, k), rad, to which all gimbals may go at once from ``start`` (k,) or (m, k), rad."""
    margin = np.radians(MARGIN_DEG)
    low, high = np.minimum(start, end) - margin, np.maximum(start, end) + margin
    free = np.ones(len(end), bool)
    for zone in limits.zones_deg:
        inside = np.ones(len(end), bool)
        for j, ends_deg in zone.items():
            begin, stop = np.radians(ends_deg)
            turns = [(low[:, j] <= stop + turn) & (high[:, j] >= begin + turn) for turn in _TURNS]
            inside &= np.any(turns, axis=0)
        free &= ~inside
    return free


def route(limits: GimbalLimits, start: Floats, end: Floats) -> list[Floats] | None:
    """The orientations (k,), rad, to go to one after the other, the last of them ``end``; None where no way is free.

    start, end (k,): rad. It is the end alone where all gimbals may go at once.
    """
    if not limits.allowed(end[None])[0]:
        return None
    if is_free(limits, start, end[None])[0]:
        return [end]
    for order in itertools.permutations(range(len(start))):
        stations = _stations(start, end[None], order)
        if all(is_free(limits, before, after)[0] for before, after in itertools.pairwise(stations)):
            distinct = [station[0] for k, station in enumerate(stations[1:]) if (station != stations[k]).any()]
            return distinct or [end]
    return None


def can_be_reached(limits: GimbalLimits, start: Floats, ends: Floats) -> Mask:
    """Mask (m,) of the ends (m, k), rad, to which ``route`` finds a way from ``start`` (k,), rad."""
    reached = is_free(limits, start, ends)
    if not reached.all():
        for order in itertools.permutations(range(len(start))):
            stations = _stations(start, ends, order)
            legs = [is_free(limits, before, after) for before, after in itertools.pairwise(stations)]
            reached |= np.all(legs, axis=0)
    return reached & limits.allowed(ends)


def _stations(start: Floats, ends: Floats, order: tuple[int, ...]) -> list[Floats]:
    """Return the orientations (m, k) at the beginning and after each gimbal has gone, in this order."""
    stations = [np.repeat(start[None], len(ends), axis=0)]
    for j in order:
        following = stations[-1].copy()
        following[:, j] = ends[:, j]
        stations.append(following)
    return stations


PEAK_OVER_MEAN = 1.875
"""Ratio of peak to mean speed of a minimum-jerk slew."""

_CROSSING_S = 1e4  # cost of a way through a forbidden zone, which is avoided if possible
_AGAIN_S = 1e3  # cost of two successive visits of the same orientation
_MOVES, _FRUITLESS, _STARTS = 400, 12, 6


@dataclass(frozen=True)
class Timing:
    """Duration of a dwell, s; peak speed of a slew, deg/s; and the largest correlation with time that is tolerated."""

    dwell_s: float
    slew_degps: float
    correlation: float = 0.1


def slews_s(one: Floats, other: Floats, slew_degps: float) -> Floats:
    """Durations of slews between poses (..., k), rad, in seconds; the gimbal with the longest way reaches the peak
    speed."""
    return PEAK_OVER_MEAN * np.degrees(np.abs(one - other)).max(axis=-1) / slew_degps


def middles_s(poses: Floats, timing: Timing) -> Floats:
    """Middle of each dwell (n,), s, from the beginning of the first."""
    return _middles(slews_s(poses[1:], poses[:-1], timing.slew_degps)[None], timing.dwell_s)[0]


def _middles(slews: Floats, dwell_s: float) -> Floats:
    """Return the middles (b, n) from the slews (b, n - 1) between the dwells."""
    steps = np.concatenate([np.full((len(slews), 1), 0.5 * dwell_s), slews + dwell_s], axis=1)
    return np.cumsum(steps, axis=1)


def time_correlation(middles: Floats, columns: Floats) -> float:
    """Multiple correlation of times (n,) with columns (n, c); 1 if the columns can fit any times."""
    return float(_correlations(middles[None], _space(columns))[0])


def _space(columns: Floats) -> Floats:
    """Return an orthonormal basis (n, r) of the columns (n, c) about their means."""
    left, singular, _ = np.linalg.svd(columns - columns.mean(axis=0), full_matrices=False)
    return left[:, singular > 1e-6 * max(float(singular[0]), 1e-300)]


def _correlations(times: Floats, space: Floats) -> Floats:
    """Return the multiple correlations of times (b, n), each in order of the visits."""
    centred = times - times.mean(axis=1, keepdims=True)
    spread = np.linalg.norm(centred, axis=1)
    return np.linalg.norm(centred @ space, axis=1) / np.where(spread > 0, spread, 1.0)


def order(
    poses: Floats, columns: Floats, timing: Timing, limits: GimbalLimits, start: Floats | None, seed: int = 0
) -> Ints:
    """The order (n,) of visits to poses (n, k) with the least time in slews among those that keep the correlation
    small.

    It is found by swaps and reversals from several random orders. ``start`` (k,) is the present pose; None if it does
    not matter.
    """
    count = len(poses)
    if count < 2:
        return np.arange(count)
    rng, space = np.random.default_rng(seed), _space(columns)
    ways = slews_s(poses[:, None], poses[None], timing.slew_degps)
    costs = ways + _CROSSING_S * limits.crosses(poses[:, None], poses[None]) + np.where(ways > 0, 0.0, _AGAIN_S)
    first = np.zeros(count)
    if start is not None:
        first = slews_s(poses, start, timing.slew_degps) + _CROSSING_S * limits.crosses(start[None], poses)
    bound = 0 < space.shape[1] < count - 1
    scale = float(count * max(ways.mean(), 1e-3))

    def cost(tours: Ints) -> Floats:
        edges = tours[:, :-1], tours[:, 1:]
        spent = costs[edges].sum(axis=1) + first[tours[:, 0]]
        if not bound:
            return spent
        times = np.empty(tours.shape)
        np.put_along_axis(times, tours, _middles(ways[edges], timing.dwell_s), axis=1)
        return spent + 20.0 * scale * np.maximum(_correlations(times, space) - timing.correlation, 0.0)

    best, least = np.arange(count), np.inf
    for _ in range(_STARTS):
        tour, own = _improve(rng.permutation(count), cost, rng)
        if own < least - 1e-9:
            best, least = tour, own
    return best


def _improve(tour: Ints, cost: Callable[[Ints], Floats], rng: np.random.Generator) -> tuple[Ints, float]:
    """Improve an order by random moves until a number of them in sequence brings no gain."""
    least, fruitless = float(cost(tour[None])[0]), 0
    while fruitless < _FRUITLESS:
        moved = _moves(tour, rng)
        costs = cost(moved)
        k = first_least(costs)
        fruitless = 0 if costs[k] < least - 1e-9 else fruitless + 1
        if not fruitless:
            tour, least = moved[k], float(costs[k])
    return tour, least


def _moves(tour: Ints, rng: np.random.Generator) -> Ints:
    """Return random variants (m, n) of an order (n,), with two visits swapped or those between two reversed."""
    count = len(tour)
    ends = np.sort(rng.integers(0, count, (_MOVES, 2)), axis=1)
    low, high = ends.T[:, :, None]
    at = np.broadcast_to(np.arange(count), (_MOVES, count))
    reversing = rng.random(_MOVES)[:, None] < 0.5
    swapped = np.where(at == low, high, np.where(at == high, low, at))
    turned = np.where((at >= low) & (at <= high), low + high - at, at)
    return tour[np.where(reversing, turned, swapped)]
