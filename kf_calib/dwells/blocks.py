"""Blocks of readings of one dwell, and the account of what became of all readings."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import Floats, Mask
from kf_calib.dwells.slew_kinematics import Curve
from kf_calib.dwells.stationarity import Stillness

LARGEST_MPS2 = 1e12
"""Beyond any reading, counts of a 32-bit converter included: those are for the check of the unit to tell."""
LARGEST_RAD = 1e6
"""Beyond any angle: 160 000 turns, of which a double keeps the fraction to 1e-10 rad."""
LARGEST_C = 1e6
"""Beyond any temperature."""
_TURNING_DEG = 1.0  # in a block: a platform that only creeps stays below


@dataclass(frozen=True, slots=True)
class Block:
    """Up to 4000 consecutive readings of one dwell, which began at ``arrival_s``, or of the slew that ended it.

    dwell: its number, counted from 1.
    arrival_s: as the angles tell it; felt_s: as the readings do, from which on they settle (None: not known better).
    elapsed_s (n,) since the first sample of the recording; accel_mps2 (n, 3); pose (1, k): the mean of the angle
    messages while the platform stands still, or (n, k) where it creeps; temperature_c (n,), NaN where not measured.
    """

    dwell: int
    arrival_s: float
    elapsed_s: Floats
    accel_mps2: Floats
    pose: Floats
    temperature_c: Floats
    curve: Curve | None = None
    """How the angles went, in a slew; None in a dwell."""
    variance_mps2_2: Floats | None = None
    """Of averaged readings: variance (n, 3) of those that each was made of."""
    taken: int = 1
    """How many readings each new one stands for."""
    felt_s: float | None = None
    pose_sigma_rad: float = 0.0
    """What the noise of the angles leaves uncertain of the pose, 1 sigma."""
    turns: tuple[int, ...] = ()
    """Whole turns of each gimbal by which ``pose`` goes beyond the angles as they were recorded; () of quaternions."""


@dataclass
class Tally:
    """What became of every sample that was read; ``sentences`` says what a user should know of it.

    slewing: used though the platform moved; moving: not used because it did. short_dwells: those too short for the
    whole margin after their arrival, least_settling_s: what the shortest had. turned_deg: how far the platform turned,
    at most, in a block that counts as still.
    """

    read: int = 0
    used: int = 0
    slewing: int = 0
    moving: int = 0
    settling: int = 0
    not_finite: int = 0
    too_large: int = 0
    repeated: int = 0
    backward: int = 0
    leaping: int = 0
    without_pose: int = 0
    poses: int = 0
    poses_dropped: int = 0
    temperatures_dropped: int = 0
    gated: int = 0
    farthest_rad: float = 0.0
    first_backward_s: float | None = None
    short_dwells: int = 0
    least_settling_s: float = math.inf
    turned_deg: float = 0.0

    def sentences(self) -> list[str]:
        backward_s = self.first_backward_s or 0.0
        said = {
            "not_finite": "readings that were not finite (NaN or infinite), dropped: {}.",
            "too_large": f"readings beyond {LARGEST_MPS2:.0e} m/s^2, which nothing can read, dropped: {{}}.",
            "repeated": "readings that repeated the stamp before them, dropped: {}.",
            "backward": f"readings whose stamps jumped back (first at {backward_s:.3f} s), dropped: {{}}.",
            "leaping": "readings with a stamp far ahead of their neighbours, dropped: {}.",
            "without_pose": "readings with no platform angle within 1 s of them, dropped: {}.",
            "poses_dropped": f"angle messages not finite, beyond {LARGEST_RAD:.0e} rad, out of order of time or no "
            "unit quaternion, dropped: {}.",
            "temperatures_dropped": f"temperatures not finite or beyond {LARGEST_C:.0e} degC, dropped: {{}}.",
            "gated": "outlying readings (innovation gate), rejected: {}; --no-gate keeps them.",
        }
        return [text.format(getattr(self, key)) for key, text in said.items() if getattr(self, key)]

    def unmet(self, stillness: Stillness) -> list[str]:
        """What was asked for and could not be done, one sentence each."""
        said, one = list[str](), self.short_dwells == 1
        if self.short_dwells:
            said.append(
                f"{self.short_dwells} dwell{' is' if one else 's are'} too short to leave out {stillness.settle_s:g} s "
                f"after {'its' if one else 'each'} arrival (--settle-s): a third of {'it' if one else 'each'} was left "
                f"out, {'' if one else 'of the shortest '}{self.least_settling_s:.3g} s."
            )
        if self.turned_deg > _TURNING_DEG:
            said.append(
                f"the platform turns by {self.turned_deg:.3g} deg in what counts as standing still (--still-deg "
                f"{stillness.tolerance_deg:g}): where that is a slew, lower --still-deg."
            )
        return said


def within(values: Floats, largest: float) -> Mask | None:
    """Which rows (m, k) hold nothing that is not finite or beyond ``largest``; None: all of them."""
    size = np.abs(values)
    return None if size.max(initial=0.0) <= largest else np.asarray((size <= largest).all(axis=1))
