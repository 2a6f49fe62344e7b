"""Effects that no catalogue knows: the verdict on them has to be ``unknown``. They are physics that benches do show."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.sources.simulation.injected.gimbal import axis_nonorthogonality, base_turning, harmonic
from kf_calib.sources.simulation.injected.kinds import SimulatedBench, above, added, column, made, output, pendulous
from kf_calib.sources.simulation.physics import TrueState, TrueStep, adding, carried_by_earth, rotate, turning_platform
from kf_calib.sources.simulation.sensors import FirstOrder
from kf_calib.sources.simulation.visit_plans import attitude

NO_FAMILY = "none of the known"
"""The family of what belongs to no physical class of the catalogue's effects."""
_made, _added = partial(made, known=False), partial(added, known=False)
_BIAS = "m/s^2", ("5ug", "100ug"), ("2mg", "20mg")  # unit and sizes of what acts as a bias

_made(
    "encoder-harmonic-3", "rad", ("10urad", "200urad"), ("0.5mrad", "10mrad"),
    stage="angles", coefficients=("s", "c"), per_axis=True, driver="angle", family="gimbal and encoder",
)(harmonic(3))  # fmt: skip


@_made("thermal-tilt", "rad/K", ("5urad/K", "50urad/K"), ("0.1mrad/K", "1mrad/K"),
       stage="attitude", coefficients=("N", "E"), driver="temperature", family="temperature")  # fmt: skip
def thermal_tilt(delta: Floats, simulated: SimulatedBench, *, reference: float = 25.0) -> TrueStep:
    """Thermal tilt of the pier: the base is turned by T (delta N about North, delta E about East)."""
    return base_turning(delta, simulated, lambda state: above(state, reference)[:, 0])


@_added("fifth-order", "1/(m/s^2)^4", ("5ug/g^5", "100ug/g^5"), ("2mg/g^5", "20mg/g^5"),
        driver="specific force", family="nonlinearity")  # fmt: skip
def fifth_order(k: Floats, state: TrueState) -> Floats:
    """Fifth-order nonlinearity: K5 a_i^5."""
    return k * state.input_mps2**5


@_added("triple-product", "1/(m/s^2)^2", ("5ug/g^3", "100ug/g^3"), ("2mg/g^3", "20mg/g^3"),
        driver="specific force", family="cross-axis")  # fmt: skip
def triple_product(k: Floats, state: TrueState) -> Floats:
    """Triple product: K_ipo a_i a_p a_o."""
    return k * state.input_mps2 * pendulous(state) * output(state)


@_added("fourth-harmonic", *_BIAS, driver="specific force", family="nonlinearity")
def fourth_harmonic(k: Floats, state: TrueState) -> Floats:
    """Spherical harmonic of degree 4: H (35 u^4 - 30 u^2 + 3) / 8, u the cosine of input axis and specific force."""
    squares = (state.input_mps2 / np.linalg.norm(state.force_mps2, axis=1, keepdims=True)) ** 2
    return k * (35.0 * squares**2 - 30.0 * squares + 3.0) / 8.0


@_added("third-cosine", *_BIAS, driver="specific force", family="nonlinearity")
def third_cosine(k: Floats, state: TrueState) -> Floats:
    """Cosine of thrice the direction: H s^3 cos(3 psi), psi and s the angle about the output axis and the sine of the
    angle from it of the specific force (spherical harmonic of degree 3)."""
    across = (state.input_mps2 + 1j * pendulous(state)) / np.linalg.norm(state.force_mps2, axis=1, keepdims=True)
    return k * np.real(across**3)


@_added("thermal-scale-2", "1/K^2", ("1ppm/K^2", "10ppm/K^2"), ("20ppm/K^2", "200ppm/K^2"),
        driver="temperature", family="temperature")  # fmt: skip
def thermal_scale_2(k: Floats, state: TrueState, *, reference: float = 25.0) -> Floats:
    """Thermal curvature of the scale factor: alpha_s2 T^2 a_i."""
    return k * above(state, reference) ** 2 * state.input_mps2


@_made("bias-jump", *_BIAS, driver="time", family="bias in time")
def bias_jump(k: Floats, simulated: SimulatedBench, *, share: float = 0.4) -> TrueStep:
    """Jump of the bias: constant from ``share`` of the run on, where something in the sensor has given way."""
    start_s = share * simulated.duration_s
    return adding(lambda state: k * column(np.where(state.time_s >= start_s, 1.0, 0.0)))


@_added("power-warm-up", "m/s^2", ("20ug", "200ug"), ("2mg", "20mg"), driver="time", family="bias in time")
def power_warm_up(k: Floats, state: TrueState, *, tau: float = 120.0) -> Floats:
    """Warm-up by a power law: B / sqrt(1 + t / tau), as heat spreads into a thick base (diffusion)."""
    return k / np.sqrt(1.0 + column(state.time_s) / tau)


@_added("chirp", *_BIAS, driver="time", family=NO_FAMILY)
def chirp(k: Floats, state: TrueState, *, frequency: float = 2e-3, chirp: float = 1e-5) -> Floats:
    """Periodic bias of rising frequency: A sin(2 pi (f t + chirp t^2 / 2)), as from a fan that speeds up."""
    t = column(state.time_s)
    return k * np.sin(2.0 * np.pi * (frequency * t + 0.5 * chirp * t**2))


@_made("telegraph", *_BIAS, driver="time", family="bias in time")
def telegraph(k: Floats, simulated: SimulatedBench, *, tau: float = 200.0) -> TrueStep:
    """Telegraph noise: each bias switches between -k and +k, staying tau on average (burst or popcorn noise)."""
    chance = -0.5 * np.expm1(-2.0 * simulated.period_s / tau)
    rng, level = simulated.generator("telegraph"), np.ones((1, 3))

    def contribution(state: TrueState) -> Floats:
        nonlocal level
        flips = np.where(rng.random((len(state.time_s), 3)) < chance, -1.0, 1.0)
        levels = level * np.cumprod(flips, axis=0)
        level = levels[-1:]
        return k * levels

    return adding(contribution)


@_made("previous-pose", *_BIAS, driver="previous orientation", family="memory")
def previous_pose(k: Floats, simulated: SimulatedBench) -> TrueStep:
    """Memory of the previous pose: k sin of the innermost angle of the dwell before; zero in the first dwell."""
    sines = np.concatenate([[0.0], np.sin(simulated.motion.angles_rad[:-1, -1])])
    return adding(lambda state: k * sines[state.dwell])


@_made("cable-torque", *_BIAS, driver="angle", family=NO_FAMILY)
def cable_torque(k: Floats, simulated: SimulatedBench) -> TrueStep:
    """Torque of a wound-up cable: k times the square of the innermost angle, as it was commanded, in half turns."""
    return adding(lambda state: k * (state.angles_rad[:, -1:] / np.pi) ** 2)


# -- like real sensors and benches --


@_added("double-warm-up", "m/s^2", ("10ug", "200ug"), ("1mg", "10mg"), driver="time", family="bias in time")
def double_warm_up(
    k: Floats, state: TrueState, *, tau: float = 120.0, slow: float = 1500.0, share: float = 0.4
) -> Floats:
    """Warm-up of two time constants: B ((1 - share) exp(-t / tau) + share exp(-t / slow)), as the electronics and then
    the block come to their temperatures."""
    t = column(state.time_s)
    return k * ((1.0 - share) * np.exp(-t / tau) + share * np.exp(-t / slow))


@_made("creep-and-walk", "m/s^2", ("5ug", "100ug"), ("1mg", "10mg"), driver="time", family="bias in time")
def creep_and_walk(k: Floats, simulated: SimulatedBench, *, tau: float = 60.0, share: float = 0.3) -> TrueStep:
    """Creep of the bias after power-on, then a random walk: k (ln(1 + t / tau) + share W), W a random walk whose
    variance is t / tau; the creep is the faster at first, the walk later on."""
    walk = FirstOrder(simulated.generator("creep-and-walk"), 1.0, math.sqrt(simulated.period_s / tau), 0.0)
    return adding(lambda state: k * (np.log1p(column(state.time_s) / tau) + share * walk(len(state.time_s))))


@_made("output-step", *_BIAS, coefficients=("step",), driver="time",
      family="bias in time")  # fmt: skip
def output_step(size: Floats, simulated: SimulatedBench) -> TrueStep:
    """Step of one accelerometer's output: constant from an instant on; which one, and when between a fifth and four
    fifths of the run, is drawn from the seed."""
    rng = simulated.generator("output-step")
    steps, start_s = size * np.eye(3)[rng.integers(3)], rng.uniform(0.2, 0.8) * simulated.duration_s
    return adding(lambda state: steps * column(np.where(state.time_s >= start_s, 1.0, 0.0)))


@_made("loose-mount", "rad", ("2urad", "50urad"), ("0.1mrad", "5mrad"), stage="attitude", coefficients=("x", "y", "z"),
      signed=False, driver="specific force", family="unstated noise")  # fmt: skip
def loose_mount(play: Floats, simulated: SimulatedBench) -> TrueStep:
    """Loose mount: in each dwell the platform is turned in itself by play_j clip(u_k + z, -1, 1) about axis j, u_k
    the part of gravity's direction along the axis that follows j, z a standard normal number, the friction: it rests
    between two stops, mostly near the one that gravity pulls it to."""
    angles_rad, count = simulated.motion.angles_rad, len(simulated.motion.angles_rad)
    upward = carried_by_earth(
        simulated.bench, np.array([[0.0, 1.0, 0.0]]), np.multiply(simulated.motion.arrive_ns, 1e-9)
    )
    pull = rotate(attitude(simulated.axes, angles_rad, simulated.bench.up).inv(), upward)[:, [1, 2, 0]]
    friction = simulated.generator("loose-mount").standard_normal((count, 3))
    turns_rad = play * np.clip(pull + friction, -1.0, 1.0)
    return turning_platform(lambda state: state.of_dwells(turns_rad))


@_made("eccentric-bearing", "rad", ("5urad", "50urad"), ("0.1mrad", "5mrad"), stage="angles", coefficients=("s", "c"),
      per_axis=True, driver="angle", family="gimbal and encoder")  # fmt: skip
def eccentric_bearing(size: Floats, simulated: SimulatedBench, axis: int, *, share: float = 1.0) -> TrueStep:
    """Eccentric bearing of a gimbal: its encoder errs by s sin q + c cos q, and its axis is tilted in its parent by
    share s and share c, as with encoder-harmonic-1 and axis-nonorthogonality, because its shaft is off its centre."""
    parts = harmonic(1)(size, simulated, axis), axis_nonorthogonality(share * size, simulated, axis)

    def step(state: TrueState) -> None:
        for part in parts:
            part(state)

    return step
