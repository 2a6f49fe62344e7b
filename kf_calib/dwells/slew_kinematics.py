"""The angles and the angular rate of the platform during a slew, from its angle messages.

Messages are infrequent (about 10 Hz). A cubic spline through them gives angles and speeds at the readings. Straight
lines between them would be off by their sagitta and would have no acceleration.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench, turn

PIECE_RAD = np.radians(2.0)
PIECE_S = 0.2
_SHORTEST = 3  # readings of a piece, as many as a parabola has coefficients
_STEP_S = 1e-3  # step of the difference quotient for the acceleration; the spline is smooth over it


@dataclass(frozen=True)
class Curve:
    """The gimbal angles of one slew as functions of elapsed time, s: ``angles`` (n,) -> (n, k), rad, and ``speeds``,
    rad/s."""

    bench: Bench
    angles: Callable[[Floats], Floats]
    speeds: Callable[[Floats], Floats]

    @classmethod
    def through(cls, bench: Bench, elapsed_s: Floats, pose: Floats) -> Curve:
        """The curve through angle messages ``pose`` (m, k) at times ``elapsed_s`` (m,), m > 3."""
        from scipy.interpolate import CubicSpline

        spline = CubicSpline(elapsed_s, pose)
        return cls(bench, spline, spline.derivative())

    def rate(self, elapsed_s: Floats) -> Floats:
        """Angular rate omega (n, 3), rad/s, of the platform relative to the bench, in the platform frame.

        It follows from gimbal to gimbal, outer to inner: w_k = R_k^T w_(k-1) + axis_k dq_k/dt.
        """
        angles, speeds, omega = self.angles(elapsed_s), self.speeds(elapsed_s), np.zeros((len(elapsed_s), 3))
        for k, axis in enumerate(self.bench.axes):
            omega = turn(omega, np.array(axis), -angles[:, k]) + speeds[:, k, None] * np.array(axis)
        return omega

    def rate_change(self, elapsed_s: Floats) -> Floats:
        """Angular acceleration domega/dt (n, 3), rad/s^2, in the platform frame."""
        return (self.rate(elapsed_s + _STEP_S) - self.rate(elapsed_s - _STEP_S)) / (2.0 * _STEP_S)

    def cuts(self, elapsed_s: Floats) -> list[int]:
        """Indices at which readings at times ``elapsed_s`` (n,) are cut into pieces of at most about 2 deg and 0.2 s
        and at least 3 readings."""
        speed = np.linalg.norm(self.rate(elapsed_s), axis=1)
        steps = np.diff(elapsed_s, prepend=elapsed_s[:1])
        passed = np.cumsum(steps * (speed / PIECE_RAD + 1.0 / PIECE_S))
        edges = [0]
        for edge in np.searchsorted(passed, np.arange(1.0, passed[-1])).tolist():
            if edge - edges[-1] >= _SHORTEST and len(elapsed_s) - edge >= _SHORTEST:
                edges.append(edge)
        return [*edges, len(elapsed_s)]
