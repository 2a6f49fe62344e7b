"""imucal (mad-lab-fau): JSON that ``CalibrationInfo.from_json_file`` reads, of format version 2.0.0.

    f = R_a^-1 K_a^-1 (reading - b_a)

Bias first, then scale factors, then alignment (imucal/ferraris_calibration_info.py, ``_calibrate_acc``). Units: m/s^2.
imucal needs matrices of a gyroscope, too: they leave it as it is, and its unit is not stated.
"""

from __future__ import annotations

import json

import numpy as np

from kf_calib.bench.raw_input import PLAIN
from kf_calib.exchange.exports.affine import AffineTarget


class Imucal(AffineTarget):
    """Matrix and offset; K_a are the scale factors, the rows of R_a the input axes."""

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
