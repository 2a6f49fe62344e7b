"""Averages of the readings over smooth windows of a second or more, taken before all other processing.

Vibration of the bench is thousands of times larger than the noise of a good accelerometer, but it averages out much
faster than noise of that size; what remains in the mean of a dwell are the incomplete cycles at its ends. Windows that
rise and fall smoothly have no such remainder, and only the noise at low frequencies is left in the averages.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from functools import cache, lru_cache

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from kf_calib.bench.arrays import Floats
from kf_calib.dwells.blocks import Block
from kf_calib.dwells.coherent_tone import CELL_S
from kf_calib.dwells.limits import FEWEST_COMPARED
from kf_calib.dwells.line_spectrum import SpectralLine

WINDOW_S = 1.0
"""Default length of a window, s."""

_CYCLES = 20.0  # cycles in a window: a millionth of an oscillation is left, and slow changes are still resolved
_OVERLAP = 3  # number of windows in which each reading lies; the squares of Hann windows then add up to a constant


def window_s(lines: Iterable[SpectralLine]) -> float:
    """Length of the windows that average out the strongest of the lines in the readings, s.

    A vibration that is sampled too slowly appears at another frequency and leaves as much as one of that frequency.
    """
    strongest = max(lines, key=lambda line: float(np.linalg.norm(line.amplitude_mps2)), default=None)
    return WINDOW_S if strongest is None else max(WINDOW_S, _CYCLES / strongest.frequency_hz)


@cache
def correlations() -> Floats:
    """Correlations (3,) of an average of white noise with itself and the next two, which the overlap of windows
    produces."""
    weights = np.sin(np.pi * (np.arange(3000) + 0.5) / 3000.0) ** 4
    shifted = [weights[: len(weights) - k * len(weights) // _OVERLAP] for k in range(_OVERLAP)]
    return np.array([part @ weights[-len(part) :] for part in shifted]) / (weights @ weights)


@cache
def inflation() -> float:
    """Inflation kappa of averages of white noise: their spectral density at frequency zero relative to that of white
    noise of their variance."""
    return float(2.0 * correlations().sum() - 1.0)


def average(block: Block, length_s: float = WINDOW_S) -> Block | None:
    """The block averaged over cos^4 windows, with the variance of the readings in each; None if the block is too short.

    The side lobes of the window fall as the fifth power of the frequency; with 30 cycles in a window, 1e-7 of an
    oscillation remains. A window is hardly longer than a quarter of the block. The variances are taken about a parabola
    over the block, because a vibration has no mean within so short a window.
    """
    count, span_s = len(block.elapsed_s), float(block.elapsed_s[-1] - block.elapsed_s[0])
    step = math.ceil(min(length_s / max(span_s, 1e-9), 1.0 / FEWEST_COMPARED) * count / _OVERLAP)
    length = step * _OVERLAP
    if span_s < FEWEST_COMPARED * CELL_S or step < 2 or length > count:
        return None  # a window would not cover several periods of vibration
    weights = np.sin(np.pi * (np.arange(length) + 0.5) / length) ** 4
    weights /= weights.sum()

    def means(values: Floats) -> Floats:
        return np.asarray(sliding_window_view(values, length, axis=0)[::step] @ weights)

    parabola = orthonormal_parabola(count)
    level = block.accel_mps2.mean(axis=0)
    deviation = block.accel_mps2 - level
    shaking = deviation - parabola @ (parabola.T @ deviation)
    return replace(
        block,
        elapsed_s=means(block.elapsed_s),
        accel_mps2=level + means(deviation),
        pose=block.pose if len(block.pose) == 1 else means(block.pose),
        temperature_c=means(block.temperature_c),
        variance_mps2_2=means(shaking**2),
        readings_per_row=step,
    )


@lru_cache(maxsize=4)  # blocks are mostly of one length
def orthonormal_parabola(count: int) -> Floats:
    """1, u, u^2 at ``count`` instants evenly from u = -1 to 1, made orthonormal, (n, 3)."""
    u = np.linspace(-1.0, 1.0, count)
    return np.linalg.qr(np.column_stack([np.ones(count), u, u * u]))[0]
