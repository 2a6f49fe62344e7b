"""What is in a table before it is evaluated: what each column was taken for and why, and the orientations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from kf_calib.bench.raw_input import RawInput
from kf_calib.bench.streams import Table
from kf_calib.errors import CountsError, InputError
from kf_calib.sources.tables.columns import Columns
from kf_calib.sources.tables.grid import grid_of
from kf_calib.sources.tables.numbers import Numbers
from kf_calib.sources.tables.opening import Opening
from kf_calib.sources.text.units import Units
from kf_calib.support.units import STANDARD_GRAVITY_MPS2


@dataclass(frozen=True)
class ColumnFound:
    """A column as it was understood.

    header, first: as they stand in the table. meaning: of ``words.Meaning``, gimbal angles with their number, outer to
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
    cannot be evaluated; empty if it can, else there are no rows. has_sigma: whether the noise is written down.
    has_unit: whether it is known what the readings are in, which is ``input``. angles: number of gimbal angles.
    is_by_hand: whether no column tells an orientation.
    """

    path: Path
    columns: list[ColumnFound]
    count: int
    orientation: str
    rows: list[RowFound]
    has_sigma: bool
    has_unit: bool
    input: RawInput
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
    grid = grid_of(path, units.dataset).chosen(units.where)
    table_columns = Columns.of(grid, columns, Numbers.of(grid))
    angles = angles and bool(table_columns.orientation)
    opening = Opening(table_columns, _complete(overrides, len(table_columns.angles)), units, angles=angles)
    opening.refuse_samples()
    table, trouble = None, ""
    try:
        table = opening.table()
    except CountsError:
        raise
    except InputError as error:
        trouble = str(error)
    kind = table_columns.orientation if angles else ""
    has_sigma = table is not None and table.orientations[0].sigma_mps2 is not None
    rows = _rows(table, table_columns, angles) if table else []
    described = _columns(table_columns, opening.by_size, set(columns))
    return Survey(
        path, described, len(grid.rows), kind, rows, has_sigma, opening.has_unit, opening.raw, trouble,
        list(opening.warnings), len(table_columns.angles), not table_columns.orientation,
    )  # fmt: skip


def _complete(overrides: Mapping[str, str], angles: int) -> dict[str, str]:
    """The bench with any gravity and any axes where none are stated: cells are read alike on every bench."""
    metadata = dict(overrides)
    if not {"gravity_mps2", "latitude_deg"} & metadata.keys():
        metadata["gravity_mps2"] = str(STANDARD_GRAVITY_MPS2)
    if angles and not metadata.get("axes"):
        metadata["axes"] = " ".join("yzx"[k % 3] for k in range(angles))
    return metadata


def _columns(columns: Columns, by_size: Mapping[int, str], stated: set[str]) -> list[ColumnFound]:
    """The columns in their order; ``by_size``: units that the size of the numbers told."""
    described = list[ColumnFound]()
    for k, (header, meaning) in enumerate(zip(columns.grid.header, columns.meanings, strict=True)):
        told_by = "--column" if header in stated else "content" if header in columns.guessed else "name"
        if k in by_size and told_by != "--column":
            told_by = {"name": "size", "content": "content and size"}[told_by]
        number = f" {columns.angles.index(k) + 1}" if meaning.ours == "angle" else ""
        first = next((cell for cell in columns.grid.column(k) if cell is not None), "")
        unit = by_size.get(k) or meaning.unit if meaning.ours else ""
        first = f"{first:.10g}" if isinstance(first, float) else str(first)
        described.append(ColumnFound(header, first, meaning.ours + number, unit, told_by if meaning.ours else ""))
    return described


def _rows(table: Table, columns: Columns, angles: bool) -> list[RowFound]:
    has_faces = angles and columns.has("face")
    faces = columns.grid.column(columns.places("face")[0]) if has_faces else [None] * len(columns.grid.rows)
    rows = list[RowFound]()
    for k, (row, face, orientation) in enumerate(zip(columns.grid.numbers, faces, table.orientations, strict=True)):
        norm = float(np.linalg.norm(orientation.mean_mps2))
        x, y, z = (orientation.mean_mps2 / max(norm, 1e-300)).tolist()
        pose = tuple(map(float, orientation.pose)) if angles else ()
        readings = None if orientation.sigma_mps2 is None else orientation.count
        name = None if face is None else str(face)
        rows.append(
            RowFound(
                k + 1, row, orientation.elapsed_s, name, pose, (x, y, z), norm, readings, orientation.temperature_c
            )
        )
    return rows
