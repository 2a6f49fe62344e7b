"""Folding: rows of readings become the sufficient statistics of dwells and of slews, block by block."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.dwells.coherent_tone import MOST_CELLS, Cells, Trace
from kf_calib.dwells.line_spectrum import Spectrum
from kf_calib.dwells.pieces import FEWEST_PIECES, MOST_PIECES, MOST_RUN_PIECES, Piece, coarsened
from kf_calib.dwells.qr import square_triangle
from kf_calib.dwells.rows import Rows, basis
from kf_calib.dwells.sufficient_statistics import Autocovariance, DwellFactor
from kf_calib.dwells.window_average import orthonormal_parabola

_CORRELATED_SAMPLES = 8192  # first readings of a dwell over which its autocovariance is accumulated, at least


def fold(rows: Rows, carrier_hz: float = 0.0) -> tuple[Piece, ...]:
    """Fold one block of rows into pieces."""
    width = 9 if carrier_hz else 3
    channels = rows.innovation if rows.static else rows.readings.T
    level = rows.readings[0] - channels[:, 0]  # what was subtracted from the readings to give the innovation
    pieces = list[Piece]()
    for part, u, nodes in rows.pieces:
        stacked = np.empty((width + 3, len(u)))  # contiguous rows are what LAPACK needs and are faster to fill
        stacked[:width], stacked[width:] = basis(u, rows.elapsed_s[part], carrier_hz), channels[:, part]
        folded = square_triangle(stacked.T)
        folded[0, width:] += folded[0, 0] * level
        pieces.append(Piece(folded, nodes, len(u), carrier_hz, len(u) * rows.readings_per_row))
    return tuple(pieces)


def detrended(innovation: Floats, elapsed_s: Floats | None = None, carrier_hz: float = 0.0) -> Floats:
    """Innovations (3, n) with their parabola removed and, on a carrier, also its oscillating basis functions."""
    count = innovation.shape[1]
    curve = orthonormal_parabola(count)
    if carrier_hz:
        curve = np.linalg.qr(basis(np.linspace(-1.0, 1.0, count), elapsed_s, carrier_hz).T)[0]
    return innovation - (innovation @ curve) @ curve.T


class _DwellSequence:
    """A sequence of dwells, or of slews, to which blocks are added in order of time.

    The blocks of the last dwell are merged only when the sequence is read; merging each as it arrives would copy the
    whole dwell every time. In a run of very many pieces those of its closed dwells are merged, too.
    """

    def __init__(self, folded: Iterable[DwellFactor] = ()) -> None:
        self._folded, self._blocks = list(folded), list[DwellFactor]()
        self._closed_pieces, self._most_closed = 0, MOST_RUN_PIECES

    def add(self, block: DwellFactor) -> None:
        """Add a block of the last dwell or of a new one."""
        if self._last(block.number) is None:
            if self._folded and not block.moving:
                self._bound_closed()
            self.folded.append(block)
            return
        if self._count + len(block.pieces) > MOST_PIECES and not block.moving:
            last = self.folded[-1]
            self._folded[-1] = replace(last, pieces=coarsened(last.pieces))
        if block.autocovariance.count:  # merged now, since ``autocovariance_count`` reads the count from the dwell
            self._folded[-1] = self._folded[-1].merge([block])
        else:
            self._blocks.append(block)

    def autocovariance_count(self, number: int) -> int:
        """Number of readings in the autocovariance of the dwell of this number, which is either the last or a new
        one."""
        last = self._last(number)
        return last.autocovariance.count if last else 0

    @property
    def folded(self) -> list[DwellFactor]:
        """All dwells, each with all its blocks."""
        if self._blocks:
            self._folded[-1] = self._folded[-1].merge(self._blocks)
            self._blocks = []
        return self._folded

    def _bound_closed(self) -> None:
        """Count the pieces of the dwell that closes; where the run has too many, halve those of its long dwells."""
        self._closed_pieces += self._count
        if self._closed_pieces <= self._most_closed:
            return
        self._folded = [_with_half_the_pieces(dwell) for dwell in self.folded]
        self._closed_pieces = sum(len(dwell.pieces) for dwell in self._folded)
        self._most_closed = max(MOST_RUN_PIECES, 5 * self._closed_pieces // 4)

    @property
    def _count(self) -> int:
        """Number of pieces of the last dwell."""
        return len(self._folded[-1].pieces) + sum(len(block.pieces) for block in self._blocks)

    def _last(self, number: int) -> DwellFactor | None:
        """Return the last dwell if it has this number, else None."""
        return self._folded[-1] if self._folded and self._folded[-1].number == number else None


def _with_half_the_pieces(dwell: DwellFactor) -> DwellFactor:
    """The dwell with its pieces merged two by two, if it has many: only three fit into a third of its length."""
    count = len(dwell.pieces)
    return dwell if count <= FEWEST_PIECES else replace(dwell, pieces=coarsened(dwell.pieces, count // 3))


class Folder:
    """Folds rows into sequences of dwells and of slews, on a carrier if its frequency is not 0."""

    def __init__(self, carrier_hz: float = 0.0) -> None:
        self._dwells, self._slews = _DwellSequence(), _DwellSequence()
        self.carrier_hz = carrier_hz
        self._cells: Cells | None = None
        self._traced = 0

    @property
    def dwells(self) -> list[DwellFactor]:
        """The dwells folded so far."""
        return self._dwells.folded

    @dwells.setter
    def dwells(self, dwells: Iterable[DwellFactor]) -> None:
        self._dwells = _DwellSequence(dwells)

    @property
    def slews(self) -> list[DwellFactor]:
        """The slews folded so far."""
        return self._slews.folded

    @slews.setter
    def slews(self, slews: Iterable[DwellFactor]) -> None:
        self._slews = _DwellSequence(slews)

    def add(self, rows: Rows) -> None:
        """Fold one block of rows into its dwell or slew."""
        growing = self._slews if rows.moving else self._dwells
        block = DwellFactor(
            rows.dwell, fold(rows, self.carrier_hz), moving=rows.moving, pose_sigma_rad=rows.pose_sigma_rad,
            turns=rows.turns,
        )  # fmt: skip
        innovation, readings = rows.without_rotations
        if not rows.moving and growing.autocovariance_count(rows.dwell) < _CORRELATED_SAMPLES:
            residuals = detrended(innovation, rows.elapsed_s, self.carrier_hz)
            autocovariance, spectrum = Autocovariance.of(residuals), Spectrum.of(residuals, rows.elapsed_s)
            block = replace(block, autocovariance=autocovariance, spectrum=spectrum)
        self._cells = self._cells or Cells.of(rows.elapsed_s)
        if self._cells and not rows.moving and not block.averaged and self._traced < MOST_CELLS:
            block = replace(block, trace=Trace.of(readings, rows.elapsed_s, self._cells))
            self._traced += len(block.trace)
        growing.add(block)
