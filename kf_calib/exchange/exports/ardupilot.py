"""ArduPilot: parameters of an accelerometer, as Mission Planner, MAVProxy and QGroundControl load them (NAME,VALUE).

    f = R ((reading - (p(T) - p(CALTEMP)) - INS_ACCOFFS_{X,Y,Z}) * INS_ACCSCAL_{X,Y,Z})

Temperature first, then offset, then scale, axis by axis; R, the rotation of the board, comes after and is left as it is
(libraries/AP_InertialSensor: ``_rotate_and_correct_accel``, ``TCal::correct_sensor``). p(T) = 1e-6 (ACC1 u + ACC2 u^2 +
ACC3 u^3), u = T - 35 degC, T and CALTEMP held within TMIN and TMAX. Units: m/s^2, degC. ArduPilot takes offsets of up
to 3.5 m/s^2 either way, and scale factors from 0.8 to 1.2.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from kf_calib.errors import InputError
from kf_calib.exchange.exports.affine import AffineTarget

_RANGES = {"OFFS": (-3.5, 3.5, "m/s^2"), "SCAL": (0.8, 1.2, "")}


class ArduPilot(AffineTarget):
    """Diagonal matrix, offset, cubic of the temperature."""

    title, diagonal, thermal, folds = "ArduPilot", True, True, False
    reference_c: ClassVar[float] = 35.0

    def text(self) -> str:
        values = dict(self._values())
        for name, value in values.items():
            low, high, unit = _RANGES.get(name[7:11], (-np.inf, np.inf, ""))
            if not low <= value <= high:
                raise InputError(f"{name} would be {value:.3g}, and ArduPilot takes {low} to {high} {unit}".rstrip()
                                 + ": look for a wrong channel, sign or unit in the calibrating run.")  # fmt: skip
        return "\n".join([*self.heading, *(f"{name},{value:.9g}" for name, value in values.items()), ""])

    def _values(self) -> Iterator[tuple[str, float]]:
        affine, grid = self.affine, self.grid
        at_c = float(np.clip(affine.reference_c, grid.low_c, grid.high_c))
        offset = affine.offset + affine.drift_at(at_c)[0]
        for i, axis in enumerate("XYZ"):
            yield f"INS_ACCOFFS_{axis}", float(offset[i])
            yield f"INS_ACCSCAL_{axis}", float(affine.matrix[i, i])
        if not self.drifts:
            return
        yield from {"INS_ACC1_CALTEMP": at_c, "INS_TCAL1_ENABLE": 1, "INS_TCAL1_TMIN": grid.low_c,
                    "INS_TCAL1_TMAX": grid.high_c}.items()  # fmt: skip
        for k, own in enumerate(affine.drift):
            yield from ((f"INS_TCAL1_ACC{k + 1}_{axis}", 1e6 * float(own[i])) for i, axis in enumerate("XYZ"))
