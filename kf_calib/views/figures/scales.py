"""Axes that can be read: logarithms with their values as labels, orientations as whole numbers."""

from __future__ import annotations

import itertools
import math
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator

_WIDE = 1.6  # decades, above which only decades are labelled

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_LEAST_RANGE = 4.0  # between the ends of an axis, so that two labels at least are on it
_FEWEST = 3  # decades with labels; where there are fewer, 2 and 5 have labels, too
_LABELS = 6  # at most, of decades


def written(value: float) -> str:
    """A number as on an axis: 0.05, 20,000, 10⁻⁸."""
    if value == 0.0 or 1e-4 <= abs(value) < 1e6:
        return f"{value:,.10g}"
    exponent = math.floor(math.log10(abs(value)) + 1e-9)
    mantissa = value / 10.0**exponent
    power = f"10{str(exponent).translate(_RAISED)}"
    return power if abs(mantissa - 1.0) < 1e-6 else f"{mantissa:.3g}·{power}"


def log_scale(axes: Axes, values: Any, which: Literal["x", "y"] = "y", room: float = 0.0) -> None:
    """Make an axis logarithmic over all positive ``values``, and write numbers at its ticks; none without a value.

    room: share of the axis that is left free above them, for text.
    """
    flat = np.concatenate([np.asarray(own, float).ravel() for own in values] or [np.zeros(0)])
    flat = flat[np.isfinite(flat) & (flat > 0.0)]
    low, high = (float(flat.min()) / 1.15, float(flat.max()) * 1.15) if flat.size else (0.5, 20.0)
    if high < _LEAST_RANGE * low:
        middle = math.sqrt(low * high)
        low, high = middle / math.sqrt(_LEAST_RANGE), middle * math.sqrt(_LEAST_RANGE)
    high *= (high / low) ** (room / (1.0 - room))
    axis = axes.yaxis if which == "y" else axes.xaxis
    (axes.set_yscale if which == "y" else axes.set_xscale)("log")
    (axes.set_ylim if which == "y" else axes.set_xlim)(low, high)
    axis.set_major_locator(FixedLocator(ticks(low, high) if flat.size else []))
    axis.set_major_formatter(FuncFormatter(lambda value, _: written(value)))
    axis.set_minor_locator(NullLocator())
    axis.set_minor_formatter(NullFormatter())


def ticks(low: float, high: float) -> list[float]:
    """Values with labels on a logarithmic axis from ``low`` to ``high``."""
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    decades = sum(low <= 10.0**power <= high for power in range(first, last + 1))
    steps = (1.0,) if decades >= _FEWEST else (1.0, 2.0, 5.0)
    every = max(1, math.ceil(decades / _LABELS))
    found = [step * 10.0**power for power, step in itertools.product(range(first, last + 1, every), steps)]
    return [float(f"{value:.6g}") for value in found if low <= value <= high]


def whole_numbers(axes: Axes, first: float, last: float, words: str = "orientation") -> None:
    """Let the x axis count orientations from ``first`` to ``last``; 0 is what was known before them."""
    room = max(0.03 * (last - first), 0.5)
    axes.set_xlim(first - room, last + room)
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True, min_n_ticks=1))
    axes.set_xlabel(f"{words} (0: before)" if words and first == 0 else words)


def label_axis(axis: Axis, low: float, high: float) -> None:
    """Give a logarithmic axis from ``low`` to ``high`` ticks with their values: at decades, or at 1, 2, 5 in a few."""
    decades = float(np.log10(high / low))
    steps = (1.0,) if decades > _WIDE else (1.0, 2.0, 5.0) if decades > 0.7 else (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)
    first, last = int(np.floor(np.log10(low))), int(np.ceil(np.log10(high)))
    every = max(1, round(decades / 8.0))
    ticks = [step * 10.0**power for power in range(first, last + 1, every) for step in steps]
    axis.set_major_locator(FixedLocator([tick for tick in ticks if low <= tick <= high]))
    axis.set_minor_locator(LogLocator(subs=range(2, 10)) if every == 1 else FixedLocator([]))
    axis.set_major_formatter(FuncFormatter(lambda value, _: plain(value)))
    axis.set_minor_formatter(NullFormatter())


def plain(value: float) -> str:
    """A number without an exponent where it is short so."""
    return f"{value:.6f}".rstrip("0").rstrip(".") if 1e-4 <= value < 1e6 else f"{value:.0e}"
