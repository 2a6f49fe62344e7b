"""Units of readings and angles where the names of columns tell none: stated, or told by the size of the numbers."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from kf_calib.bench.arrays import Floats, lengths
from kf_calib.bench.bench import Bench
from kf_calib.bench.counts import SIGNED, parse_counts
from kf_calib.bench.keys import BenchKeys
from kf_calib.bench.raw_input import CHANNELS, PLAIN, UNITS, RawInput
from kf_calib.errors import BenchError, InputError
from kf_calib.sources.text.names import ACCEL
from kf_calib.support.units import STANDARD_GRAVITY_MPS2

AnyTemperature = TypeVar("AnyTemperature", float, Floats)
_BY_SIZE = (("g", 0.5, 2.0), ("m/s2", 5.0, 20.0), ("mg", 500.0, 2000.0), ("mm/s2", 5e3, 2e4))
"""Units in which the size of gravity lies between two numbers; the last where these have decimals, as counts have none.
"""
_USUAL = {
    **{2.0**bits: {"accel_unit": "g", "accel_scale": repr(2.0**-bits)} for bits in range(6, 25)},
    **{STANDARD_GRAVITY_MPS2 / size: {"accel_scale": f"{size:g}"} for size in (1e-2, 1e-3)},
}
"""Bench keys of counts by their number in 1 g, which is a power of two for most sensors; 1 mm/s^2 is as usual."""
_NEAR_USUAL = 0.1  # as readings at rest are to it
_NEAR = (0.2, 5.0)
"""The norm in g of a sensor that is not shaken hard."""
_IN_WORDS = {"m/s2": "m/s^2", "mm/s2": "mm/s^2", "count": "counts"}


@dataclass(frozen=True)
class Units:
    """Units where the header names none; None: guessed from the numbers.

    accel_scale: size of one count, in ``accel`` (m/s^2 if that is None). g_mps2: what 1 g stands for.
    input: what the device of a calibration sends, which holds where none of this is stated. is_restated: whether
    ``accel`` goes before the names of columns. counts: how the numbers are to be read.
    rate_hz: of rows without a time. where: column and cell of the rows that count, as ``I=0``. dataset: of a container.
    """

    accel: str | None = None
    accel_scale: float = 1.0
    angle: str | None = None
    g_mps2: float = STANDARD_GRAVITY_MPS2
    input: RawInput | None = None
    is_restated: bool = False
    counts: str = SIGNED
    rate_hz: float | None = None
    where: str = ""
    dataset: str = ""

    @classmethod
    def of(
        cls, keys: BenchKeys, angle: str | None = None, g: str | float = STANDARD_GRAVITY_MPS2,
        input: RawInput | None = None,
    ) -> Units:  # fmt: skip
        """Units as bench keys state them; g: m/s^2 that 1 g stands for, or ``local``. Raises InputError."""
        stated = RawInput.from_metadata(keys)
        if len(set(stated.sizes)) > 1:
            raise BenchError("accel_scale has a size for each channel: in lines and tables, state one for all.")
        if g == "local":
            standard = {} if "latitude_deg" in keys else {"gravity_mps2": STANDARD_GRAVITY_MPS2}
            g = Bench.from_metadata({**standard, **keys}, has_angles=False).gravity_mps2
        elif not re.fullmatch(r"\s*9(\.\d*)?\s*", str(g)) or not 9.0 < float(g) < 10.0:
            raise InputError(f"--g-unit is {g!r}: give m/s^2 from 9 to 10, such as 9.80665, or local.")
        unit = stated.unit if "accel_unit" in keys else None
        default = None if {"accel_unit", "accel_scale"} & set(keys) else input
        return cls(unit, stated.sizes[0], angle, float(g), default, bool(keys.get("restate_input")), stated.counts)

    def told_by(self, names: Sequence[str], named: Sequence[str]) -> Sequence[str]:
        """The units of readings (``named``) by the names of their columns, empty where these tell none, or an option
        restates them. Raises InputError where an option states another one."""
        if self.accel and self.is_restated:
            return [""] * len(named)
        for name, unit in zip(names, named, strict=True):
            if self.accel and unit not in ("", "count", self.accel):
                raise InputError(
                    f"column {name!r} is in {unit} by its name, and --accel-unit is {self.accel}: leave out "
                    "--accel-unit, rename the column by --column, or where its name is wrong, add --restate-input."
                )
        return named

    def as_default(self, named: Sequence[str], norm: float) -> bool:
        """Whether readings of this size are what the device of the calibration sends; named: units by their names."""
        if self.input is None or self.input.is_plain:
            return False
        if self.input.sizes == PLAIN.sizes and not {"", "count"} & set(named):
            return False
        level = norm * float(self.input.factors.mean()) / STANDARD_GRAVITY_MPS2
        return set(named) <= {"", "count"} or math.isnan(norm) or _NEAR[0] < level < _NEAR[1]

    def mps2_per(self, units: Sequence[str]) -> Floats:
        """The size of each of these units, m/s^2."""
        g = self.g_mps2 / STANDARD_GRAVITY_MPS2
        return np.array([ACCEL[unit] * (g if unit.endswith("g") else 1.0) for unit in units])


def reading_units(named: Sequence[str], values: Floats, stated: Units) -> tuple[RawInput | None, str, str]:
    """The sizes of the numbers of three readings, None where nothing tells these; how their unit is said; and the unit
    that the numbers told, empty where something else does.

    named: units by the names of their columns, empty where these tell none. values (n, 3): readings as they are
    written, whose size at rest tells a unit that neither a name nor ``stated`` tells.
    """
    values = parse_counts(stated.counts).signed(values[np.isfinite(values).all(axis=1)])
    norm = usual_norm(values)
    if stated.as_default(named, norm):
        assert stated.input is not None
        default = replace(stated.input, channels=CHANNELS)
        return default, f"{default.unit_words}, as of the calibration", ""
    size = norm * stated.accel_scale
    are_counts = bool((values == np.rint(values)).all()) or stated.accel_scale != 1.0
    by_size = next((unit for unit, low, high in _BY_SIZE[: 3 if are_counts else 4] if low < size < high), "count")
    units = [unit if unit not in ("", "count") else stated.accel or ("m/s2" if unit else by_size) for unit in named]
    guessed = by_size if "" in named and not stated.accel else ""
    words = " and ".join(dict.fromkeys(_IN_WORDS.get(unit, unit) for unit in units))
    if stated.accel_scale != 1.0 or "count" in named:
        words = f"counts of {stated.accel_scale:g} {words}"
    words += " by their size (--accel-unit)" * bool(guessed)
    if any(unit.endswith("g") for unit in units):
        words += f", 1 g = {stated.g_mps2:.7g} m/s^2 (--g-unit)"
    mps2, scale = stated.mps2_per(units), stated.accel_scale
    if not stated.accel and scale == 1.0 and "count" in (*units, *named):
        raw = None
    elif len(set(units)) == 1 and UNITS.get(units[0]) == mps2[0]:  # in the unit that they are written in
        raw = RawInput(sizes=(scale, scale, scale), unit=units[0], counts=stated.counts)
    else:
        raw = replace(RawInput.of_factors((scale * mps2).tolist()), counts=stated.counts)
    return raw, words, guessed


def usual_norm(values: Floats) -> float:
    """The median size of readings (n, 3), NaN where there are none."""
    norms = lengths(values)
    norms = norms[np.isfinite(norms)]
    return float(np.median(norms)) if len(norms) else math.nan


def size_of_count(norm: float) -> dict[str, str]:
    """Bench keys for the size of a count, of which gravity has so many: that of the usual ones which is nearest, where
    one is near."""
    usual = min(_USUAL, key=lambda counts: abs(norm / counts - 1.0))
    if abs(norm / usual - 1.0) < _NEAR_USUAL:
        return _USUAL[usual]
    return {"accel_scale": f"{STANDARD_GRAVITY_MPS2 / norm if norm > 0.0 else math.nan:.3g}"}


def celsius(value: AnyTemperature, unit: str) -> AnyTemperature:
    """A temperature, or an array of them, in a unit ``c``, ``k`` or ``f``, in degrees Celsius."""
    return value if unit == "c" else value - 273.15 if unit == "k" else (value - 32.0) / 1.8
