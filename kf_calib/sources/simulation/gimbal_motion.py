"""The moving gimbals of the simulated bench: angles over time, and the attitude they make, by scipy's rotations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from kf_calib.bench.arrays import Floats, Times
from kf_calib.bench.bench import Vector

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


@dataclass(frozen=True)
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
        u = np.clip((time_ns - self.leave_ns[dwell]) / np.maximum(slew_ns[dwell], 1), 0.0, 1.0)
        return dwell, u**3 * (10.0 - 15.0 * u + 6.0 * u**2)

    def angles_at(self, time_ns: Times) -> Floats:
        """Gimbal angles (n, k), rad."""
        return between(self.angles_rad, *self.locate(time_ns))


def between(values: Floats, dwell: Times, share: Floats) -> Floats:
    """What has ``values`` (m, k) in the dwells and goes with the slew profile between them, at n instants: (n, k)."""
    following = np.minimum(dwell + 1, len(values) - 1)
    return values[dwell] + share[:, None] * (values[following] - values[dwell])
