"""What ``--target`` says: the sigmas that a run is to reach."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from kf_calib.errors import InputError, how_to_write

if TYPE_CHECKING:
    pass
_SIZES = {"rad": 1.0, "deg": math.pi / 180, "arcmin": math.pi / 10800, "arcsec": math.pi / 648000, "1": 1.0,
          "ppm": 1e-6, "m/s^2": 1.0, "mg": 9.80665e-3, "ug": 9.80665e-6, "µg": 9.80665e-6}  # fmt: skip
_KINDS = {"rad": ("rad", "deg", "arcmin", "arcsec"), "1": ("1", "ppm"), "m/s^2": ("m/s^2", "mg", "ug", "µg")}


def parsed_targets(texts: tuple[str, ...]) -> dict[str, float]:
    """Sigmas wanted by symbol, SI; a kind (theta, K ...) stands for all its parameters."""
    from kf_calib.bench import paper_parameters

    out = dict[str, float]()
    for text in texts:
        name, _, size = text.partition("=")
        symbols = [s for s in paper_parameters.SYMBOLS if name == s or name == s.rstrip("123")]
        if not symbols:
            raise InputError(
                f"--target {text!r} names no parameter: use one of {', '.join(paper_parameters.SYMBOLS)}, or theta, "
                "phi, nu, K, b."
            )
        kinds = _KINDS[paper_parameters.UNITS[paper_parameters.SYMBOLS.index(symbols[0])]]
        unit = next((unit for unit in sorted(kinds, key=len, reverse=True) if size.endswith(unit) and unit != "1"), "")
        try:
            value = float(size.removesuffix(unit)) * _SIZES[unit or kinds[0]]
        except ValueError:
            value = math.nan
        if not 0.0 < value < math.inf:
            raise InputError(
                f"--target {text!r}: give a sigma above zero in {', '.join(kinds)}, as {name}=1{kinds[-1]}"
                f"{how_to_write(size)}."
            )
        out |= dict.fromkeys(symbols, value)
    return out
