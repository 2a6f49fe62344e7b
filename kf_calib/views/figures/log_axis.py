"""Logarithmic axes whose ticks are the quantity itself: 0.1, 1, 10."""

from __future__ import annotations

import numpy as np
from matplotlib.axis import Axis
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullFormatter

_WIDE = 1.6  # decades, above which only decades are labelled


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
