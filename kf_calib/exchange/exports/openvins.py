"""OpenVINS: Ta and R_IMUtoACC of ``kalibr_imu_chain.yaml``, model kalibr.

    f = R_IMUtoACC^T Ta^-1 (reading - bias)

Of Ta^-1 OpenVINS keeps the lower triangle (VioManagerOptions.h), hence the rotation: S^-1 = Q L, Ta = L^-1, R_IMUtoACC
= Q^T. The bias is a state of its filter, which begins at zero: the file has no place for it (Propagator.cpp: ``a_hat =
R_ACCtoIMU * Da * (am - bias_a)``). Units: none. Noise and gyroscopes, of which a calibration knows nothing, are to be
added.
"""

from __future__ import annotations

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.exchange.exports.affine import AffineTarget


class OpenVins(AffineTarget):
    """Lower triangular matrix and rotation, no offset."""

    title, bias = "OpenVINS", False

    def text(self) -> str:
        rotation, lower = rotation_and_lower(self.affine.matrix)
        matrices = {"Ta": np.tril(np.linalg.inv(lower)), "R_IMUtoACC": rotation.T}
        lines = [
            line for name, own in matrices.items() for line in (f"  {name}:", *(f"    - {r}" for r in own.tolist()))
        ]
        return "\n".join(["%YAML:1.0", *self.heading, "imu0:", '  model: "kalibr"', *lines, ""])


def rotation_and_lower(matrix: Floats) -> tuple[Floats, Floats]:
    """Q and L, of which the matrix is the product: a proper rotation, and a lower triangular matrix."""
    q, r = np.linalg.qr(matrix[:, ::-1])
    rotation, lower = q[:, ::-1], r[::-1, ::-1]
    sign = np.where(np.diag(lower) < 0.0, -1.0, 1.0)
    sign[0] *= np.linalg.det(rotation * sign)  # of mirrored axes one scale factor is negative
    sign = np.sign(sign)
    return rotation * sign, lower * sign[:, None]
