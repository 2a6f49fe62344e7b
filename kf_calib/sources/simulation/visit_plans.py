"""Plans: which orientations the simulated bench visits, in which order, and for how long; how its gimbals move between
them: angles over time, and the attitude they make, by scipy's rotations.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from kf_calib.bench.arrays import Floats, Times
from kf_calib.bench.bench import Vector
from kf_calib.errors import InputError
from kf_calib.support.text import number_from

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
            row = [number_from(cell) for cell in cells]
        except ValueError:
            if rows or number > 1:
                raise InputError(f"{path}, line {number}: {line!r} is not {width} angles in deg.") from None
            continue
        if row and len(row) != width:
            raise InputError(f"{path}, line {number}: {len(row)} angles for {width} gimbals: give --axes of the plan.")
        rows += [row] if row else []
    if not rows:
        raise InputError(f"{path}: holds no orientation; write a line of {width} angles in deg for each.")
    return rows


def six_faces(axes: Sequence[Vector] = YZX, dwell_s: float = 60.0, up: str = "y") -> list[PlannedVisit]:
    """Each platform axis up and down (+x, -x, +y, -y, +z, -z), by the fewest quarter turns of the gimbals.

    Raises InputError where quarter turns of these axes do not show all six faces to gravity.
    """
    quarters = list(itertools.product((0.0, 90.0, -90.0, 180.0), repeat=len(axes)))
    quarters.sort(key=lambda angles_deg: sum(map(abs, angles_deg)))
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
    return explicit_plan(_spread_angles_deg(count, tuple(axes), seed, up), dwell_s)


@lru_cache(maxsize=128)
def _spread_angles_deg(count: int, axes: tuple[Vector, ...], seed: int, up: str) -> Floats:
    """The gimbal angles (count, k) of a spread plan: they take a tenth of a second, and do not depend on the dwells."""
    rng = np.random.default_rng(seed)
    directions = Rotation.random(rng=rng).apply(_fibonacci_lattice(count))
    angles = [_angles_towards(direction, axes, rng, up) for direction in rng.permutation(directions)]
    return np.degrees(angles)


def up_directions(axes: Sequence[Vector], angles_rad: Floats, up: str = "y") -> Floats:
    """The vertical seen from the platform (n, 3) at gimbal angles (n, k); ``up``: what is up where these are zero."""
    return attitude(axes, angles_rad, up).inv().apply([0.0, 1.0, 0.0])


def _up_direction(axes: Sequence[Vector], angles_rad: Sequence[float], up: str) -> Floats:
    """``up_directions`` (3,) at one set of angles, to the last bit, in numbers instead of arrays: a search for angles
    asks for a thousand."""
    x, y, z, w = base_with_up(up).as_quat()[0].tolist()
    for axis, angle in zip(axes, angles_rad, strict=True):
        a, b, c, d = _quaternion(*(angle * part for part in axis))
        x, y, z, w = (
            w * a + d * x + (y * c - z * b), w * b + d * y + (z * a - x * c), w * c + d * z + (x * b - y * a),
            w * d - x * a - y * b - z * c,
        )  # fmt: skip
        norm = math.sqrt(x * x + y * y + z * z + w * w)
        x, y, z, w = x / norm, y / norm, z / norm, w / norm
    return np.array([2.0 * (x * y + z * w), -x * x + y * y - z * z + w * w, 2.0 * (y * z - x * w)])


def _quaternion(x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """The unit quaternion (x, y, z, w) of a rotation vector, rad: (v sin(|v| / 2) / |v|, cos(|v| / 2))."""
    angle = math.sqrt(x * x + y * y + z * z)
    square = angle * angle
    scale = math.sin(angle / 2.0) / angle if angle > 1e-3 else 0.5 - square / 48.0 + square * square / 3840.0
    return scale * x, scale * y, scale * z, math.cos(angle / 2.0)


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
        apart = _up_direction(axes, angles_rad.tolist(), up) - direction
        return np.concatenate([apart, _PULL * (angles_rad - start_rad)])

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


_PEAK_OF_MINIMUM_JERK = 1.875  # greatest speed of the profile over its mean speed


def attitude(axes: Sequence[Vector], angles_rad: Floats, up: str = "y") -> Rotation:
    """Platform -> bench at angles (n, k): each gimbal, outer first, turns about its axis of the one that carries it,
    and the first about one of a base whose axis ``up`` points up."""
    turned = base_with_up(up)
    for axis, angle in zip(axes, angles_rad.T, strict=True):
        turned = turned * Rotation.from_rotvec(angle[:, None] * np.array(axis))
    return turned


@lru_cache
def base_with_up(up: str) -> Rotation:
    """The frame in which the axes are named -> bench (y up): its axis ``up`` (z, -x ...) points up, and its x where the
    bench's x does, or its y where x is vertical."""
    if up == "y":
        return Rotation.from_rotvec(np.zeros((1, 3)))
    vertical = np.zeros(3)
    vertical["xyz".index(up[-1])] = -1.0 if up.startswith("-") else 1.0
    level = [0.0, 1.0, 0.0] if up.endswith("x") else [1.0, 0.0, 0.0]
    bench_from_base = np.array([level, vertical, np.cross(level, vertical)])  # rows: bench x, y, z seen in the base
    return Rotation.from_matrix(bench_from_base[None])


@dataclass
class Motion:
    """Dwells at ``angles_rad`` (m, k), each from ``arrive_ns`` to ``leave_ns`` (m,); slews between, all axes at once.

    A slew follows the minimum-jerk profile ``10 u^3 - 15 u^4 + 6 u^5``, u = 0 ... 1 (Flash and Hogan, 1985): speed and
    acceleration are zero at both ends. Times count from the first sample.
    """

    angles_rad: Floats
    arrive_ns: Times
    leave_ns: Times

    @classmethod
    def through(cls, angles_rad: Floats, dwell_s: Floats, slew_rate_degps: float) -> Motion:
        """The motion whose fastest axis reaches ``slew_rate_degps`` in every slew (infinity: slews take no time)."""
        farthest_deg = np.degrees(np.abs(np.diff(angles_rad, axis=0)).max(axis=1))
        slew_ns = np.rint(1e9 * _PEAK_OF_MINIMUM_JERK * farthest_deg / slew_rate_degps).astype(np.int64)
        dwell_ns = np.rint(1e9 * dwell_s).astype(np.int64)
        arrive_ns = np.concatenate([[0], np.cumsum(dwell_ns[:-1] + slew_ns)])
        return cls(angles_rad, arrive_ns, arrive_ns + dwell_ns)

    @property
    def end_ns(self) -> int:
        return int(self.leave_ns[-1])

    def locate(self, time_ns: Times) -> tuple[Times, Floats]:
        """Per instant (n,): the dwell it is in or was last in, and the share of the way to the next one, 0 to 1."""
        dwell = np.searchsorted(self.arrive_ns, time_ns, side="right") - 1
        slew_ns = np.append(self.arrive_ns[1:] - self.leave_ns[:-1], 0)
        share = np.clip((time_ns - self.leave_ns[dwell]) / np.maximum(slew_ns[dwell], 1), 0.0, 1.0)
        return dwell, self._profile(share)

    def _profile(self, share: Floats) -> Floats:
        """The share of the way that is behind it, by that of the time."""
        return share**3 * (10.0 - 15.0 * share + 6.0 * share**2)

    def angles_at(self, time_ns: Times) -> Floats:
        """Gimbal angles (n, k), rad."""
        return between(self.angles_rad, *self.locate(time_ns))


def between(values: Floats, dwell: Times, share: Floats) -> Floats:
    """What has ``values`` (m, k) in the dwells and goes with the slew profile between them, at n instants: (n, k)."""
    following = np.minimum(dwell + 1, len(values) - 1)
    return values[dwell] + share[:, None] * (values[following] - values[dwell])
