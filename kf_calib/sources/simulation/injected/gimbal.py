"""Errors of the bench: surroundings (gravity, Earth's rotation, magnetic field, clock), encoders, axes, base, platform.

Errors of the positioner are all solved as rotations. Encoders: recorded is the reading q, true is q + error(q). Turns
of a rotation vector follow the right-hand rule.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import accumulate

import numpy as np
from scipy.spatial.transform import Rotation

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Vector
from kf_calib.sources.simulation.injected.kinds import SimulatedBench, column, made
from kf_calib.sources.simulation.physics import (
    TrueState,
    TrueStep,
    adding,
    along,
    carried_by_earth,
    earth_rate_radps,
    putting,
    rotate,
    to_bench,
    turning_base,
    turning_platform,
)
from kf_calib.sources.simulation.visit_plans import attitude

_LATITUDE_RAD = math.radians(50.0)


@made("latency", "s", ("0.1ms", "5ms"), ("0.1ms", "5ms"), stage="angles", coefficients=("tau_d",), signed=False)
def latency(delay: Floats, simulated: SimulatedBench) -> TrueStep:
    """Latency: the reading stamped t is what was true at t - tau_d, for the block as a whole (acquisition chain)."""

    def step(state: TrueState) -> None:
        state.time_s = np.maximum(state.time_s - delay[0], 0.0)
        state.angles_rad = simulated.motion.angles_at(np.rint(state.time_s * 1e9).astype(np.int64))

    return step


@made("earth-rotation", "1", ("1", "1"), ("1", "1"), stage="attitude", coefficients=("share",))
def earth_rotation(share: Floats, simulated: SimulatedBench, *, latitude: float = _LATITUDE_RAD) -> TrueStep:
    """Rotation of the Earth: the platform is held in inertial space, so that gravity turns in it by share times
    15.041 deg/h more than is stated; ``latitude`` counts where the bench states none (WGS 84)."""
    stated_deg = simulated.bench.latitude_deg
    latitude_deg = math.degrees(latitude) if stated_deg is None else stated_deg
    rate_radps = share[0] * earth_rate_radps(latitude_deg, simulated.bench.azimuth_deg)
    return turning_base(lambda state: -column(state.time_s) * rate_radps)


@made("gravity-error", "1", ("10ppm", "700ppm"), ("10ppm", "700ppm"), stage="force", coefficients=("epsilon",))
def gravity_error(epsilon: Floats, simulated: SimulatedBench) -> TrueStep:
    """Wrong gravity: true is g (1 + epsilon), g is stated (gravimetry)."""
    return putting("force_mps2", lambda state: state.force_mps2 * (1.0 + epsilon[0]))


@made("magnetic", "m/s^2/T", ("1ug/G", "20ug/G"), ("20ug/G", "400ug/G"))
def magnetic(
    m: Floats, simulated: SimulatedBench, *, north: float = 2e-5, up: float = -4.5e-5, east: float = 0.0
) -> TrueStep:
    """Magnetic sensitivity: m B along the input axis, E_i . B_p, of the local field, which is fixed to the Earth
    and given by its parts toward North, up and East (IEEE Std 1293)."""
    field = to_bench([north, up, east], simulated.bench.azimuth_deg)[None]

    def contribution(state: TrueState) -> Floats:
        in_platform = rotate(state.attitude.inv(), carried_by_earth(simulated.bench, field, state.time_s))
        return m * along(in_platform, simulated.sensors.input_axes)

    return adding(contribution)


_ROUNDS = 6  # of the flexure's fixed point; each gains the digits of its angle
_PROBE_S = 2e-4  # of the second difference that makes an acceleration


def encoder_error(axis: int, error: Callable[[Floats], Floats]) -> TrueStep:
    """The step that makes the true angle of one gimbal differ from its reading."""
    return turning_gimbal(axis, lambda state: error(state.angles_rad[:, axis]))


def turning_gimbal(axis: int, error_rad: Callable[[TrueState], Floats]) -> TrueStep:
    """The step that turns one gimbal by so much (n,) more."""

    def turned(state: TrueState) -> Floats:
        return state.angles_rad + column(error_rad(state)) * np.eye(state.angles_rad.shape[1])[axis]

    return putting("angles_rad", turned)


@made(
    "encoder-offset", "rad", ("1arcsec", "20arcsec"), ("0.02deg", "0.5deg"),
    stage="angles", coefficients=("epsilon",), per_axis=True,
)  # fmt: skip
def encoder_offset(epsilon: Floats, simulated: SimulatedBench, axis: int) -> TrueStep:
    """Zero of an encoder: the true angle is q + epsilon."""
    return encoder_error(axis, lambda q: np.full_like(q, epsilon[0]))


@made(
    "encoder-scale", "1", ("1ppm", "20ppm"), ("0.1permille", "2permille"),
    stage="angles", coefficients=("epsilon",), per_axis=True,
)  # fmt: skip
def encoder_scale(epsilon: Floats, simulated: SimulatedBench, axis: int) -> TrueStep:
    """Scale of an encoder: the true angle is q (1 + epsilon), q as it was commanded, whole turns included."""
    return encoder_error(axis, lambda q: epsilon[0] * q)


def harmonic(order: int) -> Callable[..., TrueStep]:
    def make(size: Floats, simulated: SimulatedBench, axis: int) -> TrueStep:
        return encoder_error(axis, lambda q: size[0] * np.sin(order * q) + size[1] * np.cos(order * q))

    multiple = "q" if order == 1 else f"{order}q"
    make.__doc__ = (
        f"Encoder error of order {order}: the true angle is q + s sin {multiple} + c cos {multiple}, "
        "from a graduated circle off its centre or out of round."
    )
    return make


for _order in (1, 2):
    made(
        f"encoder-harmonic-{_order}", "rad", ("1urad", "100urad"), ("0.1mrad", "5mrad"),
        stage="angles", coefficients=("s", "c"), per_axis=True,
    )(harmonic(_order))  # fmt: skip


@made(
    "backlash", "rad", ("5urad", "100urad"), ("0.1mrad", "10mrad"),
    stage="angles", coefficients=("play",), signed=False, per_axis=True,
)  # fmt: skip
def backlash(play: Floats, simulated: SimulatedBench, axis: int) -> TrueStep:
    """Play between a gimbal and its encoder: the true angle is q less half the play where the gimbal was last moved
    forward, and q more half of it where it was last moved back; it changes sides on the way (gears, belts, worms)."""

    def error_rad(state: TrueState) -> Floats:
        moves = np.diff(simulated.motion.angles_rad[:, axis], prepend=simulated.motion.angles_rad[:1, axis])
        senses = list(accumulate(np.sign(moves).tolist(), lambda before, sense: sense or before))
        return -0.5 * play[0] * state.of_dwells(column(np.array(senses)))[:, 0]

    return turning_gimbal(axis, error_rad)


@made(
    "axis-nonorthogonality", "rad", ("5urad", "50urad"), ("0.1mrad", "5mrad"),
    stage="angles", coefficients=("u", "v"), per_axis=True,
)  # fmt: skip
def axis_nonorthogonality(tilt: Floats, simulated: SimulatedBench, axis: int) -> TrueStep:
    """Nonorthogonality of a gimbal axis: it is tilted in its parent by u and v about the two axes that follow it in
    cyclic order, for y about z and x; at zero angles the frames coincide."""
    nominal = simulated.axes[axis]
    true = tuple(Rotation.from_rotvec(tilt @ across(nominal)).apply(nominal).tolist())
    return putting("axes", lambda state: [*state.axes[:axis], true, *state.axes[axis + 1 :]])


def across(axis: Vector) -> Floats:
    """Two unit vectors (2, 3) across an axis: the next two in cyclic order where it is x, y or z."""
    letter = int(np.argmax(np.abs(axis)))
    following = np.eye(3)[(letter + 1) % 3]
    first = following - np.dot(following, axis) * np.array(axis)
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(axis, first)])


@made("base-tilt", "rad", ("5urad", "500urad"), ("0.1mrad", "10mrad"), stage="attitude", coefficients=("N", "E"))
def base_tilt(delta: Floats, simulated: SimulatedBench) -> TrueStep:
    """Tilt of the base: it is turned by the rotation vector (delta N about North, delta E about East)."""
    return base_turning(delta, simulated, lambda state: np.ones(1))


@made(
    "base-tilt-drift", "rad/s", ("1urad/day", "50urad/day"), ("1urad/h", "100urad/h"),
    stage="attitude", coefficients=("N", "E"),
)  # fmt: skip
def base_tilt_drift(rate: Floats, simulated: SimulatedBench) -> TrueStep:
    """Drift of the base's tilt: turned by t (rate N about North, rate E about East)."""
    return base_turning(rate, simulated, lambda state: state.time_s)


def base_turning(delta: Floats, simulated: SimulatedBench, multiple: Callable[[TrueState], Floats]) -> TrueStep:
    """The step that turns the base about horizontal axes by (delta N, delta E) times something (n,)."""
    vector = to_bench([delta[0], 0.0, delta[1]], simulated.bench.azimuth_deg)
    return turning_base(lambda state: column(multiple(state)) * vector)


@made(
    "platform-drift", "rad/s", ("0.01deg/h", "1deg/h"), ("1deg/h", "30deg/h"),
    stage="attitude", coefficients=("x", "y", "z"),
)  # fmt: skip
def platform_drift(rate: Floats, simulated: SimulatedBench) -> TrueStep:
    """Drift of the platform: turned in its own axes by the rotation vector omega_d t, from its gyros (IEEE Std 813)."""
    return turning_platform(lambda state: column(state.time_s) * rate)


@made(
    "flexure", "rad/(m/s^2)", ("5urad/g", "100urad/g"), ("0.1mrad/g", "3mrad/g"),
    stage="force", coefficients=("x", "y", "z"),
)  # fmt: skip
def flexure(offset: Floats, simulated: SimulatedBench) -> TrueStep:
    """Flexure: the platform gives way by the rotation vector f x d, the torque of gravity on a mass off the centre
    times compliance; d is compliance x mass x offset, and f is felt by the bent platform (Hooke's law)."""
    return bending(offset, np.ones(3))


@made(
    "uneven-flexure", "rad/(m/s^2)", ("5urad/g", "100urad/g"), ("0.1mrad/g", "3mrad/g"),
    stage="force", coefficients=("x", "y", "z"),
)  # fmt: skip
def uneven_flexure(
    offset: Floats, simulated: SimulatedBench, *, cx: float = 2.0, cy: float = 0.1, cz: float = 0.7
) -> TrueStep:
    """Flexure of different stiffness about each axis: the platform gives way by (cx, cy, cz) times the three parts of
    f x d, its compliances about its axes, each of them as part of the mean one (Hooke's law)."""
    return bending(offset, np.array([cx, cy, cz]))


def bending(offset: Floats, compliance: Floats) -> TrueStep:
    """The step that turns the platform by f x offset, each part times the compliance (3,) about its axis."""

    def step(state: TrueState) -> None:
        bent = Rotation.identity()
        for _ in range(_ROUNDS):
            bent = Rotation.from_rotvec(compliance * np.cross(rotate(bent.inv(), state.force_mps2), offset))
        state.force_mps2, state.attitude = rotate(bent.inv(), state.force_mps2), state.attitude * bent

    return step


@made(
    "lever-arm", "m", ("5mm", "3cm"),
    stage="input", coefficients=tuple(number + axis for number in "123" for axis in "xyz"),
)  # fmt: skip
def lever_arm(arm: Floats, simulated: SimulatedBench) -> TrueStep:
    """Lever arm: accelerometer i sits at r_i in the platform, whose origin does not move, and feels in slews the
    acceleration of its place along its input axis, R E_i . d2(R r_i)/dt2 (kinematics)."""
    arms, shifts_s = arm.reshape(3, 3), (-_PROBE_S, 0.0, _PROBE_S)

    def step(state: TrueState) -> None:
        if state.moving:
            before, now, after = (_into_bench(simulated, state.time_s + shift_s) for shift_s in shifts_s)
            felt = (after(arms) - 2.0 * now(arms) + before(arms)) / _PROBE_S**2
            state.input_mps2 = state.input_mps2 + np.sum(now(simulated.sensors.input_axes) * felt, axis=2)

    return step


def _into_bench(simulated: SimulatedBench, time_s: Floats) -> Callable[[Floats], Floats]:
    """What takes three vectors of the platform, rows (3, 3), into the bench at n instants: (n, 3, 3)."""
    time_ns = np.rint(np.maximum(time_s, 0.0) * 1e9).astype(np.int64)
    carried = attitude(simulated.axes, simulated.motion.angles_at(time_ns))
    return lambda rows: np.stack([rotate(carried, row[None]) for row in rows], axis=1)
