"""What raw readings are in, where their norm at rest shows that it is not what is stated."""

from __future__ import annotations

from kf_calib.bench.raw_input import LABELS, UNITS, RawInput

_NEAR = (0.8, 1.25)


def wrong_unit(level: float, stated: RawInput, gravity_mps2: float) -> str:
    """The likely cause and the option that states it, in words without a full stop at the end.

    level: the norm of the readings at rest, made by the raw input that is stated, over gravity.
    """
    size = float(stated.factors.mean())
    raw = level * gravity_mps2 / size
    for unit, mps2 in UNITS.items():
        if _NEAR[0] <= raw * mps2 / gravity_mps2 <= _NEAR[1]:
            scale = "" if stated.sizes == (1.0, 1.0, 1.0) else " --accel-scale 1"
            return (
                f"the readings have a norm of {raw:.4g} at rest, which is gravity in {LABELS[unit]}, not in "
                f"{stated.unit_words}: state it with --accel-unit {unit}{scale}{stated.restating}"
            )
    advice = f"give the size of one count in {LABELS[stated.unit]} with --accel-scale{stated.restating}"
    if stated.sizes != (1.0, 1.0, 1.0):
        about = size / level / UNITS[stated.unit]
        advice = f"one would be of about {about:.3g} {LABELS[stated.unit]}: --accel-scale{stated.restating} states it"
    return (
        f"the readings have a norm of {raw:.4g} {stated.unit_words} at rest, {level:.3g} times gravity "
        f"({gravity_mps2:.4g} m/s^2): they look like counts; {advice}"
    )
