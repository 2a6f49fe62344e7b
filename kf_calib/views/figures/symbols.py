"""Symbols as in the paper, and the units that parameters are shown in."""

from __future__ import annotations

from typing import NamedTuple

from kf_calib.bench import paper_parameters
from kf_calib.estimation.measurement_model import STATE_COUNT
from kf_calib.estimation.results import Parameter

_SUBSCRIPTS = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")
_GREEK = {"theta": "θ", "phi": "φ", "nu": "ν", "alpha": "α", "beta": "β", "kappa": "κ", "gamma": "γ", "delta": "δ",
          "omega": "ω", "eps": "ε", "tau": "τ"}  # fmt: skip
_UNITS = {"rad": ("arcsec", 206264.80624709636), "1": ("ppm", 1e6), "m/s^2": ("µg", 1e6 / 9.80665)}
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


TWELVE = tuple(
    Shown(label(symbol), *_UNITS[unit])
    for symbol, unit in zip(paper_parameters.SYMBOLS, paper_parameters.UNITS, strict=True)
)
MICRO_G = _UNITS["m/s^2"][1]
"""µg in one m/s^2."""


def shown(parameters: tuple[Parameter, ...]) -> tuple[Shown, ...]:
    """How the twelve parameters are written, and the coefficients of effects that follow them."""
    rest = (Shown(label(each.symbol), plain(each.shown_unit), each.per_si) for each in parameters[STATE_COUNT:])
    return (*TWELVE, *rest)
