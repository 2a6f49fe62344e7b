"""The sides on which a sensor has lain, by the direction of gravity in its readings, and the one to turn up next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.dwells.sufficient_statistics import DwellFactor
from kf_calib.estimation.dwell_columns import Carried
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.free_attitude import DIRECTIONS, covariance_of, felt, most_informative, turned, undetermined
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.noise_model import within_dwells

SAME_SIDE_DEG = 10.0
"""Poses whose directions of gravity differ by less than this are of one side: the second tells little that is new."""
_TILTS_DEG = {2: 45, 3: 55}  # of an edge and of a corner from the nearest face


@dataclass(frozen=True)
class Sides:
    """The sides of some poses.

    up (D, 3): unit vector that points up in each. side: number of the side of each, counted from 0. missing: scale
    factors and biases that the poses do not determine. following: the axes that should point up next, as ``+x +y``.
    """

    up: Floats
    side: tuple[int, ...]
    missing: tuple[str, ...]
    following: str

    @classmethod
    def of(cls, dwells: Sequence[DwellFactor], model: Model, fitted: Fit | None = None) -> Sides:
        """The sides of dwells; fitted: what they gave, None where they do not determine it."""
        if fitted is None:
            model, state = Model(model.bench, square=True), model.nominal_state()
            carried = Carried(turned(dwells, state, model.bench.gravity_mps2), model, state)
            noise = within_dwells(dwells)
        else:
            carried, noise, state = fitted.carried, fitted.noise, fitted.carried.state
        covariance = covariance_of(carried, noise, model.bench.square_rad)
        up = directions(np.array([dwell.means[4:] for dwell in dwells]), state)
        following = most_informative(covariance, state, model.bench.gravity_mps2)
        return cls(up, _grouped(up), tuple(undetermined(covariance)), following)

    @property
    def count(self) -> int:
        """Number of different sides."""
        return len(set(self.side))

    def like(self, up: Floats) -> int | None:
        """Index of the first of the poses that is on the same side as this direction (3,); None for a new side."""
        near = np.flatnonzero(self.up @ up > np.cos(np.radians(SAME_SIDE_DEG)))
        return int(near[0]) if near.size else None


def directions(readings: Floats, state: Floats) -> Floats:
    """The unit vectors (D, 3) that point up, by mean readings (D, 3)."""
    force = felt(readings, state)
    return np.asarray(force / np.linalg.norm(force, axis=1, keepdims=True))


def nearest(up: Floats) -> str:
    """The face, edge or corner of a cube that is nearest to a direction (3,), as ``+x +y``."""
    return max(DIRECTIONS, key=lambda name: float(DIRECTIONS[name] @ up))


def turn_in_words(up: str) -> str:
    """How to hold it so that these axes point up alike: ``+x points up, tilted 45 deg toward +y``."""
    first, *others = up.split()
    tilt = f", tilted {_TILTS_DEG[len(others) + 1]} deg toward {' and '.join(others)}" if others else ""
    return f"{first} points up{tilt}"


def _grouped(up: Floats) -> tuple[int, ...]:
    """Return the number of the side of each direction (D, 3): that of the first direction near it."""
    near = up @ up.T > np.cos(np.radians(SAME_SIDE_DEG))
    firsts = near.argmax(axis=1).tolist()
    numbers = {first: k for k, first in enumerate(dict.fromkeys(firsts))}
    return tuple(numbers[first] for first in firsts)
