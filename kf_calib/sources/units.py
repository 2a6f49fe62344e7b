"""Units of readings and angles where the names of columns tell none: stated, or told by the size of the numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.errors import InputError
from kf_calib.sources.tables.words import ACCEL
from kf_calib.support.units import STANDARD_GRAVITY_MPS2

_BY_SIZE = (("g", 0.5, 2.0), ("m/s2", 5.0, 20.0), ("mg", 500.0, 2000.0))
"""Units in which the size of gravity lies between two numbers."""
_IN_WORDS = {"m/s2": "m/s^2", "count": "counts"}


@dataclass(frozen=True)
class Units:
    """Units where the header names none; None: guessed from the numbers.

    accel_scale: size of one count, in ``accel`` (m/s^2 if that is None). g: m/s^2 that 1 g stands for, or ``local``.
    """

    accel: str | None = None
    accel_scale: float = 1.0
    angle: str | None = None
    g: str | float = STANDARD_GRAVITY_MPS2

    def g_mps2(self, local_mps2: float) -> float:
        """What 1 g stands for at a place of this gravity. Raises InputError where that cannot be."""
        if self.g == "local":
            return local_mps2
        try:
            size = float(self.g)
        except ValueError:
            size = 0.0
        if not 9.0 < size < 10.0:
            raise InputError(f"--g-unit is {self.g!r}: give m/s^2 from 9 to 10, such as 9.80665, or local.")
        return size


class ReadingUnits(NamedTuple):
    """Units of the three readings.

    units: of each. factors (3,): from the numbers to m/s^2. words: how the unit is said. by_size: whether the numbers
    told it. is_known: whether anything did.
    """

    units: tuple[str, ...]
    factors: Floats
    words: str
    by_size: bool
    is_known: bool


def reading_units(named: Sequence[str], norm: float, stated: Units, local_mps2: float) -> ReadingUnits:
    """The units of three readings.

    named: units by the names of their columns, empty where these tell none. norm: size of the readings at rest as they
    are written, from which a unit is told that neither a name nor ``stated`` tells.
    """
    size = norm * stated.accel_scale
    by_size = next((unit for unit, low, high in _BY_SIZE if low < size < high), "count")
    units = [unit if unit not in ("", "count") else stated.accel or ("m/s2" if unit else by_size) for unit in named]
    is_guessed = "" in named and not stated.accel
    words = " and ".join(dict.fromkeys(_IN_WORDS.get(unit, unit) for unit in units))
    if stated.accel_scale != 1.0 or "count" in named:
        words = f"counts of {stated.accel_scale:g} {words}"
    words += " by their size (--accel-unit)" * is_guessed
    if any(unit.endswith("g") for unit in units):
        words += f", 1 g = {stated.g_mps2(local_mps2):.7g} m/s^2 (--g-unit)"
    is_known = bool(stated.accel) or stated.accel_scale != 1.0 or "count" not in (*units, *named)
    factors = stated.accel_scale * mps2_per(units, stated, local_mps2)
    return ReadingUnits(tuple(units), factors, words, is_guessed, is_known)


def mps2_per(units: Sequence[str], stated: Units, local_mps2: float) -> Floats:
    """The size of each of these units, m/s^2."""
    return np.array(
        [
            ACCEL[unit] * (stated.g_mps2(local_mps2) / STANDARD_GRAVITY_MPS2 if unit.endswith("g") else 1.0)
            for unit in units
        ]
    )
