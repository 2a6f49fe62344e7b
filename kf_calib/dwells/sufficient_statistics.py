"""Square-root sufficient statistics of dwells: small triangular matrices, which are all that is kept of the samples.

A dwell is cut into pieces, short ones after the arrival and longer ones later (1, 1, 2, 4 ... 60 s). Over a piece every
column of a model is smooth and is approximated by the parabola through its values at the beginning, middle and end of
the piece, its *nodes*. The readings are reduced by QR together with the basis of the parabola, [1 u u^2 | z1 z2 z3] ->
6 x 6, without whitening. From this triangle, the rows of any column that is known at the nodes follow without further
approximation, whatever the model. Noise model, filter and diagnosis therefore need no second pass over the data, and a
column that changes (with a time constant or a sensitivity) is evaluated again at a few hundred nodes only.

A column that oscillates within a piece is not a parabola. For such columns the dwells are folded on a *carrier* of a
frequency f0 near that of the oscillation: the basis is 1, u, u^2 and the products of these with cos 2 pi f0 t and sin 2
pi f0 t, the triangle is 12 x 12, and a column is known by nine values, three of its plain part and three of each
envelope. The number of basis functions is called K below; it is 3, or 9 on a carrier.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.dwells.coherent_tone import Trace, tone
from kf_calib.dwells.line_spectrum import SpectralLine, Spectrum, lines_of_several
from kf_calib.dwells.pieces import Pieces

LAGS = 64
"""Lags of the autocovariance; fewer readings tell no correlation of their own."""
CROSS_LAGS = 8
"""Lags of the products of one channel with another, of a dwell's first block."""


@dataclass(frozen=True)
class Autocovariance:
    """Sums of lagged products (L + 1, 3) within blocks of readings less their parabola, and the numbers of pairs (L +
    1,).

    The parabola is removed because a drift would otherwise count as noise, and the test for the drift would lose its
    power.

    across (CROSS_LAGS + 1, 3, 3): the sums of x_t x_(t-k)^T over all channels, of the ``crossed`` readings of which
    they were formed.
    """

    products: Floats = field(default_factory=lambda: np.zeros((LAGS + 1, 3)))
    pairs: Floats = field(default_factory=lambda: np.zeros(LAGS + 1))
    count: int = 0
    blocks: int = 0
    across: Floats = field(default_factory=lambda: np.zeros((CROSS_LAGS + 1, 3, 3)))
    crossed: int = 0

    def __add__(self, other: Autocovariance) -> Autocovariance:
        return Autocovariance(
            self.products + other.products,
            self.pairs + other.pairs,
            self.count + other.count,
            self.blocks + other.blocks,
            self.across + other.across,
            self.crossed + other.crossed,
        )

    def times(self, weights: Floats) -> Autocovariance:
        """The sums with the products of each channel times its weight (3,)."""
        if (weights == 1.0).all():
            return self
        across = np.sqrt(np.outer(weights, weights)) * self.across
        return replace(self, products=weights * self.products, across=across)

    @classmethod
    def of(cls, residuals: Floats, first: bool = True) -> Autocovariance:
        """The sums for one block of readings (3, n) from which the parabola has been removed; those over all channels
        if it is the first of its dwell."""
        count = residuals.shape[1]
        padded = 1 << (count + LAGS).bit_length()
        spectrum = np.fft.rfft(residuals, padded, axis=1)
        products = np.zeros((LAGS + 1, 3))
        lags = min(LAGS, count - 1) + 1
        products[:lags] = np.fft.irfft(np.abs(spectrum) ** 2, padded, axis=1)[:, :lags].T
        pairs = np.maximum(count - np.arange(LAGS + 1), 0).astype(float)
        if not first or count <= CROSS_LAGS:
            return cls(products, pairs, count, 1)
        across = [residuals[:, lag:] @ residuals[:, : count - lag].T for lag in range(CROSS_LAGS + 1)]
        return cls(products, pairs, count, 1, np.array(across), count)


@dataclass(frozen=True, repr=False, eq=False)
class Dwell:
    """The sufficient statistics of one dwell.

    - number: its number, counted from 1.
    - pieces: its pieces in order of time.
    - autocovariance, spectrum: of its first readings.
    - trace: sums of its readings in cells of the run's clock.
    - moving: True for the slew after the dwell of that number, which is folded like a dwell.
    - pose_sigma_rad: uncertainty of its pose due to noise of the angles.
    - turns: whole turns of each gimbal by which its pose goes beyond the angles as recorded.
    - weights (3,): of the readings of each channel, the variance of one of the run over that of one of this dwell.
    - correlation (3, 3): of the means of the readings of two channels, by noise that they share.
    """

    number: int
    pieces: Pieces
    autocovariance: Autocovariance = field(default_factory=Autocovariance)
    spectrum: Spectrum = field(default_factory=Spectrum)
    trace: Trace = field(default_factory=Trace)
    moving: bool = False
    pose_sigma_rad: float = 0.0
    turns: tuple[int, ...] = ()
    weights: tuple[float, ...] = (1.0, 1.0, 1.0)
    correlation: Floats = field(default_factory=lambda: np.eye(3))

    @property
    def carrier_hz(self) -> float:
        """Frequency of the carrier on which the dwell was folded; 0 for none."""
        return self.pieces.carrier_hz

    @property
    def start_s(self) -> float:
        """Time of the first reading since the first sample, s."""
        return float(self.pieces.nodes.elapsed_s[0])

    @property
    def end_s(self) -> float:
        """Time of the last reading since the first sample, s."""
        return float(self.pieces.nodes.elapsed_s[-1])

    @property
    def count(self) -> int:
        """Number of readings, or of averages of them, that were folded."""
        return int(self.pieces.counts.sum())

    @property
    def pose(self) -> Floats:
        """Mean pose (k,)."""
        poses = self.pieces.nodes.pose
        return self.pieces.counts / self.count @ poses.reshape(-1, 3, poses.shape[1]).mean(axis=1)

    @property
    def recorded_pose(self) -> Floats:
        """Mean pose (k,) with the angles as they were recorded, without the whole turns added to make them
        continuous."""
        return self.pose - 2.0 * np.pi * np.array(self.turns) if self.turns else self.pose

    @property
    def means(self) -> Floats:
        """Means (7,) of the regressors 1, f_x, f_y, f_z and of the three readings."""
        return self.pieces.counts @ self.pieces.means / self.count

    def merge(self, blocks: Sequence[Dwell]) -> Dwell:
        """This dwell merged with further blocks of its samples."""
        pieces = Pieces.joined([self.pieces, *(block.pieces for block in blocks)])
        order = np.argsort(pieces.nodes.elapsed_s[::3], kind="stable")
        return replace(
            self,
            pieces=pieces[order],
            autocovariance=sum((block.autocovariance for block in blocks), self.autocovariance),
            spectrum=sum((block.spectrum for block in blocks), self.spectrum),
            trace=Trace.joined([self.trace, *(block.trace for block in blocks)]),
        )

    def repeat(self, times: float) -> Dwell:
        """This dwell as if each of its readings had been taken ``times`` times."""
        counts = np.round(self.pieces.counts * times).astype(int)
        return replace(self, pieces=replace(self.pieces, triangles=self.pieces.triangles * times**0.5, counts=counts))


def lines_of(dwells: Sequence[Dwell], level: float = 0.01) -> tuple[SpectralLine, ...]:
    """Oscillations in the readings of dwells at the significance ``level``.

    These are the lines of the averaged spectrum or, if there are none, a single oscillation that is too weak to appear
    there but keeps its phase from dwell to dwell. The p-values account for both tests. In the averaged spectrum dwells
    count by their weights: the power of one that is louder than the others would have few degrees of freedom.
    """
    spectral_lines = lines_of_several([dwell.spectrum.times(dwell.weights) for dwell in dwells], 0.5 * level)
    steady = None if spectral_lines else tone([dwell.trace for dwell in dwells], 0.5 * level)
    oscillations = spectral_lines or ((steady,) if steady else ())
    return tuple(replace(line, p_value=min(1.0, 2.0 * line.p_value)) for line in oscillations)
