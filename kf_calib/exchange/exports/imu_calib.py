"""imu_calib (dpkoch, ROS): YAML that the node ``apply_calib`` reads.

    f = SM reading - bias

Matrix first, then the bias, which so is in units of specific force, not of readings (src/accel_calib/accel_calib.cpp,
``applyCalib``). SM: nine numbers row by row. Units: m/s^2.
"""

from __future__ import annotations

from kf_calib.exchange.exports.affine import AffineTarget


class ImuCalib(AffineTarget):
    """Matrix and offset."""

    title = "imu_calib"

    def text(self) -> str:
        matrix = self.affine.matrix
        bias = matrix @ self.affine.offset
        return "\n".join([*self.heading, f"SM: {matrix.ravel().tolist()}", f"bias: {bias.tolist()}", ""])
