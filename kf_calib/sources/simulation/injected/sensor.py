"""Nonlinearities of the accelerometers. Terms and names: IEEE Std 1293 (model equation of a linear accelerometer).

a_i: along the true input axis. a_p, a_o: pendulous and output axis, the platform's of the nominal triads.
"""

from __future__ import annotations

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.sources.simulation.injected.kinds import Rig, added, made
from kf_calib.sources.simulation.injected.terms import output, pendulous, sign
from kf_calib.sources.simulation.physics import State, Step


@made("dead-zone", "m/s^2", ("1ug", "5ug"), ("0.1mg", "1mg"), stage="input", signed=False)
def dead_zone(d: Floats, rig: Rig) -> Step:
    """Dead zone: no response, -a_i, where |a_i| < d (IEEE Std 528, dead band without hysteresis)."""

    def step(state: State) -> None:
        state.input_mps2 = np.where(np.abs(state.input_mps2) < d, 0.0, state.input_mps2)

    return step


@added("bias-asymmetry", "m/s^2", ("1ug", "10ug"), ("0.1mg", "1mg"))
def bias_asymmetry(k: Floats, state: State) -> Floats:
    """Bias asymmetry: the bias differs by K0' between both signs, K0'/2 sgn a_i (IEEE Std 1293)."""
    return k / 2.0 * sign(state.input_mps2)


@added("scale-asymmetry", "1", ("1ppm", "30ppm"), ("0.1permille", "1permille"))
def scale_asymmetry(k: Floats, state: State) -> Floats:
    """Scale factor asymmetry: it differs by K1' between both signs, K1'/2 |a_i| (IEEE Std 1293)."""
    return k / 2.0 * np.abs(state.input_mps2)


@added("second-order", "1/(m/s^2)", ("1ug/g^2", "20ug/g^2"), ("0.1mg/g^2", "3mg/g^2"))
def second_order(k: Floats, state: State) -> Floats:
    """Second-order nonlinearity: K2 a_i^2 (IEEE Std 1293)."""
    return k * state.input_mps2**2


@added("third-order", "1/(m/s^2)^2", ("0.1ug/g^3", "10ug/g^3"), ("0.5mg/g^3", "5mg/g^3"))
def third_order(k: Floats, state: State) -> Floats:
    """Third-order nonlinearity: K3 a_i^3 (IEEE Std 1293)."""
    return k * state.input_mps2**3


@added("odd-quadratic", "1/(m/s^2)", ("1ug/g^2", "10ug/g^2"), ("0.1mg/g^2", "1mg/g^2"))
def odd_quadratic(k: Floats, state: State) -> Floats:
    """Odd quadratic nonlinearity: K_oq a_i |a_i| (IEEE Std 1293)."""
    return k * state.input_mps2 * np.abs(state.input_mps2)


@added("cross-coupling-ip", "1/(m/s^2)", ("1ug/g^2", "30ug/g^2"), ("0.1mg/g^2", "1mg/g^2"))
def cross_coupling_ip(k: Floats, state: State) -> Floats:
    """Cross coupling of input and pendulous axis: K_ip a_i a_p, a deflected pendulum turns its axis (IEEE Std 1293)."""
    return k * state.input_mps2 * pendulous(state)


@added("cross-coupling-io", "1/(m/s^2)", ("1ug/g^2", "30ug/g^2"), ("0.1mg/g^2", "1mg/g^2"))
def cross_coupling_io(k: Floats, state: State) -> Floats:
    """Cross coupling of input and output axis: K_io a_i a_o (IEEE Std 1293)."""
    return k * state.input_mps2 * output(state)


@added("cross-coupling-po", "1/(m/s^2)", ("1ug/g^2", "30ug/g^2"), ("0.1mg/g^2", "1mg/g^2"))
def cross_coupling_po(k: Floats, state: State) -> Floats:
    """Cross coupling of pendulous and output axis: K_po a_p a_o (IEEE Std 1293)."""
    return k * pendulous(state) * output(state)


@added("cross-axis-square", "1/(m/s^2)", ("1ug/g^2", "20ug/g^2"), ("0.1mg/g^2", "1mg/g^2"))
def cross_axis_square(k: Floats, state: State) -> Floats:
    """Cross-axis nonlinearity: K_pp a_p^2 (IEEE Std 1293)."""
    return k * pendulous(state) ** 2
