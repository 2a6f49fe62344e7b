"""What a model leaves of columns: their projection onto the orthogonal complement of the model's own."""

from __future__ import annotations

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.estimation import square_root_information


class Complement:
    """The orthogonal complement of a model's columns H, the first ``width`` of whitened rows [H | ...] (m, c)."""

    def __init__(self, rows: Floats, width: int) -> None:
        scaled = square_root_information.scale_columns(rows[:, : width + 1])[0]
        left, singular, _ = np.linalg.svd(scaled, full_matrices=False)
        self._explained = left[:, singular > 1e-9]

    def of(self, columns: Floats) -> Floats:
        """Columns (m, ...) projected off H."""
        for _ in range(2):  # projecting twice removes the rounding errors that large components leave in the remainder
            columns = columns - self._explained @ (self._explained.T @ columns)
        return columns
