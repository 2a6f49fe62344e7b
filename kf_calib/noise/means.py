"""The means of the readings and of a model's columns over each dwell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.dwells.pieces import of_all_pieces
from kf_calib.dwells.rows import on_nodes
from kf_calib.dwells.sufficient_statistics import Dwell
from kf_calib.dwells.table import DwellTable


@dataclass(frozen=True, repr=False)
class Means:
    """Means over each of D dwells.

    - design (D, 3, p): the model's columns.
    - readings (D, 3), force_mps2 (D, 3): readings and specific force.
    - counts (D, 3): number of readings of each channel, each as many as its weight says.
    - ends_s (D, 2): when each dwell begins and ends.
    - correlations (D, 3, 3): of the channels' means, by noise that they share.
    - bending (D, 3, 3): by how much effects change the readings per unit of force (``Attitudes``).
    """

    design: Floats
    readings: Floats
    force_mps2: Floats
    counts: Floats
    ends_s: Floats
    correlations: Floats = field(default_factory=lambda: np.eye(3)[None])
    bending: Floats = field(default_factory=lambda: np.zeros((1, 3, 3)))

    def __getitem__(self, part: int | list[int] | slice) -> Means:
        known = {each.name: getattr(self, each.name) for each in fields(self)}
        of_dwells = {name: values for name, values in known.items() if len(values) == len(self.counts)}
        return Means(**{name: values[part] for name, values in of_dwells.items()})

    def sensitivities(self, state: Floats) -> Floats:
        """Change (D, 3, 3) of the mean readings per unit of force at ``state`` (p,), effects included."""
        return state[:STATE_COUNT].reshape(3, 4)[:, :3] + self.bending


def means_of(dwells: Sequence[Dwell], columns: Sequence[Floats]) -> Means:
    """The means of dwells with these columns."""
    table, values = DwellTable.of(dwells), of_all_pieces(columns)
    if table.folded.shows_means_only and not values.strides[1]:  # the same at all nodes
        design = values[:, 0]
    else:
        design = _design(table, values)
    return Means(
        design, table.means[:, 4:], table.felt_means_mps2, table.folded.weights * table.folded.counts[:, None],
        table.folded.ends_s, table.folded.correlations, table.bendings,
    )  # fmt: skip


def _design(table: DwellTable, values: Floats) -> Floats:
    """Return the means (D, 3, p) of columns (pieces, K nodes, 3, p)."""
    folded = table.folded
    functions = table.triangles[:, 0, : folded.width] / table.triangles[:, :1, 0]  # means of the basis
    of_nodes = on_nodes(functions[:, : values.shape[1]])  # (pieces, K)
    of_pieces = of_nodes[:, None] @ values.reshape(*values.shape[:2], -1)
    return folded.weighted(of_pieces[:, 0]).reshape(len(table), *values.shape[2:])
