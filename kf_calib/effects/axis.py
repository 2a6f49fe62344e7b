"""What an effect is drawn against: the quantity over which what it adds to readings has a shape.

An effect of the catalogue states it (``Effect.drawn_against``), a formula has it in itself. What states none is drawn
against what it adds with its fitted coefficients: an effect of the platform against the turn that it makes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench
from kf_calib.effects.effect import Effect, FrameEffect, Regressor, SensorEffect
from kf_calib.effects.formula import Formula, FrameFormula, Reading, quantities
from kf_calib.effects.stimulus import Stimulus

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


def turned_about(effects: Sequence[Effect]) -> Callable[[Stimulus], Floats] | None:
    """The axis (m, 3), of unit length, about which all the effects turn the platform, whatever their coefficients;
    None where there is no such axis."""
    gimbals = {effect.gimbal if isinstance(effect, FrameEffect) else None for effect in effects}
    first = effects[0]
    return first.about if isinstance(first, FrameEffect) and None not in gimbals and len(gimbals) == 1 else None


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
