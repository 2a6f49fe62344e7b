"""What is true of the simulated bench, and the steps that make it so.

A ``TrueState`` goes through steps in three groups: the platform (angles -> attitude -> specific force), the response
of the accelerometers (specific force -> input acceleration -> readings), and the recording (noise). They share no
formula with the estimator. Hidden effects (``injected``) are further steps between these.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench, Vector
from kf_calib.sources.simulation.sensors import Process, Sensors
from kf_calib.sources.simulation.settings import Ambient
from kf_calib.sources.simulation.visit_plans import attitude, between

SIDEREAL_DAY_S = 86164.0905
"""One turn of the Earth in inertial space."""


@dataclass
class TrueState:
    """What is true of n consecutive samples that lie within one dwell, or within one slew.

    Arrays have n rows, or one where a quantity is constant over the stretch: they broadcast. ``dwell`` is the one the
    platform is in, or was last in; ``share`` of the way to the next one it has gone.
    """

    time_s: Floats  # (n,) since the first sample
    ambient: Ambient
    dwell: int
    moving: bool
    arrival_s: float
    share: Floats  # (n,) or (1,)
    axes: Sequence[Vector]  # of the gimbals, outer first
    angles_rad: Floats  # (n, k) or (1, k); the encoders see them without the hidden effects, and with their noise
    attitude: Rotation = field(default_factory=Rotation.identity)  # platform -> bench
    force_mps2: Floats = field(default_factory=lambda: np.zeros((1, 3)))  # specific force, in the platform
    input_mps2: Floats = field(default_factory=lambda: np.zeros((1, 3)))  # along each accelerometer's input axis
    reading_mps2: Floats = field(default_factory=lambda: np.zeros((1, 3)))

    @property
    def temperature_c(self) -> Floats:
        return self.ambient(self.time_s)

    @property
    def since_arrival_s(self) -> Floats:
        return self.time_s - self.arrival_s

    def of_dwells(self, values: Floats) -> Floats:
        """What has ``values`` (m, k) in the dwells and passes smoothly from one to the next: (n, k) or (1, k)."""
        return between(values, np.full(len(self.share), self.dwell), self.share)


TrueStep = Callable[[TrueState], None]
"""One part of the bench: changes what is true in a ``TrueState``. It may remember what went before."""


def set_attitudes(states: Sequence[TrueState], up: str) -> None:
    """The chain of gimbals, on a base whose axis ``up`` points up: angles -> attitude in the bench frame; of many
    stretches at once, because a call of scipy's rotations takes as long as a stretch of samples."""
    for axes, alike in groupby(states, key=lambda state: tuple(state.axes)):
        some = list(alike)
        whole = attitude(axes, np.concatenate([state.angles_rad for state in some]), up)
        ends = np.cumsum([len(state.angles_rad) for state in some]).tolist()
        for state, end in zip(some, ends, strict=True):
            state.attitude = whole[end - len(state.angles_rad) : end]


def putting(quantity: str, value: Callable[[TrueState], Any]) -> TrueStep:
    """The step that puts a value in the place of a quantity of the state."""
    return lambda state: setattr(state, quantity, value(state))


def adding(contribution_mps2: Callable[[TrueState], Floats]) -> TrueStep:
    """The step that adds to the readings."""
    return putting("reading_mps2", lambda state: state.reading_mps2 + contribution_mps2(state))


def turning_base(rotation_rad: Callable[[TrueState], Floats]) -> TrueStep:
    """The step that turns the base by rotation vectors (n, 3)."""
    return putting("attitude", lambda state: Rotation.from_rotvec(rotation_rad(state)) * state.attitude)


def turning_platform(rotation_rad: Callable[[TrueState], Floats]) -> TrueStep:
    """The step that turns the platform in itself by rotation vectors (n, 3)."""
    return putting("attitude", lambda state: state.attitude * Rotation.from_rotvec(rotation_rad(state)))


def gravity(bench: Bench) -> TrueStep:
    """Specific force seen by the platform: f_p = C_bp^T f_b, f_b = (0, g, 0), which turns with the Earth where the
    platform is held in inertial space."""
    up_mps2 = np.array([[0.0, bench.gravity_mps2, 0.0]])
    return putting(
        "force_mps2", lambda state: rotate(state.attitude.inv(), carried_by_earth(bench, up_mps2, state.time_s))
    )


def carried_by_earth(bench: Bench, vector: Floats, time_s: Floats) -> Floats:
    """A vector (1, 3) fixed to the Earth, in the frame that attitudes refer to: it turns where that one is inertial."""
    if bench.reference == "base":
        return vector
    # a bench that says inertial states its latitude
    rate_radps = earth_rate_radps(bench.latitude_deg or 0.0, bench.azimuth_deg)
    return rotate(Rotation.from_rotvec(time_s[:, None] * rate_radps), vector)


def earth_rate_radps(latitude_deg: float, azimuth_deg: float) -> Floats:
    """Turning rate of the Earth (3,) in the bench frame."""
    pole = Rotation.from_rotvec([0.0, 0.0, np.radians(latitude_deg)]).apply([1.0, 0.0, 0.0])  # raised from North
    return 2.0 * np.pi / SIDEREAL_DAY_S * to_bench(pole, azimuth_deg)


def to_bench(north_up_east: ArrayLike, azimuth_deg: float) -> Floats:
    """A vector (3,) given by its parts toward North, Up and East, in the bench frame, whose x has the azimuth."""
    from_north = Rotation.from_rotvec([0.0, -np.radians(azimuth_deg), 0.0])  # East is z: toward it is a turn about Down
    return from_north.inv().apply(north_up_east)


def inputs(sensors: Sensors) -> TrueStep:
    """Accelerations along the input axes of the three accelerometers: a_i = E_i . f."""
    return putting("input_mps2", lambda state: along(state.force_mps2, sensors.input_axes))


def rotate(rotation: Rotation, vector: Floats) -> Floats:
    """A vector (n, 3) turned by rotations, n or 1 of them."""
    return along(vector, rotation.as_matrix().reshape(-1, 3, 3))


def along(vector: Floats, axes: Floats) -> Floats:
    """Parts (n, 3) of a vector (n, 3) along three axes, the rows (3, 3) or (n, 3, 3).

    Written out, because products of matrices round differently with the number of samples.
    """
    return vector[:, 0:1] * axes[..., 0] + vector[:, 1:2] * axes[..., 1] + vector[:, 2:3] * axes[..., 2]


def response(sensors: Sensors) -> TrueStep:
    """Readings of the three accelerometers: K_i a_i + b_i."""
    return putting("reading_mps2", lambda state: sensors.scales * state.input_mps2 + sensors.biases_mps2)


@dataclass(frozen=True)
class Disturbance:
    """Noise added to the readings; ``when_moving``: only in slews."""

    process: Process
    when_moving: bool = False

    def __call__(self, state: TrueState) -> None:
        if state.moving or not self.when_moving:
            state.reading_mps2 = state.reading_mps2 + self.process(len(state.time_s))


class WalkingBias(Disturbance):
    """One that moves the biases: where it ends, they are then."""
