"""What is in a table before it is evaluated: what each column was taken for and why, and the orientations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from kf_calib.bench.streams import Table
from kf_calib.errors import CountsError, InputError
from kf_calib.sources.text.columns import Columns
from kf_calib.sources.text.grid import grid_of
from kf_calib.sources.text.means import TableOfMeans
from kf_calib.sources.text.reader import named
from kf_calib.sources.text.units import Units
from kf_calib.support.units import STANDARD_GRAVITY_MPS2


@dataclass(frozen=True)
class ColumnFound:
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


@dataclass(frozen=True)
class RowFound:
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
    """What is in a table.

    orientation: ``angles``, ``attitude`` or ``face``; empty where no column tells it, or none is used. trouble: why it
    cannot be evaluated; empty if it can, else there is no table and no rows. angles: number of gimbal angles.
    is_by_hand: whether no column tells an orientation.
    """

    path: Path
    columns: list[ColumnFound]
    count: int
    orientation: str
    rows: list[RowFound]
    table: Table | None
    trouble: str
    warnings: list[str]
    angles: int
    is_by_hand: bool


def survey(
    path: Path,
    overrides: Mapping[str, str] = MappingProxyType({}),
    columns: Mapping[str, str] = MappingProxyType({}),
    units: Units | None = None,
    *,
    angles: bool = True,
) -> Survey:
    """What is in a table. What is not stated of the bench does not matter here. angles: whether orientations count, if
    there are any.

    Raises InputError where not even the columns can be understood, or the rows are samples.
    """
    units = units or Units()
    grid = grid_of(path, units.dataset)
    table, trouble = None, ""
    with named(grid.name):
        means = TableOfMeans(grid, columns, _with_gravity(overrides), units, angles=None if angles else False)
        means.refuse_samples()
        means.are_lacking, understood = False, means.columns  # who asks is told by ``is_by_hand``
        if understood.angles and not overrides.get("axes"):
            means.overrides["axes"] = " ".join("yzx"[k % 3] for k in range(len(understood.angles)))
        try:
            table = means.table()
        except CountsError:
            raise
        except InputError as error:
            trouble = f"{grid.name}: {error}"
    kind = understood.orientation if means.angles else ""
    rows = _rows(table, means) if table else []
    return Survey(
        path, _columns(understood, set(columns)), len(understood.rows), kind, rows, table, trouble, means.warnings,
        len(understood.angles), not understood.orientation,
    )  # fmt: skip


def _with_gravity(overrides: Mapping[str, str]) -> dict[str, str]:
    """The bench with any gravity where none is stated: cells are read alike on every bench, as with any axes."""
    is_stated = bool({"gravity_mps2", "latitude_deg"} & overrides.keys())
    return {**({} if is_stated else {"gravity_mps2": str(STANDARD_GRAVITY_MPS2)}), **overrides}


def _columns(columns: Columns, stated: set[str]) -> list[ColumnFound]:
    """The columns in their order."""
    described = list[ColumnFound]()
    for k, (header, meaning) in enumerate(zip(columns.header, columns.meanings, strict=True)):
        told_by = "--column" if header in stated else "content" if header in columns.guessed else "name"
        if k in columns.by_size and told_by != "--column":
            told_by = {"name": "size", "content": "content and size"}[told_by]
        number = f" {columns.angles.index(k) + 1}" if k in columns.angles else ""
        first = next((row[k] for row in columns.rows if row[k]), "")
        unit = columns.by_size.get(k) or meaning.unit if meaning.ours else ""
        described.append(ColumnFound(header, first, meaning.ours + number, unit, told_by if meaning.ours else ""))
    return described


def _rows(table: Table, means: TableOfMeans) -> list[RowFound]:
    place = means.columns.place("face") if means.angles else None
    rows = list[RowFound]()
    for k, orientation in enumerate(table.orientations):
        norm = float(np.linalg.norm(orientation.mean_mps2))
        x, y, z = (orientation.mean_mps2 / max(norm, 1e-300)).tolist()
        pose = tuple(map(float, orientation.pose)) if means.angles else ()
        readings = None if orientation.sigma_mps2 is None else orientation.count
        face = None if place is None else means.columns.rows[k][place]
        rows.append(
            RowFound(
                k + 1, means.numbers[k], orientation.elapsed_s, face, pose, (x, y, z), norm, readings,
                orientation.temperature_c,
            )
        )  # fmt: skip
    return rows
