"""What columns without names hold, by their numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kf_calib.bench.arrays import Floats, lengths
from kf_calib.sources.text.heading import NAMELESS
from kf_calib.sources.text.names import Meaning

_MOSTLY = 0.9  # of the steps of a time go up, and of sizes are counted
_LIKE, _EXACT = 2.0, 0.01


def is_nameless(header: Sequence[str]) -> bool:
    """Whether columns have no names but their numbers."""
    return bool(header) and all(name == NAMELESS.format(k + 1) for k, name in enumerate(header))


def meanings_by_numbers(values: Floats) -> list[Meaning]:
    """What columns (n, k) are, NaN where a cell is no number: a first column that goes up is the time, the three beside
    each other whose size changes least are the readings. No meaning where there are no such three."""
    meanings = [Meaning("", "")] * values.shape[1]
    rises = len(values) > 1 and np.mean(np.diff(values[:, 0]) > 0.0) > _MOSTLY and values.shape[1] > 3
    spreads = dict[int, float]()
    for k in range(int(rises), values.shape[1] - 2):
        sizes = lengths(values[:, k : k + 3])
        sizes = sizes[np.isfinite(sizes)]
        if len(sizes) and np.median(sizes) > 0.0:
            spreads[k] = float(np.quantile(np.abs(sizes - np.median(sizes)), _MOSTLY) / np.median(sizes))
    if not spreads:
        return meanings
    alike = _LIKE * min(spreads.values()) + _EXACT  # in one pose, columns of nothing may stand beside those that tell
    first = next(k for k, spread in spreads.items() if spread <= alike)
    meanings[first : first + 3] = [Meaning(f"a{axis}", "") for axis in "xyz"]
    if rises:
        meanings[0] = Meaning("time", "")
    return meanings
