"""The catalogue of physical effects: names, and how to make one.

Nothing outside this package knows an effect's name. A class listed here is found by the command line, both engines,
batch least squares, the views and the tests.
"""

from __future__ import annotations

import difflib

from kf_calib.bench import Bench
from kf_calib.effects import drift, frame, sensor, thermal
from kf_calib.effects.effect import Coefficient, Effect, FrameEffect, SensorEffect
from kf_calib.effects.stimulus import Stimulus
from kf_calib.errors import InputError

__all__ = ["Coefficient", "Effect", "FrameEffect", "SensorEffect", "Stimulus", "effect_named", "names"]

_PLAIN: dict[str, type[Effect]] = {
    kind.name: kind
    for kind in (
        sensor.BiasAsymmetry, sensor.ScaleAsymmetry, sensor.SecondOrder, sensor.ThirdOrder, sensor.OddQuadratic,
        sensor.CrossCouplingIP, sensor.CrossCouplingIO, sensor.CrossCouplingPO, sensor.CrossAxisSquare,
        drift.BiasDrift, drift.ScaleDrift, drift.Hysteresis,
        thermal.ThermalBias, thermal.ThermalBias2, thermal.ThermalScale, thermal.ThermalRate,
        thermal.ThermalMisalignment,
        frame.BaseTilt, frame.BaseTiltDrift, frame.PlatformDrift, frame.GravityError,
        frame.EarthRotation, frame.Flexure, frame.CrossTalk,
    )
}  # fmt: skip
_OF_A_GIMBAL = {
    kind.name: kind
    for kind in (
        frame.EncoderOffset, frame.EncoderScale, frame.EncoderHarmonic1, frame.EncoderHarmonic2,
        frame.AxisNonorthogonality,
    )
}  # fmt: skip


def _letters(bench: Bench) -> str:
    """A letter for each gimbal: its axis, or ? where it is none of x, y, z."""
    return "".join(
        "xyz"[max(range(3), key=lambda k, a=axis: abs(a[k]))] if 1.0 in map(abs, axis) else "?" for axis in bench.axes
    )


def names(bench: Bench) -> list[str]:
    """Every effect of the catalogue that this bench can have, axis-wise ones with their axis after a colon."""
    letters = _letters(bench)
    variants = [letter if letters.count(letter) == 1 else str(k + 1) for k, letter in enumerate(letters)]
    plain = [name for name in _PLAIN if name != frame.EarthRotation.name or bench.latitude_deg is not None]
    return [*plain, *(f"{name}:{variant}" for name in _OF_A_GIMBAL for variant in variants)]


def effect_named(text: str, bench: Bench) -> Effect:
    """The effect of that name; raises InputError, with near names, where there is none."""
    name, _, variant = text.partition(":")
    if name in _PLAIN and not variant:
        return _PLAIN[name]()
    if name in _OF_A_GIMBAL and variant:
        return _OF_A_GIMBAL[name](frame.gimbal_number(variant, _letters(bench)), variant)
    near = difflib.get_close_matches(text, names(bench), n=3, cutoff=0.4)
    hint = f"did you mean {' or '.join(near)}?" if near else f"the catalogue has {', '.join(names(bench))}."
    raise InputError(f"no effect is called {text!r}: {hint}")
