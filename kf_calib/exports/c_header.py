"""C: a header with one function, which needs no other file, nor a library where no formula has a sine or the like.

    kf_calib_correct(reading, temperature_c, out)

    f = C (reading - b - e(f, T)),   T = temperature_c - 25 degC

begun at C (reading - b) and repeated as often as the last digits need, which is a fixed number. The function takes what
the device sends: order, sign and size of its channels are in it. C99, doubles; out in m/s^2 (it may be the same array),
temperature in degC, NaN where it is not known.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping
from functools import partial

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.effects import Effect
from kf_calib.effects.effect import own_formula
from kf_calib.effects.expression import FUNCTIONS, LAG, OPERATORS, Expression, numbers_stay
from kf_calib.effects.formula import Formula, quantities
from kf_calib.errors import InputError
from kf_calib.exports.target import Target, in_comment

_SIZES = (1e-8, 1e-5, 1e-3, 1.0, 2.0)
"""Of specific force, in g: so that the rounds are enough in a dead zone, too."""


class CHeader(Target):
    """All effects that depend on specific force and temperature; raises InputError for a class of the user's."""

    title = "C"

    def text(self) -> str:
        sums = [" + ".join(self._terms(i)) for i in range(3)]
        body = "\n".join(f"    {line}" for line in self._body(sums))
        used = " ".join(sums)
        needed = [f"static inline double {name}({rest}" for name, rest in HELPERS.items() if name in used]
        include = ["#include <math.h>"] if re.search(rf"\b(pow|{'|'.join(MATH.values())})\(", used) else []
        return "\n".join([
            *self._comments(), "#ifndef KF_CALIB_CORRECT_H", "#define KF_CALIB_CORRECT_H", *include, *needed, "",
            "static inline void kf_calib_correct(const double reading[3], double temperature_c, double out[3])",
            "{", body, "}", "", "#endif", "",
        ])  # fmt: skip

    def _comments(self) -> Iterator[str]:
        names = ["alignment", "scale factor", "bias", *(in_comment(str(effect)) for effect in self.correction.effects)]
        yield f"// Specific force, m/s^2, from a raw reading: {self.origin}."
        yield f"// It {self.takes}."
        yield f"// Corrected for {', '.join(names)}."
        for name in self.correction.left_out:
            yield f"// Not corrected for {in_comment(name)}."

    def _body(self, sums: list[str]) -> Iterator[str]:
        correction, used = self.correction, "".join(sums)
        yield f"static const double c[3][3] = {_array(correction.matrix)};"
        bias = ", ".join(f"{self._reading(i)} - {text_of_number(float(b))}" for i, b in enumerate(correction.bias_mps2))
        yield f"const double z[3] = {{{bias}}};"
        if not used:
            yield "(void)temperature_c;"
            yield f"for (int i = 0; i < 3; i++) out[i] = {_product('c[i]', 'z')};"
            return
        if re.search(r"\bT\b", used):
            yield "const double T = temperature_c == temperature_c ? temperature_c - 25.0 : 0.0;"
        else:
            yield "(void)temperature_c;"
        sensitivity = correction.sensitivity
        along = sensitivity / np.linalg.norm(sensitivity, axis=1, keepdims=True)
        # what the specific force is multiplied by: a along the input axes, r as it is read
        matrices = {name: own for name, own in {"a": along, "r": sensitivity}.items() if f"{name}[" in used}
        yield from (f"static const double {name}_axes[3][3] = {_array(own)};" for name, own in matrices.items())
        yield f"double f[3], e[3] = {{0.0, 0.0, 0.0}}{''.join(f', {name}[3]' for name in matrices)};"
        yield f"for (int i = 0; i < 3; i++) f[i] = {_product('c[i]', 'z')};"
        yield f"for (int n = 0; n < {self._rounds()}; n++) {{"
        for name in matrices:
            yield f"    for (int i = 0; i < 3; i++) {name}[i] = {_product(f'{name}_axes[i]', 'f')};"
        yield from (f"    e[{i}] = {own};" for i, own in enumerate(sums))
        yield f"    for (int i = 0; i < 3; i++) f[i] = {_product('c[i]', 'z', 'e')};"
        yield "}"
        yield "for (int i = 0; i < 3; i++) out[i] = f[i];"

    def _reading(self, i: int) -> str:
        """The reading of accelerometer i, from 0, in m/s^2."""
        column = abs(self.input.channels[i]) - 1
        factor = float(self.input.matrix[i, column])
        return f"reading[{column}]" if factor == 1.0 else f"{text_of_number(factor)} * reading[{column}]"

    def _terms(self, i: int) -> Iterator[str]:
        """What accelerometer i, from 0, reads more: coefficients times formulas."""
        names = self._names(i)
        for effect in self.correction.effects:
            part = self.correction.model.parts[str(effect)]
            own = self.correction.state[part.start : part.start + len(effect.coefficients)]
            expressions = self._expressions(effect)
            values = own[i * len(expressions) : (i + 1) * len(expressions)]
            for value, expression in zip(values, expressions, strict=True):
                constants: Mapping[str, TextOfC] = {"constant": effect.value} if "constant" in expression.names else {}
                every = dict.fromkeys(expression.names, 0.0) | names | constants
                yield f"{text_of_number(float(value))} * {in_c(expression, every)}"

    def _names(self, i: int) -> dict[str, TextOfC]:
        """What the names in a formula are in C, for accelerometer i; all else is at rest."""
        constants = {name: quantity.of for name, quantity in quantities(self.correction.bench.axes).items()
                     if name in ("s", "m", "K", "rad", "deg", "pi")}  # fmt: skip
        others = [j for j in range(3) if j != i]
        return {name: float(of(None)) for name, of in constants.items()} | {  # pyright: ignore[reportArgumentType]
            "g": self.correction.bench.gravity_mps2, "fx": "f[0]", "fy": "f[1]", "fz": "f[2]", "T": "T",
            "a": f"a[{i}]", "p": f"f[{(i + 1) % 3}]", "o": f"f[{(i + 2) % 3}]",
            "before": f"r[{others[0]}]", "after": f"r[{others[1]}]",
        }  # fmt: skip

    def _expressions(self, effect: Effect) -> list[Expression]:
        """The formulas of an effect, one for each coefficient that an accelerometer has."""
        if isinstance(effect, Formula):
            known = quantities(self.correction.bench.axes)
            return [Expression(effect.title, {name: each.meaning for name, each in known.items()})]
        if not effect.formulas:
            raise InputError(f"{effect} is a class in Python, which cannot be written in C: use kf-calib apply, or "
                             f"write the effect as a formula (--with 'my-{effect} = ...').")  # fmt: skip
        return [own_formula(text) for text in effect.formulas]

    def _rounds(self) -> int:
        """How often the correction has to be repeated, wherever the specific force points."""
        grid, correction = self.grid, self.correction
        every = [correction.rounds(correction.predicted(size * grid.force_mps2, grid.temperature_c),
                                   grid.temperature_c) for size in _SIZES]  # fmt: skip
        return max(every) + 1  # between the directions of the grid one more may be needed


def _array(matrix: Floats) -> str:
    """A matrix as C initialises one."""
    rows = ", ".join("{" + ", ".join(f"{value!r}" for value in row) + "}" for row in matrix.tolist())
    return f"{{{rows}}}"


def _product(row: str, vector: str, less: str = "") -> str:
    """A row of a matrix times a vector, or times the difference of two."""
    terms: Iterable[str] = (f"({vector}[{k}] - {less}[{k}])" if less else f"{vector}[{k}]" for k in range(3))
    return " + ".join(f"{row}[{k}] * {term}" for k, term in enumerate(terms))


TextOfC = str | float
_LARGEST_POWER = 12
HELPERS = {
    "kf_calib_abs": "double x) { return x < 0.0 ? -x : x; }",
    "kf_calib_sign": "double x) { return (x > 1e-9) - (x < -1e-9); }",
    "kf_calib_min": "double x, double y) { return y < x ? y : x; }",
    "kf_calib_max": "double x, double y) { return y > x ? y : x; }",
    "kf_calib_power": "double x, int n) { double y = 1.0; while (n-- > 0) y *= x; return y; }",
}
"""Functions that a piece of C may call, from their parameters on."""
MATH = {"sin": "sin", "cos": "cos", "tan": "tan", "arctan": "atan", "tanh": "tanh", "exp": "exp", "log": "log",
        "sqrt": "sqrt"}  # fmt: skip
"""Functions of formulas that C has in <math.h>."""
_OWN = {"abs": "kf_calib_abs", "sign": "kf_calib_sign", "minimum": "kf_calib_min", "maximum": "kf_calib_max"}


def in_c(expression: Expression, names: Mapping[str, TextOfC]) -> str:
    """The expression as a piece of C; names: what each of its names is."""
    return text_of_number(expression(names, _OPERATORS, _FUNCTIONS))


def text_of_number(piece: TextOfC) -> str:
    """A piece of C as it is, a number with all its digits; raises InputError for one that C has no word for."""
    if isinstance(piece, str):
        return piece
    if not math.isfinite(piece):
        raise InputError("a constant in a formula is too large for C: write the formula with smaller numbers.")
    return f"{float(piece)!r}" if piece >= 0.0 else f"({float(piece)!r})"


def _operation(sign: str, *pieces: TextOfC) -> str:
    """Return what an operator makes of pieces."""
    words = [text_of_number(piece) for piece in pieces]
    if sign == "**":
        return _power(words, pieces[1])
    if len(words) == 1:
        return f"(-{words[0]})" if sign == "neg" else words[0]
    joined = f"({words[0]} {sign} {words[1]})"
    return f"(double){joined}" if sign[0] in "<>" else joined


def _power(words: list[str], exponent: TextOfC) -> str:
    """Return a power: a product where the exponent is a small whole number."""
    if isinstance(exponent, float) and exponent.is_integer() and 0 < exponent <= _LARGEST_POWER:
        return f"kf_calib_power({words[0]}, {exponent:.0f})"
    return f"pow({', '.join(words)})"


def _call(name: str, *pieces: TextOfC) -> str:
    """Return what a function makes of pieces; what lags behind one that stays, as all does here, is the same."""
    if name == LAG:
        return text_of_number(pieces[0])
    return f"{(MATH | _OWN)[name]}({', '.join(map(text_of_number, pieces))})"


_OPERATORS = {sign: numbers_stay(number, partial(_operation, sign)) for sign, number in OPERATORS.items()}
_FUNCTIONS = {name: numbers_stay(number, partial(_call, name)) for name, number in FUNCTIONS.items()}
