"""The posterior of a dwell's setting error."""

from __future__ import annotations

from dataclasses import dataclass

from kf_calib.bench.arrays import Floats


@dataclass(frozen=True)
class AttitudeError:
    """What the readings show of a dwell's setting error: the small rotation alpha from its recorded pose to its true
    one.

    - rotation_rad (3,): the rotation vector across the force at which the dwell is linearised.
    - variance_rad2: sum of the variances of its two components across the force, which shorten the mean of the force:
      E[R(alpha) f] = (1 - variance / 2) R(mode) f.
    - bending (3, 3): derivative of the mean readings by the force that is due to the model's effects, m/s^2 per m/s^2;
      it adds to the sensitivities through which a small rotation changes the readings.
    """

    rotation_rad: Floats
    variance_rad2: float = 0.0
    bending: Floats | None = None

    @property
    def length(self) -> float:
        """Length of the mean force over that of the force."""
        return 1.0 - 0.5 * self.variance_rad2
