"""What an effect depends on, found by trying: which inputs change its columns when they alone are changed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kf_calib.bench.bench import Bench
from kf_calib.effects.effect import Effect, FrameEffect
from kf_calib.effects.frame import GravityError
from kf_calib.effects.stimulus import REFERENCE_TEMPERATURE_C, Stimulus

_TRIALS = 64
_WORDS = {
    "elapsed_s": "the course of time",
    "since_arrival_s": "the time since the arrival",
    "previous_force_mps2": "the orientation before",
    "pose": "the angles of the platform",
    "previous_pose": "the angles before",
    "variance_mps2_2": "vibration",
    "rate_radps": "the rate of turn",
    "rate_change_radps2": "the rate of turn",
}


def stimulus_of(force_mps2: np.ndarray, temperature_c: np.ndarray, bench: Bench, sensitivity: np.ndarray) -> Stimulus:
    """The state of the bench of which only specific force (n, 3) and temperature (n,) are known: all else is at rest.

    sensitivity (3, 3): rows K_i E_i.
    """
    count, width = len(force_mps2), bench.pose_width
    pose = np.zeros((count, width))
    if not bench.axes:
        pose[:, 3] = 1.0
    return Stimulus(
        bench=bench, elapsed_s=np.zeros(count), since_arrival_s=np.zeros(count), force_mps2=force_mps2,
        previous_force_mps2=force_mps2, pose=pose, previous_pose=pose, temperature_c=temperature_c,
        sensitivity=sensitivity, variance_mps2_2=np.zeros((count, 3)), rate_radps=np.zeros((count, 3)),
        rate_change_radps2=np.zeros((count, 3)), half_s=np.full(count, 0.5), within=np.zeros(count),
    )  # fmt: skip


def beyond_force_and_temperature(effect: Effect, bench: Bench) -> str:
    """What an effect depends on besides specific force and temperature, in words; empty if on nothing else.

    An effect of the platform is none of the sensor's, whatever it depends on: the sensor reads what it feels.
    """
    if isinstance(effect, FrameEffect):
        return "it is an error of the platform, not of the accelerometers"
    if isinstance(effect, GravityError):
        return "it is an error of the stated gravity, not of the accelerometers"
    if effect.walks:
        return "it depends on the course of time"
    rng = np.random.default_rng(1)
    still = _spread(bench, rng)
    before = effect.columns(still)
    for name, words in _WORDS.items():
        own = getattr(still, name)
        values = own + rng.uniform(0.1, 1.0, own.shape) * (100.0 if name.endswith("_s") else 1.0)
        if not np.array_equal(effect.columns(replace(still, **{name: np.sort(values, axis=0)})), before):
            return f"it depends on {words}"
    if effect.oscillates:
        return "it depends on the course of time"
    return ""


def depends_on_temperature(effect: Effect, bench: Bench) -> bool:
    """Whether the columns of an effect change with the temperature."""
    spread = _spread(bench, np.random.default_rng(1))
    constant = replace(spread, temperature_c=np.full(_TRIALS, REFERENCE_TEMPERATURE_C))
    return not np.array_equal(effect.columns(spread), effect.columns(constant))


def _spread(bench: Bench, rng: np.random.Generator) -> Stimulus:
    """Return instants at rest in directions and temperatures drawn at random, ten minutes altogether."""
    direction = rng.normal(size=(_TRIALS, 3))
    force = bench.gravity_mps2 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    temperature = REFERENCE_TEMPERATURE_C + rng.uniform(-20.0, 20.0, _TRIALS)
    return replace(stimulus_of(force, temperature, bench, np.eye(3)), elapsed_s=np.linspace(0.0, 600.0, _TRIALS))
