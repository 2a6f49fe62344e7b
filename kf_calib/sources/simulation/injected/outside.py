"""Effects that no catalogue knows: the verdict on them has to be ``unknown``. They are physics that benches do show."""

from __future__ import annotations

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.sources.simulation.injected.gimbal import base_turning, harmonic
from kf_calib.sources.simulation.injected.kinds import Rig, added, made
from kf_calib.sources.simulation.injected.terms import above, adding, column, output, pendulous
from kf_calib.sources.simulation.physics import State, Step

made(
    "encoder-harmonic-3", "rad", ("10urad", "200urad"), ("0.5mrad", "10mrad"),
    stage="angles", coefficients=("s", "c"), per_axis=True, known=False, driver="angle",
)(harmonic(3))  # fmt: skip


@made(
    "thermal-tilt", "rad/K", ("5urad/K", "50urad/K"), ("0.1mrad/K", "1mrad/K"),
    stage="attitude", coefficients=("N", "E"), known=False, driver="temperature",
)  # fmt: skip
def thermal_tilt(delta: Floats, rig: Rig, *, reference: float = 25.0) -> Step:
    """Thermal tilt of the pier: the base is turned by T (delta N about North, delta E about East)."""
    return base_turning(delta, rig, lambda state: above(state, reference)[:, 0])


@added(
    "fifth-order",
    "1/(m/s^2)^4",
    ("5ug/g^5", "100ug/g^5"),
    ("2mg/g^5", "20mg/g^5"),
    known=False,
    driver="specific force",
)
def fifth_order(k: Floats, state: State) -> Floats:
    """Fifth-order nonlinearity: K5 a_i^5."""
    return k * state.input_mps2**5


@added(
    "triple-product",
    "1/(m/s^2)^2",
    ("5ug/g^3", "100ug/g^3"),
    ("2mg/g^3", "20mg/g^3"),
    known=False,
    driver="specific force",
)
def triple_product(k: Floats, state: State) -> Floats:
    """Triple product: K_ipo a_i a_p a_o."""
    return k * state.input_mps2 * pendulous(state) * output(state)


@added("fourth-harmonic", "m/s^2", ("5ug", "100ug"), ("2mg", "20mg"), known=False, driver="specific force")
def fourth_harmonic(k: Floats, state: State) -> Floats:
    """Spherical harmonic of degree 4: H (35 u^4 - 30 u^2 + 3) / 8, u the cosine of input axis and specific force."""
    squares = (state.input_mps2 / np.linalg.norm(state.force_mps2, axis=1, keepdims=True)) ** 2
    return k * (35.0 * squares**2 - 30.0 * squares + 3.0) / 8.0


@added("third-cosine", "m/s^2", ("5ug", "100ug"), ("2mg", "20mg"), known=False, driver="specific force")
def third_cosine(k: Floats, state: State) -> Floats:
    """Cosine of thrice the direction: H s^3 cos(3 psi), psi and s the angle about the output axis and the sine of the
    angle from it of the specific force (spherical harmonic of degree 3)."""
    across = (state.input_mps2 + 1j * pendulous(state)) / np.linalg.norm(state.force_mps2, axis=1, keepdims=True)
    return k * np.real(across**3)


@added(
    "thermal-scale-2",
    "1/K^2",
    ("1ppm/K^2", "10ppm/K^2"),
    ("20ppm/K^2", "200ppm/K^2"),
    known=False,
    driver="temperature",
)
def thermal_scale_2(k: Floats, state: State, *, reference: float = 25.0) -> Floats:
    """Thermal curvature of the scale factor: alpha_s2 T^2 a_i."""
    return k * above(state, reference) ** 2 * state.input_mps2


@made("bias-jump", "m/s^2", ("5ug", "100ug"), ("2mg", "20mg"), known=False, driver="time")
def bias_jump(k: Floats, rig: Rig, *, share: float = 0.4) -> Step:
    """Jump of the bias: constant from ``share`` of the run on, where something in the sensor has given way."""
    start_s = share * rig.duration_s
    return adding(lambda state: k * column(np.where(state.time_s >= start_s, 1.0, 0.0)))


@added("power-warm-up", "m/s^2", ("20ug", "200ug"), ("2mg", "20mg"), known=False, driver="time")
def power_warm_up(k: Floats, state: State, *, tau: float = 120.0) -> Floats:
    """Warm-up by a power law: B / sqrt(1 + t / tau), as heat spreads into a thick base (diffusion)."""
    return k / np.sqrt(1.0 + column(state.time_s) / tau)


@added("chirp", "m/s^2", ("5ug", "100ug"), ("2mg", "20mg"), known=False, driver="time")
def chirp(k: Floats, state: State, *, frequency: float = 2e-3, chirp: float = 1e-5) -> Floats:
    """Periodic bias of rising frequency: A sin(2 pi (f t + chirp t^2 / 2)), as from a fan that speeds up."""
    t = column(state.time_s)
    return k * np.sin(2.0 * np.pi * (frequency * t + 0.5 * chirp * t**2))


@made("telegraph", "m/s^2", ("5ug", "100ug"), ("2mg", "20mg"), known=False, driver="time")
def telegraph(k: Floats, rig: Rig, *, tau: float = 200.0) -> Step:
    """Telegraph noise: each bias switches between -k and +k, staying tau on average (burst or popcorn noise)."""
    chance = -0.5 * np.expm1(-2.0 * rig.period_s / tau)
    rng, level = rig.generator("telegraph"), np.ones((1, 3))

    def contribution(state: State) -> Floats:
        nonlocal level
        flips = np.where(rng.random((len(state.time_s), 3)) < chance, -1.0, 1.0)
        levels = level * np.cumprod(flips, axis=0)
        level = levels[-1:]
        return k * levels

    return adding(contribution)


@made("previous-pose", "m/s^2", ("5ug", "100ug"), ("2mg", "20mg"), known=False, driver="previous orientation")
def previous_pose(k: Floats, rig: Rig) -> Step:
    """Memory of the previous pose: k sin of the innermost angle of the dwell before; zero in the first dwell."""
    sines = np.concatenate([[0.0], np.sin(rig.motion.angles_rad[:-1, -1])])
    return adding(lambda state: k * sines[state.dwell])


@made("cable-torque", "m/s^2", ("5ug", "100ug"), ("2mg", "20mg"), known=False, driver="angle")
def cable_torque(k: Floats, rig: Rig) -> Step:
    """Torque of a wound-up cable: k times the square of the innermost angle, as it was commanded, in half turns."""
    return adding(lambda state: k * (state.angles_rad[:, -1:] / np.pi) ** 2)
