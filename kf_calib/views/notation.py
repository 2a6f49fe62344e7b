"""How symbols and numbers are written for people, wherever they stand: tables, figures, views, certificates."""

from __future__ import annotations

import math

from kf_calib.support.units import RAISED

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


def written(value: float) -> str:
    """A number as on an axis: 0.05, 20,000, 10⁻⁸."""
    if value == 0.0 or 1e-4 <= abs(value) < 1e6:
        return f"{value:,.10g}"
    exponent = math.floor(math.log10(abs(value)) + 1e-9)
    mantissa = value / 10.0**exponent
    power = f"10{str(exponent).translate(RAISED)}"
    return power if abs(mantissa - 1.0) < 1e-6 else f"{mantissa:.3g}·{power}"
