"""What changes with time: t since the first sample."""

from __future__ import annotations

import math

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.sources.simulation.injected.kinds import Rig, added, made
from kf_calib.sources.simulation.injected.terms import column
from kf_calib.sources.simulation.noise_processes import FirstOrder
from kf_calib.sources.simulation.physics import BiasWalk, State, Step


@added("bias-drift", "m/s^2/s", ("1ug/h", "10ug/h"), ("10ug/min", "1mg/min"))
def bias_drift(k: Floats, state: State) -> Floats:
    """Bias drift: beta t (IEEE Std 1293, long-term stability)."""
    return k * column(state.time_s)


@added("scale-drift", "1/s", ("1ppm/day", "10ppm/day"), ("1ppm/h", "100ppm/h"))
def scale_drift(k: Floats, state: State) -> Floats:
    """Scale factor drift: kappa t a_i (IEEE Std 1293, long-term stability)."""
    return k * column(state.time_s) * state.input_mps2


@added("warm-up", "m/s^2", ("10ug", "200ug"), ("1mg", "10mg"))
def warm_up(k: Floats, state: State, *, tau: float = 1200.0) -> Floats:
    """Warm-up: B exp(-t / tau) after switching on at the first sample (IEEE Std 1293, turn-on transient)."""
    return k * column(np.exp(-state.time_s / tau))


@added("sinusoid", "m/s^2", ("0.01ug", "1ug"), ("1ug", "100ug"))
def sinusoid(k: Floats, state: State, *, frequency: float = 0.15, phase: float = 0.7) -> Floats:
    """Sinusoid in time: A sin(2 pi f t + phase); microseism at 0.1 to 0.3 Hz (Peterson, USGS OFR 93-322), mains."""
    return k * column(np.sin(2.0 * np.pi * frequency * state.time_s + phase))


@made("bias-walk", "m/s^2/s^(1/2)", ("0.01ug", "1ug"), ("1ug", "100ug"), signed=False)
def bias_walk(q: Floats, rig: Rig) -> Step:
    """Random walk of the bias: q times the integral of white noise, q sqrt(t) after a time t (IEEE Std 952, K)."""
    walk = FirstOrder(rig.generator("bias-walk"), 1.0, math.sqrt(rig.period_s), 0.0)
    return BiasWalk(lambda count: q * walk(count))


def _vibration_rectification(k: Floats, rig: Rig, *, rms: float, frequency: float, period: float) -> Step:
    """K2 <v^2> of the vibration below, the mean over its cycles."""

    def step(state: State) -> None:
        state.reading_mps2 = state.reading_mps2 + k * (rms * np.sin(np.pi * column(state.time_s) / period) ** 2) ** 2

    return step


@made(
    "vibration-rectification",
    "1/(m/s^2)",
    ("10ug/g^2", "50ug/g^2"),
    ("0.1mg/g^2", "3mg/g^2"),
    counted=_vibration_rectification,
)
def vibration_rectification(
    k: Floats, rig: Rig, *, rms: float = 3.0, frequency: float = 33.7, period: float = 170.0
) -> Step:
    """Vibration rectification: vibration v adds v + K2 v^2, so K2 <v^2>; v is a sinusoid of each accelerometer's own
    phase, in the readings too, whose effective value rises and falls as rms sin^2(pi t / period) (IEEE Std 1293)."""
    phases = rig.generator("vibration-rectification").uniform(0.0, 2.0 * np.pi, 3)

    def step(state: State) -> None:
        t = column(state.time_s)
        envelope = math.sqrt(2.0) * rms * np.sin(np.pi * t / period) ** 2
        shaken = envelope * np.sin(2.0 * np.pi * frequency * t + phases)
        state.reading_mps2 = state.reading_mps2 + shaken + k * shaken**2

    return step
