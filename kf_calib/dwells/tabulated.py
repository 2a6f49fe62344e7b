"""Dwells of which only mean, standard deviation and number of readings are known.

Such a dwell is one piece whose conditions are the same throughout. Its triangle has a row for the mean and, below it,
the scatter about the mean; the rows of u and u^2 are zero, since nothing is known of the course within the dwell.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Protocol

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench
from kf_calib.dwells.coherent_tone import Trace
from kf_calib.dwells.line_spectrum import Spectrum
from kf_calib.dwells.rows import REGRESSORS, Nodes, Rows
from kf_calib.dwells.sufficient_statistics import Autocovariance, DwellFactor, Piece

LEAST_COUNT = 8
"""A standard deviation of fewer readings counts as if there were more readings of more noise: the same sigma of the
mean."""
_CURVE = 3  # basis functions of a piece


class TabulatedDwell(Protocol):
    """A row of a table; ``kf_calib.sources.tables.orientation.Orientation`` is one."""

    @property
    def mean_mps2(self) -> Floats: ...

    @property
    def pose(self) -> Floats: ...

    @property
    def elapsed_s(self) -> float: ...

    @property
    def sigma_mps2(self) -> Floats | None: ...

    @property
    def count(self) -> int: ...

    @property
    def temperature_c(self) -> float: ...


def dwells_of(table: Sequence[TabulatedDwell], bench: Bench) -> list[DwellFactor]:
    """The sufficient statistics of each row of a table."""
    times = _times(table)
    unknown = Autocovariance(), Spectrum(), Trace()  # the same objects for all dwells, since a set takes 2 kB
    return [
        DwellFactor(k + 1, (Piece(triangle, nodes, row.count * times, 0.0, row.count),), *unknown)
        for k, (row, triangle, nodes) in enumerate(
            zip(table, _triangles(table, times), _nodes(table, bench), strict=True)
        )
    ]


def rows_of(table: Sequence[TabulatedDwell], bench: Bench) -> Iterator[Rows]:
    """Rows of each dwell with every reading at the mean, from which any engine makes the same estimate as from the
    readings themselves."""
    times = _times(table)
    for k, (orientation, nodes) in enumerate(zip(table, _nodes(table, bench), strict=True)):
        count = orientation.count * times
        readings = np.tile(orientation.mean_mps2, (count, 1))
        columns = np.tile(nodes.regressors[:1], (count, 1))
        assert columns.shape[1] == len(REGRESSORS)
        piece = slice(0, count), np.zeros(count), nodes
        elapsed_s = np.full(count, orientation.elapsed_s)
        yield Rows(k + 1, elapsed_s, columns, readings, np.zeros((3, count)), True, (piece,))


def _times(table: Sequence[TabulatedDwell]) -> int:
    """Return by how much the counts have to be multiplied."""
    fewest = min(
        (orientation.count for orientation in table if orientation.sigma_mps2 is not None), default=LEAST_COUNT
    )
    return math.ceil(LEAST_COUNT / fewest)


def _nodes(table: Sequence[TabulatedDwell], bench: Bench) -> Iterator[Nodes]:
    """Yield the nodes of each dwell; their times are apart by a tenth of the shortest pause, the rest does not
    change."""
    middles, poses = np.array([row.elapsed_s for row in table]), np.array([row.pose for row in table])
    half_s = 0.1 * float(np.diff(middles).min(initial=60.0))
    forces = np.repeat(bench.specific_force(middles, poses)[:, None], 3, axis=1)
    at_s, poses = middles[:, None] + half_s * np.array([-1.0, 0.0, 1.0]), np.repeat(poses[:, None], 3, axis=1)
    warmth, since_s = np.repeat([[row.temperature_c] for row in table], 3, axis=1), np.full(3, half_s)
    for at, force, pose, temperature_c in zip(at_s, forces, poses, warmth, strict=True):
        yield Nodes(at, since_s, force, pose, temperature_c)


def _triangles(table: Sequence[TabulatedDwell], times: int) -> Floats:
    """Return the triangles (D, 6, 6) of the one piece of each dwell."""
    counts, triangles = (
        np.array([row.count * times for row in table], float),
        np.zeros((len(table), _CURVE + 3, _CURVE + 3)),
    )
    triangles[:, 0, 0] = np.sqrt(counts)
    triangles[:, 0, _CURVE:] = np.sqrt(counts)[:, None] * np.array([row.mean_mps2 for row in table])
    scattering = [k for k, row in enumerate(table) if row.sigma_mps2 is not None]
    if scattering:  # about a parabola, because the noise model assumes so
        sigmas = np.array([table[k].sigma_mps2 for k in scattering], float)
        freedom = times * (counts[scattering, None] - _CURVE)
        triangles[np.array(scattering)[:, None], _CURVE + np.arange(3), _CURVE + np.arange(3)] = sigmas * np.sqrt(
            freedom
        )
    return triangles
