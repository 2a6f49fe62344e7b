"""Units of coefficients as instruments' data sheets write them, converted to SI."""

from __future__ import annotations

import math
import re

from kf_calib.errors import InputError, how_to_write

STANDARD_GRAVITY_MPS2 = 9.80665

UNITS = {
    "": 1.0, "1": 1.0, "ppm": 1e-6, "permille": 1e-3,
    "g": STANDARD_GRAVITY_MPS2, "mg": 1e-3 * STANDARD_GRAVITY_MPS2, "ug": 1e-6 * STANDARD_GRAVITY_MPS2, "mps2": 1.0,
    "rad": 1.0, "mrad": 1e-3, "urad": 1e-6, "deg": math.radians(1.0), "arcmin": math.radians(1 / 60),
    "arcsec": math.radians(1 / 3600),
    "ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0, "day": 86400.0, "Hz": 1.0,
    "K": 1.0, "T": 1.0, "G": 1e-4, "m": 1.0, "cm": 1e-2, "mm": 1e-3,
}  # fmt: skip
"""Factors to m/s^2, rad, s, K, T, m."""

_NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*")


def si(text: str) -> float:
    """A number with or without a unit, in SI: ``4e-5``, ``4ug/g^2``, ``100 ppm/K``, ``5arcsec``, ``1ug*min/K``.

    A unit is made of words of ``UNITS`` with whole powers, as ``word^2``, times ``*`` and divided ``/`` by others.
    """
    match = _NUMBER.fullmatch(text)
    if not match:
        raise InputError(f"{text!r} is not a number: give one such as 4e-5 or 4ug/g^2{how_to_write(text)}.")
    value = float(match[1]) * _factor(match[2])
    if not math.isfinite(value):
        raise InputError(f"{text!r} is not a finite number: give one such as 4e-5.")
    return value


def _factor(unit: str) -> float:
    over, *under = unit.split("/")
    return math.prod(map(_power, over.split("*"))) / math.prod(map(_power, under))


def _power(word: str) -> float:
    name, _, power = word.partition("^")
    if name not in UNITS or (power and not re.fullmatch(r"[1-9]", power)):
        raise InputError(f"unit {word!r} is not known: use {', '.join(filter(None, UNITS))}, as in 4ug/g^2.")
    return UNITS[name] ** int(power or 1)
