"""The shape of an effect in letters: what the readings show of it and what it adds, over its own axis."""

from __future__ import annotations

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.effect_shape import EffectShape
from kf_calib.support.units import shown, shown_whole, significant

_WIDTH, _HEIGHT = 64, 8
_READING, _FITTED, _ZERO = "●", "·", "┈"


def text_plot(shape: EffectShape) -> str:
    """Lines of text: a point a dwell of the channel that shows the effect most, and the effect as a dotted curve."""
    k = shape.clearest
    known = np.isfinite(shape.readings[:, k])
    across = shown_whole(shape.unit, float(np.nanmax(np.abs(shape.values))))
    upward = shown(shape.quantity)
    x, y = shape.values[known, k] * across.per_si, shape.readings[known, k] * upward.per_si
    at, middle = x, shape.component[known, k] * upward.per_si
    if shape.is_curve:
        at, middle = (each * unit.per_si for each, unit in zip(shape.curve(k)[:2], (across, upward), strict=True))
    low, high = min(y.min(), middle.min(), 0.0), max(y.max(), middle.max(), 0.0)
    canvas = [[" "] * _WIDTH for _ in range(_HEIGHT)]
    ends = (x.min(), x.max()), (low, high)
    for mark, points in ((_ZERO, (np.linspace(*ends[0], _WIDTH), np.zeros(_WIDTH))), (_FITTED, (at, middle)),
                         (_READING, (x, y))):  # fmt: skip
        for column, row in zip(_cells(points[0], *ends[0], _WIDTH), _cells(points[1], *ends[1], _HEIGHT), strict=True):
            canvas[_HEIGHT - 1 - row][column] = mark
    labels = {0: significant(high, 2), _HEIGHT - 1: significant(low, 2)}
    lines = [f"{labels.get(row, ''):>7} ┤{''.join(cells)}".rstrip() for row, cells in enumerate(canvas)]
    of = f"{shape.channels[k]}, {upward.label}"
    symbol = f" ({shape.symbol})" if "·" in shape.symbol else ""
    first, last = significant(ends[0][0]), significant(ends[0][1])
    words = f"{shape.words}{symbol}, {across.label}"
    title = f"What {shape.effect} must explain {_READING} and what it adds {_FITTED} ({of})"
    line, ends_text = f"{'':8}└{'─' * _WIDTH}", f"{'':9}{first}{last:>{_WIDTH - len(first)}}"
    return "\n".join([title, *lines, line, ends_text, f"{'':9}{words.center(_WIDTH)}".rstrip()])


def _cells(values: Floats, low: float, high: float, count: int) -> list[int]:
    """Return the number of the cell, from 0, in which each value lies between two ends."""
    share = (values - low) / (high - low) if high > low else np.full(len(values), 0.5)
    return np.clip((share * count).astype(int), 0, count - 1).tolist()
