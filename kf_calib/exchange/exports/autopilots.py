"""Autopilots, which correct axis by axis: PX4 and ArduPilot, with a cubic of the temperature."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from kf_calib.errors import InputError
from kf_calib.exchange.exports.affine import AffineTarget

_LEAST_CHANGE = 0.01


class Px4(AffineTarget):
    """PX4: parameters of an accelerometer, as QGroundControl loads them.

        f = R ((reading - thermal(T) - CAL_ACC0_{X,Y,Z}OFF) * CAL_ACC0_{X,Y,Z}SCALE)

    Offset first, then scale, axis by axis; R, the rotation of the sensor and the board, comes after and is left as
    it is (src/lib/sensor_calibration/Accelerometer.hpp, ``Correct``). thermal(T) = X0 + X1 u + X2 u^2 + X3 u^3, u =
    T - TREF, T held within TMIN and TMAX (src/modules/temperature_compensation). Units: m/s^2, degC. A line is
    vehicle, component, name, value, type (6: whole number, 9: real of 32 bits), with tabulators between.
    """

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


_RANGES = {"OFFS": (-3.5, 3.5, "m/s^2"), "SCAL": (0.8, 1.2, "")}


class ArduPilot(AffineTarget):
    """ArduPilot: parameters of an accelerometer, as Mission Planner, MAVProxy and QGroundControl load them
    (NAME,VALUE).

        f = R ((reading - (p(T) - p(CALTEMP)) - INS_ACCOFFS_{X,Y,Z}) * INS_ACCSCAL_{X,Y,Z})

    Temperature first, then offset, then scale, axis by axis; R, the rotation of the board, comes after and is left
    as it is (libraries/AP_InertialSensor: ``_rotate_and_correct_accel``, ``TCal::correct_sensor``). p(T) = 1e-6
    (ACC1 u + ACC2 u^2 + ACC3 u^3), u = T - 35 degC, T and CALTEMP held within TMIN and TMAX. Units: m/s^2, degC.
    ArduPilot takes offsets of up to 3.5 m/s^2 either way, and scale factors from 0.8 to 1.2.
    """

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
