"""What changes with time: drift and walk of the bias, warm-up, settling after a step, oscillation; and what the
surroundings do to the sensors: magnetic fields, and temperature T, counted from the reference (25 degC).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench.arrays import Floats, sign
from kf_calib.effects.effect import (
    MICRO_G,
    MILLI_G,
    PAIRS,
    Bearer,
    Coefficient,
    Effect,
    Regressor,
    SensorEffect,
    Typical,
    Unknown,
    of_each,
)
from kf_calib.effects.stimulus import Stimulus

_TIME, _STEP = Regressor("t", "time", "s"), Regressor("da", "last step along the input axis", "m/s^2")
_LEAST_STEP_MPS2 = 0.1 * MILLI_G  # less has either sign by noise of the angles and creep of the platform
_HELD = 2.5  # cycles in a piece, of which its parabola holds a fourteenth of the power


class BiasDrift(SensorEffect):
    """beta t, t since the first sample."""

    family = "bias in time"
    name, title, source = "bias-drift", "bias that drifts with time", "IEEE Std 1293, drift"
    on_data_sheet = "bias drift"
    drawn_against = _TIME
    formulas = ("t",)
    confused_with = "warm-up; a monotone order of poses mixes it with angle"
    symbol, unit, scale = "beta", "m/s^3", 1e-6
    typical = Typical((1 * MICRO_G / 3600, 10 * MICRO_G / 3600), (10 * MICRO_G / 60, MILLI_G / 60))


class ScaleDrift(SensorEffect):
    """kappa t a_i."""

    family = "scale in time"
    name, title, source = "scale-drift", "scale factor that drifts with time", "IEEE Std 1293, drift"
    on_data_sheet = "scale drift"
    drawn_against = Regressor("t*a", "time times force along the input axis", "m/s")
    formulas = ("t*a",)
    confused_with = "base-tilt-drift"
    symbol, unit, scale = "kappa", "1/s", 1e-7
    typical = Typical((1e-6 / 86400, 10e-6 / 86400), (0.0, 1e-2 / 3600))  # a chip that warms by 20 K, at 0.05 %/K


class Hysteresis(SensorEffect):
    """h sgn(Delta a_i), Delta a_i the last step that setting errors do not make."""

    family = "memory"
    name, title, source = "hysteresis", "reading that depends on the side it was come from", "IEEE Std 1293, hysteresis"
    on_data_sheet = "hysteresis"
    drawn_against = _STEP
    confused_with = "needs the same pose from two sides"
    symbol, unit, scale = "h", "m/s^2", 1e-3
    typical = Typical((1 * MICRO_G, 20 * MICRO_G), (0.0, 2 * MILLI_G))

    def terms(self, s: Stimulus) -> Floats:
        least_mps2 = max(_LEAST_STEP_MPS2, s.unsure_rad * s.bench.gravity_mps2)
        return sign(s.step, least_mps2)


class _Decay(SensorEffect):
    """Something that dies away with a time constant, common to the three accelerometers."""

    def __init__(self) -> None:
        assert self.unknown is not None
        self.value = float(np.sqrt(self.unknown.low * self.unknown.high))


class WarmUp(_Decay):
    """B exp(-t / tau), t since the first sample."""

    family = "bias in time"
    name, title, source = "warm-up", "bias that settles after switching on", "IEEE Std 1293, turn-on transient"
    drawn_against = _TIME
    formulas = ("exp(-t/constant)",)
    confused_with = "bias-drift; needs an early long dwell"
    symbol, unit, scale = "B", "m/s^2", 1e-2
    unknown = Unknown("tauWarm", "s", 5.0, 10800.0, "min", 1.0 / 60.0)
    typical = Typical((10 * MICRO_G, 200 * MICRO_G), (1 * MILLI_G, 10 * MILLI_G))

    def acts_for_s(self, s: Stimulus) -> float:
        return s.span_s


class ScaleWarmUp(WarmUp):
    """S exp(-t / tau) a_i, t since the first sample."""

    family = "scale in time"
    name, title = "scale-warm-up", "scale factor that settles after switching on"
    drawn_against = Regressor("", "force along the input axis, fading with the warm-up", "m/s^2")
    formulas = ("exp(-t/constant)*a",)
    confused_with = "scale-drift, warm-up; needs early orientations of both signs"
    symbol, unit, scale = "S", "1", 1e-3
    unknown = Unknown("tauScale", "s", 5.0, 10800.0, "min", 1.0 / 60.0)
    typical = Typical((1e-6, 100e-6), (0.1e-3, 10e-3))
    prior = 0.25  # in a run that is short beside its time constant it is a scale-drift, and cannot be told from it


class Settling(_Decay):
    """C Delta a_i exp(-tau / tau_0), tau since the arrival in the dwell, Delta a_i the last step of the input."""

    family = "memory"
    name, title, source = "settling", "creep after a change of the input", "IEEE Std 1293, settling"
    drawn_against = _STEP
    formulas = ("da*exp(-tau/constant)",)
    confused_with = "shows in early against late samples of a dwell"
    symbol, unit, scale = "C", "1", 1e-3
    unknown = Unknown("tauSettle", "s", 3.0, 600.0, "s", 1.0)
    typical = Typical((1e-6, 30e-6))

    def acts_for_s(self, s: Stimulus) -> float:
        return float(s.since_arrival_s.max())


class Memory(_Decay):
    """c (a_i - x), tau dx/dt = a_i - x: what came before is forgotten over several dwells; x begins at a_i."""

    family = "memory"
    name, title, source = "memory", "slow response to a change of the input", "anelastic relaxation; IEEE Std 1293"
    confused_with = "settling, which is over with the next step; bias-walk; needs the same pose after different ones"
    symbol, unit, scale = "c", "1", 1e-3
    drawn_against = Regressor("", "force along the input axis less what is remembered", "m/s^2")
    unknown = Unknown("tauMemory", "s", 3.0, 7200.0, "s", 1.0)
    typical = Typical((1e-6, 100e-6), (0.1e-3, 3e-3))

    def terms(self, s: Stimulus) -> Floats:
        return s.along - s.remembered(self.value)

    def acts_for_s(self, s: Stimulus) -> float:
        return s.span_s

    def log_share(self, s: Stimulus) -> float:
        dwell_s = float(s.since_arrival_s.max())  # what is forgotten within a dwell is a settling
        return super().log_share(s) + 4.0 * math.log(min(self.value / max(dwell_s, 1e-9), 1.0))


class Sinusoid(Effect):
    """A_i sin 2 pi f t + B_i cos 2 pi f t, t since the first sample; f is common to the three accelerometers.

    On a carrier f0, with d = 2 pi (f - f0) t: sin 2 pi f t = sin d cos 2 pi f0 t + cos d sin 2 pi f0 t, and the cosine
    likewise: the envelopes are slow where f is near f0, however fast the carrier.
    In a piece of a dwell it is the parabola nearest to it, so that one of a cycle or two a piece is still seen.
    """

    family = "surroundings"
    name, title, source = "sinusoid", "oscillation of one frequency", "Peterson, USGS OFR 93-322 (microseism); mains"
    drawn_against = _TIME
    confused_with = "slower than a dwell: bias-drift, thermal effects"
    unknown = Unknown("fSin", "Hz", 1e-6, 1e5, "Hz", 1.0)
    oscillates = True
    step = 1e-7  # the phase is thousands of rad
    value = 0.15
    typical = Typical((0.01 * MICRO_G, 1 * MICRO_G))
    symbols, unit, scale = tuple(f"{kind}{i}" for i in (1, 2, 3) for kind in ("As", "Ac")), "m/s^2", 1e-3
    bearers = PAIRS

    def columns(self, s: Stimulus) -> Floats:
        at_s, shares = s.about
        parts = np.stack(_parts(s, (shares * self._wave(s, at_s)).sum(axis=1)), axis=1)
        return of_each(np.repeat(parts[:, None], 3, axis=1))

    def derivative(self, s: Stimulus, coefficients: Floats) -> Floats:
        """A_i and B_i times the changes of sine and cosine per unit of ln f: d(e^(i d)) = 2 pi i f t e^(i d)."""
        at_s, shares = s.about
        changes = 2j * np.pi * self.value * (shares * at_s * self._wave(s, at_s)).sum(axis=1)
        return (coefficients.reshape(3, 2) @ np.array(_parts(s, changes))).T[:, :, None]

    def _wave(self, s: Stimulus, at_s: Floats) -> NDArray[np.complex128]:
        """e^(i d) at instants."""
        return np.exp(2j * np.pi * (self.value - s.carrier_hz) * at_s)

    def grid(self, s: Stimulus) -> Floats:
        """In quarters of 1/run, about the carrier; without one, as far as parabolas over the pieces hold much of it."""
        step = 0.25 / s.span_s
        if s.carrier_hz:
            count = int(np.ceil(max(0.15 / s.longest_piece_s, 2.0 / s.span_s) / step))
            found = s.carrier_hz + step * np.arange(-count, count + 1, dtype=float)
            return found[found > 0]
        return step * np.arange(2, int(np.clip(_HELD / s.usual_piece_s / step, 8, 4000)), dtype=float)

    def reach(self, s: Stimulus) -> float:
        return min(0.25 / s.span_s / self.value, 0.5)  # slower than the run: no step leads out of any range


def _parts(s: Stimulus, wave: NDArray[np.complex128]) -> tuple[Floats, Floats]:
    """Sine and cosine (m,) of a wave e^(i d), or what of them the stimulus asks for on a carrier."""
    sin, cos = wave.imag, wave.real
    if not s.carrier_hz:
        return sin, cos
    none = np.zeros_like(sin)
    return ((none, none), (sin, cos), (cos, -sin))[s.part]


class BiasWalk(Effect):
    """The integral of white noise in each bias: no column, but process noise of the filter."""

    family = "bias in time"
    name, title, source = "bias-walk", "bias that walks at random", "IEEE Std 1293, annex on Allan variance"
    drawn_against = _TIME
    borne_by = Bearer.SENSORS
    confused_with = "bias-drift; scatter from dwell to dwell"
    intensity = Coefficient("qb", "m/s^2/s^(1/2)", 1e-5)

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return ()

    def columns(self, s: Stimulus) -> Floats:
        return np.zeros((len(s), 3, 0))


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
    symbols, unit, scale = tuple(f"mB{part}{i}" for i in (1, 2, 3) for part in "NE"), "m/s^2", 1e-3

    @property
    def relations(self) -> Sequence[Floats]:
        """All sensors are in one field: (m_i B_N, m_i B_E) = m_i B (cos a, sin a), its direction a is not known."""
        directions = np.linspace(0.0, np.pi, _DIRECTIONS, endpoint=False)
        return [np.kron(np.eye(3), [[np.cos(a)], [np.sin(a)]]).astype(float) for a in directions]

    def columns(self, s: Stimulus) -> Floats:
        return of_each(s.axes @ np.swapaxes(s.level_in_platform, 1, 2))


IEEE = "IEEE Std 1293, environmental sensitivities"
_TEMPERATURE = Regressor("T", "temperature less 25 °C", "K")


class ThermalBias(SensorEffect):
    """alpha T."""

    family = "temperature"
    name, title, source = "thermal-bias", "bias that follows the temperature", IEEE
    on_data_sheet = "bias per kelvin"
    drawn_against = _TEMPERATURE
    formulas = ("T",)
    confused_with = "needs a temperature swing"
    symbol, unit, scale = "alpha", "m/s^2/K", 1e-3
    typical = Typical((5 * MICRO_G, 30 * MICRO_G), (0.15 * MILLI_G, 1 * MILLI_G))


class ThermalBias2(SensorEffect):
    """alpha_2 T^2."""

    family = "temperature"
    name, title, source = "thermal-bias-2", "bias that follows the square of the temperature", IEEE
    drawn_against = _TEMPERATURE
    formulas = ("T**2",)
    symbol, unit, scale = "alpha2_", "m/s^2/K^2", 1e-4


class ThermalScale(SensorEffect):
    """alpha_s T a_i."""

    family = "temperature"
    name, title, source = "thermal-scale", "scale factor that follows the temperature", IEEE
    on_data_sheet = "scale per kelvin"
    drawn_against = Regressor("T*a", "temperature less 25 °C, times force along the input axis", "K m/s^2")
    formulas = ("T*a",)
    confused_with = "needs both signs of the input at two temperatures"
    symbol, unit, scale = "alphaS", "1/K", 1e-4
    typical = Typical((50e-6, 150e-6))


class ThermalRate(SensorEffect):
    """kappa dT/dt."""

    family = "temperature"
    name, title, source = "thermal-rate", "bias that follows the rate of the temperature", IEEE
    drawn_against = Regressor("dT")
    formulas = ("dT",)
    confused_with = "warm-up"
    symbol, unit, scale = "kappaT", "m s^-1/K", 1e-1
    typical = Typical((1 * 60 * MICRO_G, 50 * 60 * MICRO_G))


class ThermalMisalignment(Effect):
    """gamma_p T a_p + gamma_o T a_o."""

    family = "temperature"
    name, title, source = "thermal-misalignment", "alignment that follows the temperature", IEEE
    borne_by = Bearer.SENSORS
    formulas = ("T*p", "T*o")
    typical = Typical((0.1e-6, 10e-6))
    symbols, unit, scale = tuple(f"gamma{axis}{i}" for i in (1, 2, 3) for axis in "PO"), "rad/K", 1e-5
    bearers = PAIRS

    def columns(self, s: Stimulus) -> Floats:
        return of_each(s.warmth[:, None, None] * np.stack([s.pendulous, s.output], axis=2))


class ThermalLag(SensorEffect):
    """alpha L, tau dL/dt = T - L: the sensor follows the thermometer late, in balance at the first sample."""

    family = "temperature"
    name, title, source = "thermal-lag", "bias that follows the temperature late", IEEE
    drawn_against = Regressor("", "temperature through the fitted lag, less 25 °C", "K")
    confused_with = "thermal-bias and thermal-rate together"
    symbol, unit, scale = "alphaL", "m/s^2/K", 1e-3
    typical = ThermalBias.typical
    unknown = Unknown("tauLag", "s", 30.0, 7200.0, "min", 1.0 / 60.0)
    value = 600.0

    def terms(self, s: Stimulus) -> Floats:
        return np.repeat(s.lagged_warmth(self.value)[:, None], 3, axis=1)


class ThermalHysteresis(SensorEffect):
    """alpha P, P the temperature through a play of a half-width: it follows T only where that pushes it."""

    family = "temperature"
    name, title = "thermal-hysteresis", "bias that depends on whether it became warmer or colder"
    source = "IEEE Std 1293, thermal hysteresis"
    drawn_against = Regressor("", "temperature through the fitted play, less 25 °C", "K")
    confused_with = "thermal-bias, thermal-lag; needs the same temperature from two sides"
    symbol, unit, scale = "alphaH", "m/s^2/K", 1e-3
    typical = ThermalBias.typical
    unknown = Unknown("playT", "K", 0.02, 20.0, "K", 1.0)
    value = 1.0

    def terms(self, s: Stimulus) -> Floats:
        return np.repeat(s.played_warmth(self.value)[:, None], 3, axis=1)

    def log_share(self, s: Stimulus) -> float:
        swing_k = float(np.ptp(s.warmth))  # a play of less than a tenth of the swing is a thermal-bias
        return 4.0 * math.log(min(max(self.value / max(0.1 * swing_k, 1e-9), 1e-9), 1.0))
