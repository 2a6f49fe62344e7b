"""Dwells of which only mean, standard deviation and number of readings are known.

Such a dwell is one piece whose conditions are the same throughout. Its triangle has a row for the mean and, below it,
the scatter about the mean; the rows of u and u^2 are zero, since nothing is known of the course within the dwell.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cached_property
from typing import Protocol

import numpy as np

from kf_calib.bench.arrays import Floats, Ints, Mask
from kf_calib.bench.bench import Bench
from kf_calib.dwells.coherent_tone import Trace
from kf_calib.dwells.line_spectrum import Spectrum
from kf_calib.dwells.rows import REGRESSORS, Nodes, Rows
from kf_calib.dwells.stack import DwellStack, Folded
from kf_calib.dwells.sufficient_statistics import Autocovariance, DwellFactor, Piece
from kf_calib.support.computed_sequence import ComputedSequence

LEAST_COUNT = 8
"""A standard deviation of fewer readings counts as if there were more readings of more noise: the same sigma of the
mean."""
_CURVE = 3  # basis functions of a piece
_UNKNOWN = Autocovariance(), Spectrum(), Trace()  # the same objects for all dwells, since a set takes 2 kB


class TabulatedMeans(Protocol):
    """The rows of a table, as columns; ``kf_calib.sources.tables.orientation.Orientations`` is one."""

    @property
    def mean_mps2(self) -> Floats: ...

    @property
    def pose(self) -> Floats: ...

    @property
    def elapsed_s(self) -> Floats: ...

    @property
    def sigma_mps2(self) -> Floats | None: ...

    @property
    def counts(self) -> Ints: ...

    @property
    def temperature_c(self) -> Floats: ...


def dwells_of(table: TabulatedMeans, bench: Bench) -> DwellStack:
    """The sufficient statistics of each row of a table."""
    return DwellStack(FoldedTable(table, bench))


def rows_of(table: TabulatedMeans, bench: Bench) -> Iterator[Rows]:
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

    def __init__(self, table: TabulatedMeans, bench: Bench) -> None:
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
        return np.ones(len(self.dwells))

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


def _times(table: TabulatedMeans) -> int:
    """Return by how much the counts have to be multiplied."""
    counts = table.counts[_scattering(table)]
    return math.ceil(LEAST_COUNT / int(counts.min(initial=LEAST_COUNT))) if counts.size else 1


def _scattering(table: TabulatedMeans) -> Mask:
    """Return which rows (D,) have a standard deviation."""
    if table.sigma_mps2 is None:
        return np.zeros(len(table.counts), bool)
    return np.asarray(np.isfinite(table.sigma_mps2).all(axis=1))


def _nodes(table: TabulatedMeans, bench: Bench) -> Nodes:
    """Return the nodes of all dwells (3 D); their times are apart by a tenth of the shortest pause, the rest does not
    change."""
    half_s = 0.1 * float(np.diff(table.elapsed_s).min(initial=60.0))
    at_s = table.elapsed_s[:, None] + half_s * np.array([-1.0, 0.0, 1.0])
    forces = bench.specific_force(table.elapsed_s, table.pose)
    return Nodes(
        at_s.ravel(), np.full(at_s.size, half_s), np.repeat(forces, 3, axis=0), np.repeat(table.pose, 3, axis=0),
        np.repeat(table.temperature_c, 3),
    )  # fmt: skip


def _triangles(table: TabulatedMeans, times: int) -> Floats:
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
