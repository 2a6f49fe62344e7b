"""The shape of an effect in letters: what the readings show of it and what it adds, over its own axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.effect_shape import EffectShape
from kf_calib.support.units import Unit, shown, shown_whole, significant

_WIDTH, _HEIGHT = 64, 8
_LEFT = 9  # letters of the numbers beside the plot
_READING, _FITTED, _ZERO = "●", "·", "┈"


@dataclass(frozen=True)
class TextPlot:
    """A point a dwell of the channel that shows an effect most, and the effect as a dotted curve."""

    shape: EffectShape

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """The plot, as wide as there is room, and its axes in words."""
        shape, k = self.shape, self.shape.clearest
        width = min(_WIDTH, options.max_width - _LEFT)
        across = shown_whole(shape.unit, float(np.nanmax(np.abs(shape.values))))
        symbol = f" ({shape.symbol})" if "·" in shape.symbol else ""
        of = f"{shape.channels[k]}, {shown(shape.quantity).label}"
        yield Text(f"What {shape.effect} must explain {_READING} and what it adds {_FITTED} ({of})")
        yield Text("\n".join(_lines(shape, k, across, width)), no_wrap=True)
        words = f"{shape.words}{symbol}, {across.label}"
        yield Text(f"{'':{_LEFT}}{words.center(width)}".rstrip() if len(words) <= width else words)


def _lines(shape: EffectShape, k: int, across: Unit, width: int) -> list[str]:
    """Return the plot of a channel in so many columns, with numbers at the ends of its axes."""
    known, upward = np.isfinite(shape.readings[:, k]), shown(shape.quantity)
    x, y = shape.values[known, k] * across.per_si, shape.readings[known, k] * upward.per_si
    at, middle = x, shape.component[known, k] * upward.per_si
    if shape.is_curve:
        at, middle = (each * unit.per_si for each, unit in zip(shape.curve(k)[:2], (across, upward), strict=True))
    low, high = min(y.min(), middle.min(), 0.0), max(y.max(), middle.max(), 0.0)
    left, right = float(x.min()), float(x.max())
    canvas = [[" "] * width for _ in range(_HEIGHT)]
    for mark, columns, rows in ((_ZERO, np.linspace(left, right, width), np.zeros(width)), (_FITTED, at, middle),
                                (_READING, x, y)):  # fmt: skip
        places = zip(_cells(columns, left, right, width), _cells(rows, low, high, _HEIGHT), strict=True)
        for column, row in places:
            canvas[_HEIGHT - 1 - row][column] = mark
    labels = {0: significant(high, 2), _HEIGHT - 1: significant(low, 2)}
    lines = [f"{labels.get(row, ''):>{_LEFT - 2}} ┤{''.join(cells)}".rstrip() for row, cells in enumerate(canvas)]
    first, last = significant(left), significant(right)
    return [*lines, f"{'':{_LEFT - 1}}└{'─' * width}", f"{'':{_LEFT}}{first}{last:>{width - len(first)}}"]


def _cells(values: Floats, low: float, high: float, count: int) -> list[int]:
    """Return the number of the cell, from 0, in which each value lies between two ends."""
    share = (values - low) / (high - low) if high > low else np.full(len(values), 0.5)
    return np.clip((share * count).astype(int), 0, count - 1).tolist()
