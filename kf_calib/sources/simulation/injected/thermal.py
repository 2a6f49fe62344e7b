"""What the true temperature does to the accelerometers. T: above the ``reference``, 25 degC unless told otherwise."""

from __future__ import annotations

import math

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.sources.simulation.injected.kinds import Rig, added, made
from kf_calib.sources.simulation.injected.terms import above, adding, column, output, pendulous
from kf_calib.sources.simulation.physics import State, Step

_PENDULOUS_AND_OUTPUT = ("1p", "1o", "2p", "2o", "3p", "3o")


@made(
    "thermal-misalignment", "rad/K", ("0.1urad/K", "10urad/K"), ("10urad/K", "100urad/K"),
    stage="input", coefficients=_PENDULOUS_AND_OUTPUT,
)  # fmt: skip
def thermal_misalignment(gamma: Floats, rig: Rig, *, reference: float = 25.0) -> Step:
    """Thermal misalignment: the input axis leans to (1, gamma_p T, gamma_o T), a_i + gamma_p T a_p + gamma_o T a_o."""
    to_pendulous, to_output = gamma[0::2], gamma[1::2]

    def step(state: State) -> None:
        p, o = to_pendulous * above(state, reference), to_output * above(state, reference)
        leaning = state.input_mps2 + p * pendulous(state) + o * output(state)
        state.input_mps2 = leaning / np.sqrt(1.0 + p**2 + o**2)

    return step


@added("thermal-bias", "m/s^2/K", ("5ug/K", "30ug/K"), ("0.15mg/K", "1mg/K"))
def thermal_bias(k: Floats, state: State, *, reference: float = 25.0) -> Floats:
    """Thermal sensitivity of the bias: alpha T (IEEE Std 1293)."""
    return k * above(state, reference)


@added("thermal-bias-2", "m/s^2/K^2", ("0.1ug/K^2", "1ug/K^2"), ("3ug/K^2", "30ug/K^2"))
def thermal_bias_2(k: Floats, state: State, *, reference: float = 25.0) -> Floats:
    """Thermal curvature of the bias: alpha_2 T^2 (IEEE Std 1293)."""
    return k * above(state, reference) ** 2


@added("thermal-scale", "1/K", ("50ppm/K", "150ppm/K"), ("100ppm/K", "500ppm/K"))
def thermal_scale(k: Floats, state: State, *, reference: float = 25.0) -> Floats:
    """Thermal sensitivity of the scale factor: alpha_s T a_i (IEEE Std 1293; raw, magnet and servo uncompensated)."""
    return k * above(state, reference) * state.input_mps2


@added("thermal-rate", "m/s^2/(K/s)", ("1ug*min/K", "50ug*min/K"), ("0.01mg*min/K", "1mg*min/K"))
def thermal_rate(k: Floats, state: State) -> Floats:
    """Sensitivity to the rate of temperature: kappa dT/dt, from gradients inside the sensor (IEEE Std 1293)."""
    return k * column(state.ambient.rate(state.time_s))


@made("thermal-lag", "m/s^2/K", ("5ug/K", "30ug/K"), ("0.15mg/K", "1mg/K"))
def thermal_lag(alpha: Floats, rig: Rig, *, tau: float = 600.0, reference: float = 25.0) -> Step:
    """Thermal lag: alpha L, where tau dL/dt = T - L, the sensor follows the thermometer; L = T at the first sample."""
    lag = Lag(rig.period_s, tau)
    return adding(lambda state: alpha * column(lag(state.temperature_c - reference)))


class Lag:
    """First-order lag, tau dy/dt = x - y, of what goes in straight lines from sample to sample; in balance at first.

    Exactly: y_n = phi y_(n-1) + (c - phi) x_(n-1) + (1 - c) x_n, phi = e^-r, c = (1 - e^-r) / r, r = period / tau.
    """

    def __init__(self, period_s: float, tau_s: float) -> None:
        ratio = period_s / tau_s
        phi, c = math.exp(-ratio), -math.expm1(-ratio) / ratio
        self._over, self._under = [1.0 - c, c - phi], [1.0, -phi]
        self._carried: Floats | None = None

    def __call__(self, values: Floats) -> Floats:
        from scipy.signal import lfilter  # takes 0.4 s to load, which other effects need not wait for

        if self._carried is None:
            self._carried = (1.0 - self._over[0]) * values[:1]
        lagged, self._carried = lfilter(self._over, self._under, values, zi=self._carried)
        return lagged
