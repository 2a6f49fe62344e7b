"""The search for an oscillation that keeps its phase over the whole run.

Spectra that are averaged in power do not show an oscillation as weak as a fit over the whole run would detect. Here the
readings of all dwells are averaged in cells of the run's clock, the parabola of each dwell is removed, and all cells
are transformed at once, so that a sinusoid of constant phase adds up in amplitude. The search begins at about 1.5
cycles per dwell, above which a parabola leaves most of the oscillation, and ends at the few hertz that the cells
resolve.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench.arrays import LAST_DIGITS, Floats, Mask
from kf_calib.dwells.limits import CUBIC, CURVE
from kf_calib.dwells.line_spectrum import SpectralLine, independent
from kf_calib.support.tail_probabilities import sidak

CELL_S = 0.125
"""Largest length of a cell, unless readings are less frequent: several periods of vibration."""
MOST_CELLS = 1 << 17
"""Cells with readings that are kept of a run: four and a half hours, which take 4 MB."""
_LONGEST_RUN = 1 << 20  # cells of a run, with pauses, from its first reading on, that are transformed: a day and a half
_FEWEST_CYCLES = CURVE / 2  # per dwell: a parabola, of as many coefficients as half cycles, removes a slower one
_HIGHEST = 0.75  # highest frequency, as a share of half the rate of cells
_BANDS, _BAND_POINTS = 40, 16  # bands of equal ratio, with at least so many frequencies; their medians give the noise


@dataclass(frozen=True)
class Cells:
    """The division of the run's clock into cells of ``readings`` readings each, which come every ``step_s``.

    A cell has a whole number of readings because the count would otherwise alternate between cells, and the resulting
    beat would fold slow noise into the band.
    """

    step_s: float
    readings: int

    @classmethod
    def of(cls, elapsed_s: Floats) -> Cells | None:
        """Cells for readings at these times; None if there are too few readings."""
        if len(elapsed_s) < 3:
            return None
        step_s = float(np.median(np.diff(elapsed_s)))
        return cls(step_s, max(1, int(CELL_S / step_s)))

    @property
    def cell_s(self) -> float:
        """Length of a cell, s."""
        return self.step_s * self.readings

    def numbers(self, elapsed_s: Floats) -> NDArray[np.intp]:
        """Numbers of the cells in which these times lie; readings on schedule lie in the middle of their step."""
        return ((elapsed_s / self.step_s + 0.5) / self.readings).astype(np.intp)


@dataclass(frozen=True)
class Trace:
    """Sums (m, 3) and counts (m,) of a dwell's readings in consecutive cells of the run's clock, beginning with cell
    ``first``."""

    cell_s: float = CELL_S
    first: int = 0
    sums: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    counts: Floats = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def of(cls, readings: Floats, elapsed_s: Floats, into: Cells) -> Trace:
        """The sums of a block of readings (n, 3) at increasing times (n,)."""
        cells = into.numbers(elapsed_s)
        kept = int(np.searchsorted(cells, _LONGEST_RUN))
        if not kept:
            return cls()
        cells, readings = cells[:kept], readings[:kept]
        starts = np.append(0, np.flatnonzero(cells[1:] != cells[:-1]) + 1)
        positions, length = cells[starts] - cells[0], int(cells[-1] - cells[0]) + 1
        sums, counts = np.zeros((length, 3)), np.zeros(length)
        sums[positions] = np.add.reduceat(readings, starts, axis=0)
        counts[positions] = np.diff(starts, append=len(cells))
        return cls(into.cell_s, int(cells[0]), sums, counts)

    def __len__(self) -> int:
        return len(self.counts)

    @classmethod
    def joined(cls, some: Iterable[Trace]) -> Trace:
        """The sums of all blocks of a dwell."""
        traces = [trace for trace in some if len(trace)]
        if len(traces) < 2:
            return traces[0] if traces else cls()
        first, end = _ends(traces)
        sums, counts = np.zeros((end - first, 3)), np.zeros(end - first)
        for trace in traces:
            part = slice(trace.first - first, trace.first - first + len(trace))
            sums[part] += trace.sums
            counts[part] += trace.counts
        return cls(traces[0].cell_s, first, sums, counts)

    @property
    def residual_sums(self) -> Floats:
        """The sums (m, 3) after the least-squares parabola of the readings, weighted by their counts, has been
        removed."""
        roots = np.sqrt(self.counts)[:, None]
        measured = roots[:, 0] > 0
        curve = np.linalg.qr(roots[measured] * np.vander(np.linspace(-1.0, 1.0, len(self)), 3)[measured])[0]
        means = self.sums[measured] / roots[measured]
        residuals = np.zeros_like(self.sums)
        residuals[measured] = roots[measured] * (means - curve @ (curve.T @ means))
        return residuals


def band_hz(traces: Sequence[Trace]) -> tuple[float, float]:
    """Lowest and highest frequency at which ``tone`` searches; infinite if it cannot."""
    recorded = [trace for trace in traces if len(trace)]
    if not recorded:
        return np.inf, np.inf
    low, high = _FEWEST_CYCLES / _median_dwell_s(recorded), _HIGHEST * 0.5 / recorded[0].cell_s
    return (low, high) if high > 2.0 * low else (np.inf, np.inf)


def _ends(traces: Sequence[Trace]) -> tuple[int, int]:
    """Return the first cell of a run and the one after the last."""
    return min(trace.first for trace in traces), max(trace.first + len(trace) for trace in traces)


def _median_dwell_s(traces: Sequence[Trace]) -> float:
    """Return the length of the dwell that contains the median cell when dwells are sorted by length."""
    lengths = np.sort([len(trace) for trace in traces])
    return float(lengths[np.searchsorted(np.cumsum(lengths), 0.5 * lengths.sum())] * traces[0].cell_s)


def tone(traces: Sequence[Trace], level: float = 0.01) -> SpectralLine | None:
    """The most likely oscillation of constant frequency and phase in all dwells, or None.

    It is returned if its p-value over the whole band is below ``level`` and if it keeps its phase from dwell to dwell.
    The test statistic at a frequency is the mean over the channels of |X|^2 divided by the noise level, which without
    an oscillation is gamma distributed with 2 degrees of freedom per channel.
    """
    from scipy.special import fdtrc

    low_hz, high_hz = band_hz(traces)
    if not np.isfinite(low_hz):
        return None
    recorded = [trace for trace in traces if len(trace)]
    first, end = _ends(recorded)
    size = 1 << (2 * (end - first)).bit_length()
    grid = np.zeros((3, end - first))
    for trace in recorded:
        grid[:, trace.first - first :][:, : len(trace)] += trace.residual_sums.T
    largest = max(float(np.abs(trace.sums).max()) for trace in recorded)
    varying = np.asarray(np.abs(grid).max(axis=1) > LAST_DIGITS * largest)
    cell_s = recorded[0].cell_s
    step_hz = 1.0 / (size * cell_s)
    band = slice(int(np.ceil(low_hz / step_hz)), int(high_hz / step_hz) + 1)
    if not varying.any() or band.stop - band.start < CUBIC * _BAND_POINTS:
        return None
    frequency_hz = step_hz * np.arange(band.start, band.stop, dtype=float)
    wave = np.fft.rfft(grid, size, axis=1)[:, band]
    passed_share = _share_beside_parabola(np.pi * frequency_hz * _median_dwell_s(recorded))
    power = (wave.real**2 + wave.imag**2)[varying] / passed_share
    levels, variance = _levels(power, frequency_hz, size / (end - first))
    heights = power / levels
    freedom, height = 2.0 * independent(heights.T), heights.mean(axis=0)
    chances = fdtrc(freedom, freedom / variance, height)
    k = int(np.argmax(np.where(chances <= chances.min(), height, 0.0)))  # the tallest of those beyond any chance
    p_value = sidak(float(chances[k]), len(height))
    if p_value >= level or not _steady(recorded, frequency_hz[k], levels[:, k] * passed_share[k], varying):
        return None
    gain = passed_share[k] * np.sinc(frequency_hz[k] * cell_s) * sum(float(trace.counts.sum()) for trace in recorded)
    return SpectralLine(
        float(frequency_hz[k]), p_value, int(np.argmax(np.abs(wave[:, k]))), 2.0 * np.abs(wave[:, k]) / gain
    )


def _steady(traces: Sequence[Trace], frequency_hz: float, noise: Floats, varying: Mask) -> bool:
    """Tell whether more than half of the power at a frequency keeps its phase from dwell to dwell; otherwise it is
    vibration.

    ``noise`` (c,) is the expected |X|^2 over all dwells without the oscillation; in a single dwell it is proportional
    to the number of readings.
    """
    waves = [
        np.exp(-2j * np.pi * frequency_hz * trace.cell_s * (trace.first + np.arange(len(trace)))) @ trace.residual_sums
        for trace in traces
    ]
    counts = np.array([trace.counts.sum() for trace in traces])
    shares = (counts / counts.sum())[:, None]
    amplitudes = np.array(waves)[:, varying]
    incoherent_power = np.sum(np.abs(amplitudes) ** 2 / (noise * shares) - 1.0)
    coherent_power = np.sum(np.abs(amplitudes.sum(axis=0)) ** 2 / noise - 1.0)
    return bool(coherent_power > 0.5 * incoherent_power)


def _share_beside_parabola(half_phase: Floats) -> Floats:
    """Return the share of a sinusoid's power that remains after a parabola over a dwell is removed.

    If the phase advances by 2 x over the dwell, the share is 1 - sum over l = 0, 1, 2 of (2 l + 1) j_l(x)^2, where j_l
    are the spherical Bessel functions; x is beyond 1, so that nothing cancels in their closed form.
    """
    x = half_phase
    first = np.sin(x) / x
    second = (first - np.cos(x)) / x
    third = 3.0 * second / x - first
    return 1.0 - first**2 - 3.0 * second**2 - 5.0 * third**2


def _levels(power: Floats, frequency_hz: Floats, padded: float) -> tuple[Floats, Floats]:
    """Return the noise level (c, b) of |X|^2 (c, b) as a smooth curve, and the relative variance (b,) of the curve.

    The curve is a cubic through the logarithms of medians in bands. Medians are insensitive to lines, and a cubic
    follows white noise as well as noise that rises to low frequencies. The median of independent exponential variates,
    ln 2 times their mean, is as precise as the mean of (ln 2)^2 as many. ``padded`` is the number of frequencies per
    independent one.
    """
    x = np.log(frequency_hz)
    x = 2.0 * (x - x[0]) / (x[-1] - x[0]) - 1.0
    count = len(x)
    ends = [0]
    while ends[-1] < count:
        equal = int(np.searchsorted(x, x[min(ends[-1], count - 1)] + 2.0 / _BANDS))
        ends.append(min(max(equal, ends[-1] + _BAND_POINTS), count))
    if len(ends) > 2 and ends[-1] - ends[-2] < _BAND_POINTS:
        ends.pop(-2)
    centres = np.array([x[a:b].mean() for a, b in itertools.pairwise(ends)])
    medians = np.array([np.median(power[:, a:b], axis=1) for a, b in itertools.pairwise(ends)])
    logs = np.log(np.maximum(medians / np.log(2.0), 1e-300))
    weights = np.log(2.0) * np.sqrt(np.diff(ends) / padded)[:, None]
    degree = min(CUBIC, len(centres) - 1)
    basis, upper = np.linalg.qr(weights * np.vander(centres, degree + 1))
    curve = np.vander(x, degree + 1) @ np.linalg.inv(upper)
    return np.exp(curve @ (basis.T @ (weights * logs))).T, (curve**2).sum(axis=1)
