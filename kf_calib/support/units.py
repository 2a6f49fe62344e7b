"""Units: the program counts in SI; people read the units of the field or SI, and may write either.

    shown("m/s^2")                  # Unit("µg", 101971.6...): what the output for people is in now
    shown(run.parameters["K1"])     # Unit("ppm", 1e6)
    shown("rad").text(4.8e-6)       # "0.99 arcsec"
    with shown_in("si"): ...        # Unit("rad", 1.0) in here; ``--units si`` does this for a command
    quantity("3µg", "m/s^2")        # 2.94e-05: what a user wrote, in SI

Numbers in JSON are SI values and do not come here.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Literal, NamedTuple, Protocol

from kf_calib.errors import InputError, how_to_write

STANDARD_GRAVITY_MPS2 = 9.80665
"""By definition (3rd CGPM, 1901); g, mg and µg are in it wherever the bench stands."""

_G, _MICRO = STANDARD_GRAVITY_MPS2, 1e6
RAISED = str.maketrans("0123456789.-", "⁰¹²³⁴⁵⁶⁷⁸⁹·⁻")
"""Digits of a power, as printed."""


class Unit(NamedTuple):
    """label: as printed. per_si: how many of it make one SI unit, so that an SI value times it is in this unit."""

    label: str
    per_si: float

    def number(self, value: float, digits: int = 3, zeros: bool = False) -> str:
        """An SI value in this unit to significant ``digits``; zeros: with those at the end (0.130), for columns."""
        return significant(value * self.per_si, digits, zeros)

    def text(self, value: float, digits: int = 3) -> str:
        """The same with the label behind it."""
        return f"{self.number(value, digits)} {self.label}"

    def with_sigma(self, value: float, sigma: float) -> str:
        """An SI value and its sigma in this unit, as ``rounded`` writes them."""
        return f"{' ± '.join(self.rounded(value, sigma))} {self.label}"

    def rounded(self, value: float, sigma: float) -> tuple[str, str]:
        """An SI value and its sigma in this unit, rounded to two significant digits of sigma."""
        return rounded(value * self.per_si, sigma * self.per_si)


class Quantity(Protocol):
    """A parameter or coefficient: its SI unit, and the unit of the field that it is shown in."""

    @property
    def unit(self) -> str: ...
    @property
    def shown_unit(self) -> str: ...
    @property
    def per_si(self) -> float: ...


def per_power_of_g(power: float) -> Unit:
    """The unit of a coefficient that multiplies the nth power of an acceleration: µg, ppm, µg/g², µg/g³ ..."""
    label = {0.0: "µg", 1.0: "ppm"}.get(power, f"µg/g{f'{power:g}'.translate(RAISED)}")
    return Unit(label, _MICRO * _G ** (power - 1.0) if power else _MICRO / _G)


_FIELD = {
    "rad": Unit("arcsec", math.degrees(3600.0)),
    "1": per_power_of_g(1),
    "m/s^2": per_power_of_g(0),
    "s^2/m": per_power_of_g(2),
    "s^4/m^2": per_power_of_g(3),
    "rad s^2/m": Unit("arcsec/g", math.degrees(3600.0) * _G),
    "m/s^3": Unit("µg/h", 3600.0 * _MICRO / _G),
    "1/s": Unit("ppm/h", 3600.0 * _MICRO),
    "rad/s": Unit("µrad/day", 86400.0 * _MICRO),
    "m/s^2/K": Unit("µg/K", _MICRO / _G),
    "m/s^2/K^2": Unit("µg/K²", _MICRO / _G),
    "1/K": Unit("ppm/K", _MICRO),
    "rad/K": Unit("µrad/K", _MICRO),
    "m s^-1/K": Unit("µg per K/min", _MICRO / _G / 60.0),
    "m/s^2/s^(1/2)": Unit("µg/√s", _MICRO / _G),
    "m/s^2/Hz^(1/2)": Unit("µg/√Hz", _MICRO / _G),
    "rad/s/Hz^(1/2)": Unit("°/√h", math.degrees(60.0)),
    "rad/s^2/Hz^(1/2)": Unit("°/h/√h", math.degrees(3600.0 * 60.0)),
    "K/Hz^(1/2)": Unit("mK/√Hz", 1e3),
    "m/s^2 s": Unit("µg·s", _MICRO / _G),
    "K s": Unit("mK·s", 1e3),
    "K/s^(1/2)": Unit("mK/√s", 1e3),
}
"""SI unit -> unit of the field. One unit for all sizes: a bias is in µg, be it of a quartz accelerometer or a chip."""

_WHOLE = {
    "rad": [(0.01, _FIELD["rad"]), (math.inf, Unit("deg", math.degrees(1.0)))],
    "m/s^2": [(0.01, _FIELD["m/s^2"]), (math.inf, Unit("g", 1.0 / _G))],
    "s": [(300.0, Unit("s", 1.0)), (math.inf, Unit("min", 1.0 / 60.0))],
    "K": [(0.5, Unit("mK", 1e3))],
    "K/s": [(math.inf, Unit("K/h", 3600.0))],
    "m^2/s^4": [(math.inf, Unit("g²", 1.0 / _G**2))],
    "m^3/s^6": [(math.inf, Unit("g³", 1.0 / _G**3))],
    "K m/s^2": [(math.inf, Unit("K·g", 1.0 / _G))],
    "m/s": [(6e3, Unit("g·s", 1.0 / _G)), (math.inf, Unit("g·h", 1.0 / _G / 3600.0))],
}
"""SI unit -> units of quantities themselves, each for what is up to a size in SI."""

System = Literal["field", "si"]
_system: ContextVar[System] = ContextVar("units", default="field")


@contextmanager
def shown_in(system: System) -> Iterator[None]:
    """A context in which what is printed and drawn for people is in units of the field or in SI; numbers in JSON are in
    SI always.

    system: "field" (arcsec, ppm, µg ..., as everywhere else) or "si" (rad, 1, m/s^2 ...).
    """
    token = _system.set(system)
    try:
        yield
    finally:
        _system.reset(token)


def field_unit(unit: str) -> Unit:
    """The unit of the field for an SI unit, which stands for itself where the field has no other."""
    return _FIELD.get(unit, Unit(unit, 1.0))


def shown(of: str | Quantity) -> Unit:
    """The unit in which people are shown what is in this SI unit, or this parameter or coefficient."""
    if isinstance(of, str):
        return Unit(of, 1.0) if _system.get() == "si" else field_unit(of)
    return Unit(of.unit, 1.0) if _system.get() == "si" else Unit(of.shown_unit, of.per_si)


def shown_whole(unit: str, largest: float = math.inf) -> Unit:
    """The unit in which people are shown a quantity itself, not an error of it: a gimbal's angle in deg, force in g.

    largest: the greatest size that is shown, in SI; what is small is in a smaller unit.
    """
    if _system.get() == "si":
        return Unit(unit, 1.0)
    return next((shown_unit for bound, shown_unit in _WHOLE.get(unit, ()) if largest <= bound), Unit(unit, 1.0))


def significant(value: float, digits: int = 3, zeros: bool = False) -> str:
    """A number to significant digits; 1.2e+03 is written 1200, as no one reads powers of ten beside a unit."""
    text = f"{value:{'#' if zeros and value else ''}.{digits}g}".rstrip(".")
    return f"{float(text):.0f}" if "e+" in text and abs(value) < 1e9 else text


def span(seconds: float) -> str:
    """A duration as text, such as ``45 s``, ``12 min``, ``3.4 h`` or ``5 d``; "-" where it is unknown or infinite."""
    if not math.isfinite(seconds):
        return "-"
    for size, unit in ((86400.0, "d"), (3600.0, "h"), (60.0, "min")):
        if seconds >= 2.0 * size:
            return f"{significant(seconds / size, 2)} {unit}"
    return f"{seconds:.0f} s"


def rounded(value: float, sigma: float) -> tuple[str, str]:
    """A value and its sigma as text, rounded to two significant digits of sigma (GUM 7.2.6), with one power of ten
    where there would be many zeros."""
    if not (math.isfinite(sigma) and sigma > 0):
        return f"{value:.6g}", f"{sigma:.2g}"
    place = int(f"{sigma:.1e}".partition("e")[2])  # of 0.00998 as of 0.010, which it rounds to
    if _PLAIN[0] <= place <= _PLAIN[1]:
        decimals = max(0, 1 - place)
        return f"{value:.{decimals}f}", f"{sigma:.{decimals}f}"
    power = max(place, int(f"{abs(value):.1e}".partition("e")[2])) if value else place
    decimals, scale = power - place + 1, 10.0**-power
    return f"{value * scale:.{decimals}f}e{power:+03d}", f"{sigma * scale:.{decimals}f}e{power:+03d}"


_PLAIN = (-9, 7)
"""Places of the first digit of a sigma that is written without a power of ten."""


WORDS: dict[str, dict[str, float]] = {
    "1": {"": 1.0, "1": 1.0, "ppm": 1e-6, "permille": 1e-3, "%": 1e-2},
    "m/s^2": {"mps2": 1.0, "g": _G, "mg": 1e-3 * _G, "ug": 1e-6 * _G},
    "rad": {"rad": 1.0, "mrad": 1e-3, "urad": 1e-6, "deg": math.radians(1.0), "arcmin": math.radians(1 / 60),
            "arcsec": math.radians(1 / 3600)},
    "s": {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0, "day": 86400.0},
    "Hz": {"Hz": 1.0},
    "K": {"K": 1.0},
    "T": {"T": 1.0, "G": 1e-4},
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6},
}  # fmt: skip
"""Words of which a user makes units, by what they measure, with their size in SI."""

_POWERS = {"1": {}, "m/s^2": {"m": 1, "s": -2}, "Hz": {"s": -1}}
_FACTORS = {word: factor for words in WORDS.values() for word, factor in words.items()}
_MEASURED = {word: _POWERS.get(kind, {kind: 1}) for kind, words in WORDS.items() for word in words}
_NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^,]*?)\s*")
_WORD = re.compile(r"([A-Za-z%]+)\^?(-?[1-9])")
_TYPED = str.maketrans({"µ": "u", "μ": "u", "²": "^2", "³": "^3", "⁴": "^4"})


def si(text: str) -> float:
    """A number with or without a unit, in SI: ``4e-5``, ``4ug/g^2``, ``100 ppm/K``, ``5arcsec``, ``1ug*min/K``.

    A unit is made of ``WORDS`` with whole powers, as ``word^2``, times ``*`` and divided ``/`` by others.
    """
    return _read(text)[0]


def quantity(text: str, unit: str) -> float:
    """The same where the unit must measure what the SI ``unit`` does; raises InputError, also for 4ug of an angle."""
    value, written_unit = _read(text)
    if written_unit and _measured(written_unit) != _measured(unit):
        raise InputError(f"{text.strip()!r} is not in a unit of this kind: use {', '.join(choices(unit))}.")
    return value


def choices(unit: str) -> list[str]:
    """The units in which a quantity of this SI unit can be given, SI first."""
    words = [word for word in _FACTORS if word and _measured(word) == _measured(unit)]
    return [unit, *(word for word in words if word not in (unit, "mps2"))]


def _read(text: str) -> tuple[float, str]:
    """Return the value in SI and the unit as it was written."""
    match = _NUMBER.fullmatch(text)
    if not match:
        raise InputError(f"{text!r} is not a number: give one such as 4e-5 or 4ug/g^2{how_to_write(text)}.")
    over, under = _split(match[2])
    value = float(match[1]) * (math.prod(map(_factor, over)) / math.prod(map(_factor, under)))
    if not math.isfinite(value):
        raise InputError(f"{text!r} is not a finite number: give one such as 4e-5.")
    return value, match[2]


def _split(unit: str) -> tuple[list[tuple[str, int]], list[tuple[str, int]]]:
    """Return the words and powers of a unit above and below the first slash."""
    over, *under = re.sub(r"\s*([*/])\s*", r"\1", unit.translate(_TYPED)).replace(" ", "*").split("/")
    return [_power(word) for word in over.split("*")], [_power(word) for word in under]


def _power(word: str) -> tuple[str, int]:
    """Return a word and its power: m/s^2 may be written m/s2."""
    match = None if word in _FACTORS else _WORD.fullmatch(word)
    name, power = (match[1], int(match[2])) if match else (word, 1)
    if name not in _FACTORS:
        raise InputError(f"unit {word!r} is not known: use {', '.join(filter(None, _FACTORS))}, as in 4ug/g^2.")
    return name, power


def _factor(word: tuple[str, int]) -> float:
    return _FACTORS[word[0]] ** word[1]


def _measured(unit: str) -> dict[str, int]:
    """Return the powers of rad, m, s, K and T that a unit measures."""
    powers = Counter[str]()
    for sign, words in zip((1, -1), _split(unit), strict=True):
        for name, power in words:
            for base, exponent in _MEASURED[name].items():
                powers[base] += sign * power * exponent
    return {base: power for base, power in powers.items() if power}
