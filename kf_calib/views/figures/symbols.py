"""Words and numbers in figures, symbols as in the paper, and the units that parameters are shown in."""

from __future__ import annotations

from collections.abc import Iterable
from textwrap import fill
from typing import NamedTuple

from kf_calib.bench import paper_parameters
from kf_calib.effects import Coefficient
from kf_calib.estimation.results import Parameter
from kf_calib.support import units

_SUBSCRIPTS = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")
_GREEK = {"theta": "θ", "phi": "φ", "nu": "ν", "alpha": "α", "beta": "β", "kappa": "κ", "gamma": "γ", "delta": "δ",
          "omega": "ω", "eps": "ε", "tau": "τ"}  # fmt: skip
KINDS = {"rad": "angle", "1": "scale factor", "m/s^2": "bias"}


class Shown(NamedTuple):
    """How a parameter is written: its symbol, its unit, and how many of the unit make one SI unit."""

    label: str
    unit: str
    per_si: float


def label(symbol: str) -> str:
    """A symbol with Greek letters and subscripts, for a figure: ``theta1`` becomes θ₁; a dollar sign stays one."""
    latin = next((each for each in _GREEK if symbol.startswith(each)), "")
    name = _GREEK.get(latin, "") + symbol[len(latin) :]
    stem = name.rstrip("0123456789")
    return plain(stem.removesuffix("_") + name[len(stem) :].translate(_SUBSCRIPTS))


def plain(text: str) -> str:
    """Text of the user as it is: matplotlib would read what is between two dollar signs as a formula."""
    return text.replace("$", r"\$")


def twelve() -> tuple[Shown, ...]:
    """How the twelve parameters are written, in the units that are asked for."""
    pairs = zip(paper_parameters.SYMBOLS, paper_parameters.UNITS, strict=True)
    return tuple(Shown(label(symbol), *units.shown(unit)) for symbol, unit in pairs)


def with_coefficients(coefficients: Iterable[Parameter | Coefficient]) -> tuple[Shown, ...]:
    """The same, followed by coefficients of effects."""
    found = [(each.symbol, units.shown(each)) for each in coefficients]
    return (*twelve(), *(Shown(label(symbol), plain(unit.label), unit.per_si) for symbol, unit in found))


def wrapped(text: str, width: int) -> str:
    """A text in lines of at most so many letters, broken between words only: names of effects stay whole."""
    return fill(text, width, break_on_hyphens=False, break_long_words=False)


def rounded_number(value: float, digits: int = 3) -> str:
    """A number to so many significant digits, without an exponent unless it is very small."""
    return f"{float(f'{value:.{digits}g}'):.12g}"
