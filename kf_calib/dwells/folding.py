"""Folding: rows of readings become the sufficient statistics of dwells and of slews, block by block.

Of dwells in a table only mean, standard deviation and number of readings are known. Such a dwell is one piece whose
conditions are the same throughout. Its triangle has a row for the mean and, below it, the scatter about the mean; the
rows of u and u^2 are zero, since nothing is known of the course within the dwell.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import cached_property

import numpy as np

from kf_calib.bench.arrays import ComputedSequence, Floats, Ints, Mask
from kf_calib.bench.bench import Bench
from kf_calib.bench.streams import Orientations
from kf_calib.dwells.coherent_tone import MOST_CELLS, Cells, Trace
from kf_calib.dwells.line_spectrum import Spectrum
from kf_calib.dwells.pieces import FEWEST_PIECES, MOST_PIECES, MOST_RUN_PIECES, Piece, coarsened
from kf_calib.dwells.qr import square_triangle
from kf_calib.dwells.rows import REGRESSORS, Nodes, Rows, basis
from kf_calib.dwells.stack import DwellStack, Folded
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


LEAST_COUNT = 8
"""A standard deviation of fewer readings counts as if there were more readings of more noise: the same sigma of the
mean."""
_CURVE = 3  # basis functions of a piece
_UNKNOWN = Autocovariance(), Spectrum(), Trace()  # the same objects for all dwells, since a set takes 2 kB


def dwells_of_table(table: Orientations, bench: Bench) -> DwellStack:
    """The sufficient statistics of each row of a table."""
    return DwellStack(FoldedTable(table, bench))


def rows_of_table(table: Orientations, bench: Bench) -> Iterator[Rows]:
    """Rows of each dwell with every reading at the mean, from which any engine makes the same estimate as from the
    readings themselves."""
    for dwell, mean_mps2, elapsed_s in zip(
        FoldedTable(table, bench).dwells, table.mean_mps2, table.elapsed_s.tolist(), strict=True
    ):
        count, nodes = dwell.count, dwell.pieces[0].nodes
        readings = np.tile(mean_mps2, (count, 1))
        columns = np.tile(nodes.regressors[:1], (count, 1))
        assert columns.shape[1] == len(REGRESSORS)
        piece = slice(0, count), np.zeros(count), nodes
        yield Rows(
            dwell.number, np.full(count, elapsed_s), columns, readings, np.zeros((3, count)), True, (piece,)
        )  # fmt: skip


class FoldedTable(Folded):
    """The dwells of a table, of which all is in arrays from the beginning: a dwell is an object of 1.5 kB, and is made
    only where it is asked for."""

    def __init__(self, table: Orientations, bench: Bench) -> None:
        self._table, count, times = table, len(table.elapsed_s), _times(table)
        self.dwells = _RowsAsDwells(self)
        self.piece_numbers, self.ends = np.ones(count, np.intp), np.arange(count + 1)
        self.piece_counts, self.reading_counts = (times * table.counts).astype(float), table.counts.astype(float)
        self.triangles = [_triangles(table, times)[:, None]]
        self._nodes = _nodes(table, bench)

    @cached_property
    def widths(self) -> Ints:
        return np.full(len(self.dwells), _CURVE)

    @cached_property
    def weights(self) -> Floats:
        return np.ones((len(self.dwells), 3))

    @cached_property
    def moving(self) -> Mask:
        return np.zeros(len(self.dwells), bool)

    @cached_property
    def pose_sigmas_rad(self) -> Floats:
        return np.zeros(len(self.dwells))

    @cached_property
    def autocovariance(self) -> Autocovariance:
        return _UNKNOWN[0]

    @cached_property
    def spreads(self) -> Floats:
        (triangles,) = self.triangles
        scatter = np.square(np.einsum("dii->di", triangles[:, 0, _CURVE:, _CURVE:]))
        return (scatter / self.counts[:, None])[:, :, None] * np.eye(3)

    @cached_property
    def came_from(self) -> dict[int, DwellFactor]:
        return {}

    def of_nodes(self, name: str) -> Floats:
        return getattr(self._nodes, name)

    def rates(self, name: str) -> Floats:
        return np.broadcast_to(0.0, self._nodes.force_mps2.shape)

    def dwell(self, k: int) -> DwellFactor:
        """The dwell at an index."""
        part, nodes = slice(3 * k, 3 * k + 3), self._nodes
        here = Nodes(
            nodes.elapsed_s[part], nodes.since_arrival_s[part], nodes.force_mps2[part], nodes.pose[part],
            nodes.temperature_c[part],
        )  # fmt: skip
        piece = Piece(
            self.triangles[0][k, 0], here, int(self.piece_counts[k]), 0.0, int(self.reading_counts[k])
        )  # fmt: skip
        return DwellFactor(k + 1, (piece,), *_UNKNOWN)


class _RowsAsDwells(ComputedSequence[DwellFactor]):
    """The rows of a folded table, each made into a dwell when it is asked for."""

    def __init__(self, folded: FoldedTable) -> None:
        self._folded = folded

    def __len__(self) -> int:
        return len(self._folded.piece_numbers)

    def item(self, k: int) -> DwellFactor:
        return self._folded.dwell(k)


def _times(table: Orientations) -> int:
    """Return by how much the counts have to be multiplied."""
    counts = table.counts[_scattering(table)]
    return math.ceil(LEAST_COUNT / int(counts.min(initial=LEAST_COUNT))) if counts.size else 1


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
    triangles = np.zeros((len(counts), _CURVE + 3, _CURVE + 3))
    triangles[:, 0, 0] = np.sqrt(counts)
    triangles[:, 0, _CURVE:] = np.sqrt(counts)[:, None] * table.mean_mps2
    if table.sigma_mps2 is not None:  # about a parabola, because the noise model assumes so
        freedom = times * (counts[scattering, None] - _CURVE)
        triangles[scattering[:, None], _CURVE + np.arange(3), _CURVE + np.arange(3)] = table.sigma_mps2[
            scattering
        ] * np.sqrt(freedom)
    return triangles
