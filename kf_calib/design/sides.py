"""The sides on which a sensor has lain, by the direction of gravity in its readings, and the one to turn up next.

A plan turns up, of 26 directions, one after another always that in which |f| is known worst, which is the one that
lowers the generalised variance of the nine parameters most.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench
from kf_calib.dwells.table import DwellTable
from kf_calib.estimation.attitude import facing_readings, force_shown
from kf_calib.estimation.dwell_columns import LinearisedDwells
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.free_attitude import (
    DIRECTIONS,
    covariance_of,
    most_informative,
    row_of,
    undetermined,
    weak_covariance,
)
from kf_calib.estimation.measurement_model import Model
from kf_calib.noise.within_dwells import within_dwells

SAME_SIDE_DEG = 10.0
"""Poses whose directions of gravity differ by less than this are of one side: the second tells little that is new."""
_TILTS_DEG = {2: 45, 3: 55}  # of an edge and of a corner from the nearest face


@dataclass(frozen=True)
class Sides:
    """The sides of some poses.

    numbers: of their dwells. up (D, 3): unit vector that points up in each. side: number of the side of each, from 0.
    missing: scale factors and biases that the poses do not determine. following: the axes that should point up next, as
    ``+x +y``.
    """

    numbers: tuple[int, ...]
    up: Floats
    side: tuple[int, ...]
    missing: tuple[str, ...]
    following: str

    @classmethod
    def of(cls, dwells: DwellTable, bench: Bench, fitted: Fit | None = None) -> Sides:
        """The sides of dwells; fitted: to these or fewer dwells, None where they do not determine it."""
        model = Model(bench)
        state = model.nominal_state() if fitted is None else fitted.linearised.state
        noise = within_dwells(dwells) if fitted is None else fitted.noise
        facing = facing_readings(dwells, state, bench.gravity_mps2)
        covariance = covariance_of(LinearisedDwells(facing, model, state), noise, bench.square_rad)
        force = force_shown(dwells.means[:, 4:], state)
        up = force / np.linalg.norm(force, axis=1, keepdims=True)
        following = most_informative(covariance, state, bench.gravity_mps2)
        numbers = tuple(dwells.folded.numbers.tolist())
        return cls(numbers, up, _grouped(up), tuple(undetermined(covariance)), following)

    @property
    def count(self) -> int:
        """Number of different sides."""
        return len(set(self.side))

    @property
    def repeats(self) -> int | None:
        """Number of the earlier dwell on the side of the last one; None where that side is new."""
        first = self.side.index(self.side[-1])
        return self.numbers[first] if first < len(self.side) - 1 else None

    @property
    def last(self) -> str:
        """The face, edge or corner of a cube that points up in the last pose, nearly, as ``+x +y``."""
        return max(DIRECTIONS, key=lambda name: float(DIRECTIONS[name] @ self.up[-1]))


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


SYMBOLS = ("K1", "b1", "nu1", "K2", "b2", "theta3", "phi3", "K3", "b3")
"""The nine parameters that are left without angles."""


@dataclass(frozen=True)
class HandPlan:
    """Sides to turn up, each by the axes that point up alike (``+x``, ``+x -z``), and the sigmas (poses + 1, 9) before
    and after each, in SI."""

    up: tuple[str, ...]
    sigma: Floats

    @classmethod
    def of(cls, count: int, model: Model, mean_mps2: float, before: Fit | None = None) -> HandPlan:
        """The plan of ``count`` poses after a run or from nothing; ``mean_mps2``: sigma of a pose's mean reading."""
        state = model.nominal_state() if before is None else before.linearised.state
        square_rad = model.bench.square_rad
        covariance = weak_covariance() if before is None else covariance_of(before.linearised, before.noise, square_rad)
        gravity, up, sigmas = model.bench.gravity_mps2, list[str](), [_sigmas(covariance, state)]
        for _ in range(count):
            up.append(most_informative(covariance, state, gravity))
            row, across = row_of(up[-1], state, gravity)
            gain = covariance @ row
            covariance = covariance - np.outer(gain, gain) / (row @ gain + mean_mps2**2 * (across @ across))
            sigmas.append(_sigmas(covariance, state))
        return cls(tuple(up), np.array(sigmas))


def _sigmas(covariance: Floats, state: Floats) -> Floats:
    """Return the sigmas (9,) of the parameters."""
    jacobian = paper_parameters.jacobian(state)
    places = [paper_parameters.SYMBOLS.index(symbol) for symbol in SYMBOLS]
    return np.sqrt(np.maximum(np.diag(jacobian @ covariance @ jacobian.T), 0.0))[places]
