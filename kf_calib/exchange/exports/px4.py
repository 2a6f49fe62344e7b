"""PX4: parameters of an accelerometer, as QGroundControl loads them.

    f = R ((reading - thermal(T) - CAL_ACC0_{X,Y,Z}OFF) * CAL_ACC0_{X,Y,Z}SCALE)

Offset first, then scale, axis by axis; R, the rotation of the sensor and the board, comes after and is left as it is
(src/lib/sensor_calibration/Accelerometer.hpp, ``Correct``). thermal(T) = X0 + X1 u + X2 u^2 + X3 u^3, u = T - TREF,
T held within TMIN and TMAX (src/modules/temperature_compensation). Units: m/s^2, degC. A line is vehicle, component,
name, value, type (6: whole number, 9: real of 32 bits), with tabulators between.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from kf_calib.errors import InputError
from kf_calib.exchange.exports.affine import AffineTarget

_LEAST_CHANGE = 0.01


class Px4(AffineTarget):
    """Diagonal matrix, offset, cubic of the temperature."""

    title, diagonal, thermal, folds = "PX4", True, True, False

    def text(self) -> str:
        scale = np.diag(self.affine.matrix)
        if scale.min() <= 0.0:
            raise InputError(f"PX4 takes no scale factor of {scale.min():.3g}: state in --channels of the calibrating "
                             "run which channel is which accelerometer, with its sign.")  # fmt: skip
        lines = [f"1\t1\t{name}\t{value:.9g}\t{6 if isinstance(value, int) else 9}" for name, value in self._values()]
        head = [*self.heading, "# For the accelerometer whose device id is in CAL_ACC0_ID (and TC_A0_ID).",
                "#", "# Vehicle-Id Component-Id Name Value Type"]  # fmt: skip
        return "\n".join([*head, *lines, ""])

    @property
    def remarks(self) -> tuple[str, ...]:
        changes = self.affine.offset, np.diag(self.affine.matrix) - 1.0
        if min(np.linalg.norm(change) for change in changes) > _LEAST_CHANGE:
            return ()
        return (f"some releases of PX4 ignore offsets, or changes of scale factors, below {_LEAST_CHANGE} (length of "
                "the vector): look with its command sensors status whether they are in use",)  # fmt: skip

    def _values(self) -> Iterator[tuple[str, float]]:
        affine, grid = self.affine, self.grid
        for i, axis in enumerate("XYZ"):
            yield f"CAL_ACC0_{axis}OFF", float(affine.offset[i])
            yield f"CAL_ACC0_{axis}SCALE", float(affine.matrix[i, i])
        if not self.drifts:
            return
        yield "TC_A_ENABLE", 1
        yield from {"TC_A0_TMIN": grid.low_c, "TC_A0_TMAX": grid.high_c, "TC_A0_TREF": affine.reference_c}.items()
        for k, own in enumerate([np.zeros(3), *affine.drift]):
            yield from ((f"TC_A0_X{k}_{i}", float(value)) for i, value in enumerate(own))
