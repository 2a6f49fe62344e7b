"""The order in which orientations are visited: slews are short, and time is uncorrelated with the direction of gravity.

A sensor drift that is linear in time is mistaken for a change of the parameters to the extent that the times of the
visits are correlated with the columns of the model. This is measured by the multiple correlation of the times with the
three components of the specific force, 0 to 1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import Floats, Ints
from kf_calib.design.gimbal_limits import Reach

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


def order(poses: Floats, columns: Floats, timing: Timing, reach: Reach, start: Floats | None, seed: int = 0) -> Ints:
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
    costs = ways + _CROSSING_S * reach.crosses(poses[:, None], poses[None]) + np.where(ways > 0, 0.0, _AGAIN_S)
    first = np.zeros(count)
    if start is not None:
        first = slews_s(poses, start, timing.slew_degps) + _CROSSING_S * reach.crosses(start[None], poses)
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
        if own < least:
            best, least = tour, own
    return best


def _improve(tour: Ints, cost: Callable[[Ints], Floats], rng: np.random.Generator) -> tuple[Ints, float]:
    """Improve an order by random moves until a number of them in sequence brings no gain."""
    least, fruitless = float(cost(tour[None])[0]), 0
    while fruitless < _FRUITLESS:
        moved = _moves(tour, rng)
        costs = cost(moved)
        k = int(np.argmin(costs))
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
