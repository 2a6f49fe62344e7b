"""Which runs of a large fleet are drawn: what lies outside always, of the others so many that a view stays small."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kf_calib.fleet.track import Track

MOST = 3000
"""Runs or units of a parameter that are drawn besides those outside."""
OUTLIER = 0.01
"""Chance below which a unit lies outside its population."""
_LIMIT = 3.0  # sigma of the scatter beyond which a run lies outside


def every(count: int) -> int:
    """Of so many, one in how many is drawn."""
    return -(-count // MOST)


def thinned(track: Track) -> NDArray[np.bool_]:
    """Which runs (n,) of a parameter are drawn: one in so many, and all beyond the limits of the control chart."""
    count = len(track.values)
    return (np.arange(count) % every(count) == 0) | (np.abs(track.deviations) > _LIMIT * track.scatter)


def thinned_units(track: Track) -> NDArray[np.bool_]:
    """Which units (u,) are drawn: one in so many, and all outliers."""
    count = len(track.units)
    return (np.arange(count) % every(count) == 0) | (track.chances < OUTLIER)
