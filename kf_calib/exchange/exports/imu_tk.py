"""imu_tk: a ``.calib`` file of the accelerometers.

    f = T K (reading - B)

Bias first, then scale factors, then alignment (include/imu_tk/calibration.h, ``unbiasNormalize``). T has ones on its
diagonal, K is diagonal; each is three rows, then B, a number a row. Units: m/s^2.
"""

from __future__ import annotations

import numpy as np

from kf_calib.bench.raw_input import CHANNELS
from kf_calib.errors import InputError
from kf_calib.exchange.exports.affine import AffineTarget

_LEAST = 0.1


class ImuTk(AffineTarget):
    """Matrix and offset."""

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
