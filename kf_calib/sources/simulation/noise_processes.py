"""Noise of the simulated bench: processes that stream, and go on over dwells and batches without a seam.

Every coloured noise is a sum of first-order processes ``y_n = phi y_(n-1) + s w_n``, w white with variance 1: white
noise, AR(1), 1/f (many time constants) and the random walk (phi = 1). Each has a generator of its own, so what it
yields does not depend on how the samples are cut into batches, nor on which other noises are on.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np

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
        for name in (field.name for field in fields(self)):
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
