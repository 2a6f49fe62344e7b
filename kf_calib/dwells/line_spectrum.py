"""The averaged power spectrum of the readings within dwells, and a test for spectral lines.

Readings without their parabola are cut into segments of equal length and multiplied by a Hann window, which confines a
strong line or steep noise to nearby bins; then |X|^2 is averaged over the segments. A bin is a line if it stands out of
the noise level, which is the product of an autoregressive spectrum (the slope of coloured noise), a cubic in logarithms
(the rise to low frequencies) and the median of the neighbouring bins (the remainder).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, reduce

import numpy as np

from kf_calib.bench.arrays import Floats, Mask
from kf_calib.dwells.limits import CUBIC, CURVE, SAMPLE
from kf_calib.support.tail_probabilities import sidak

_LENGTHS = np.array(sorted([4000, *(2**k for k in range(6, 12)), *(3 * 2**k for k in range(5, 11))]))
_FIRST_BIN = CURVE  # in lower bins the parabola has removed the power
_ORDER = 8
_SKIPPED = 3  # nearest bins on either side, which a line may fill, of the ``SAMPLE`` that give the level
_MEDIAN_EFFICIENCY = 0.45  # efficiency of the median of bins that the Hann window has correlated
_RISE_BINS = 128  # up to this bin a rise that no autoregression follows (1/f) is fitted
_MOST_LINES = 5  # that are told; what swings like a square wave has dozens
_LEAK = 0.05  # bins into which a line leaks more than this share of the level are not searched for another


@dataclass(frozen=True)
class SpectralLine:
    """A spectral line.

    - p_value: the probability that noise alone has a peak as high anywhere in the spectrum.
    - channel: the channel (from 0) in which it stands out most.
    - amplitude_mps2 (3,): its amplitude in each channel.
    """

    frequency_hz: float
    p_value: float
    channel: int
    amplitude_mps2: Floats


@dataclass(frozen=True)
class _Sum:
    """Sums over segments of one length: the power |X|^2 (bins, 3), the number of segments, and their total duration,
    s."""

    power: Floats
    segments: int
    duration_s: float

    def __add__(self, other: _Sum) -> _Sum:
        return _Sum(self.power + other.power, self.segments + other.segments, self.duration_s + other.duration_s)


@dataclass(frozen=True)
class Spectrum:
    """Power of segments of readings, summed separately for each length of segment; at most 48 kB for each length."""

    sums: dict[int, _Sum] = field(default_factory=dict)

    def __add__(self, other: Spectrum) -> Spectrum:
        shared = {length: self.sums[length] + other.sums[length] for length in self.sums.keys() & other.sums.keys()}
        return Spectrum({**self.sums, **other.sums, **shared})

    def times(self, weights: tuple[float, ...]) -> Spectrum:
        """The spectrum of readings of these weights: the power of each segment counts by that of its channel."""
        if set(weights) == {1.0}:
            return self
        return Spectrum({length: replace(each, power=weights * each.power) for length, each in self.sums.items()})

    @classmethod
    def of(cls, residuals: Floats, elapsed_s: Floats) -> Spectrum:
        """The spectrum of a block (3, n) without its parabola at times (n,), in segments of the longest length that
        fits."""
        count = residuals.shape[1]
        index = int(np.searchsorted(_LENGTHS, count, side="right")) - 1
        if index < 0:
            return cls()
        length = int(_LENGTHS[index])
        segments = count // length
        parts = residuals[:, : segments * length].reshape(3, segments, length)
        amplitudes = np.fft.rfft(parts * _taper(length))
        duration_s = (elapsed_s[-1] - elapsed_s[0]) / (count - 1) * length * segments
        return cls({length: _Sum((amplitudes.real**2 + amplitudes.imag**2).sum(axis=1).T, segments, float(duration_s))})


def lines(spectra: Iterable[Spectrum], level: float = 0.01) -> tuple[SpectralLine, ...]:
    """The lines of a run whose p-value is below ``level``, the most significant first, from the spectra of its dwells.

    The segment length that covers most readings is used; channels that do not vary are left out.
    """
    length, segments = _best_covered(spectra)
    if segments is None:
        return ()
    varying = np.asarray((segments.power[_FIRST_BIN:-1] > 0).all(axis=0))
    if not varying.any():
        return ()
    return _Search(segments, length, varying).lines(level)


def lines_of_several(spectra: Sequence[Spectrum], level: float) -> tuple[SpectralLine, ...]:
    """The lines that are there even without the dwell that has most of the strongest: what swings in one dwell alone
    is a disturbance of that dwell. p-values are the larger of both."""
    significant = lines(spectra, level)
    if len(spectra) < 2 or not significant:
        return significant
    length, total = _best_covered(spectra)
    assert total is not None
    bin_hz = total.segments / total.duration_s
    k = round(significant[0].frequency_hz / bin_hz)
    powers = [float(each.sums[length].power[k].sum()) if length in each.sums else 0.0 for each in spectra]
    loudest = int(np.argmax(powers))
    others = lines([*spectra[:loudest], *spectra[loudest + 1 :]], level)
    there = [(line, [each.p_value for each in others if abs(each.frequency_hz - line.frequency_hz) < 1.5 * bin_hz])
             for line in significant]  # fmt: skip
    return tuple(replace(line, p_value=max(line.p_value, *p_values)) for line, p_values in there if p_values)


def lowest_hz(spectra: Iterable[Spectrum]) -> float:
    """Lowest frequency at which ``lines`` searches; infinite if there is no spectrum."""
    segments = _best_covered(spectra)[1]
    return np.inf if segments is None else _FIRST_BIN * segments.segments / segments.duration_s


def _best_covered(spectra: Iterable[Spectrum]) -> tuple[int, _Sum | None]:
    """Return the segment length that covers most readings, and the sum over its segments."""
    total = reduce(Spectrum.__add__, spectra, Spectrum())
    length = max(total.sums, key=lambda each: each * total.sums[each].segments, default=0)
    return length, total.sums.get(length)


class _Search:
    """The search for lines in the sum of segments of one length.

    The statistic of a bin is the mean over the channels of power divided by noise level. In white noise, power over
    level is gamma distributed with 2 degrees of freedom per segment in each channel, so that the mean has up to 6 per
    segment, fewer if the channels share noise. Because the level is estimated from the median of n neighbours, which is
    as precise as the mean of 0.45 n bins, the statistic is approximately F distributed; it has fewer denominator
    degrees of freedom where the cubic follows single bins.
    """

    def __init__(self, total: _Sum, length: int, varying: Mask) -> None:
        self.length, self.segments, self.bin_hz = length, total.segments, total.segments / total.duration_s
        self.power, self.varying = total.power / total.segments, varying
        level = [_level(self.power[:, i], total.segments) if on else np.inf for i, on in enumerate(varying)]
        self.level = np.column_stack([np.broadcast_to(each, len(self.power)) for each in level])
        self.heights = self.power / self.level
        self.height = self.heights[:, varying].mean(axis=1)
        self.freedom = 2.0 * total.segments * independent(self.heights[_FIRST_BIN:-1, varying])

    def lines(self, level: float) -> tuple[SpectralLine, ...]:
        """The lines whose p-value is below ``level``."""
        significant, candidates = list[SpectralLine](), self._peaks()
        bins = len(self.height) - _FIRST_BIN - 1
        while candidates.any() and len(significant) < _MOST_LINES:
            k = int(np.argmax(np.where(candidates, self.height, 0.0)))
            p_value = sidak(self._chance(k), bins)
            if p_value >= level:
                break
            line, position = self._line(k, p_value)
            significant.append(line)
            candidates &= self.height[k] * _leakage(np.arange(len(candidates), dtype=float) - position) < _LEAK
        return tuple(significant)

    def _peaks(self) -> Mask:
        """Return a mask (b,) of the bins that are at least as high as both neighbours."""
        peaks = np.zeros(len(self.height), bool)
        inner = self.height[1:-1]
        peaks[1:-1] = (inner >= self.height[:-2]) & (inner >= self.height[2:])
        peaks[:_FIRST_BIN] = False
        return peaks

    def _chance(self, k: int) -> float:
        """Return the probability that noise alone makes bin ``k`` as high as it is."""
        from scipy.special import fdtrc

        neighbours = max(min(2 * (SAMPLE - _SKIPPED), len(self.height) - 2 * _SKIPPED), 1)
        relative = 1.0 / (_MEDIAN_EFFICIENCY * neighbours) + _leverages(len(self.height))[k]
        return float(fdtrc(self.freedom, self.freedom / relative, self.height[k]))

    def _line(self, k: int, p_value: float) -> tuple[SpectralLine, float]:
        """Return the line in bin ``k`` and its position between bins, from the main lobe of the Hann window, sin(pi x)
        / (pi x (1 - x^2)) / 2."""
        # heights relative to the level at one bin, since a strong line makes the level itself vary
        lobe = np.maximum((self.power[k - 2 : k + 3] / self.level[k])[:, self.varying].mean(axis=1) - 1.0, 0.0)
        centre = 1 + int(np.argmax(lobe[1:-1]))
        side = 1 if lobe[centre + 1] >= lobe[centre - 1] else -1
        ratio = float(np.sqrt(lobe[centre + side] / max(lobe[centre], 1e-300)))
        k += centre - 2
        shift = float(np.clip((2.0 * ratio - 1.0) / (ratio + 1.0), 0.0, 0.5))
        gain = 0.25 * self.length * np.sinc(shift) / (1.0 - shift**2)
        excess = np.where(np.isfinite(self.level[k]), self.power[k] - self.level[k], 0.0)
        amplitude = np.sqrt(np.maximum(excess, 0.0)) / gain
        position = k + side * shift
        return SpectralLine(position * self.bin_hz, p_value, int(np.argmax(self.heights[k])), amplitude), position


def independent(heights: Floats) -> float:
    """Effective number of independent channels in the mean of heights (b, c): c^2 / sum of their correlation matrix."""
    count = heights.shape[1]
    if count == 1:
        return 1.0
    bounded = np.minimum(heights, np.quantile(heights, 0.95, axis=0))  # a line in all channels must not count
    return float(count**2 / np.clip(np.corrcoef(bounded.T), 0.0, 1.0).sum())


def _leakage(bins: Floats) -> Floats:
    """Return an upper bound of what a line of height 1 leaks into a bin at this distance."""
    distance = np.maximum(np.abs(bins), 1.5)
    return np.where(np.abs(bins) < _SKIPPED, np.inf, 1.0 / (np.pi * distance * (distance**2 - 1.0)) ** 2)


def _level(power: Floats, segments: int) -> Floats:
    """Return the noise level (b,) in each bin, as described at the top of this file.

    Lines are cut off before the autoregression is fitted, because it would follow them.
    """
    from scipy.linalg import solve_toeplitz
    from scipy.special import gammaincinv

    length = 2 * (len(power) - 1)
    bound, slope = _running_median(power, 6, 0), power
    for _ in range(4):  # iterating admits a steep rise to low frequencies, but no line: its neighbours do not rise
        cut = np.minimum(power, 3.0 * bound)
        cut[:_FIRST_BIN] = cut[_FIRST_BIN]
        gamma = np.fft.irfft(cut, length)[: min(_ORDER, length // 32) + 1]
        gamma[0] *= 1.0 + 1e-9
        a = np.append(1.0, -solve_toeplitz(gamma[:-1], gamma[1:]))
        slope = 1.0 / np.abs(np.fft.rfft(a, length)) ** 2
        bound = slope * np.median(power / slope)
    slope = slope * _rise(power / slope)
    median = _running_median(power / slope, SAMPLE, _SKIPPED)
    return slope * median * segments / float(gammaincinv(segments, 0.5))


def _rise(ratio: Floats) -> Floats:
    """Return a robust cubic in logarithms through the lowest bins (b,); what stands out of it does not bend it."""
    basis, rise = _cubic(len(ratio)), np.ones(len(ratio))
    logs = np.log(np.maximum(ratio[_FIRST_BIN : _FIRST_BIN + len(basis)], 1e-300))
    bounded = logs
    for _ in range(6):
        residuals = logs - basis @ (basis.T @ bounded)
        bound = 3.0 * float(np.median(np.abs(residuals)))
        bounded = logs - residuals + np.clip(residuals, -bound, bound)
    curve = np.exp(basis @ (basis.T @ bounded))
    rise[: _FIRST_BIN + len(basis)] = np.append(np.full(_FIRST_BIN, curve[0]), curve)
    rise[_FIRST_BIN + len(basis) :] = curve[-1]
    return rise


def _leverages(count: int) -> Floats:
    """Return the leverage of each bin (b,) on the cubic."""
    basis, leverages = _cubic(count), np.zeros(count)
    leverages[_FIRST_BIN : _FIRST_BIN + len(basis)] = (basis**2).sum(axis=1)
    return leverages


@lru_cache(maxsize=16)
def _cubic(count: int) -> Floats:
    """Return an orthonormal basis (n, 4) of 1, x, x^2, x^3, where x is the logarithm of the lowest bin numbers."""
    x = np.log(np.arange(_FIRST_BIN, min(_RISE_BINS, count - 1)))
    return np.linalg.qr(np.vander(x - x.mean(), CUBIC + 1))[0]


def _running_median(values: Floats, reach: int, skipped: int) -> Floats:
    """Return the median (b,) of ``reach`` bins on either side without the nearest ``skipped``; at the ends the window
    is shifted."""
    count = len(values) - _FIRST_BIN - 1
    size = min(2 * reach + 1, count)
    k = np.arange(len(values))
    first = np.clip(k - size // 2, _FIRST_BIN, _FIRST_BIN + count - size)
    window = first[:, None] + np.arange(size)
    neighbours = (
        np.where(np.abs(window - k[:, None]) <= skipped - 1, np.nan, values[window]) if skipped else values[window]
    )
    return np.nanmedian(neighbours, axis=1)


@lru_cache(maxsize=16)
def _taper(length: int) -> Floats:
    """Return the Hann window (n,)."""
    return 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(length) / length)
