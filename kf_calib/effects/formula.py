"""A user's own effect as a formula over what the bench does: ``mine = fx*fy*T``.

One coefficient for each accelerometer, ``mine1 mine2 mine3``; reading i is ``mine_i`` times the formula larger. With
a gimbal after its name, ``mine:z = sin(3*q_z)``, the formula is an error of that gimbal's angle; as in ``mine:base =
T`` a tilt of the base about North and East, and as in ``mine:platform = t`` a turn of the platform about its own axes.
The quantities (f and a without accelerometer errors, all in SI units):

=================  =======  ============================================================================
name               unit     what it is
=================  =======  ============================================================================
fx fy fz           m/s^2    specific force in the platform frame
a p o              m/s^2    the same along the input, pendulous and output axis of the accelerometer
da                 m/s^2    last step of a from dwell to dwell; 0 in the first
play1 play3 play6  m/s^2    a through a play of 1, 3 or 6 m/s^2 to either side: it follows where it is pushed
T                  K        temperature less 25 degC; 0 where it is not measured
dT                 K/s      rate of the temperature
t                  s        time since the first sample
tau                s        time since the arrival in the dwell
q1 q2 q3 ...       rad      gimbal angles, outer first; also outer, inner, and q_x q_y q_z where one is
q1_before ...      rad      the same in the dwell before
q1_move ...        rad      last move of a gimbal; 0 where it stood still, but for noise and rounding
q1_way ...         rad      way that a gimbal has turned since the first dwell, in either sense
g                  m/s^2    local gravity
s m K rad deg pi            units and the number, to make a formula's units agree: exp(-tau/(60*s))
=================  =======  ============================================================================

``lag(T, 60*s)`` is what follows T with a time constant of 60 s, and was in balance at first; so of any quantity.
``q1_way - lag(q1_way, 600*s)`` is what a gimbal's motor has warmed, and has not yet lost.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench, Vector
from kf_calib.effects import checks
from kf_calib.effects.effect import Bearer, SensorEffect, interleaved
from kf_calib.effects.expression import LAG, VALUES, Expression
from kf_calib.effects.frame import RotationEffect, gimbal_number
from kf_calib.effects.quantities import gimbal_letters, quantities
from kf_calib.effects.stimulus import Stimulus
from kf_calib.errors import InputError

NAME_RULE = "letters, digits, - and _, a letter first, at most 40 of them"
BASE, PLATFORM = "base", "platform"
"""After a formula's name: it tilts the base, or turns the platform, and the block on it."""

_LARGE_RAD = 1e-3
_LARGE_MPS2 = 1e-3  # what a prior lets a coefficient add to a typical reading


def split(text: str) -> tuple[str, str]:
    """Name and expression of ``NAME = FORMULA``; raises InputError where the name is none."""
    name, _, expression = (" ".join(part.split()) for part in text.partition("="))  # on one line
    if not is_name(name.partition(":")[0]):
        raise InputError(f"{name[:60]!r} cannot name an effect: write NAME = FORMULA, the name of {NAME_RULE}.")
    return name, expression


def is_name(text: str) -> bool:
    return re.fullmatch(r"[A-Za-z][A-Za-z0-9_-]{0,39}", text) is not None


def symbol_stem(name: str) -> str:
    """What the number of the accelerometer is put after."""
    return f"{name}_" if name[-1].isdigit() else name


class Reading:
    """A formula read: its expression over the quantities of the bench."""

    def __init__(self, name: str, expression: str, bench: Bench) -> None:
        self.name, self._known = name, quantities(bench.axes)
        try:
            self.expression = Expression(expression, {key: each.meaning for key, each in self._known.items()})
        except InputError as error:
            raise InputError(f"{name}: {error}") from None

    def __call__(self, s: Stimulus) -> Floats:
        """Values (m, 1) or (m, 3)."""
        return s.of_course(self._in_course) if self.expression.lags else self._values(s, VALUES)

    def _in_course(self, course: Stimulus) -> Floats:
        """Return values where all instants of a run are in order of time."""
        return self._values(course, VALUES | {LAG: partial(self._lag, course)})

    def _values(self, s: Stimulus, functions: dict[str, Callable[..., Any]]) -> Floats:
        """Return values (m, 1) or (m, 3), with these functions."""
        names = {name: self._known[name].of(s) for name in self.expression.names}
        values = self.expression(names, functions=functions)
        return np.array(np.broadcast_to(values, (len(s), np.shape(values)[-1] if np.ndim(values) else 1)), dtype=float)

    def _lag(self, course: Stimulus, values: Floats | float, tau_s: Floats | float) -> Floats:
        """Return what follows values in a run; raises InputError where the time constant is none."""
        constants = np.unique(tau_s)
        if not (len(constants) == 1 and 0.0 < constants[0] < np.inf):
            raise InputError(f"{self.name}: {LAG} needs one time constant above 0, as in {LAG}(T, 60*s).")
        return course.lag(values, float(constants[0]))

    @property
    def units(self) -> dict[str, str]:
        """Of the quantities, by name."""
        return {key: quantity.unit for key, quantity in self._known.items()}

    @property
    def unit(self) -> str:
        """SI unit of the formula; "" where its units do not fit, as those of one may that the program has written."""
        from kf_calib.effects.expression import pint_unit_of, text

        try:
            return text(pint_unit_of(self.expression, self.units))
        except InputError:
            return ""

    def typical(self, stimulus: Stimulus) -> float:
        """Rms on a trial run, to a power of ten."""
        size = np.abs(self(stimulus))
        largest = float(size.max())
        if not 1e-60 < largest < 1e60:
            raise InputError(f"{self.name} has values up to {largest:.1e}: multiply the formula by a constant.")
        return 10.0 ** round(math.log10(largest * np.sqrt(np.mean((size / largest) ** 2))))


def _units(reading: Reading, turning: bool) -> tuple[str, tuple[str, float]]:
    """SI unit of a formula's coefficients, a unit of the field, and how many of it are one; of angles, or readings."""
    from kf_calib.effects.expression import coefficient_units, pint_unit_of, turning_units

    try:
        unit = pint_unit_of(reading.expression, reading.units)
        return turning_units(unit) if turning else coefficient_units(unit)
    except InputError as error:
        raise InputError(f"{reading.name}: {error}") from None


def _check(effect: Formula | FrameFormula, bench: Bench, large: float) -> None:
    """Give an effect its units, what its checks say, and the scale of its coefficients: with it, it adds ``large`` on a
    trial run. Raises InputError where it cannot be used."""
    reading, turning = effect.reading, isinstance(effect, RotationEffect)
    stimulus = _trial(bench.axes, bench.gravity_mps2)
    unit, shown = _units(reading, turning)
    if turning and reading(stimulus).shape[1] != 1:
        words = "an angle is one for the whole block: use fx, fy, fz in place of a, p, o and da."
        raise InputError(f"{effect.name}: {words}")
    vars(effect).update(unit=unit, shown=shown)
    vars(effect).update(remarks=checks.check_effect(effect, stimulus), scale=large / reading.typical(stimulus))


class Formula(SensorEffect):
    """An effect ``name = expression``; raises InputError, with the formula in it, where it cannot be used.

    text: what gives the same effect again; remarks: what its checks had to say. The unit of the coefficients follows
    from that of the expression, their scale from what they add on a trial run: about 1e-3 m/s^2. Not ``checked`` are
    formulas that the program has written itself, to see what they explain: they have no units, and the scale 1.
    """

    source, confused_with = "user's formula", ""
    borne_by = Bearer.EITHER

    def __init__(self, name: str, expression: str, bench: Bench, checked: bool = True) -> None:
        self.reading = Reading(name, expression, bench)
        self.text, self.remarks = f"{name} = {expression}", tuple[str, ...]()
        # of the class in the catalogue; here each formula has its own
        vars(self).update(name=name, title=expression, symbol=symbol_stem(name), unit="", shown=("", 1.0), scale=1.0)
        if checked:
            _check(self, bench, _LARGE_MPS2)

    def terms(self, s: Stimulus) -> Floats:
        terms = np.array(np.broadcast_to(self.reading(s), (len(s), 3)), dtype=float)
        checks.refuse_not_finite(self, terms, s)
        return terms


class FrameFormula(RotationEffect):
    """An effect ``name:place = expression``: an error of a gimbal's angle, a tilt of the base about North and East, or
    a turn of the platform about its three axes.

    Raises InputError like ``Formula``, and where the expression is not one value for the whole block.
    """

    source, confused_with = "user's formula", ""
    borne_by = Bearer.EITHER

    def __init__(self, name: str, place: str, expression: str, bench: Bench, checked: bool = True) -> None:
        self.reading = Reading(name, expression, bench)
        self.text, self.remarks = f"{name}:{place} = {expression}", tuple[str, ...]()
        self.gimbal = None if place in (BASE, PLATFORM) else gimbal_number(place, gimbal_letters(bench.axes))
        axes = {BASE: "NE", PLATFORM: "XYZ"}.get(place, [f"_{place}"])
        symbols = tuple(f"{symbol_stem(name)}{axis}" for axis in axes)
        vars(self).update(
            name=name, variant=place, title=expression, symbols=symbols, unit="", shown=("", 1.0), scale=1.0,
            bearers=interleaved(len(symbols)),
        )  # fmt: skip
        if checked:
            _check(self, bench, _LARGE_RAD)

    def rotations(self, s: Stimulus) -> Floats:
        values = self.reading(s)
        checks.refuse_not_finite(self, values, s)
        if self.variant == PLATFORM:
            return -values[:, :, None] * np.eye(3)
        axes = self.about(s)[:, None] if self.gimbal is not None else -s.level_in_platform
        return values[:, :, None] * axes


@lru_cache(maxsize=8)
def _trial(axes: tuple[Vector, ...], gravity_mps2: float) -> Stimulus:
    """The trial run of a bench: no formula can write into it, so all share it."""
    return checks.trial(Bench(axes, gravity_mps2))


@lru_cache(maxsize=1 << 12)
def formula(text: str, axes: tuple[Vector, ...], gravity_mps2: float, checked: bool = True) -> Formula | FrameFormula:
    """The formula's effect, made once for each bench: a run asks for it many times."""
    (full, expression), bench = split(text), _trial(axes, gravity_mps2).bench
    name, _, place = full.partition(":")
    if place:
        return FrameFormula(name, place, expression, bench, checked)
    return Formula(name, expression, bench, checked)
