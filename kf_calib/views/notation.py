"""How symbols and numbers are written for people, wherever they stand: tables, figures, views, certificates."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.support.units import RAISED, Unit, shown, shown_whole

if TYPE_CHECKING:
    from kf_calib.bench.bench import Bench
    from kf_calib.diagnosis.explanation import EffectShape
    from kf_calib.diagnosis.residual_drivers import Driver
    from kf_calib.effects import Coefficient
    from kf_calib.estimation.results import Parameter

_OF_THE_PAPER = {"theta": "θ", "phi": "φ", "nu": "ν"}
_GREEK = {**_OF_THE_PAPER, "alpha": "α", "beta": "β", "kappa": "κ", "gamma": "γ", "delta": "δ", "omega": "ω",
          "eps": "ε", "tau": "τ"}  # fmt: skip
_DIGITS = "0123456789"
_SUBSCRIPTS = str.maketrans(_DIGITS, "₀₁₂₃₄₅₆₇₈₉")


def symbol(name: str) -> str:
    """A symbol as text, with the Greek letters of the paper: ``theta1`` is θ1."""
    for latin, greek in _OF_THE_PAPER.items():
        name = name.replace(latin, greek)
    return name


def label(name: str) -> str:
    """A symbol as it is printed, with Greek letters and subscripts: ``theta1`` is θ₁, ``K2_3`` is K2₃."""
    latin = next((each for each in _GREEK if name.startswith(each)), "")
    stem = name.rstrip(_DIGITS)
    return _GREEK.get(latin, "") + stem[len(latin) :].removesuffix("_") + name[len(stem) :].translate(_SUBSCRIPTS)


class Shown(NamedTuple):
    """How a parameter is written: its symbol, its unit, and how many of the unit make one SI unit."""

    label: str
    unit: str
    per_si: float


def twelve() -> tuple[Shown, ...]:
    """How the twelve parameters are written, in the units that are asked for."""
    pairs = zip(paper_parameters.SYMBOLS, paper_parameters.UNITS, strict=True)
    return tuple(Shown(label(symbol), *shown(unit)) for symbol, unit in pairs)


def with_coefficients(coefficients: Iterable[Parameter | Coefficient]) -> tuple[Shown, ...]:
    """The same, followed by coefficients of effects."""
    return (*twelve(), *(Shown(label(each.symbol), *shown(each)) for each in coefficients))


def gimbal_names(bench: Bench) -> list[str]:
    """Number and axis of each gimbal from the outermost inwards, such as ``1_y`` and ``2_z``."""
    return [f"{k}_{axis.replace(',', ';')}" for k, axis in enumerate(bench.to_metadata()["axes"].split(), 1)]


def signed(text: str) -> str:
    """A number that was written, with its sign: of a change, or of what a value is less another."""
    return text if text.startswith("-") else f"+{text}"


def unit_across(drawn: Driver | EffectShape) -> Unit:
    """The unit in which people are shown the quantity that residuals or an effect are drawn over."""
    return shown_whole(drawn.unit, float(np.nanmax(np.abs(drawn.values))))


def written(value: float) -> str:
    """A number as on an axis: 0.05, 20,000, 10⁻⁸."""
    if value == 0.0 or 1e-4 <= abs(value) < 1e6:
        return f"{value:,.10g}"
    exponent = math.floor(math.log10(abs(value)) + 1e-9)
    mantissa = value / 10.0**exponent
    power = f"10{str(exponent).translate(RAISED)}"
    return power if abs(mantissa - 1.0) < 1e-6 else f"{mantissa:.3g}·{power}"
