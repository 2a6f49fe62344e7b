"""When the orientations of a table were measured."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.sources.tables.columns import Columns
from kf_calib.sources.tables.grid import Cell
from kf_calib.sources.tables.numbers import stamps_of
from kf_calib.sources.tables.words import TIME

_USUAL_PAUSE_S = 60.0
_FIRST = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(frozen=True)
class RowTimes:
    """Times of the rows since the first, and the stamp of the first where it has a date.

    said: what they were taken from; empty where the table has none, and the rows count as a minute apart.
    """

    elapsed_s: Floats
    start_ns: int | None
    said: str

    @classmethod
    def of(cls, columns: Columns) -> RowTimes:
        """Raises InputError for a cell that is no time, and for rows that are out of order."""
        places, count = columns.places("time"), len(columns.grid.rows)
        if not places:
            return cls(_USUAL_PAUSE_S * np.arange(count, dtype=np.float64), None, "")
        unit, cells = columns.meanings[places[0]].unit, columns.grid.column(places[0])
        said, start_ns = f"time from {columns.named(places)}", None
        are_numbers = len(places) == 1 and (
            columns.numbers.values(cells) is not None or all(cell is None or columns.is_number(cell) for cell in cells)
        )
        if are_numbers or (len(places) == 1 and unit in TIME):
            said += f" in {unit or 's'}"
            elapsed_s = TIME[unit or "s"] * columns.values(places[0], "a time", optional=True)
        else:
            stamps = _stamps(columns, places)
            elapsed_s = np.array([(stamp - stamps[0]).total_seconds() for stamp in stamps])
            said += "" if stamps[0].tzinfo else " (UTC, since no time zone is named)"
            start_ns = round((_in_utc(stamps[0]) - _FIRST).total_seconds()) * 10**9
        _refuse_disorder(columns, elapsed_s, places[0])
        return cls(elapsed_s - elapsed_s[0], start_ns, said)


def _stamps(columns: Columns, places: list[int]) -> list[datetime]:
    """Return the stamps, of which date and time may stand in two columns."""
    grid, cells = columns.grid, columns.grid.column(places[0])
    if len(places) > 1:
        parts = zip(*(grid.column(place) for place in places), strict=True)
        cells = [" ".join(_date_or_time(cell) for cell in own if cell is not None) or None for own in parts]
    return stamps_of(grid, grid.header[places[0]], list(cells), columns.to_leave_out(places[0]))


def _in_utc(stamp: datetime) -> datetime:
    return stamp if stamp.tzinfo else stamp.replace(tzinfo=UTC)


def _date_or_time(cell: Cell) -> str:
    """Return the cell of one of two columns for date and time, which a spreadsheet gives as a stamp at midnight."""
    return cell.strftime("%Y-%m-%d") if isinstance(cell, datetime) else str(cell)


def _refuse_disorder(columns: Columns, elapsed_s: Floats, place: int) -> None:
    back = np.flatnonzero(np.diff(elapsed_s) <= 0)
    if back.size:
        row = int(back[0]) + 1
        wanted = f"the row before is not earlier: sort the rows by time, or {columns.to_leave_out(place)}"
        raise columns.grid.refuse(row, columns.grid.header[place], columns.grid.rows[row][place], wanted)
