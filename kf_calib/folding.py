"""Dwells folded into triangular factors: all that is kept of the samples.

Each dwell's rows [X | z] (regressors, three readings) are folded by QR into one upper-triangular factor of 7 x 7
numbers, unwhitened, so that noise model, filter and diagnosis need no second pass over the data. Factors of the same
dwell from two places merge by stacking and one more QR.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from kf_calib.model import REGRESSORS, Rows
from kf_calib.samples import Floats, Mask
from kf_calib.triangle import triangle

WIDTH = len(REGRESSORS)
_LAGS = 64
_CORRELATED_SAMPLES = 8192  # readings of a dwell whose autocovariance is accumulated
_FIRST_SNAPSHOT = 64


@dataclass(frozen=True)
class Autocovariance:
    """Sums of lagged products of the innovations within blocks: products (L + 1, 3), pairs (L + 1,), blocks' n."""

    products: Floats = field(default_factory=lambda: np.zeros((_LAGS + 1, 3)))
    pairs: Floats = field(default_factory=lambda: np.zeros(_LAGS + 1))
    count: int = 0
    blocks: int = 0

    def __add__(self, other: Autocovariance) -> Autocovariance:
        return Autocovariance(
            self.products + other.products,
            self.pairs + other.pairs,
            self.count + other.count,
            self.blocks + other.blocks,
        )

    @classmethod
    def of(cls, innovation: Floats) -> Autocovariance:
        """Of innovations (3, n)."""
        count = innovation.shape[1]
        padded = 1 << (count + _LAGS).bit_length()
        spectrum = np.fft.rfft(innovation, padded, axis=1)
        products = np.zeros((_LAGS + 1, 3))
        lags = min(_LAGS, count - 1) + 1
        products[:lags] = np.fft.irfft(np.abs(spectrum) ** 2, padded, axis=1)[:, :lags].T
        return cls(products, np.maximum(count - np.arange(_LAGS + 1), 0).astype(float), count, 1)


@dataclass(frozen=True)
class DwellFactor:
    """One dwell, folded: factor (7, 7) upper triangular over [1 f_x f_y f_z | z1 z2 z3], count of readings."""

    number: int
    start_s: float
    end_s: float
    count: int
    factor: Floats
    pose: Floats  # (k,), mean
    temperature_c: float
    autocovariance: Autocovariance
    snapshots: tuple[tuple[float, int, Floats], ...] = ()  # (end_s, count, factor) at doublings of the count

    @property
    def means(self) -> Floats:
        """Means of the regressors and readings, (7,): 1, f (3), z (3)."""
        return self.factor[0] / self.factor[0, 0]

    def merged(self, other: DwellFactor) -> DwellFactor:
        """The same dwell from two stretches of samples, this one the earlier."""
        count = self.count + other.count
        shared = (self.count * self.pose + other.count * other.pose) / count
        return replace(
            self,
            end_s=max(self.end_s, other.end_s),
            count=count,
            factor=triangle(np.vstack([self.factor, other.factor])),
            pose=shared,
            temperature_c=(self.count * self.temperature_c + other.count * other.temperature_c) / count,
            autocovariance=self.autocovariance + other.autocovariance,
            snapshots=self.snapshots + other.snapshots,
        )


def fold(rows: Rows, correlated: bool = True) -> DwellFactor:
    """One block as a factor of its own; ``correlated``: its autocovariance too."""
    return DwellFactor(
        number=rows.dwell,
        start_s=float(rows.elapsed_s[0]),
        end_s=float(rows.elapsed_s[-1]),
        count=len(rows.readings),
        factor=_static_triangle(rows) if rows.static else _triangle(np.hstack([rows.columns, rows.readings])),
        pose=rows.pose,
        temperature_c=rows.temperature_c,
        autocovariance=Autocovariance.of(rows.innovation) if correlated else Autocovariance(),
    )


def _triangle(stacked: Floats) -> Floats:
    """The (7, 7) triangle of rows (n, 7), padded with zeros where there are fewer rows than columns."""
    width = stacked.shape[1]
    if len(stacked) < width:
        stacked = np.vstack([stacked, np.zeros((width - len(stacked), width))])
    return triangle(stacked)


def _static_triangle(rows: Rows) -> Floats:
    """The triangle of rows with constant columns: their mean times sqrt(n), and that of what is orthogonal to it."""
    out, count = np.zeros((WIDTH + 3, WIDTH + 3)), len(rows.readings)
    out[0] = np.sqrt(count) * np.concatenate([rows.columns[0], rows.readings.mean(axis=0)])
    rest = triangle(rows.innovation.T)
    out[WIDTH : WIDTH + len(rest), WIDTH:] = rest
    return out


class Folder:
    """Folds rows into the list of dwell factors, dwell after dwell."""

    def __init__(self) -> None:
        self.dwells: list[DwellFactor] = []

    def add(self, rows: Rows) -> None:
        current = self.dwells[-1] if self.dwells else None
        if current is None or current.number != rows.dwell:
            self.dwells.append(replace(fold(rows), snapshots=_early_snapshots(rows)))
            return
        block = fold(rows, correlated=current.autocovariance.count < _CORRELATED_SAMPLES)
        if block.count + current.count >= 2 * _last_count(current):
            block = replace(block, snapshots=((current.end_s, current.count, current.factor),))
        self.dwells[-1] = current.merged(block)


def _last_count(dwell: DwellFactor) -> int:
    return dwell.snapshots[-1][1] if dwell.snapshots else _FIRST_SNAPSHOT


def _early_snapshots(rows: Rows) -> tuple[tuple[float, int, Floats], ...]:
    """Factors of the first 64, 128, 256 ... readings of a dwell's first block, for curves within the dwell."""
    stacked = np.hstack([rows.columns, rows.readings])
    out, size, done, factor = list[tuple[float, int, Floats]](), _FIRST_SNAPSHOT, 0, np.empty((0, stacked.shape[1]))
    while size < len(stacked):
        factor = _triangle(np.vstack([factor, stacked[done:size]]))
        out.append((float(rows.elapsed_s[size - 1]), size, factor))
        done, size = size, 2 * size
    return tuple(out)


def informative(factors: Floats) -> Mask:
    """Which of the first 4 rows of factors (D, 7, 7) carry model columns, (D, 4) bool.

    A still platform has one: the mean. The others then hold columns of rounding size and are noise.
    """
    size = np.linalg.norm(factors[:, :WIDTH, :WIDTH], axis=2)
    return size > 1e-9 * size[:, :1]


def within_squares(dwell: DwellFactor) -> tuple[Floats, int]:
    """Residual sums of squares (3,) within a dwell, and how many model columns were fitted to get them."""
    fitted = np.append(informative(dwell.factor[None])[0], [False] * 3)
    return np.sum(dwell.factor[~fitted, WIDTH:] ** 2, axis=0), int(fitted.sum())
