"""What is known of the setting error of a dwell beyond its prior."""

from __future__ import annotations

from dataclasses import dataclass

from kf_calib.bench.arrays import Floats


@dataclass(frozen=True)
class AttitudeError:
    """What the readings show of a dwell's setting error, the rotation alpha by which it stands off its pose.

    - rotation_rad (3,): the rotation vector across the force at which the dwell is linearised.
    - variance_rad2: sum of the variances of its two components across the force, which shorten the mean of the force:
      E[R(alpha) f] = (1 - variance / 2) R(mode) f.
    - bending (3, 3): by how much the effects of the model change the mean readings per unit of the force, m/s^2 per
      m/s^2; it adds to the sensitivities by which a small rotation shows.
    """

    rotation_rad: Floats
    variance_rad2: float = 0.0
    bending: Floats | None = None

    @property
    def length(self) -> float:
        """Length of the mean force over that of the force."""
        return 1.0 - 0.5 * self.variance_rad2
