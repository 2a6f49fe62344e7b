"""The unit of a formula: the same expression evaluated by pint with units in place of numbers.

A plain number stays a number, so that it can be an exponent; a plain 0 goes with any unit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

from kf_calib.effects.expression import FUNCTIONS, OPERATORS, Expression
from kf_calib.errors import InputError
from kf_calib.support.units import RAISED, field_unit, per_power_of_g

_ORDER = {"radian": "rad", "meter": "m", "second": "s", "kelvin": "K"}
_POWER_LIMIT = 12.0
PintUnit = Any
"""pint.Unit; pint is imported where a formula is used only."""


@cache
def _registry() -> Any:
    import pint

    no_file: Any = None  # pint takes it, and its annotation does not say so
    units = pint.UnitRegistry(no_file)  # four definitions instead of the thousand of its file
    for line in ("meter = [length] = m", "second = [time] = s", "kelvin = [temperature] = K", "radian = [] = rad"):
        units.define(line)
    return units


def pint_unit_of(expression: Expression, units: Mapping[str, str]) -> PintUnit:
    """The unit of an expression over quantities of these ``units``; raises InputError where they do not fit."""
    names = {name: _registry().Unit(units[name]) for name in expression.names}
    return _unit(expression(names, _OPERATORS, _FUNCTIONS))


def coefficient_units(unit: PintUnit) -> tuple[str, tuple[str, float]]:
    """SI unit of the coefficient of an expression in ``unit``; and the unit of the field, with how many make one SI.

    Where the expression holds the nth power of an acceleration, the coefficient is told in µg per g^n, as the
    catalogue does.
    """
    acceleration = _registry().Unit("m/s^2")
    si_unit = text(acceleration / unit)
    power = _exponents(unit).get("meter", 0.0)
    if power not in (0.0, 1.0, 2.0, 3.0, 4.0):
        return si_unit, (si_unit, 1.0)
    shown = per_power_of_g(power)
    return si_unit, (text(acceleration**power / unit, shown.label, raised=True), shown.per_si)


def turning_units(unit: PintUnit) -> tuple[str, tuple[str, float]]:
    """The same of the coefficient of an expression that is an angle per unit of the coefficient; told in arcsec."""
    own, shown = _registry().Unit("rad") / unit, field_unit("rad")
    return text(own), (text(1 / unit, shown.label), shown.per_si)


def text(unit: PintUnit, head: str = "", raised: bool = False) -> str:
    """A unit in one line, for example ``rad s^2/m``; after ``head`` if there is one, exponents ``raised`` or not."""

    def power(name: str, exponent: float) -> str:
        if exponent == 1.0:
            return name
        return name + (f"{exponent:.4g}".translate(RAISED) if raised else f"^{exponent:.4g}")

    found = _exponents(unit)
    powers = [(short, found[name]) for name, short in _ORDER.items() if found.get(name)]
    above = [*([head] if head else []), *(power(name, value) for name, value in powers if value > 0)]
    return "".join([" ".join(above) or "1", *(f"/{power(name, -value)}" for name, value in powers if value < 0)])


def _exponents(unit: PintUnit) -> dict[str, float]:
    return {name: float(value) for name, value in _registry().Quantity(1.0, unit).unit_items()}


def _unit(value: PintUnit | float) -> PintUnit:
    return _registry().Unit("") if isinstance(value, float) else value


def _alike(verb: str) -> Callable[..., PintUnit]:
    def rule(one: PintUnit | float, other: PintUnit | float) -> PintUnit:
        if _zero(one) or _zero(other):
            return _unit(other if _zero(one) else one)
        left, right = _unit(one), _unit(other)
        if not left.is_compatible_with(right):
            raise InputError(
                f"{text(left)} and {text(right)} cannot be {verb}: multiply or divide by g, or by a number with a unit "
                "(10*K, 60*s), until both have the same unit."
            )
        return left

    return rule


def _compared(one: PintUnit | float, other: PintUnit | float) -> PintUnit:
    return _alike("compared")(one, other) ** 0


def _zero(value: PintUnit | float) -> bool:
    return isinstance(value, float) and value == 0.0


def _power(base: PintUnit | float, exponent: PintUnit | float) -> PintUnit:
    if not isinstance(exponent, float):
        _plain("an exponent")(exponent)
        return _plain("the base of a varying power")(base)
    if abs(exponent) > _POWER_LIMIT:
        raise InputError(f"a power of {exponent:.3g} is too high: {_POWER_LIMIT:g} is the most.")
    return _unit(base) ** exponent


def _plain(what: str) -> Callable[..., PintUnit]:
    def rule(value: PintUnit | float) -> PintUnit:
        unit = _unit(value)
        if not unit.dimensionless:
            own = text(unit).replace("^", "**").replace(" ", "*")
            raise InputError(
                f"{what} must be a number without unit, and here it is in {text(unit)}: divide what is in it by a "
                f"constant of that unit, for example by (10*{own})."
            )
        return _registry().Unit("")

    return rule


def _numbers_stay(number: Callable[..., Any], rule: Callable[..., PintUnit]) -> Callable[..., PintUnit | float]:
    def apply(*values: PintUnit | float) -> PintUnit | float:
        if all(isinstance(value, float) for value in values):
            return float(number(*values))
        return rule(*values)

    return apply


_RULES: dict[str, Callable[..., PintUnit]] = {
    "+": _alike("added"), "-": _alike("subtracted"), **dict.fromkeys(("<", "<=", ">", ">="), _compared),
    "*": lambda a, b: _unit(a) * _unit(b), "/": lambda a, b: _unit(a) / _unit(b), "**": _power,
    "neg": _unit, "pos": _unit, "abs": _unit, "sqrt": lambda a: _unit(a) ** 0.5, "sign": lambda a: _unit(a) ** 0,
    "minimum": _alike("compared"), "maximum": _alike("compared"),
    **{name: _plain(f"what {name} is taken of") for name in ("sin", "cos", "tan", "arctan", "tanh", "exp", "log")},
}  # fmt: skip
_OPERATORS = {sign: _numbers_stay(number, _RULES[sign]) for sign, number in OPERATORS.items()}
_FUNCTIONS = {name: _numbers_stay(number, _RULES[name]) for name, number in FUNCTIONS.items()}
