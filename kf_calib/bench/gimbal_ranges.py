"""Ranges of gimbal angles in text: limits that must not be left, and zones that must not be entered.

    limits_of("z=-90:90 outer=-170:170", ["y", "z", "x"])     # {1: (-90.0, 90.0), 0: (-170.0, 170.0)}
    zones_of("z=10:40,x=-5:5; y=150:180", ["y", "z", "x"])    # [{1: (10.0, 40.0), 2: (-5.0, 5.0)}, {0: (150.0, 180.0)}]

A gimbal is named by its number (1 is the outer one), its place (outer, middle, inner) or its axis (x, y, z).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from kf_calib.errors import BenchError
from kf_calib.support.plain_text import cut

_PLACES = ("outer", "middle", "inner")
Range = tuple[float, float]


def gimbal_named(text: str, axes: Sequence[str]) -> int:
    """Number of a gimbal, from 0, by its name; axes: names of the axes, outer to inner. Raises BenchError."""
    count, letters = len(axes), [name.lstrip("-") for name in axes]
    places = dict(zip(_PLACES if count == 3 else ("outer", "inner")[:count], range(count), strict=False))
    numbers = {str(j + 1): j for j in range(count)}
    by_letter = {letter: j for j, letter in enumerate(letters) if letters.count(letter) == 1}
    known = numbers | places | by_letter
    if text not in known:
        raise BenchError(f"gimbal {cut(text, 60)!r} is not known: use one of {', '.join(known)}.")
    return known[text]


def ranges(text: str, axes: Sequence[str]) -> dict[int, Range]:
    """Ranges in deg by gimbal from text such as ``z=-90:90`` or ``outer=0:30,x=-10:10``; raises BenchError."""
    by_gimbal = dict[int, Range]()
    for part in text.split(","):
        name, equals, ends = part.strip().partition("=")
        low, colon, high = ends.partition(":")
        try:
            low_deg, high_deg = float(low), float(high)
        except ValueError:
            low_deg = high_deg = math.nan
        if not (equals and colon and -360.0 <= low_deg <= high_deg <= 360.0 and high_deg - low_deg <= 360.0):
            raise BenchError(
                f"{cut(part.strip(), 60)!r} is no range of a gimbal: write AXIS=LOW:HIGH in deg, as in z=-90:90."
            )
        by_gimbal[gimbal_named(name, axes)] = low_deg, high_deg
    return by_gimbal


def limits_of(text: str, axes: Sequence[str]) -> dict[int, Range]:
    """The limits by gimbal, from ranges that spaces, commas or semicolons part; raises BenchError."""
    parts = text.replace(";", " ").replace(",", " ").split()
    return ranges(",".join(parts), axes) if parts else {}


def zones_of(text: str, axes: Sequence[str]) -> list[dict[int, Range]]:
    """The forbidden zones, which semicolons part; each has ranges of gimbals, parted by commas. Raises BenchError."""
    return [ranges(part, axes) for part in text.split(";") if part.strip()]
