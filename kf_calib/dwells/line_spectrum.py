"""The averaged power spectrum of the readings within dwells, and the test for lines in it.

Readings less their parabola are cut into segments of equal length, tapered by Hann's window (a strong line or a steep
noise then stays near its own bins), and |X|^2 is averaged. A bin is a line where it stands out of the noise under it;
that is an autoregression for the slope of a coloured noise, a cubic in logarithms for its rise to low frequencies, and
the median of the bins around for what these leave.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import lru_cache, reduce

import numpy as np

from kf_calib.bench.arrays import Floats, Mask
from kf_calib.support.tail_probabilities import sidak

_LENGTHS = np.array(sorted([4000, *(2**k for k in range(6, 12)), *(3 * 2**k for k in range(5, 11))]))
_FIRST_BIN = 3  # below, the parabola has taken the power
_ORDER = 8
_NEIGHBOURS, _OWN = 32, 3  # bins on either side that give the level, less those a line may fill
_MEDIAN_EFFICIENCY = 0.45  # of the median of bins that Hann's window has made alike, against as many independent ones
_BENT, _CUBIC = 128, 3  # up to this bin noise may rise to low frequencies as no autoregression does (1/f)
_MOST = 5
_LEAK = 0.05  # of the level: bins in which a line leaves more are not searched for another


@dataclass(frozen=True)
class Line:
    """A peak of the spectrum over its surroundings; channel: where it stands out most; amplitude_mps2 (3,).

    p_value: of the run, how likely noise without a line has a peak as high, anywhere in the spectrum.
    """

    frequency_hz: float
    p_value: float
    channel: int
    amplitude_mps2: Floats


@dataclass(frozen=True)
class _Sum:
    """Of segments of one length: power |X|^2 summed (bins, 3), segments, seconds they last in all."""

    power: Floats
    segments: int
    duration_s: float

    def __add__(self, other: _Sum) -> _Sum:
        return _Sum(self.power + other.power, self.segments + other.segments, self.duration_s + other.duration_s)


@dataclass(frozen=True)
class Spectrum:
    """Power of segments of readings, summed by length of segment: at most 48 kB a length."""

    sums: dict[int, _Sum] = field(default_factory=dict)

    def __add__(self, other: Spectrum) -> Spectrum:
        both = {length: self.sums[length] + other.sums[length] for length in self.sums.keys() & other.sums.keys()}
        return Spectrum({**self.sums, **other.sums, **both})

    @classmethod
    def of(cls, left: Floats, elapsed_s: Floats) -> Spectrum:
        """Of a block (3, n) without its parabola, at instants (n,); in segments of the longest length that fits."""
        count = left.shape[1]
        place = int(np.searchsorted(_LENGTHS, count, side="right")) - 1
        if place < 0:
            return cls()
        length = int(_LENGTHS[place])
        segments = count // length
        parts = left[:, : segments * length].reshape(3, segments, length)
        found = np.fft.rfft(parts * _taper(length))
        duration_s = (elapsed_s[-1] - elapsed_s[0]) / (count - 1) * length * segments
        return cls({length: _Sum((found.real**2 + found.imag**2).sum(axis=1).T, segments, float(duration_s))})


def lines(spectra: Iterable[Spectrum], level: float = 0.01) -> tuple[Line, ...]:
    """The lines of a run whose p-value is below ``level``, the likeliest first, from the spectra of its dwells.

    The length of segment in which most readings came is used; channels that do not vary are left out.
    """
    length, own = _most(spectra)
    if own is None:
        return ()
    moving = np.asarray((own.power[_FIRST_BIN:-1] > 0).all(axis=0))
    if not moving.any():
        return ()
    return _Search(own, length, moving).lines(level)


def lowest_hz(spectra: Iterable[Spectrum]) -> float:
    """From which frequency on ``lines`` looks for lines; infinite where there is no spectrum."""
    own = _most(spectra)[1]
    return np.inf if own is None else _FIRST_BIN * own.segments / own.duration_s


def _most(spectra: Iterable[Spectrum]) -> tuple[int, _Sum | None]:
    """The length of segment in which most readings came, and the sum over these segments."""
    total = reduce(Spectrum.__add__, spectra, Spectrum())
    length = max(total.sums, key=lambda each: each * total.sums[each].segments, default=0)
    return length, total.sums.get(length)


class _Search:
    """For lines in the sum of segments of one length.

    A bin's height is the mean over the channels of power over level. In white noise a channel's share of it is gamma
    distributed with 2 degrees of freedom a segment, so the mean has up to 6, fewer where channels share their noise.
    Over a level from the median of n neighbours it is about F distributed, as from a mean of 0.45 n bins; of fewer
    where the cubic follows single bins.
    """

    def __init__(self, own: _Sum, length: int, moving: Mask) -> None:
        self.length, self.segments, self.bin_hz = length, own.segments, own.segments / own.duration_s
        self.power, self.moving = own.power / own.segments, moving
        level = [_level(self.power[:, i], own.segments) if on else np.inf for i, on in enumerate(moving)]
        self.level = np.column_stack([np.broadcast_to(each, len(self.power)) for each in level])
        self.heights = self.power / self.level
        self.height = self.heights[:, moving].mean(axis=1)
        self.freedom = 2.0 * own.segments * independent(self.heights[_FIRST_BIN:-1, moving])

    def lines(self, level: float) -> tuple[Line, ...]:
        found, open_ = list[Line](), self._peaks()
        bins = len(self.height) - _FIRST_BIN - 1
        while open_.any() and len(found) < _MOST:
            k = int(np.argmax(np.where(open_, self.height, 0.0)))
            p_value = sidak(self._chance(k), bins)
            if p_value >= level:
                break
            line, place = self._line(k, p_value)
            found.append(line)
            open_ &= self.height[k] * _leakage(np.arange(len(open_), dtype=float) - place) < _LEAK
        return tuple(found)

    def _peaks(self) -> Mask:
        """Bins (b,) that are at least as high as both their neighbours."""
        out = np.zeros(len(self.height), bool)
        inner = self.height[1:-1]
        out[1:-1] = (inner >= self.height[:-2]) & (inner >= self.height[2:])
        out[:_FIRST_BIN] = False
        return out

    def _chance(self, k: int) -> float:
        """That noise alone makes bin ``k`` as high."""
        from scipy.special import fdtrc

        neighbours = max(min(2 * (_NEIGHBOURS - _OWN), len(self.height) - 2 * _OWN), 1)
        relative = 1.0 / (_MEDIAN_EFFICIENCY * neighbours) + _leverages(len(self.height))[k]
        return float(fdtrc(self.freedom, self.freedom / relative, self.height[k]))

    def _line(self, k: int, p_value: float) -> tuple[Line, float]:
        """The line in bin ``k``, and between which bins it lies: Hann's lobe is sin(pi x) / (pi x (1 - x^2)) / 2."""
        # heights over the level at one bin: under a strong line the level itself has slopes
        near = np.maximum((self.power[k - 2 : k + 3] / self.level[k])[:, self.moving].mean(axis=1) - 1.0, 0.0)
        at = 1 + int(np.argmax(near[1:-1]))
        side = 1 if near[at + 1] >= near[at - 1] else -1
        ratio = float(np.sqrt(near[at + side] / max(near[at], 1e-300)))
        k += at - 2
        shift = float(np.clip((2.0 * ratio - 1.0) / (ratio + 1.0), 0.0, 0.5))
        gain = 0.25 * self.length * np.sinc(shift) / (1.0 - shift**2)
        excess = np.where(np.isfinite(self.level[k]), self.power[k] - self.level[k], 0.0)
        amplitude = np.sqrt(np.maximum(excess, 0.0)) / gain
        place = k + side * shift
        return Line(place * self.bin_hz, p_value, int(np.argmax(self.heights[k])), amplitude), place


def independent(heights: Floats) -> float:
    """How many independent channels the mean of heights (b, c) is worth: c^2 / sum of their correlations."""
    count = heights.shape[1]
    if count == 1:
        return 1.0
    bounded = np.minimum(heights, np.quantile(heights, 0.95, axis=0))  # a line in all channels is not what is meant
    return float(count**2 / np.clip(np.corrcoef(bounded.T), 0.0, 1.0).sum())


def _leakage(bins: Floats) -> Floats:
    """At most what a line of height 1 leaves so many bins away."""
    away = np.maximum(np.abs(bins), 1.5)
    return np.where(np.abs(bins) < _OWN, np.inf, 1.0 / (np.pi * away * (away**2 - 1.0)) ** 2)


def _level(power: Floats, segments: int) -> Floats:
    """The noise under each bin (b,): an autoregression, a rise to low frequencies, the neighbours' median.

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
    slope = slope * _rise(power / slope)
    median = _running_median(power / slope, _NEIGHBOURS, _OWN)
    return slope * median * segments / float(gammaincinv(segments, 0.5))


def _rise(ratio: Floats) -> Floats:
    """What a cubic in logarithms makes of the lowest bins (b,); what stands out of it does not bend it."""
    frame, out = _cubic(len(ratio)), np.ones(len(ratio))
    logs = np.log(np.maximum(ratio[_FIRST_BIN : _FIRST_BIN + len(frame)], 1e-300))
    bounded = logs
    for _ in range(6):
        away = logs - frame @ (frame.T @ bounded)
        bound = 3.0 * float(np.median(np.abs(away)))
        bounded = logs - away + np.clip(away, -bound, bound)
    found = np.exp(frame @ (frame.T @ bounded))
    out[: _FIRST_BIN + len(frame)] = np.append(np.full(_FIRST_BIN, found[0]), found)
    out[_FIRST_BIN + len(frame) :] = found[-1]
    return out


def _leverages(count: int) -> Floats:
    """By how much each bin (b,) pulls the cubic to itself."""
    frame, out = _cubic(count), np.zeros(count)
    out[_FIRST_BIN : _FIRST_BIN + len(frame)] = (frame**2).sum(axis=1)
    return out


@lru_cache(maxsize=16)
def _cubic(count: int) -> Floats:
    """1, x, x^2, x^3 of x the logarithm of the lowest bins, made orthonormal, (n, 4)."""
    x = np.log(np.arange(_FIRST_BIN, min(_BENT, count - 1)))
    return np.linalg.qr(np.vander(x - x.mean(), _CUBIC + 1))[0]


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
def _taper(length: int) -> Floats:
    """Hann's window (n,)."""
    return 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(length) / length)
