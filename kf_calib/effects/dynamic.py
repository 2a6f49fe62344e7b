"""What shows while the platform turns: the time a reading was taken, and where each accelerometer sits."""

from __future__ import annotations

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.effects.effect import Bearer, Coefficient, Effect
from kf_calib.effects.stimulus import Stimulus


class Latency(Effect):
    """-tau_d da_i/dt, for the block as a whole: a reading stamped t is what was true at t - tau_d."""

    family = "slews"
    name, title, source = "latency", "delay of the readings", "acquisition chain"
    borne_by = Bearer.BENCH  # the clock and the acquisition are the bench's
    confused_with = "seen in slews only"
    dynamic = True

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return (Coefficient("tau_d", "s", 1e-2, "ms", 1e3),)

    def columns(self, s: Stimulus) -> Floats:
        return -(s.force_rate_mps3 @ s.sensitivity.T)[:, :, None]


class LeverArm(Effect):
    """K_i E_i . (omega x (omega x r_i) + domega/dt x r_i), r_i the place of accelerometer i in the platform."""

    family = "slews"
    name, title, source = "lever-arm", "place of each accelerometer", "rigid-body kinematics"
    confused_with = "seen in slews only, about several axes"
    dynamic = True

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return tuple(Coefficient(f"r{i}{axis}", "m", 0.1, "mm", 1e3) for i in (1, 2, 3) for axis in "xyz")

    def columns(self, s: Stimulus) -> Floats:
        columns, turning = np.zeros((len(s), 3, 9)), _cross(s.rate_radps)
        per_metre = turning @ turning + _cross(s.rate_change_radps2)  # what it does to r, (m, 3, 3)
        for i in range(3):
            columns[:, i, 3 * i : 3 * i + 3] = s.sensitivity[i] @ per_metre
        return columns


def _cross(vector: Floats) -> Floats:
    """Matrices (m, 3, 3) that turn r into vector x r, of vectors (m, 3)."""
    return np.cross(vector[:, None, :], np.eye(3)[None]).swapaxes(1, 2)
