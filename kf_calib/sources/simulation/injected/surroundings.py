"""What the surroundings do: gravity, the Earth's rotation, magnetic field; and when a reading is taken."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from kf_calib.bench.arrays import Floats
from kf_calib.sources.simulation.injected.kinds import Rig, made
from kf_calib.sources.simulation.injected.terms import adding, column
from kf_calib.sources.simulation.physics import State, Step, along, carried_by_earth, earth_rate_radps, rotate, to_bench

_LATITUDE_RAD = math.radians(50.0)


@made("latency", "s", ("0.1ms", "5ms"), ("0.1ms", "5ms"), stage="angles", coefficients=("tau_d",), signed=False)
def latency(delay: Floats, rig: Rig) -> Step:
    """Latency: the reading stamped t is what was true at t - tau_d, for the block as a whole (acquisition chain)."""

    def step(state: State) -> None:
        state.time_s = np.maximum(state.time_s - delay[0], 0.0)
        state.angles_rad = rig.motion.angles_at(np.rint(state.time_s * 1e9).astype(np.int64))

    return step


@made("earth-rotation", "1", ("1", "1"), ("1", "1"), stage="attitude", coefficients=("share",))
def earth_rotation(share: Floats, rig: Rig, *, latitude: float = _LATITUDE_RAD) -> Step:
    """Rotation of the Earth: the platform is held in inertial space, so that gravity turns in it by share times
    15.041 deg/h more than is stated; ``latitude`` counts where the bench states none (WGS 84)."""
    stated_deg = rig.bench.latitude_deg
    latitude_deg = math.degrees(latitude) if stated_deg is None else stated_deg
    rate_radps = share[0] * earth_rate_radps(latitude_deg, rig.bench.azimuth_deg)

    def step(state: State) -> None:
        state.attitude = Rotation.from_rotvec(-column(state.time_s) * rate_radps) * state.attitude

    return step


@made("gravity-error", "1", ("10ppm", "700ppm"), ("10ppm", "700ppm"), stage="force", coefficients=("epsilon",))
def gravity_error(epsilon: Floats, rig: Rig) -> Step:
    """Wrong gravity: true is g (1 + epsilon), g is stated (gravimetry)."""

    def step(state: State) -> None:
        state.force_mps2 = state.force_mps2 * (1.0 + epsilon[0])

    return step


@made("magnetic", "m/s^2/T", ("1ug/G", "20ug/G"), ("20ug/G", "400ug/G"))
def magnetic(m: Floats, rig: Rig, *, north: float = 2e-5, up: float = -4.5e-5, east: float = 0.0) -> Step:
    """Magnetic sensitivity: m B along the input axis, E_i . B_p, of the local field, which is fixed to the Earth
    and given by its parts toward North, up and East (IEEE Std 1293)."""
    field = to_bench([north, up, east], rig.bench.azimuth_deg)[None]

    def contribution(state: State) -> Floats:
        in_platform = rotate(state.attitude.inv(), carried_by_earth(rig.bench, field, state.time_s))
        return m * along(in_platform, rig.sensors.input_axes)

    return adding(contribution)
