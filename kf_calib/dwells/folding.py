"""Folding: rows of readings become the sufficient statistics of dwells and of slews, block by block.

Of dwells in a table only mean, standard deviation and number of readings are known. Such a dwell is one piece whose
conditions are the same throughout. Its triangle has a row for the mean and, below it, the scatter about the mean; the
rows of u and u^2 are zero, since nothing is known of the course within the dwell.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from kf_calib.bench.arrays import Floats, Mask
from kf_calib.bench.bench import Bench
from kf_calib.bench.streams import Orientations
from kf_calib.dwells.blocks import BLOCK_SAMPLES
from kf_calib.dwells.coherent_tone import MOST_CELLS, Cells, Trace
from kf_calib.dwells.limits import CURVE, FEWEST_READINGS
from kf_calib.dwells.line_spectrum import Spectrum
from kf_calib.dwells.pieces import FEWEST_PIECES, MOST_PIECES, MOST_RUN_PIECES, MOST_SLEW_PIECES, Pieces, coarsened
from kf_calib.dwells.qr import square_triangle
from kf_calib.dwells.rows import Nodes, Rows, basis
from kf_calib.dwells.sufficient_statistics import Autocovariance, Dwell
from kf_calib.dwells.table import DwellTable, FoldedDwells
from kf_calib.dwells.window_average import orthonormal_parabola


def fold(rows: Rows, carrier_hz: float = 0.0) -> Pieces:
    """Fold one block of rows into pieces."""
    width, counts = 9 if carrier_hz else 3, np.diff(rows.cuts)
    channels = rows.innovation if rows.static else rows.readings.T
    level = rows.readings[0] - channels[:, 0]  # what was subtracted from the readings to give the innovation
    stacked = np.concatenate([basis(rows.u, rows.elapsed_s, carrier_hz), channels])
    triangles = np.empty((len(counts), width + 3, width + 3))
    for count in np.unique(counts).tolist():  # pieces of as many readings are decomposed together
        alike = np.flatnonzero(counts == count)
        places = rows.cuts[alike, None] + np.arange(count)
        triangles[alike] = square_triangle(np.moveaxis(stacked[:, places], 0, 2))
    triangles[:, 0, width:] += triangles[:, :1, 0] * level
    return Pieces(triangles, rows.nodes, counts, counts * rows.readings_per_row, carrier_hz)


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

    def __init__(self, folded: Iterable[Dwell] = ()) -> None:
        self._folded, self._blocks = list(folded), list[Dwell]()
        self._closed_pieces, self._most_closed = 0, MOST_RUN_PIECES

    def add(self, block: Dwell) -> None:
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
    def folded(self) -> list[Dwell]:
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

    def _last(self, number: int) -> Dwell | None:
        """Return the last dwell if it has this number, else None."""
        return self._folded[-1] if self._folded and self._folded[-1].number == number else None


def _with_half_the_pieces(dwell: Dwell) -> Dwell:
    """The dwell with its pieces merged two by two, if it has many: only three fit into a third of its length."""
    count = len(dwell.pieces)
    return dwell if count <= FEWEST_PIECES else replace(dwell, pieces=coarsened(dwell.pieces, count // 3))


class Folder:
    """Folds rows into sequences of dwells and of slews, on a carrier if its frequency is not 0.

    In a run of very many slews every second one is kept, or every fourth, and so on, so that memory is bounded.
    """

    def __init__(self, carrier_hz: float = 0.0) -> None:
        self._dwells, self._slews = _DwellSequence(), _DwellSequence()
        self.carrier_hz = carrier_hz
        self._cells: Cells | None = None
        self._traced = self._slew_pieces = 0
        self._every = 1  # of so many slews one is kept

    @property
    def dwells(self) -> list[Dwell]:
        """The dwells folded so far."""
        return self._dwells.folded

    @dwells.setter
    def dwells(self, dwells: Iterable[Dwell]) -> None:
        self._dwells = _DwellSequence(dwells)

    @property
    def slews(self) -> list[Dwell]:
        """The slews folded so far."""
        return self._slews.folded

    @slews.setter
    def slews(self, slews: Iterable[Dwell]) -> None:
        self._slews = _DwellSequence(slews)
        self._slew_pieces = sum(len(slew.pieces) for slew in self.slews)

    def add(self, rows: Rows) -> None:
        """Fold one block of rows into its dwell or slew."""
        if rows.moving and (rows.dwell - 1) % self._every:
            return
        growing = self._slews if rows.moving else self._dwells
        block = Dwell(
            rows.dwell, fold(rows, self.carrier_hz), moving=rows.moving, pose_sigma_rad=rows.pose_sigma_rad,
            turns=rows.turns,
        )  # fmt: skip
        innovation, readings = rows.without_rotations
        known = 0 if rows.moving else growing.autocovariance_count(rows.dwell)
        if not rows.moving and known <= 2 * BLOCK_SAMPLES:  # of the first blocks
            residuals = detrended(innovation, rows.elapsed_s, self.carrier_hz)
            autocovariance, spectrum = (
                Autocovariance.of(residuals, first=not known),
                Spectrum.of(residuals, rows.elapsed_s),
            )
            block = replace(block, autocovariance=autocovariance, spectrum=spectrum)
        self._cells = self._cells or Cells.of(rows.elapsed_s)
        if self._cells and not rows.moving and not block.pieces.averaged and self._traced < MOST_CELLS:
            block = replace(block, trace=Trace.of(readings, rows.elapsed_s, self._cells))
            self._traced += len(block.trace)
        growing.add(block)
        if rows.moving:
            self._slew_pieces += len(block.pieces)
            while self._slew_pieces > MOST_SLEW_PIECES and len(self.slews) > 1:
                self._every *= 2
                self.slews = [slew for slew in self.slews if (slew.number - 1) % self._every == 0]


def dwells_of_table(table: Orientations, bench: Bench) -> DwellTable:
    """The sufficient statistics of each row of a table."""
    count, times = len(table.elapsed_s), _times(table)
    pieces = Pieces(_triangles(table, times), _nodes(table, bench), times * table.counts, table.counts)
    folded = FoldedDwells(
        pieces, np.arange(count + 1), np.arange(1, count + 1), np.zeros(count, bool), np.zeros(count),
        np.ones((count, 3)), np.tile(np.eye(3), (count, 1, 1)), [()] * count, [Autocovariance()] * count,
        [Spectrum()] * count, [Trace()] * count,
    )  # fmt: skip
    return DwellTable(folded)


def rows_of_table(table: Orientations, bench: Bench) -> Iterator[Rows]:
    """Rows of each dwell with every reading at the mean, from which any engine makes the same estimate as from the
    readings themselves."""
    nodes, counts = _nodes(table, bench), (_times(table) * table.counts).tolist()
    for k, (mean_mps2, elapsed_s, count) in enumerate(
        zip(table.mean_mps2, table.elapsed_s.tolist(), counts, strict=True)
    ):
        readings, here = np.tile(mean_mps2, (count, 1)), nodes[3 * k : 3 * k + 3]
        yield Rows(
            k + 1, np.full(count, elapsed_s), np.tile(here.regressors[:1], (count, 1)), readings, np.zeros((3, count)),
            True, np.zeros(count), here, np.array([0, count]),
        )  # fmt: skip


def _times(table: Orientations) -> int:
    """Return by how much the counts have to be multiplied: a standard deviation of few readings counts as if there were
    more readings of more noise, the same sigma of the mean."""
    counts = table.counts[_scattering(table)]
    return math.ceil(FEWEST_READINGS / int(counts.min(initial=FEWEST_READINGS))) if counts.size else 1


def _scattering(table: Orientations) -> Mask:
    """Return which rows (D,) have a standard deviation."""
    if table.sigma_mps2 is None:
        return np.zeros(len(table.counts), bool)
    return np.asarray(np.isfinite(table.sigma_mps2).all(axis=1))


def _nodes(table: Orientations, bench: Bench) -> Nodes:
    """Return the nodes of all dwells (3 D); their times are apart by a tenth of the shortest pause, the rest does not
    change."""
    half_s = 0.1 * float(np.diff(table.elapsed_s).min(initial=60.0))
    at_s = table.elapsed_s[:, None] + half_s * np.array([-1.0, 0.0, 1.0])
    forces = bench.specific_force(table.elapsed_s, table.pose)
    return Nodes(
        at_s.ravel(), np.full(at_s.size, half_s), np.repeat(forces, 3, axis=0), np.repeat(table.pose, 3, axis=0),
        np.repeat(table.temperature_c, 3),
    )  # fmt: skip


def _triangles(table: Orientations, times: int) -> Floats:
    """Return the triangles (D, 6, 6) of the one piece of each dwell."""
    counts, scattering = (table.counts * times).astype(float), np.flatnonzero(_scattering(table))
    triangles = np.zeros((len(counts), CURVE + 3, CURVE + 3))
    triangles[:, 0, 0] = np.sqrt(counts)
    triangles[:, 0, CURVE:] = np.sqrt(counts)[:, None] * table.mean_mps2
    if table.sigma_mps2 is not None:  # about a parabola, because the noise model assumes so
        freedom = times * (counts[scattering, None] - CURVE)
        triangles[scattering[:, None], CURVE + np.arange(3), CURVE + np.arange(3)] = table.sigma_mps2[
            scattering
        ] * np.sqrt(freedom)
    return triangles
