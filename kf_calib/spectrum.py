"""The averaged power spectrum of the readings within dwells, and the test for a line in it."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from kf_calib.samples import Floats

_LENGTHS = np.array(sorted([4000, *(2**k for k in range(6, 12)), *(3 * 2**k for k in range(5, 11))]))
_FIRST_BIN = 2  # below, the parabola has taken the power
_ORDER = 8
_NEIGHBOURS, _OWN = 32, 2  # bins on either side that give the level, less those a line may fill
_MEDIAN_EFFICIENCY = 0.64


@dataclass(frozen=True)
class Line:
    """The highest peak of the spectrum over its surroundings; amplitude_mps2 (3,).

    p_value: how likely noise without a line has a peak as high, anywhere.
    """

    frequency_hz: float
    amplitude_mps2: Floats
    p_value: float


@dataclass
class _Sum:
    """Of segments of one length: power |X|^2 summed (bins, 3), segments, seconds they last in all."""

    power: Floats
    segments: int = 0
    duration_s: float = 0.0


@dataclass
class Spectrum:
    """Power of segments of innovations less their parabola, summed by length; memory does not grow with the run."""

    sums: dict[int, _Sum] = field(default_factory=dict)

    def add(self, innovation: Floats, elapsed_s: Floats) -> None:
        """A block (3, n) at instants (n,); cut into segments of the longest of the lengths that fits."""
        count = innovation.shape[1]
        place = int(np.searchsorted(_LENGTHS, count, side="right")) - 1
        if place < 0:
            return
        length = int(_LENGTHS[place])
        own = self.sums.setdefault(length, _Sum(np.zeros((length // 2 + 1, 3))))
        for first in range(0, count - length + 1, length):
            part = innovation[:, first : first + length]
            part = part - (part @ _parabola(length)) @ _parabola(length).T
            found = np.fft.rfft(part, axis=1)
            own.power += (found.real**2 + found.imag**2).T
            own.segments += 1
        own.duration_s += (elapsed_s[-1] - elapsed_s[0]) / (count - 1) * length * (count // length)

    def line(self) -> Line | None:
        """The line that stands out most, from the length that most readings came in; None: too few readings."""
        moving = {length: own for length, own in self.sums.items() if (own.power[_FIRST_BIN:-1] > 0).all()}
        if not moving:
            return None
        length = max(moving, key=lambda each: each * moving[each].segments)
        own = moving[length]
        return _line(own.power / own.segments, length, own.segments, own.duration_s / own.segments)


def _line(power: Floats, length: int, segments: int, duration_s: float) -> Line:
    """The highest bin that is higher than both its neighbours, and between which bins it lies.

    A bin is the mean of the channels, each over its level: gamma distributed for white noise with 3 ``segments``
    degrees of freedom; over a level from the median of n neighbours about F distributed, as from 0.64 n bins' mean.
    """
    from scipy.special import fdtrc

    level = np.column_stack([_level(channel, segments) for channel in power.T])
    height = (power / level).mean(axis=1)
    inner = slice(_FIRST_BIN, len(height) - 1)
    peak = (height[inner] >= height[_FIRST_BIN - 1 : -2]) & (height[inner] >= height[_FIRST_BIN + 1 :])
    k = _FIRST_BIN + int(np.argmax(np.where(peak, height[inner], 0.0)))
    neighbours = min(2 * (_NEIGHBOURS - _OWN), len(height) - 2 * _OWN)
    freedom = 6.0 * segments
    alone = float(fdtrc(freedom, freedom * _MEDIAN_EFFICIENCY * neighbours, height[k]))
    side = 1 if height[k + 1] >= height[k - 1] else -1
    here, beside = np.sqrt(np.maximum(height[[k, k + side]] - 1.0, 0.0))
    shift = float(beside / max(here + beside, 1e-300))  # a rectangular window's lobe is sin(pi x) / (pi x)
    amplitude = 2.0 * np.sqrt(np.maximum(power[k] - level[k], 0.0)) / (length * np.sinc(shift))
    return Line(
        (k + side * shift) / duration_s, amplitude, float(-np.expm1(peak.size * np.log1p(-min(alone, 1 - 1e-16))))
    )


def _level(power: Floats, segments: int) -> Floats:
    """The noise under each bin (b,): an autoregression for the slope, the neighbours' median for what it leaves.

    Lines are cut off before the autoregression is fitted, or it would follow them.
    """
    from scipy.linalg import solve_toeplitz
    from scipy.special import gammaincinv

    length = 2 * (len(power) - 1)
    bound, slope = _running_median(power, 6, 0), power
    for _ in range(4):  # a steep rise to low frequencies is let in bit by bit, a line is not: nothing near it rises
        cut = np.minimum(power, 3.0 * bound)
        cut[:_FIRST_BIN] = cut[_FIRST_BIN]
        gamma = np.fft.irfft(cut, length)[: min(_ORDER, length // 32) + 1]
        gamma[0] *= 1.0 + 1e-9
        a = np.append(1.0, -solve_toeplitz(gamma[:-1], gamma[1:]))
        slope = 1.0 / np.abs(np.fft.rfft(a, length)) ** 2
        bound = slope * np.median(power / slope)
    median = _running_median(power / slope, _NEIGHBOURS, _OWN)
    return slope * median * segments / float(gammaincinv(segments, 0.5))


def _running_median(values: Floats, reach: int, own: int) -> Floats:
    """Median (b,) of ``reach`` bins on either side less ``own`` next to it; the window is shifted at the ends."""
    count = len(values) - _FIRST_BIN - 1
    size = min(2 * reach + 1, count)
    k = np.arange(len(values))
    first = np.clip(k - size // 2, _FIRST_BIN, _FIRST_BIN + count - size)
    window = first[:, None] + np.arange(size)
    left = np.where(np.abs(window - k[:, None]) <= own - 1, np.nan, values[window]) if own else values[window]
    return np.nanmedian(left, axis=1)


@lru_cache(maxsize=16)
def _parabola(length: int) -> Floats:
    """1, u, u^2 made orthonormal, (n, 3)."""
    u = np.linspace(-1.0, 1.0, length)
    return np.linalg.qr(np.column_stack([np.ones(length), u, u * u]))[0]
