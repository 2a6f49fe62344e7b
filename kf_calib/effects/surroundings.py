"""What the surroundings do to the sensors: magnetic fields, and temperature T, counted from the reference (25 degC)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.effects.effect import (
    MICRO_G,
    MILLI_G,
    Bearer,
    Coefficient,
    Effect,
    Regressor,
    SensorEffect,
    Typical,
    Unknown,
)
from kf_calib.effects.stimulus import Stimulus

_DIRECTIONS = 18
"""Directions of a field that are tried: every 10 degrees, opposite ones are the same."""


class Magnetic(Effect):
    """m_i B . E_i, B the local field: (m_i B_N) N . E_i + (m_i B_E) E . E_i, the products are fitted.

    The vertical part is along gravity, and so a scale factor.
    """

    family = "surroundings"
    name, title, source = "magnetic", "response to the local magnetic field", "IEEE Std 1293, magnetic sensitivity"
    confused_with = "needs turns about the vertical"
    typical = Typical((1 * 0.2 * MICRO_G, 20 * 0.2 * MICRO_G))  # 1 to 20 ug/G in a horizontal field of 0.2 G

    @property
    def relations(self) -> Sequence[Floats]:
        """All sensors are in one field: (m_i B_N, m_i B_E) = m_i B (cos a, sin a), its direction a is not known."""
        directions = np.linspace(0.0, np.pi, _DIRECTIONS, endpoint=False)
        return [np.kron(np.eye(3), [[np.cos(a)], [np.sin(a)]]).astype(float) for a in directions]

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return tuple(Coefficient(f"mB{part}{i}", "m/s^2", 1e-3) for i in (1, 2, 3) for part in "NE")

    def columns(self, s: Stimulus) -> Floats:
        columns = np.zeros((len(s), 3, 6))
        along = np.stack([s.to_platform(axis) for axis in s.level_axes], axis=2)  # (m, 3, 2)
        for i in range(3):
            columns[:, i, 2 * i : 2 * i + 2] = np.einsum("x,mxk->mk", s.axes[i], along)
        return columns


IEEE = "IEEE Std 1293, environmental sensitivities"
_TEMPERATURE = Regressor("T", "temperature less 25 °C", "K")


class ThermalBias(SensorEffect):
    """alpha T."""

    family = "temperature"
    name, title, source = "thermal-bias", "bias that follows the temperature", IEEE
    drawn_against = _TEMPERATURE
    formulas = ("T",)
    confused_with = "needs a temperature swing"
    symbol, unit, scale = "alpha", "m/s^2/K", 1e-3
    typical = Typical((5 * MICRO_G, 30 * MICRO_G), (0.15 * MILLI_G, 1 * MILLI_G))

    def terms(self, s: Stimulus) -> Floats:
        return np.repeat(s.warmth[:, None], 3, axis=1)


class ThermalBias2(SensorEffect):
    """alpha_2 T^2."""

    family = "temperature"
    name, title, source = "thermal-bias-2", "bias that follows the square of the temperature", IEEE
    drawn_against = _TEMPERATURE
    formulas = ("T**2",)
    symbol, unit, scale = "alpha2_", "m/s^2/K^2", 1e-4

    def terms(self, s: Stimulus) -> Floats:
        return np.repeat(s.warmth[:, None] ** 2, 3, axis=1)


class ThermalScale(SensorEffect):
    """alpha_s T a_i."""

    family = "temperature"
    name, title, source = "thermal-scale", "scale factor that follows the temperature", IEEE
    drawn_against = Regressor("T*a", "temperature less 25 °C, times force along the input axis", "K m/s^2")
    formulas = ("T*a",)
    confused_with = "needs both signs of the input at two temperatures"
    symbol, unit, scale = "alphaS", "1/K", 1e-4
    typical = Typical((50e-6, 150e-6))

    def terms(self, s: Stimulus) -> Floats:
        return s.warmth[:, None] * s.along


class ThermalRate(SensorEffect):
    """kappa dT/dt."""

    family = "temperature"
    name, title, source = "thermal-rate", "bias that follows the rate of the temperature", IEEE
    drawn_against = Regressor("dT")
    confused_with = "warm-up"
    symbol, unit, scale = "kappaT", "m s^-1/K", 1e-1
    typical = Typical((1 * 60 * MICRO_G, 50 * 60 * MICRO_G))

    def terms(self, s: Stimulus) -> Floats:
        return np.repeat(s.warming[:, None], 3, axis=1)


class ThermalMisalignment(Effect):
    """gamma_p T a_p + gamma_o T a_o."""

    family = "temperature"
    name, title, source = "thermal-misalignment", "alignment that follows the temperature", IEEE
    borne_by = Bearer.SENSORS
    formulas = ("T*p", "T*o")
    typical = Typical((0.1e-6, 10e-6))

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return tuple(Coefficient(f"gamma{axis}{i}", "rad/K", 1e-5) for i in (1, 2, 3) for axis in ("P", "O"))

    def columns(self, s: Stimulus) -> Floats:
        columns = np.zeros((len(s), 3, 6))
        for i in range(3):
            columns[:, i, 2 * i] = s.warmth * s.pendulous[:, i]
            columns[:, i, 2 * i + 1] = s.warmth * s.output[:, i]
        return columns


class ThermalLag(SensorEffect):
    """alpha L, tau dL/dt = T - L: the sensor follows the thermometer late, in balance at the first sample."""

    family = "temperature"
    name, title, source = "thermal-lag", "bias that follows the temperature late", IEEE
    drawn_against = _TEMPERATURE
    confused_with = "thermal-bias and thermal-rate together"
    symbol, unit, scale = "alphaL", "m/s^2/K", 1e-3
    typical = ThermalBias.typical
    unknown = Unknown("tauLag", "s", 30.0, 7200.0, "min", 1.0 / 60.0)

    def __init__(self) -> None:
        self.value = 600.0

    def terms(self, s: Stimulus) -> Floats:
        return np.repeat(s.lagged_warmth(self.value)[:, None], 3, axis=1)
