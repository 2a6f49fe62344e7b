"""Kalibr: the accelerometers of ``imu.yaml``, model scale-misalignment.

    reading = M f + bias(t),   f = M^-1 (reading - bias(t))

The file has no place for the bias: who reads it estimates it (kalibr_imu_camera_calibration/IccSensors.py,
``IccScaledMisalignedImu``). Kalibr turns its frame so that M is lower triangular; here M is full, and f in the frame of
the block. Units: none. Noise and gyroscopes, of which a calibration knows nothing, are to be added.
"""

from __future__ import annotations

import numpy as np

from kf_calib.exchange.exports.affine import AffineTarget


class Kalibr(AffineTarget):
    """Matrix, no offset."""

    title, bias = "Kalibr", False

    def text(self) -> str:
        rows = np.linalg.inv(self.affine.matrix).tolist()
        lines = [
            f"# {self.origin}.",
            f"# It {self.takes}.",
            "imu0:",
            "  accelerometers:",
            "    M:",
            *(f"    - {row}" for row in rows),
        ]
        return "\n".join([*lines, "  model: scale-misalignment", ""])
