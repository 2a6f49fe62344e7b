"""What is in a table before it is evaluated: what each column was taken for and why, and the orientations."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from kf_calib.bench.keys import UNSTATED, BenchKeys
from kf_calib.bench.streams import Table
from kf_calib.errors import CountsError, InputError
from kf_calib.sources.text.grid import grid_of
from kf_calib.sources.text.means import TableOfMeans
from kf_calib.sources.text.reader import named
from kf_calib.sources.text.units import Units
from kf_calib.support.units import STANDARD_GRAVITY_MPS2


class Survey(TableOfMeans):
    """What is in a table. What is not stated of the bench does not matter here: cells are read alike with any gravity
    and any axes. angles: whether orientations count, if there are any.

    evaluated: None where it cannot be, and ``trouble`` says why. Raises InputError where not even the columns can be
    understood, or the rows are samples.
    """

    evaluated: Table | None = None
    trouble = ""

    def __init__(
        self, path: Path, overrides: BenchKeys = UNSTATED, columns: Mapping[str, str] = MappingProxyType({}),
        units: Units | None = None, *, angles: bool = True,
    ) -> None:  # fmt: skip
        grid = grid_of(path, units.dataset if units else "")
        keys, self.path, self._stated = overrides.copy(), path, columns
        if not {"gravity_mps2", "latitude_deg"} & keys.keys():
            keys["gravity_mps2"] = STANDARD_GRAVITY_MPS2
        with named(grid.name):
            super().__init__(grid, columns, keys, units or Units(), None if angles else False)
            self.refuse_samples()
            self.are_lacking = False  # whoever asks is told by the columns
            if (places := self.columns.angles) and not overrides.get("axes"):
                self.overrides["axes"] = " ".join("yzx"[k % 3] for k in range(len(places)))
            try:
                self.evaluated = self.table()
            except CountsError:
                raise
            except InputError as error:
                self.trouble = f"{grid.name}: {error}"

    @property
    def orientation(self) -> str:
        """``angles``, ``attitude`` or ``face``; empty where no column tells it, or none is used."""
        return self.columns.orientation if self.angles else ""

    @cached_property
    def described_columns(self) -> list[dict[str, str]]:
        """The columns in their order.

        header, first: name and first cell as they stand in the table. meaning: of ``names.Meaning``, gimbal angles with
        their number, outer to inner; empty if it is not used. unit: of its numbers. told_by: ``name``, ``content``,
        ``size`` (the unit, by its numbers), ``content and size`` or ``--column``.
        """
        columns, described = self.columns, list[dict[str, str]]()
        for k, (header, meaning) in enumerate(zip(columns.header, columns.meanings, strict=True)):
            by_size, is_used = columns.by_size.get(k, ""), bool(meaning.ours)
            told_by = " and ".join(["content"] * (header in columns.guessed) + ["size"] * bool(by_size)) or "name"
            number = f" {columns.angles.index(k) + 1}" if k in columns.angles else ""
            described.append({
                "header": header, "first": next((row[k] for row in columns.rows if row[k]), ""),
                "meaning": meaning.ours + number, "unit": (by_size or meaning.unit) * is_used,
                "told_by": ("--column" if header in self._stated else told_by) * is_used,
            })  # fmt: skip
        return described

    @cached_property
    def described_rows(self) -> list[dict[str, Any]]:
        """The orientations; none where the table cannot be evaluated.

        number: of the dwell; row: in the table. at_s: its middle since the first. face: as it was written down. pose:
        gimbal angles in rad, or attitude; empty without angles. up (3,): the unit vector along the mean readings.
        readings: how many were averaged; None where it is not known.
        """
        described, place = list[dict[str, Any]](), self.columns.place("face") if self.orientation else None
        for k, row in enumerate(self.evaluated.orientations if self.evaluated else ()):
            norm = float(np.linalg.norm(row.mean_mps2))
            described.append({
                "number": k + 1, "row": self.rows[k], "at_s": row.elapsed_s,
                "face": None if place is None else self.columns.rows[k][place],
                "pose": list(map(float, row.pose)) if self.orientation else [],
                "up": (row.mean_mps2 / max(norm, 1e-300)).tolist(), "norm_mps2": norm,
                "readings": None if row.sigma_mps2 is None else row.count, "temperature_c": row.temperature_c,
            })  # fmt: skip
        return described
