"""Readings averaged over windows of a second or more, before anything else is made of them.

Vibration of the bench is thousands of times the noise of a good accelerometer, and averages away a thousand times
better than noise of that size would: what it leaves in the mean of a dwell are the cycles cut off at the ends. Windows
that rise and fall smoothly cut nothing off, and what remains of the readings in them is their noise at low frequencies.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from functools import cache

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from kf_calib.bench.arrays import Floats
from kf_calib.dwells.blocks import Block
from kf_calib.dwells.line_spectrum import Line
from kf_calib.dwells.orthonormal_parabola import orthonormal_parabola

WINDOW_S = 1.0
"""Usual length of a window."""

_CYCLES = 20.0  # a window: a millionth of an oscillation is left, and windows are short enough for what comes and goes
_WINDOWS = 4  # one after another, at least, in a block
_OVERLAP = 3  # each reading lies in as many windows: with them a Hann window's squares add up to a constant
_SHORTEST_S = 0.5  # blocks that are shorter are left out: a window in them is no longer than the vibration's periods


def window_s(lines: Iterable[Line]) -> float:
    """Length of windows that average away the strongest of the lines that a vibration makes in the readings.

    One that is read too slowly is seen at another frequency, and leaves as much as if it had that.
    """
    strongest = max(lines, key=lambda line: float(np.linalg.norm(line.amplitude_mps2)), default=None)
    return WINDOW_S if strongest is None else max(WINDOW_S, _CYCLES / strongest.frequency_hz)


@cache
def correlations() -> Floats:
    """Of an average with itself and the next two, (3,): windows overlap, and white noise makes averages alike."""
    weights = np.sin(np.pi * (np.arange(3000) + 0.5) / 3000.0) ** 4
    shifted = [weights[: len(weights) - k * len(weights) // _OVERLAP] for k in range(_OVERLAP)]
    return np.array([own @ weights[-len(own) :] for own in shifted]) / (weights @ weights)


@cache
def inflation() -> float:
    """kappa of averages of white noise: their spectral density at zero frequency over that of their variance."""
    return float(2.0 * correlations().sum() - 1.0)


def averaged(block: Block, length_s: float = WINDOW_S) -> Block | None:
    """A block of averages over windows cos^4, with the variance of the readings in each; None: it is too short.

    Side lobes of the window fall as the fifth power of the frequency: at 30 cycles a window 1e-7 of an oscillation is
    left. A window is hardly longer than a quarter of the block. Variances are about a parabola over the block: what
    shakes has no mean in a window as short.
    """
    count, span_s = len(block.elapsed_s), float(block.elapsed_s[-1] - block.elapsed_s[0])
    step = math.ceil(min(length_s / max(span_s, 1e-9), 1.0 / _WINDOWS) * count / _OVERLAP)
    length = step * _OVERLAP
    if span_s < _SHORTEST_S or step < 2 or length > count:
        return None
    weights = np.sin(np.pi * (np.arange(length) + 0.5) / length) ** 4
    weights /= weights.sum()

    def means(values: Floats) -> Floats:
        return np.asarray(sliding_window_view(values, length, axis=0)[::step] @ weights)

    curve = orthonormal_parabola(count)
    level = block.accel_mps2.mean(axis=0)
    left = block.accel_mps2 - level
    shaking = left - curve @ (curve.T @ left)
    return replace(
        block,
        elapsed_s=means(block.elapsed_s),
        accel_mps2=level + means(left),
        pose=block.pose if len(block.pose) == 1 else means(block.pose),
        temperature_c=means(block.temperature_c),
        variance_mps2_2=means(shaking**2),
        taken=step,
    )
