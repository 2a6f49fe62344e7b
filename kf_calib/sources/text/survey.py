"""What is in a table before it is evaluated: what each column was taken for and why, and the orientations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from kf_calib.bench.keys import UNSTATED, BenchKeys
from kf_calib.bench.streams import Table
from kf_calib.errors import CountsError, InputError
from kf_calib.sources.text.grid import grid_of
from kf_calib.sources.text.means import TableOfMeans
from kf_calib.sources.text.reader import named
from kf_calib.sources.text.units import Units
from kf_calib.support.units import STANDARD_GRAVITY_MPS2


class ColumnFound(NamedTuple):
    """A column as it was understood.

    header, first: as they stand in the table. meaning: of ``names.Meaning``, gimbal angles with their number, outer to
    inner; empty if it is not used. unit: of its numbers. told_by: ``name``, ``content``, ``size`` (the unit, by its
    numbers), ``content and size`` or ``--column``.
    """

    header: str
    first: str
    meaning: str
    unit: str
    told_by: str


class RowFound(NamedTuple):
    """An orientation: its dwell's number, its row in the table, its middle since the first, and what was written down.

    pose: gimbal angles in rad, or attitude; empty without angles. up (3,): the unit vector along the mean readings.
    readings: how many were averaged; None where it is not known.
    """

    number: int
    row: int
    at_s: float
    face: str | None
    pose: tuple[float, ...]
    up: tuple[float, float, float]
    norm_mps2: float
    readings: int | None
    temperature_c: float


@dataclass(frozen=True)
class Survey:
    """What is in a table. stated: columns that the user named. table: None where it cannot be evaluated, and
    ``trouble`` says why."""

    path: Path
    means: TableOfMeans
    stated: Mapping[str, str]
    table: Table | None
    trouble: str

    @property
    def orientation(self) -> str:
        """``angles``, ``attitude`` or ``face``; empty where no column tells it, or none is used."""
        return self.means.columns.orientation if self.means.angles else ""

    @cached_property
    def columns(self) -> list[ColumnFound]:
        """The columns in their order."""
        columns, described = self.means.columns, list[ColumnFound]()
        for k, (header, meaning) in enumerate(zip(columns.header, columns.meanings, strict=True)):
            first = next((row[k] for row in columns.rows if row[k]), "")
            told_by = "content" if header in columns.guessed else "name"
            if k in columns.by_size:
                told_by = {"name": "size", "content": "content and size"}[told_by]
            told_by = "--column" if header in self.stated else told_by
            number = f" {columns.angles.index(k) + 1}" if k in columns.angles else ""
            known = meaning.ours + number, columns.by_size.get(k) or meaning.unit, told_by
            described.append(ColumnFound(header, first, *known if meaning.ours else ("", "", "")))
        return described

    @cached_property
    def rows(self) -> list[RowFound]:
        """The orientations; none where the table cannot be evaluated."""
        means, rows = self.means, list[RowFound]()
        place = means.columns.place("face") if self.orientation else None
        for k, row in enumerate(self.table.orientations if self.table else ()):
            norm = float(np.linalg.norm(row.mean_mps2))
            x, y, z = (row.mean_mps2 / max(norm, 1e-300)).tolist()
            pose = tuple(map(float, row.pose)) if self.orientation else ()
            readings = None if row.sigma_mps2 is None else row.count
            face = None if place is None else means.columns.rows[k][place]
            facts = row.elapsed_s, face, pose, (x, y, z), norm, readings, row.temperature_c
            rows.append(RowFound(k + 1, means.rows[k], *facts))
        return rows


def survey(
    path: Path,
    overrides: BenchKeys = UNSTATED,
    columns: Mapping[str, str] = MappingProxyType({}),
    units: Units | None = None,
    *,
    angles: bool = True,
) -> Survey:
    """What is in a table. What is not stated of the bench does not matter here: cells are read alike with any gravity
    and any axes. angles: whether orientations count, if there are any.

    Raises InputError where not even the columns can be understood, or the rows are samples.
    """
    units = units or Units()
    grid = grid_of(path, units.dataset)
    keys = overrides.copy()
    if not {"gravity_mps2", "latitude_deg"} & keys.keys():
        keys["gravity_mps2"] = STANDARD_GRAVITY_MPS2
    with named(grid.name):
        means = TableOfMeans(grid, columns, keys, units, angles=None if angles else False)
        means.refuse_samples()
        means.are_lacking = False  # whoever asks is told by the columns
        if (places := means.columns.angles) and not overrides.get("axes"):
            means.overrides["axes"] = " ".join("yzx"[k % 3] for k in range(len(places)))
        try:
            return Survey(path, means, columns, means.table(), "")
        except CountsError:
            raise
        except InputError as error:
            return Survey(path, means, columns, None, f"{grid.name}: {error}")
