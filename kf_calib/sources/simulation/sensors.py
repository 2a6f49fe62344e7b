"""True accelerometers of the simulator: the paper's twelve parameters, grades to draw them from, and their noise.

Reading i = K_i E_i . f + b_i (M. D. Grebenkin, Vestnik MEPhI 8(3), 2019, eq. 1-6), with unit vectors E_i made by
turning the platform's axes, apart from any formula of the estimator.

Noise is made by processes that stream, and go on over dwells and batches without a seam. Every coloured noise is a sum
of first-order processes ``y_n = phi y_(n-1) + s w_n``, w white with variance 1: white noise, AR(1), 1/f (many time
constants) and the random walk (phi = 1). Each has a generator of its own, so what it yields does not depend on how the
samples are cut into batches, nor on which other noises are on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from kf_calib.bench.arrays import Floats
from kf_calib.errors import InputError

Process = Callable[[int], Floats]
"""The next n values of a noise of the three accelerometers, (n, 3) m/s^2."""

_FLICKER_RATIO = 4.0


@dataclass(frozen=True)
class TrueNoise:
    """What disturbs readings and angles. All are 1 sigma and independent between accelerometers and axes; 0: absent.

    white_mps2: noise of a reading; with ``ar1_phi`` an AR(1) process of that correlation from sample to sample and the
        same sigma.
    flicker_mps2: 1/f noise, one-sided density h/f, by the floor of its Allan deviation, sqrt(2 ln 2 h) (IEEE 952).
    walk_mps2_per_sqrt_s: random walk of each bias, starting from zero.
    scatter_mps2: constant offset of each accelerometer in each dwell.
    setting_sigma_deg: small rotation of the whole platform in each dwell, per axis, that the encoders do not see.
    encoder_sigma_deg, encoder_step_deg: noise and resolution of an encoder reading; they do not move the platform.
    outlier_rate, outlier_mps2: probability that a reading jumps, and by how much (either sign).
    vibration_mps2: added noise of the readings while the platform moves.
    """

    white_mps2: float = 0.0
    ar1_phi: float = 0.0
    flicker_mps2: float = 0.0
    walk_mps2_per_sqrt_s: float = 0.0
    scatter_mps2: float = 0.0
    setting_sigma_deg: float = 0.0
    encoder_sigma_deg: float = 0.0
    encoder_step_deg: float = 0.0
    outlier_rate: float = 0.0
    outlier_mps2: float = 0.0
    vibration_mps2: float = 0.0

    def __post_init__(self) -> None:
        for name in (item.name for item in fields(self)):
            value = getattr(self, name)
            if not 0.0 <= value < math.inf:
                raise InputError(f"{name} is {value:g}: give a noise as zero or a positive number.")
        if self.ar1_phi >= 1.0 or self.outlier_rate > 1.0:
            raise InputError("ar1_phi must be below 1 and outlier_rate at most 1: give them so.")

    def dwell_sigma_mps2(self, dwells: int) -> float:
        """By how much the means of so many dwells scatter, however long they are: of flicker, by h ln(dwells)."""
        flicker = self.flicker_mps2**2 * max(math.log(dwells) / (2.0 * math.log(2.0)), 1.0)
        return math.sqrt(self.scatter_mps2**2 + flicker)

    def processes(self, seed: int, period_s: float, duration_s: float) -> list[Process]:
        """The processes to be added to readings every ``period_s`` over ``duration_s``, fresh from their start."""
        processes = list[Process]()
        if self.white_mps2:
            step = self.white_mps2 * math.sqrt(1.0 - self.ar1_phi**2)
            processes.append(FirstOrder(generator(seed, "white"), self.ar1_phi, step, self.white_mps2))
        if self.flicker_mps2:
            processes += flicker(seed, self.flicker_mps2, period_s, duration_s)
        if self.walk_mps2_per_sqrt_s:
            step = self.walk_mps2_per_sqrt_s * math.sqrt(period_s)
            processes.append(FirstOrder(generator(seed, "walk"), 1.0, step, 0.0))
        if self.outlier_rate and self.outlier_mps2:
            processes.append(OutlierProcess(generator(seed, "outliers"), self.outlier_rate, self.outlier_mps2))
        return processes


class FirstOrder:
    """y_n = phi y_(n-1) + step_sigma w_n for three accelerometers; y before the first sample has ``start_sigma``."""

    def __init__(self, rng: np.random.Generator, phi: float, step_sigma: float, start_sigma: float) -> None:
        self._rng, self._phi, self._step_sigma = rng, phi, step_sigma
        self._carried = phi * start_sigma * rng.standard_normal((1, 3))

    def __call__(self, count: int) -> Floats:
        drive = self._step_sigma * self._rng.standard_normal((count, 3))
        if self._phi == 0.0:
            return drive
        from scipy.signal import lfilter  # takes 0.4 s to load, which white noise need not wait for

        values, self._carried = lfilter([1.0], [1.0, -self._phi], drive, axis=0, zi=self._carried)
        return values


class OutlierProcess:
    """Jumps by ``size_mps2``, either sign, of single readings with probability ``rate``."""

    def __init__(self, rng: np.random.Generator, rate: float, size_mps2: float) -> None:
        self._rng, self._rate, self._size_mps2 = rng, rate, size_mps2

    def __call__(self, count: int) -> Floats:
        chance = self._rng.random((count, 3)) / self._rate  # below 1: a jump, and its half says which way
        return self._size_mps2 * np.where(chance < 1.0, np.where(chance < 0.5, -1.0, 1.0), 0.0)


def flicker(seed: int, floor_mps2: float, period_s: float, duration_s: float) -> list[Process]:
    """1/f noise as a sum of Ornstein-Uhlenbeck processes, their time constants a factor r = 4 apart.

    From one sample to the whole run; the variance of each is v = h ln r = floor^2 ln r / (2 ln 2), because
    sum_k 4 v tau_k / (1 + (2 pi f tau_k)^2) = v / (f ln r) within 0.4 % between the corners.
    """
    sigma = floor_mps2 * math.sqrt(math.log(_FLICKER_RATIO) / (2.0 * math.log(2.0)))
    count = 1 + max(0, math.floor(math.log(duration_s / period_s, _FLICKER_RATIO)))
    phis = [math.exp(-(_FLICKER_RATIO**-k)) for k in range(count)]
    return [
        FirstOrder(generator(seed, f"flicker {k}"), phi, sigma * math.sqrt(1.0 - phi**2), sigma)
        for k, phi in enumerate(phis)
    ]


def generator(seed: int, quantity: str) -> np.random.Generator:
    """The random numbers of one quantity: independent of those of any other quantity under the same seed."""
    return np.random.default_rng([seed, *quantity.encode()])


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
