"""True accelerometers of the simulator: the paper's twelve parameters, and grades to draw them from.

Reading i = K_i E_i . f + b_i (M. D. Grebenkin, Vestnik MEPhI 8(3), 2019, eq. 1-6), with unit vectors E_i made by
turning the platform's axes, apart from any formula of the estimator.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from kf_calib.bench.arrays import Floats
from kf_calib.errors import InputError
from kf_calib.sources.simulation.noise_processes import TrueNoise, generator

SENSOR_SYMBOLS = ("theta1", "phi1", "K1", "b1", "nu1", "nu2", "K2", "b2", "theta3", "phi3", "K3", "b3")
NOMINAL: Mapping[str, float] = {
    "theta1": math.radians(0.5), "phi1": 0.0, "K1": 1.0, "b1": 0.0,
    "nu1": 0.0, "nu2": 0.0, "K2": 1.0, "b2": 0.0,
    "theta3": math.radians(0.5), "phi3": math.radians(-90.0), "K3": 1.0, "b3": 0.0,
}  # fmt: skip
"""The paper's nominal parameters; rad, 1, m/s^2."""


@dataclass(frozen=True)
class Sensors:
    """True parameters of the three accelerometers, by symbol (rad, 1, m/s^2); those left out are nominal."""

    parameters: Mapping[str, float] = field(default_factory=dict[str, float])

    def __post_init__(self) -> None:
        unknown = sorted(set(self.parameters) - set(SENSOR_SYMBOLS))
        if unknown:
            raise InputError(f"{unknown[0]!r} is no parameter of the accelerometers: use {', '.join(SENSOR_SYMBOLS)}.")
        object.__setattr__(self, "parameters", {**NOMINAL, **self.parameters})

    @property
    def sensitivities(self) -> Floats:
        """Rows K_i E_i (3, 3)."""
        return self.scales[:, None] * self.input_axes

    @cached_property
    def input_axes(self) -> Floats:
        """Rows E_i (3, 3).

        E_1 and E_3 are the platform's x axis raised by theta toward y (a turn about z), then turned by phi about y;
        E_2 is y leaning so that its parts along x and z are sin nu1 and -sin nu2.
        """
        p = self.parameters
        lean_x, lean_z = math.sin(p["nu1"]), -math.sin(p["nu2"])
        second = np.array([lean_x, math.sqrt(1.0 - lean_x**2 - lean_z**2), lean_z])
        first, third = _raised_and_turned(p["theta1"], p["phi1"]), _raised_and_turned(p["theta3"], p["phi3"])
        axes = np.array([first, second, third])
        axes.setflags(write=False)
        return axes

    @property
    def scales(self) -> Floats:
        return np.array([self.parameters[f"K{i}"] for i in (1, 2, 3)])

    @property
    def biases_mps2(self) -> Floats:
        return np.array([self.parameters[f"b{i}"] for i in (1, 2, 3)])


def _raised_and_turned(theta_rad: float, phi_rad: float) -> Floats:
    raised = Rotation.from_rotvec([0.0, 0.0, theta_rad]).apply([1.0, 0.0, 0.0])
    return Rotation.from_rotvec([0.0, phi_rad, 0.0]).apply(raised)


@dataclass(frozen=True)
class SimulatedGrade:
    """What sensors of one grade are like: deviations from nominal, 1 sigma of a normal law, and noise.

    fixed: every deviation is exactly the figure given, as in the paper's Table 1.
    """

    angle_rad: float
    scale: float
    bias_mps2: float
    noise: TrueNoise
    fixed: bool = False

    def sensors(self, seed: int = 0) -> Sensors:
        """The sensors of this grade drawn with ``seed``."""
        draws = np.ones(12) if self.fixed else generator(seed, "sensors").standard_normal(12)
        sizes = (self.angle_rad, self.angle_rad, self.scale, self.bias_mps2) * 3
        pairs = zip(SENSOR_SYMBOLS, sizes * draws, strict=True)
        return Sensors({symbol: NOMINAL[symbol] + float(deviation) for symbol, deviation in pairs})


GRADES: Mapping[str, SimulatedGrade] = {
    "paper": SimulatedGrade(math.radians(30 / 3600), 5e-5, 5e-5, TrueNoise(white_mps2=1e-4), fixed=True),
    "navigation": SimulatedGrade(1e-3, 3e-4, 1e-3, TrueNoise(white_mps2=5e-5, vibration_mps2=5e-3)),
    "mems": SimulatedGrade(math.radians(3.0), 0.05, 0.5, TrueNoise(white_mps2=0.02, vibration_mps2=0.05)),
}
"""The paper's Table 1; a quartz-flexure accelerometer (100 ug, 300 ppm, 1 mrad); a consumer chip (50 mg, 5 %, 3 deg).
The noise is what every reading has; flicker, scatter and the positioner's errors are a run's: ``replace`` adds them.
"""
