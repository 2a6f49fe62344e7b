"""Formulas in C: an expression evaluated with pieces of C in place of numbers.

A plain number stays a number until it meets a piece of C, so that constants are computed here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from kf_calib.effects.expression import FUNCTIONS, OPERATORS, Expression
from kf_calib.errors import InputError

Piece = str | float
_LARGEST_POWER = 12
HELPERS = {
    "kf_calib_abs": "double x) { return x < 0.0 ? -x : x; }",
    "kf_calib_sign": "double x) { return (x > 0.0) - (x < 0.0); }",
    "kf_calib_min": "double x, double y) { return y < x ? y : x; }",
    "kf_calib_max": "double x, double y) { return y > x ? y : x; }",
    "kf_calib_power": "double x, int n) { double y = 1.0; while (n-- > 0) y *= x; return y; }",
}
"""Functions that a piece of C may call, from their parameters on."""
MATH = {"sin": "sin", "cos": "cos", "tan": "tan", "arctan": "atan", "tanh": "tanh", "exp": "exp", "log": "log",
        "sqrt": "sqrt"}  # fmt: skip
"""Functions of formulas that C has in <math.h>."""
_OWN = {"abs": "kf_calib_abs", "sign": "kf_calib_sign", "minimum": "kf_calib_min", "maximum": "kf_calib_max"}


def in_c(expression: Expression, names: Mapping[str, Piece]) -> str:
    """The expression as a piece of C; names: what each of its names is."""
    return number(expression(names, _OPERATORS, _FUNCTIONS))


def number(piece: Piece) -> str:
    """A piece of C as it is, a number with all its digits; raises InputError for one that C has no word for."""
    if isinstance(piece, str):
        return piece
    if not math.isfinite(piece):
        raise InputError("a constant in a formula is too large for C: write the formula with smaller numbers.")
    return f"{float(piece)!r}" if piece >= 0.0 else f"({float(piece)!r})"


def _operator(sign: str) -> Callable[..., Piece]:
    """Return what an operator makes of pieces."""

    def made(*pieces: Piece) -> Piece:
        if not any(isinstance(piece, str) for piece in pieces):
            return float(OPERATORS[sign](*pieces))
        words = [number(piece) for piece in pieces]
        if sign == "**":
            return _power(words, pieces[1])
        if len(words) == 1:
            return f"(-{words[0]})" if sign == "neg" else words[0]
        joined = f"({words[0]} {sign} {words[1]})"
        return f"(double){joined}" if sign[0] in "<>" else joined

    return made


def _power(words: list[str], exponent: Piece) -> str:
    """Return a power: a product where the exponent is a small whole number."""
    if isinstance(exponent, float) and exponent.is_integer() and 0 < exponent <= _LARGEST_POWER:
        return f"kf_calib_power({words[0]}, {exponent:.0f})"
    return f"pow({', '.join(words)})"


def _function(name: str) -> Callable[..., Piece]:
    """Return what a function makes of pieces."""

    def made(*pieces: Piece) -> Piece:
        if not any(isinstance(piece, str) for piece in pieces):
            return float(FUNCTIONS[name](*pieces))
        return f"{(MATH | _OWN)[name]}({', '.join(map(number, pieces))})"

    return made


_OPERATORS = {sign: _operator(sign) for sign in OPERATORS}
_FUNCTIONS = {name: _function(name) for name in FUNCTIONS}
