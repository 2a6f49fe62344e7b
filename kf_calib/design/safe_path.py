"""Ways of the gimbals from one orientation to another that enter no forbidden zone, whatever the gimbals' rates are.

Gimbals that are told to go begin together and end when each is there: on the way the platform may be anywhere in the
box of angles between the two orientations. A way is free if that whole box, with a margin for overshoot, is. Where it
is not, the gimbals may go one after the other.
"""

from __future__ import annotations

import itertools

import numpy as np

from kf_calib.bench.arrays import Floats, Mask
from kf_calib.design.gimbal_limits import Reach

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
