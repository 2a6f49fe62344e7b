"""What an effect depends on, found by trying: which inputs change its columns when they alone are changed.

An effect is drawn against one quantity, over which what it adds to readings has a shape. An effect of the catalogue
states it (``Effect.drawn_against``), a formula has it in itself. What states none is drawn against what it adds with
its fitted coefficients: an effect of the platform against the turn that it makes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench
from kf_calib.effects.effect import Effect, Regressor, SensorEffect
from kf_calib.effects.formula import Formula, FrameFormula, Reading, quantities
from kf_calib.effects.frame import GravityError, RotationEffect
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
    if isinstance(effect, RotationEffect):
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
    backwards = effect.columns(replace(still, elapsed_s=still.elapsed_s[::-1]))
    return "it depends on the course of time" if effect.oscillates or not np.array_equal(backwards, before) else ""


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


_CONSTANTS = frozenset({"g", "s", "m", "K", "rad", "deg", "pi"})


@dataclass(frozen=True)
class Axis:
    """words: what it is. symbol: the same in the letters of formulas. unit: SI. of: its values, (m, 1) or (m, 3)."""

    words: str
    symbol: str
    unit: str
    of: Callable[[Stimulus], Floats]


def axis_of(effects: Sequence[Effect], bench: Bench) -> Axis | None:
    """The quantity that effects are drawn against together; None where it is what they add with fitted coefficients.

    Several effects have one if they state the same, as formulas of one quantity do.
    """
    first, *others = (_regressor(effect, bench) for effect in effects)
    if first is None or any(other != first for other in others):
        return None
    if not first.expression:
        assert isinstance(effects[0], SensorEffect)
        return Axis(first.words, "", first.unit, effects[0].terms)
    reading, known = Reading("axis", first.expression, bench), quantities(bench.axes)
    words = first.words or known[first.expression].meaning
    unit = first.unit or (known[first.expression].unit if first.expression in known else "")
    return Axis(words, first.expression.replace("**2", "²").replace("*", "·"), unit, reading)


def is_formula(effect: Effect) -> bool:
    """Whether an effect is a formula, not a class."""
    return isinstance(effect, Formula | FrameFormula)


def turned_gimbal(effects: Sequence[Effect]) -> int:
    """The number, from 1, of the gimbal about which all the effects turn the platform, whatever their coefficients; 0
    where there is no such gimbal."""
    gimbals = {effect.gimbal if isinstance(effect, RotationEffect) else None for effect in effects}
    number = gimbals.pop() if len(gimbals) == 1 else None
    return 0 if number is None else 1 + number


def _regressor(effect: Effect, bench: Bench) -> Regressor | None:
    """Return what an effect states; of a formula its only quantity, or else the formula as it stands."""
    if not isinstance(effect, Formula | FrameFormula):
        if isinstance(effect, SensorEffect) and effect.drawn_against is None:
            return Regressor("", f"what {effect} adds per unit of its coefficient", f"m/s^2 per {effect.unit}")
        return effect.drawn_against
    expression = effect.reading.expression
    names = [name for name in expression.names if name not in _CONSTANTS]
    if len(names) == 1:
        return Regressor(names[0])
    return Regressor(expression.text, f"the formula {expression.text}", effect.reading.unit or "SI")
