"""Expressions a user types: read as Python's grammar has them, refused unless harmless, evaluated by simpleeval.

Allowed are names, numbers, ``+ - * / **``, one comparison at a time (1 where it holds, else 0) and the functions
below. Text is bounded in length and nesting; constants are floats, so that ``9**9**9`` overflows instead of growing.

The unit of a formula: the same expression evaluated by pint with units in place of numbers.

A plain number stays a number, so that it can be an exponent; a plain 0 goes with any unit.
"""

from __future__ import annotations

import ast
import difflib
import warnings
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from typing import Any

import numpy as np

from kf_calib.bench.arrays import sign
from kf_calib.errors import InputError
from kf_calib.support.units import RAISED, field_unit, per_power_of_g

LENGTH_LIMIT = 300
LAG = "lag"
"""The function of a value and a time constant that needs the course of a run: it follows the value."""

_DEPTH_LIMIT = 30  # simpleeval takes three frames of Python's stack a level
_SIGNS: dict[type[ast.AST], str] = {
    ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Pow: "**", ast.USub: "neg", ast.UAdd: "pos",
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=",
}  # fmt: skip
OPERATORS: dict[str, Callable[..., Any]] = {
    "+": np.add, "-": np.subtract, "*": np.multiply, "/": np.true_divide, "**": np.power,
    "neg": np.negative, "pos": np.positive,
    "<": lambda a, b: np.less(a, b) * 1.0, "<=": lambda a, b: np.less_equal(a, b) * 1.0,
    ">": lambda a, b: np.greater(a, b) * 1.0, ">=": lambda a, b: np.greater_equal(a, b) * 1.0,
}  # fmt: skip
FUNCTIONS: dict[str, Callable[..., Any]] = {
    "sin": np.sin, "cos": np.cos, "tan": np.tan, "arctan": np.arctan, "tanh": np.tanh, "exp": np.exp, "log": np.log,
    "sqrt": np.sqrt, "abs": np.abs, "sign": np.sign, "minimum": np.minimum, "maximum": np.maximum,
    LAG: lambda value, tau: value,
}  # fmt: skip
"""Of numbers; what lags behind one that stays is the same."""
_OF_TWO = ("minimum", "maximum", LAG)
VALUES: dict[str, Callable[..., Any]] = {**FUNCTIONS, "sign": sign}
"""The functions as they are evaluated: what is next to 0 has no sign."""
_ALLOWED = (ast.BinOp, ast.UnaryOp, ast.Compare, ast.Call, ast.Name, ast.Constant, ast.Load, *_SIGNS)


class Expression:
    """An expression that was looked at and found harmless; names: the quantities in it, in the order they appear;
    lags: whether it needs the course of a run.

    Raises InputError where the text is no such expression. ``meanings``: the names it may use, and what they are.
    """

    def __init__(self, text: str, meanings: Mapping[str, str]) -> None:
        self.text = text.strip()
        self._tree = _parse(self.text)
        self.names = tuple(dict.fromkeys(_look(self._tree, meanings)))
        self.lags = f"{LAG}(" in self.text.replace(" ", "")

    def __call__(
        self,
        names: Mapping[str, Any],
        operators: Mapping[str, Callable[..., Any]] = OPERATORS,
        functions: Mapping[str, Callable[..., Any]] = VALUES,
    ) -> Any:
        """Its value for these values of its names; other operators and functions evaluate it in another algebra."""
        from simpleeval import SimpleEval

        # own operators: simpleeval's refuse arrays that are longer than a string may be, and powers of them
        signs = {kind: operators[sign] for kind, sign in _SIGNS.items()}
        run = SimpleEval(operators=signs, functions=dict(functions), names=dict(names))
        with np.errstate(all="ignore"):
            return run.eval(self.text, self._tree)


def _parse(text: str) -> ast.expr:
    if not text:
        raise InputError("there is no formula after the equals sign: write NAME = FORMULA, for example mine = a*T.")
    if len(text) > LENGTH_LIMIT:
        raise InputError(f"a formula of {len(text)} characters is too long: at most {LENGTH_LIMIT} are read.")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # "3if" is a SyntaxWarning, and no concern of the user's
            tree = ast.parse(text, mode="eval").body
    except (SyntaxError, ValueError, MemoryError, RecursionError) as error:
        place = getattr(error, "offset", None)
        where = f" at character {place}" if place else ""
        said = getattr(error, "msg", None) or "too deeply nested"
        raise InputError(
            f"{text!r} is not a formula ({said}{where}): write it as in Python, for example a*T."
        ) from None
    return tree


def _look(tree: ast.expr, meanings: Mapping[str, str]) -> Iterable[str]:
    """The names of a tree of nothing but what is allowed; its constants become floats."""
    waiting: list[tuple[ast.AST, int]] = [(tree, 1)]
    while waiting:
        node, depth = waiting.pop()
        if depth > _DEPTH_LIMIT:
            raise InputError(f"the formula is nested more than {_DEPTH_LIMIT} deep: write it with fewer parentheses.")
        if not isinstance(node, _ALLOWED):
            raise InputError(
                f"{_words(node)} cannot be in a formula: use names, numbers, + - * / ** and {_functions()}."
            )
        below = list(ast.iter_child_nodes(node))
        if isinstance(node, ast.Constant):
            node.value = _number(node.value)
        elif isinstance(node, ast.Name):
            yield _symbol_of(node.id, meanings)
        elif isinstance(node, ast.Compare) and len(node.ops) > 1:
            raise InputError(f"{_words(node)} compares more than two values: multiply two comparisons instead.")
        elif isinstance(node, ast.Call):
            below = _arguments(node)
        waiting += [(child, depth + 1) for child in reversed(below)]


def _words(node: ast.AST) -> str:
    try:
        text = ast.unparse(node)
    except (ValueError, AttributeError, RecursionError):  # an operator has no text of its own
        text = ""
    return " ".join(text.split())[:40] or f"the operator {type(node).__name__}"


def _number(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{str(value)[:40]!r} is not a real number: a formula holds names, numbers and functions.")
    try:
        return float(value)
    except OverflowError:
        raise InputError("a number in the formula is too large: write it as 1e30, up to 1e308.") from None


def _symbol_of(name: str, meanings: Mapping[str, str]) -> str:
    if name in meanings:
        return name
    if name in FUNCTIONS:
        raise InputError(f"{name} is a function: write what it is taken of in parentheses after it.")
    word = name.lower()
    near = [known for known in meanings if known.lower() == word]
    near += [known for known, meaning in meanings.items() if len(word) > 3 and word in meaning]
    near += difflib.get_close_matches(name, meanings, n=3, cutoff=0.6)
    hint = f"did you mean {' or '.join(dict.fromkeys(near[:3]))}? " if near else ""
    raise InputError(f"no quantity is called {name[:40]}: {hint}Known are {' '.join(meanings)}.")


def _arguments(call: ast.Call) -> list[ast.AST]:
    name = call.func.id if isinstance(call.func, ast.Name) else ""
    if name not in FUNCTIONS:
        raise InputError(f"{_words(call.func)} is not a function of formulas: use {_functions()}.")
    count = 2 if name in _OF_TWO else 1
    if call.keywords or len(call.args) != count:
        raise InputError(f"{name} takes {count} value{'s' * (count > 1)} in parentheses.")
    return list[ast.AST](call.args)


def _functions() -> str:
    return " ".join(FUNCTIONS)


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


def _lagging(value: PintUnit | float, tau: PintUnit | float) -> PintUnit:
    if not _unit(tau).is_compatible_with(_registry().Unit("s")):
        raise InputError(
            f"the time constant of {LAG} is in {text(_unit(tau))}: write it with a unit of time, as in {LAG}(T, 60*s)."
        )
    return _unit(value)


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


def numbers_stay(number: Callable[..., Any], rule: Callable[..., Any]) -> Callable[..., Any]:
    """What gives a number for numbers, and what the rule of another algebra makes of anything else."""

    def apply(*values: Any) -> Any:
        if all(isinstance(value, float) for value in values):
            return float(number(*values))
        return rule(*values)

    return apply


_RULES: dict[str, Callable[..., PintUnit]] = {
    "+": _alike("added"), "-": _alike("subtracted"), **dict.fromkeys(("<", "<=", ">", ">="), _compared),
    "*": lambda a, b: _unit(a) * _unit(b), "/": lambda a, b: _unit(a) / _unit(b), "**": _power,
    "neg": _unit, "pos": _unit, "abs": _unit, "sqrt": lambda a: _unit(a) ** 0.5, "sign": lambda a: _unit(a) ** 0,
    "minimum": _alike("compared"), "maximum": _alike("compared"), LAG: _lagging,
    **{name: _plain(f"what {name} is taken of") for name in ("sin", "cos", "tan", "arctan", "tanh", "exp", "log")},
}  # fmt: skip
_OPERATORS = {sign: numbers_stay(number, _RULES[sign]) for sign, number in OPERATORS.items()}
_FUNCTIONS = {name: numbers_stay(number, _RULES[name]) for name, number in FUNCTIONS.items()}
