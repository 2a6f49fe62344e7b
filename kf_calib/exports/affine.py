"""Programs that correct by a matrix, an offset and, some of them, a cubic of the temperature.

    f = matrix (reading - offset - drift(T)),   drift(T) = drift_1 u + drift_2 u^2 + drift_3 u^3,   u = T - reference

The numbers are those with the least rms error over all directions of gravity and all temperatures of the run. Where
the program can hold all of the calibration, this error is zero, and they are those of the calibration.

Autopilots correct axis by axis; the others have a full matrix. Each class has the formula of its program.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, reduce
from operator import xor
from typing import ClassVar

import numpy as np
from numpy.polynomial import Polynomial

from kf_calib.bench.arrays import Floats
from kf_calib.bench.raw_input import CHANNELS, PLAIN
from kf_calib.effects import Effect
from kf_calib.effects.inputs import stimulus_of
from kf_calib.effects.stimulus import REFERENCE_TEMPERATURE_C
from kf_calib.errors import InputError
from kf_calib.exports.target import Target

_SAME = 1e-9
_POWERS = 3


@dataclass(frozen=True, eq=False)
class Affine:
    """matrix (3, 3), m/s^2 a unit of what is read; offset (3,) in that unit; drift (powers, 3): coefficients of u, u^2
    ...; none where there is no drift."""

    matrix: Floats
    offset: Floats
    drift: Floats
    reference_c: float

    def __call__(self, readings_mps2: Floats, temperature_c: Floats) -> Floats:
        return (readings_mps2 - self.offset - self.drift_at(temperature_c)) @ self.matrix.T

    def drift_at(self, temperature_c: Floats | float) -> Floats:
        """The drift (n, 3) at temperatures (n,)."""
        u = np.atleast_1d(temperature_c)[:, None] - self.reference_c
        return np.hstack([u ** (k + 1) for k in range(len(self.drift))] or [np.zeros((len(u), 0))]) @ self.drift


class AffineTarget(Target):
    """diagonal: the matrix is. bias: it holds an offset. thermal: it holds a drift, about ``reference_c``."""

    diagonal: ClassVar[bool] = False
    bias: ClassVar[bool] = True
    thermal: ClassVar[bool] = False
    reference_c: ClassVar[float] = REFERENCE_TEMPERATURE_C

    @cached_property
    def affine(self) -> Affine:
        """The numbers that the program is given: they turn raw readings into specific force, where it folds."""
        of_readings = self._of_readings
        if self.input.is_plain:
            return of_readings
        a = self.input.matrix
        inverse = np.asarray(np.linalg.inv(a), float)
        return Affine(
            of_readings.matrix @ a, inverse @ of_readings.offset, of_readings.drift @ inverse.T, of_readings.reference_c
        )

    @cached_property
    def _of_readings(self) -> Affine:
        """The numbers that turn readings in m/s^2 into specific force."""
        fitted = self._fitted
        return fitted if self.bias else Affine(fitted.matrix, np.zeros(3), fitted.drift, fitted.reference_c)

    def corrected(self, readings_mps2: Floats, temperature_c: Floats) -> Floats:
        return self._of_readings(readings_mps2, temperature_c)

    @property
    def lost(self) -> tuple[str, ...]:
        sensitivity = self.correction.sensitivity
        turned = bool((sensitivity != np.diag(np.diag(sensitivity))).any())
        return (
            *(["alignment"] if self.diagonal and turned else []),
            *(["bias"] if not self.bias and self.correction.bias_mps2.any() else []),
            *(str(effect) for effect in self.correction.effects if not self._holds(effect)),
        )

    @property
    def drifts(self) -> bool:
        """Whether the calibration has a drift with the temperature that the program is to hold."""
        grid = self.grid
        return self.thermal and grid.high_c > grid.low_c and bool(self.correction.needs_temperature)

    @property
    def _powers(self) -> Floats:
        """1 and, where there is a drift, the powers of the temperature from -1 to 1 over its range: (n, 1 or 4)."""
        grid = self.grid
        if not self.drifts:
            return np.ones((len(grid.force_mps2), 1))
        half = 0.5 * (grid.high_c - grid.low_c)
        return np.vander((grid.temperature_c - grid.low_c) / half - 1.0, _POWERS + 1, increasing=True)

    def _holds(self, effect: Effect) -> bool:
        """Whether matrix, offset and drift are enough for an effect: its columns are made of their terms."""
        if str(effect) in self.correction.needs_temperature and not self.drifts:
            return False
        grid = self.grid
        terms = self._powers if self.diagonal else np.hstack([self._powers, grid.force_mps2])
        stimulus = stimulus_of(grid.force_mps2, grid.temperature_c, self.correction.bench, self.correction.sensitivity)
        columns = effect.columns(stimulus).reshape(len(terms), -1)
        left = columns - terms @ np.linalg.lstsq(terms, columns, rcond=None)[0]
        return bool(np.abs(left).max() <= _SAME * np.abs(columns).max())

    @cached_property
    def _fitted(self) -> Affine:
        """Least squares: specific force along each axis by the readings, 1 and the powers of the temperature."""
        grid, powers = self.grid, self._powers
        readings = self.correction.predicted(grid.force_mps2, grid.temperature_c)
        matrix, rest = np.zeros((3, 3)), np.empty((powers.shape[1], 3))
        root = np.sqrt(grid.weight)[:, None]
        for i in range(3):
            used = [i] if self.diagonal else [0, 1, 2]
            design = np.hstack([readings[:, used], powers])
            found = np.linalg.lstsq(root * design, root[:, 0] * grid.force_mps2[:, i], rcond=None)[0]
            matrix[i, used], rest[:, i] = found[: len(used)], found[len(used) :]
        subtracted = -rest @ np.linalg.inv(matrix).T
        about = self._about_reference(subtracted)
        return Affine(matrix, about[0], about[1:], self.reference_c)

    def _about_reference(self, coefficients: Floats) -> Floats:
        """Return polynomials (powers, 3) of the temperature from -1 to 1 as such of u."""
        if len(coefficients) == 1:
            return coefficients
        grid = self.grid
        half = 0.5 * (grid.high_c - grid.low_c)
        scaled = Polynomial([(self.reference_c - grid.low_c) / half - 1.0, 1.0 / half])
        found = [Polynomial(own)(scaled).coef for own in coefficients.T]
        return np.array([np.pad(each, (0, _POWERS + 1 - len(each))) for each in found], float).T


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
    frame of the block. Units: none. Noise is in it where ``noise`` is given; the gyroscopes are to be added.
    """

    title, bias = "Kalibr", False

    def text(self) -> str:
        rows = [f"    - {row}" for row in np.linalg.inv(self.affine.matrix).tolist()]
        matrix = ["imu0:", "  accelerometers:", "    M:", *rows, "  model: scale-misalignment"]
        return "\n".join([*self.heading, *matrix, *self.noise_in_yaml, ""])


class OpenVins(AffineTarget):
    """OpenVINS: Ta and R_IMUtoACC of ``kalibr_imu_chain.yaml``, model kalibr.

        f = R_IMUtoACC^T Ta^-1 (reading - bias)

    Of Ta^-1 OpenVINS keeps the lower triangle (VioManagerOptions.h), hence the rotation: S^-1 = Q L, Ta = L^-1,
    R_IMUtoACC = Q^T. The bias is a state of its filter, which begins at zero: the file has no place for it
    (Propagator.cpp: ``a_hat = R_ACCtoIMU * Da * (am - bias_a)``). Units: none. Noise is in it
    where ``noise`` is given; the gyroscopes are to be added.
    """

    title, bias = "OpenVINS", False

    def text(self) -> str:
        rotation, lower = rotation_and_lower(self.affine.matrix)
        matrices = {"Ta": np.tril(np.linalg.inv(lower)), "R_IMUtoACC": rotation.T}
        lines = [
            line for name, own in matrices.items() for line in (f"  {name}:", *(f"    - {r}" for r in own.tolist()))
        ]
        head = ["%YAML:1.0", *self.heading, "imu0:", '  model: "kalibr"']
        return "\n".join([*head, *lines, *self.noise_in_yaml, ""])


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
        return "\n".join([*head, *lines, *(self.noise.parameter_lines if self.noise else []), ""])

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
