"""Programs that correct by a full matrix and, most of them, an offset, from imucal to VectorNav."""

from __future__ import annotations

import json
import math
from functools import reduce
from operator import xor

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.raw_input import CHANNELS, PLAIN
from kf_calib.errors import InputError
from kf_calib.exchange.exports.affine import AffineTarget


class Imucal(AffineTarget):
    """imucal (mad-lab-fau): JSON that ``CalibrationInfo.from_json_file`` reads, of format version 2.0.0.

        f = R_a^-1 K_a^-1 (reading - b_a)

    Bias first, then scale factors, then alignment (imucal/ferraris_calibration_info.py, ``_calibrate_acc``). Units:
    m/s^2. imucal needs matrices of a gyroscope, too: they leave it as it is, and its unit is not stated.
    """

    title = "imucal"

    def text(self) -> str:
        sensitivity = np.linalg.inv(self.affine.matrix)
        scale = np.linalg.norm(sensitivity, axis=1)
        none, same = np.zeros((3, 3)), np.eye(3)
        matrices = {"K_a": np.diag(scale), "R_a": sensitivity / scale[:, None], "b_a": self.affine.offset,
                    "K_g": same, "R_g": same, "K_ga": none, "b_g": none[0]}  # fmt: skip
        matrices = {name: own.tolist() for name, own in matrices.items()}
        units = {"acc_unit": "m/s^2", "gyr_unit": None, "from_acc_unit": self._unit, "from_gyr_unit": None}
        content = units | {"comment": f"{self.origin}; {self.takes}"} | matrices
        return json.dumps(content | {"cal_type": "Ferraris", "_format_version": "2.0.0"}, indent=4) + "\n"

    @property
    def _unit(self) -> str:
        """What raw readings are in, for imucal to compare with what it is called with."""
        return self.input.unit_words if self.input.sizes == PLAIN.sizes else "counts"


class ImuCalib(AffineTarget):
    """imu_calib (dpkoch, ROS): YAML that the node ``apply_calib`` reads.

        f = SM reading - bias

    Matrix first, then the bias, which so is in units of specific force, not of readings
    (src/accel_calib/accel_calib.cpp, ``applyCalib``). SM: nine numbers row by row. Units: m/s^2.
    """

    title = "imu_calib"

    def text(self) -> str:
        matrix = self.affine.matrix
        bias = matrix @ self.affine.offset
        return "\n".join([*self.heading, f"SM: {matrix.ravel().tolist()}", f"bias: {bias.tolist()}", ""])


class Kalibr(AffineTarget):
    """Kalibr: the accelerometers of ``imu.yaml``, model scale-misalignment.

        reading = M f + bias(t),   f = M^-1 (reading - bias(t))

    The file has no place for the bias: who reads it estimates it (kalibr_imu_camera_calibration/IccSensors.py,
    ``IccScaledMisalignedImu``). Kalibr turns its frame so that M is lower triangular; here M is full, and f in the
    frame of the block. Units: none. Noise and gyroscopes, of which a calibration knows nothing, are to be added.
    """

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


class OpenVins(AffineTarget):
    """OpenVINS: Ta and R_IMUtoACC of ``kalibr_imu_chain.yaml``, model kalibr.

        f = R_IMUtoACC^T Ta^-1 (reading - bias)

    Of Ta^-1 OpenVINS keeps the lower triangle (VioManagerOptions.h), hence the rotation: S^-1 = Q L, Ta = L^-1,
    R_IMUtoACC = Q^T. The bias is a state of its filter, which begins at zero: the file has no place for it
    (Propagator.cpp: ``a_hat = R_ACCtoIMU * Da * (am - bias_a)``). Units: none. Noise and gyroscopes, of which a
    calibration knows nothing, are to be added.
    """

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


_LEAST = 0.1


class ImuTk(AffineTarget):
    """imu_tk: a ``.calib`` file of the accelerometers.

        f = T K (reading - B)

    Bias first, then scale factors, then alignment (include/imu_tk/calibration.h, ``unbiasNormalize``). T has ones
    on its diagonal, K is diagonal; each is three rows, then B, a number a row. Units: m/s^2.
    """

    title = "imu_tk"

    @property
    def folds(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """It has a sign and a size for each channel, and no place for another order."""
        return tuple(map(abs, self.correction.input.channels)) == CHANNELS

    def text(self) -> str:
        matrix = self.affine.matrix
        scale = np.diag(matrix)
        if (np.abs(scale) / np.linalg.norm(matrix, axis=1)).min() < _LEAST:
            raise InputError("imu_tk takes accelerometers 1, 2 and 3 for x, y and z, which these are not: export to "
                             "imu_calib, or state --channels in the calibrating run.")  # fmt: skip
        blocks = [matrix / scale, np.diag(scale), self.affine.offset[:, None]]
        return "\n".join("".join(" ".join(map(repr, row)) + "\n" for row in block.tolist()) for block in blocks)


def _decimal(number: float) -> str:
    """The number without an exponent, to nine decimals or, where it is small, nine digits."""
    exponent = math.floor(math.log10(abs(number))) if number else 0
    return f"{number:.{max(9, 8 - exponent)}f}"


class VectorNav(AffineTarget):
    """VectorNav: the command that writes register 25, acceleration compensation.

        f = C (reading - B)

    Bias first, then the matrix, row by row (VN-100 user manual, "Acceleration Compensation"). Units: m/s^2. It
    comes on top of the calibration of the factory, so the readings that are calibrated must be those with register
    25 at its default. The register holds reals of 32 bits. The sensor keeps it over a restart after $VNWNV*57.
    """

    title = "VectorNav"

    def text(self) -> str:
        numbers = [*self.affine.matrix.ravel(), *self.affine.offset]
        command = ",".join(["VNWRG", "25", *map(_decimal, numbers)])
        return f"${command}*{reduce(xor, command.encode()):02X}\r\n"
