"""imucal (mad-lab-fau): JSON that ``CalibrationInfo.from_json_file`` reads, of format version 2.0.0.

    f = R_a^-1 K_a^-1 (reading - b_a)

Bias first, then scale factors, then alignment (imucal/ferraris_calibration_info.py, ``_calibrate_acc``). Units: m/s^2.
imucal needs matrices of a gyroscope, too: they leave it as it is, and its unit is not stated.
"""

from __future__ import annotations

import json

import numpy as np

from kf_calib.exchange.exports.affine import AffineTarget


class Imucal(AffineTarget):
    """Matrix and offset; K_a are the scale factors, the rows of R_a the input axes."""

    title = "imucal"

    def text(self) -> str:
        sensitivity = np.linalg.inv(self.affine.matrix)
        scale = np.linalg.norm(sensitivity, axis=1)
        none, same = np.zeros((3, 3)), np.eye(3)
        matrices = {"K_a": np.diag(scale), "R_a": sensitivity / scale[:, None], "b_a": self.affine.offset_mps2,
                    "K_g": same, "R_g": same, "K_ga": none, "b_g": none[0]}  # fmt: skip
        units = {"acc_unit": "m/s^2", "gyr_unit": None, "from_acc_unit": "m/s^2", "from_gyr_unit": None}
        content = units | {"comment": self.origin} | {name: each.tolist() for name, each in matrices.items()}
        return json.dumps(content | {"cal_type": "Ferraris", "_format_version": "2.0.0"}, indent=4) + "\n"
