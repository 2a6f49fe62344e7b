"""Values at the nodes of all pieces of all dwells, in one array that is also a sequence by dwell."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench.arrays import Floats
from kf_calib.dwells.rows import on_basis
from kf_calib.support.computed_sequence import ComputedSequence

PieceIndices = NDArray[np.intp]


class OfPieces(ComputedSequence[Floats]):
    """Values of the pieces of all dwells in one array (pieces, ...), as a sequence of those of each dwell."""

    def __init__(self, values: Floats, ends: PieceIndices) -> None:
        self.values, self._ends = values, ends

    def __len__(self) -> int:
        return len(self._ends) - 1

    def item(self, k: int) -> Floats:
        """The values of the pieces of one dwell."""
        return self.values[self._ends[k] : self._ends[k + 1]]

    def beside(self, *others: Sequence[Floats]) -> OfPieces:
        """The same columns (pieces, K, 3, c) with others behind them."""
        return OfPieces(np.concatenate([self.values, *map(of_all_pieces, others)], axis=3), self._ends)

    def first(self, count: int) -> OfPieces:
        """The first columns alone."""
        return OfPieces(self.values[..., :count], self._ends)


def of_all_pieces(columns: Sequence[Floats]) -> Floats:
    """The values of the pieces of all dwells in one array (pieces, ...)."""
    return columns.values if isinstance(columns, OfPieces) else np.concatenate(columns)


def basis_values(columns: Floats) -> Floats:
    """Coefficients (..., K, 3 c) on the basis functions of columns (..., K, 3, c) given at the nodes."""
    return on_basis(columns.reshape(*columns.shape[:-2], -1))
