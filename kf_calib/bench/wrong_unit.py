"""What raw readings are in, where their norm at rest shows that it is not what is stated."""

from __future__ import annotations

from typing import NamedTuple

from kf_calib.bench.raw_input import LABELS, UNITS, RawInput

LEVELS = (0.5, 2.0)
"""Between these the norm of readings at rest is gravity, whatever their scale factors and biases."""
_NEAR = (0.8, 1.25)


class WrongUnit(NamedTuple):
    """sentence: what shows it, the likely cause, and what to state, without a full stop at the end. option: what states
    the likely unit, or a size of one count that gives gravity."""

    sentence: str
    option: str


def wrong_unit(level: float, stated: RawInput, gravity_mps2: float) -> WrongUnit:
    """The unit that readings are in; level: their norm at rest, made by the raw input that is stated, over gravity."""
    size = float(stated.factors.mean())
    raw = level * gravity_mps2 / size
    for unit, mps2 in UNITS.items():
        if _NEAR[0] <= raw * mps2 / gravity_mps2 <= _NEAR[1]:
            scale = "" if stated.sizes == (1.0, 1.0, 1.0) else " --accel-scale 1"
            option = f"--accel-unit {unit}{scale}{stated.restating('accel_unit')}"
            return WrongUnit(
                f"the readings have a norm of {raw:.4g} at rest, which is gravity in {LABELS[unit]}, not in "
                f"{stated.unit_words}: state it with {option}",
                option,
            )
    about, restating = f"{size / level / UNITS[stated.unit]:.3g}", stated.restating("accel_scale")
    return WrongUnit(
        f"the readings have a norm of {raw:.4g} {stated.unit_words} at rest, {level:.3g} times gravity "
        f"({gravity_mps2:.4g} m/s^2): they look like counts; give the size of one count in {LABELS[stated.unit]}, of "
        f"about {about}, with --accel-scale{restating}",
        f"--accel-scale {about}{restating}",
    )
