"""The readings of dwells in cells of the run's clock, and the search for an oscillation that keeps its phase.

Spectra of segments are averaged in power, which does not show an oscillation as weak as one that a fit over the whole
run would find. Here the means of cells of all dwells, each dwell less its parabola, are transformed at once: a sinusoid
of one phase all along then adds up in amplitude. It is looked for from a cycle or two a dwell, where a parabola leaves
most of it, up to the few hertz that the cells hold.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench.arrays import Floats, Mask
from kf_calib.dwells.line_spectrum import Line, independent
from kf_calib.support.tail_probabilities import sidak

_CELL_S = 0.125  # at most, where readings come more often
_LONGEST = 1 << 15  # cells of a dwell that are kept: more than an hour
_LONGEST_RUN = 1 << 20  # cells of a run that are transformed at once: a day and a half
_FEWEST_CYCLES = 1.5  # a dwell: of fewer a parabola takes more than half
_HIGHEST = 0.75  # of half the rate of cells
_BANDS, _BAND_POINTS = 40, 16  # of equal ratio, and frequencies in each at least, whose median gives the noise under it
_DEGREE = 3  # of the curve through them, in logarithms
_ROUNDING = 1e-12  # of a reading
_KNOTS = 1000
_TALL = 32  # of all heights; how well the noise is known under each decides among them
_MEDIAN_EFFICIENCY = 0.48  # of the median of independent exponential variates


@dataclass(frozen=True)
class Cells:
    """The run's clock in cells of ``readings`` readings, which come every ``step_s``.

    Cells of another length would hold now more and now fewer readings: a beat, at which slow noise shows again.
    """

    step_s: float
    readings: int

    @classmethod
    def of(cls, elapsed_s: Floats) -> Cells | None:
        """For readings that come as these do; None for too few."""
        if len(elapsed_s) < 3:
            return None
        step_s = float(np.median(np.diff(elapsed_s)))
        return cls(step_s, max(1, int(_CELL_S / step_s)))

    @property
    def cell_s(self) -> float:
        return self.step_s * self.readings

    def places(self, elapsed_s: Floats) -> NDArray[np.intp]:
        """Of instants: readings on time lie in the middle between the ends of two steps."""
        return ((elapsed_s / self.step_s + 0.5) / self.readings).astype(np.intp)


@dataclass(frozen=True)
class Trace:
    """Sums (m, 3) and counts (m,) of a dwell's readings in consecutive cells of the run's clock from ``first`` on."""

    cell_s: float = _CELL_S
    first: int = 0
    sums: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    counts: Floats = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def of(cls, readings: Floats, elapsed_s: Floats, into: Cells) -> Trace:
        """Of a block (n, 3) at instants (n,), which rise."""
        cells = into.places(elapsed_s)
        starts = np.append(0, np.flatnonzero(cells[1:] != cells[:-1]) + 1)
        places, length = cells[starts] - cells[0], int(cells[-1] - cells[0]) + 1
        if length > _LONGEST:
            return cls()
        sums, counts = np.zeros((length, 3)), np.zeros(length)
        sums[places] = np.add.reduceat(readings, starts, axis=0)
        counts[places] = np.diff(starts, append=len(cells))
        return cls(into.cell_s, int(cells[0]), sums, counts)

    def __len__(self) -> int:
        return len(self.counts)

    def __add__(self, other: Trace) -> Trace:
        if not len(self) or not len(other):
            return self if len(self) else other
        first, end = min(self.first, other.first), max(self.first + len(self), other.first + len(other))
        if end - first > _LONGEST or other.cell_s != self.cell_s:
            return self
        sums, counts = np.zeros((end - first, 3)), np.zeros(end - first)
        for each in (self, other):
            part = slice(each.first - first, each.first - first + len(each))
            sums[part] += each.sums
            counts[part] += each.counts
        return Trace(self.cell_s, first, sums, counts)

    @property
    def left(self) -> Floats:
        """Sums (m, 3) less the parabola nearest to the readings."""
        roots = np.sqrt(self.counts)[:, None]
        seen = roots[:, 0] > 0
        curve = np.linalg.qr(roots[seen] * np.vander(np.linspace(-1.0, 1.0, len(self)), 3)[seen])[0]
        means = self.sums[seen] / roots[seen]
        out = np.zeros_like(self.sums)
        out[seen] = roots[seen] * (means - curve @ (curve.T @ means))
        return out


def band_hz(traces: Sequence[Trace]) -> tuple[float, float]:
    """From which frequency to which ``tone`` looks for an oscillation; infinite where it cannot."""
    seen = [trace for trace in traces if len(trace)]
    if not seen or np.diff(_ends(seen)) > _LONGEST_RUN:
        return np.inf, np.inf
    low, high = _FEWEST_CYCLES / _usual_s(seen), _HIGHEST * 0.5 / seen[0].cell_s
    return (low, high) if high > 2.0 * low else (np.inf, np.inf)


def _ends(traces: Sequence[Trace]) -> tuple[int, int]:
    """The first cell of a run and that after the last."""
    return min(trace.first for trace in traces), max(trace.first + len(trace) for trace in traces)


def _usual_s(traces: Sequence[Trace]) -> float:
    """Length of the dwell in which the middle of all cells lies."""
    lengths = np.sort([len(trace) for trace in traces])
    return float(lengths[np.searchsorted(np.cumsum(lengths), 0.5 * lengths.sum())] * traces[0].cell_s)


def tone(traces: Sequence[Trace], level: float = 0.01) -> Line | None:
    """The likeliest oscillation of one frequency and one phase in all dwells, if its p-value of the run is below
    ``level``; None where there is none, or where what there is keeps no phase.

    Its height is the mean over the channels of |X|^2 over the noise around, which is gamma distributed with 2 degrees
    of freedom a channel where there is none.
    """
    from scipy.special import fdtrc

    low_hz, high_hz = band_hz(traces)
    if not np.isfinite(low_hz):
        return None
    seen = [trace for trace in traces if len(trace)]
    first, end = _ends(seen)
    size = 1 << (2 * (end - first)).bit_length()
    grid = np.zeros((3, end - first))
    for trace in seen:
        grid[:, trace.first - first :][:, : len(trace)] += trace.left.T
    largest = max(float(np.abs(trace.sums).max()) for trace in seen)
    moving = np.asarray(np.abs(grid).max(axis=1) > _ROUNDING * largest)
    cell_s = seen[0].cell_s
    step_hz = 1.0 / (size * cell_s)
    part = slice(int(np.ceil(low_hz / step_hz)), int(high_hz / step_hz) + 1)
    if not moving.any() or part.stop - part.start < _DEGREE * _BAND_POINTS:
        return None
    frequency_hz = step_hz * np.arange(part.start, part.stop, dtype=float)
    wave = np.fft.rfft(grid, size, axis=1)[:, part]
    knots = np.geomspace(frequency_hz[0], frequency_hz[-1], _KNOTS)
    kept = np.interp(frequency_hz, knots, _kept(np.pi * knots * _usual_s(seen)))
    power = (wave.real**2 + wave.imag**2)[moving] / kept
    levels, variance = _levels(power, frequency_hz, size / (end - first))
    heights = power / levels
    freedom, height = 2.0 * independent(heights.T), heights.mean(axis=0)
    tall = np.argsort(height)[-_TALL:]
    chances = fdtrc(freedom, freedom / variance[tall], height[tall])
    k, chance = int(tall[np.argmin(chances)]), float(chances.min())
    p_value = sidak(chance, len(height))
    if p_value >= level or not _steady(seen, frequency_hz[k], levels[:, k] * kept[k], moving):
        return None
    held = kept[k] * np.sinc(frequency_hz[k] * cell_s) * sum(float(trace.counts.sum()) for trace in seen)
    return Line(float(frequency_hz[k]), p_value, int(np.argmax(np.abs(wave[:, k]))), 2.0 * np.abs(wave[:, k]) / held)


def _steady(traces: Sequence[Trace], frequency_hz: float, noise: Floats, moving: Mask) -> bool:
    """Whether more than half of the power at a frequency keeps its phase from dwell to dwell: else it is vibration.

    noise (c,): what |X|^2 of all dwells is without it; in a dwell it is less by its share of the readings.
    """
    waves = [
        np.exp(-2j * np.pi * frequency_hz * trace.cell_s * (trace.first + np.arange(len(trace)))) @ trace.left
        for trace in traces
    ]
    counts = np.array([trace.counts.sum() for trace in traces])
    shares = (counts / counts.sum())[:, None]
    own = np.array(waves)[:, moving]
    apart = np.sum(np.abs(own) ** 2 / (noise * shares) - 1.0)
    together = np.sum(np.abs(own.sum(axis=0)) ** 2 / noise - 1.0)
    return bool(together > 0.5 * apart)


def _kept(half_phase: Floats) -> Floats:
    """What a parabola over a dwell leaves of the power of a sinusoid that has the phase 2 x in it: 1 - sum over l of
    (2 l + 1) j_l(x)^2, j_l the spherical Bessel functions, l = 0, 1, 2."""
    from scipy.special import spherical_jn

    orders = np.arange(3)[:, None]
    return 1.0 - np.sum((2 * orders + 1) * spherical_jn(orders, half_phase) ** 2, axis=0)


def _levels(power: Floats, frequency_hz: Floats, padded: float) -> tuple[Floats, Floats]:
    """The noise (c, b) under |X|^2 (c, b) as a smooth curve, and the relative variance (b,) to which it is known.

    Medians of bands do not follow a line; a cubic in logarithms follows white noise and what rises to low frequencies.
    ``padded``: frequencies a 1/run.
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
    places = np.array([x[a:b].mean() for a, b in itertools.pairwise(ends)])
    medians = np.array([np.median(power[:, a:b], axis=1) for a, b in itertools.pairwise(ends)])
    logs = np.log(np.maximum(medians / np.log(2.0), 1e-300))
    weights = np.sqrt(_MEDIAN_EFFICIENCY * np.diff(ends) / padded)[:, None]
    degree = min(_DEGREE, len(places) - 1)
    frame, upper = np.linalg.qr(weights * np.vander(places, degree + 1))
    curve = np.vander(x, degree + 1) @ np.linalg.inv(upper)
    return np.exp(curve @ (frame.T @ (weights * logs))).T, (curve**2).sum(axis=1)
