"""Slews: where the platform points, and how fast it turns, from the angle messages of a motion.

The messages are few (10 Hz or so): a cubic spline through them gives angles and speeds at the readings; straight lines
would be off by their sagitta, and have no acceleration.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench, turn

PIECE_RAD = np.radians(2.0)
PIECE_S = 0.2
_SHORTEST = 3  # readings of a piece: as many as a parabola has coefficients
_STEP_S = 1e-3  # of the difference that makes an acceleration; a spline through 10 Hz is smooth over it


@dataclass(frozen=True)
class Curve:
    """The gimbal angles of one slew over elapsed time, s: ``angles`` (n,) -> (n, k), rad, and ``speeds``, rad/s."""

    bench: Bench
    angles: Callable[[Floats], Floats]
    speeds: Callable[[Floats], Floats]

    @classmethod
    def through(cls, bench: Bench, elapsed_s: Floats, pose: Floats) -> Curve:
        """Through angle messages at ``elapsed_s`` (m,), ``pose`` (m, k), m > 3."""
        from scipy.interpolate import CubicSpline

        spline = CubicSpline(elapsed_s, pose)
        return cls(bench, spline, spline.derivative())

    def rate(self, elapsed_s: Floats) -> Floats:
        """omega (n, 3), rad/s: of the platform against the bench, in the platform frame.

        Each gimbal hands its omega on to the next, which turns by its own: w_k = R_k^T w_(k-1) + axis_k dq_k/dt.
        """
        angles, speeds, omega = self.angles(elapsed_s), self.speeds(elapsed_s), np.zeros((len(elapsed_s), 3))
        for k, axis in enumerate(self.bench.axes):
            omega = turn(omega, np.array(axis), -angles[:, k]) + speeds[:, k, None] * np.array(axis)
        return omega

    def rate_change(self, elapsed_s: Floats) -> Floats:
        """domega/dt (n, 3), rad/s^2, in the platform frame."""
        return (self.rate(elapsed_s + _STEP_S) - self.rate(elapsed_s - _STEP_S)) / (2.0 * _STEP_S)

    def cuts(self, elapsed_s: Floats) -> list[int]:
        """Where readings at ``elapsed_s`` (n,) are cut into pieces of 2 deg or 0.2 s at most, 3 readings or more."""
        speed = np.linalg.norm(self.rate(elapsed_s), axis=1)
        steps = np.diff(elapsed_s, prepend=elapsed_s[:1])
        passed = np.cumsum(steps * (speed / PIECE_RAD + 1.0 / PIECE_S))
        found = [0]
        for edge in np.searchsorted(passed, np.arange(1.0, passed[-1])).tolist():
            if edge - found[-1] >= _SHORTEST and len(elapsed_s) - edge >= _SHORTEST:
                found.append(edge)
        return [*found, len(elapsed_s)]
