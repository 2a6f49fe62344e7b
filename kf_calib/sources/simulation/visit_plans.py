"""Plans: which orientations the simulated bench visits, in which order, and for how long."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Vector
from kf_calib.errors import InputError
from kf_calib.sources.simulation.gimbal_motion import attitude

YZX: tuple[Vector, ...] = ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
"""A vertical outer axis and two horizontal ones: every attitude can be reached."""

_STARTS = 4
_REACHED = 1e-9
_PULL = 1e-4  # towards the start of a search, per rad, against a miss of 1


@dataclass(frozen=True)
class PlannedVisit:
    """One orientation: gimbal angles, outer axis first, held for ``dwell_s``."""

    gimbal_deg: tuple[float, ...]
    dwell_s: float


def explicit_plan(gimbal_deg: Iterable[Sequence[float]], dwell_s: float = 60.0) -> list[PlannedVisit]:
    """The orientations given, one row of gimbal angles each, in that order."""
    return [PlannedVisit(tuple(float(angle) for angle in row), dwell_s) for row in gimbal_deg]


def stays(plan: Sequence[PlannedVisit]) -> tuple[PlannedVisit, ...]:
    """The plan with visits that follow each other at the same angles as one: a platform that is not moved is not set
    anew."""
    visits = list[PlannedVisit]()
    for visit in plan:
        if visits and visits[-1].gimbal_deg == visit.gimbal_deg:
            visits[-1] = replace(visits[-1], dwell_s=visits[-1].dwell_s + visit.dwell_s)
        else:
            visits.append(visit)
    return tuple(visits)


def angles_from_csv(path: Path, width: int) -> list[list[float]]:
    """Rows of gimbal angles, deg; a first line of names is passed over."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: the plan cannot be read ({getattr(error, 'strerror', None) or error}).") from None
    rows = list[list[float]]()
    for number, line in enumerate(lines, start=1):
        cells = line.split("#")[0].replace(",", " ").split()
        try:
            row = [float(cell) for cell in cells]
        except ValueError:
            if rows or number > 1:
                raise InputError(f"{path}, line {number}: {line!r} is not {width} angles in deg.") from None
            continue
        if row and len(row) != width:
            raise InputError(f"{path}, line {number}: {len(row)} angles for {width} gimbal axes.")
        rows += [row] if row else []
    if not rows:
        raise InputError(f"{path}: holds no orientation; write a line of {width} angles in deg for each.")
    return rows


def six_faces(axes: Sequence[Vector] = YZX, dwell_s: float = 60.0, up: str = "y") -> list[PlannedVisit]:
    """Each platform axis up and down (+x, -x, +y, -y, +z, -z), by the fewest quarter turns of the gimbals.

    Raises InputError where quarter turns of these axes do not show all six faces to gravity.
    """
    quarters = sorted(itertools.product((0.0, 90.0, -90.0, 180.0), repeat=len(axes)), key=_total_turn)
    seen = up_directions(axes, np.radians(quarters), up)
    plan = list[PlannedVisit]()
    for face in np.vstack([np.eye(3), -np.eye(3)])[[0, 3, 1, 4, 2, 5]]:
        fitting = np.flatnonzero(seen @ face > 1 - _REACHED)
        if not len(fitting):
            raise InputError(f"quarter turns of these gimbal axes cannot bring face {face} up: use a spread plan.")
        plan.append(PlannedVisit(quarters[fitting[0]], dwell_s))
    return plan


def spread_plan(
    count: int, axes: Sequence[Vector] = YZX, dwell_s: float = 60.0, seed: int = 0, up: str = "y"
) -> list[PlannedVisit]:
    """``count`` orientations whose directions of gravity are spread evenly over the sphere, in random order.

    The directions are a Fibonacci lattice turned at random; angles that do not move gravity are random, so that what
    depends on them shows. Where the axes cannot reach a direction, the nearest one they can reach is taken.
    """
    if count < 1:
        raise InputError(f"a plan of {count} orientations is not possible: ask for one or more.")
    rng = np.random.default_rng(seed)
    directions = Rotation.random(rng=rng).apply(_fibonacci_lattice(count))
    angles = [_angles_towards(direction, axes, rng, up) for direction in rng.permutation(directions)]
    return explicit_plan(np.degrees(angles), dwell_s)


def up_directions(axes: Sequence[Vector], angles_rad: Floats, up: str = "y") -> Floats:
    """The vertical seen from the platform (n, 3) at gimbal angles (n, k); ``up``: what is up where these are zero."""
    return attitude(axes, angles_rad, up).inv().apply([0.0, 1.0, 0.0])


def _total_turn(angles_deg: Sequence[float]) -> float:
    return sum(map(abs, angles_deg))


def _fibonacci_lattice(count: int) -> Floats:
    """``count`` unit vectors (n, 3) of equal area each: equal steps along an axis, the golden angle about it."""
    i = np.arange(count)
    along = 1.0 - (2.0 * i + 1.0) / count
    around = np.pi * (3.0 - math.sqrt(5.0)) * i
    radius = np.sqrt(1.0 - along**2)
    return np.column_stack([radius * np.cos(around), along, radius * np.sin(around)])


def _angles_towards(direction: Floats, axes: Sequence[Vector], rng: np.random.Generator, up: str) -> Floats:
    """Gimbal angles (k,), rad in [-pi, pi), that point the vertical along ``direction``, from random starts.

    Angles that do not move gravity stay where they start: left to rounding, each machine would have a plan of its own.
    """

    def miss(angles_rad: Floats, start_rad: Floats) -> Floats:
        apart = up_directions(axes, angles_rad[None], up)[0] - direction
        return np.append(apart, _PULL * (angles_rad - start_rad))

    best, cost = np.zeros(len(axes)), math.inf
    for _ in range(_STARTS):
        start = rng.uniform(-np.pi, np.pi, len(axes))
        solution = least_squares(miss, start, xtol=1e-12, args=(start,))
        its_cost = float(np.sum(solution.fun[:3] ** 2))
        if its_cost < cost:
            best, cost = solution.x, its_cost
        if cost < _REACHED:
            break
    return (best + np.pi) % (2.0 * np.pi) - np.pi
