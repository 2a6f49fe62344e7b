"""Which column of a table is what: told by names and units, by the numbers themselves, or by the user.

When the orientations of a table were measured.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime

import numpy as np

from kf_calib.bench.arrays import Floats, Mask, lengths
from kf_calib.errors import InputError
from kf_calib.sources.tables.grid import Cell, Grid
from kf_calib.sources.tables.numbers import Numbers, stamps_of
from kf_calib.sources.text.contents import is_nameless, meanings_by_numbers
from kf_calib.sources.text.names import QUATERNION, TIME, Meaning, face_of, meaning_of, meanings_of, unit_of_epoch
from kf_calib.support.text import cut

READINGS, SPREADS = ("ax", "ay", "az"), ("sx", "sy", "sz")
_OPTIONAL = ("time", "count", "temperature", "sd", *SPREADS)
_SEVERAL = ("angle", "time", "")
_ALIKE = 1.3  # of the norms of readings at rest, largest to smallest
_MOST = 0.6  # of the cells of a column of readings: a bad one is told later
HOW = "--column THEIRS=OURS says what a column is"
KNOWN = "ax_g (ay_mps2, az_mg), sx_g or sd_g, outer_deg (middle_rad, inner_deg), qx, face, time_s, count, temperature_c"


@dataclass
class Columns:
    """The columns of a grid by what they are; see ``words.Meaning`` for the names.

    numbers: how its numbers are written. guessed: names of columns that were recognised by their numbers alone.
    """

    grid: Grid
    numbers: Numbers
    meanings: list[Meaning]
    guessed: list[str] = field(default_factory=list[str])

    @classmethod
    def of(cls, grid: Grid, stated: Mapping[str, str], numbers: Numbers) -> Columns:
        """The columns of a grid; ``stated`` are those that the user names, theirs to ours. Raises InputError."""
        columns = cls(grid, numbers, _meanings(grid, stated))
        if is_nameless(grid.header) and not stated:
            columns._recognise_numbers()
        columns._leave_out_empty(set(stated))
        columns._recognise_contents({k for k, name in enumerate(grid.header) if name in stated})
        columns._refuse_doubles()
        return columns

    def places(self, *wanted: str) -> list[int]:
        """Indices of the columns of these kinds, in the order asked for."""
        return [k for ours in wanted for k, own in enumerate(self.meanings) if own.ours == ours]

    @property
    def angles(self) -> list[int]:
        """Indices of the gimbal angles, outer to inner where the names tell, else in the order of the header."""
        return sorted(self.places("angle"), key=lambda k: self.meanings[k].rank)

    def has(self, *wanted: str) -> bool:
        """Whether there is a column of each of these kinds."""
        return all(self.places(ours) for ours in wanted)

    def named(self, places: Sequence[int]) -> str:
        """The names of columns, quoted."""
        return ", ".join(repr(cut(self.grid.header[k], 40)) for k in places)

    @property
    def orientation(self) -> str:
        """How orientations are told: ``face``, ``attitude`` or ``angles``; empty if they are not."""
        return "face" if self.has("face") else "attitude" if self.has(*QUATERNION) else "angles" if self.angles else ""

    @property
    def unused(self) -> list[int]:
        """Indices of the columns that mean nothing here."""
        return [k for k, own in enumerate(self.meanings) if not own.ours and self.grid.header[k]]

    def to_leave_out(self, place: int) -> str:
        """What to do where a column is of no use."""
        return f"leave the column out by --column {self.grid.header[place] + '=-'!r}"

    def values(self, place: int, wanted: str = "a number", optional: bool = False, only: Mask | None = None) -> Floats:
        """The numbers (n,) of a column; raises InputError for the first cell that holds none.

        optional: whether the table would do without the column. only (n,): rows whose cells count, NaN for others.
        """
        cells = self.grid.column(place)
        if only is None and (plain := self.numbers.values(cells)) is not None:
            return np.array(plain)
        numbers = np.full(len(cells), np.nan)
        for row, cell in enumerate(cells):
            if only is not None and not only[row]:
                continue
            try:
                numbers[row] = self.numbers.value(cell)
            except (ValueError, OverflowError):
                else_ = self.to_leave_out(place) if optional else "remove the row" if cell is None else ""
                wanted_now = f"write {wanted} such as {self.numbers.example}{f', or {else_}' if else_ else ''}"
                raise self.grid.refuse(row, self.grid.header[place], cell, wanted_now) from None
        return numbers

    def is_number(self, cell: Cell) -> bool:
        """Whether a cell holds a number."""
        try:
            self.numbers.value(cell)
        except (ValueError, OverflowError):
            return False
        return True

    def _leave_out_empty(self, stated: set[str]) -> None:
        """Take columns that a template has and nobody filled as if they were not there."""
        for k, name in enumerate(self.grid.header):
            is_optional = self.meanings[k].ours in _OPTIONAL and name not in stated
            if is_optional and all(cell is None for cell in self.grid.column(k)):
                self.meanings[k] = Meaning("", "")

    def _recognise_contents(self, stated: set[int]) -> None:
        """Find faces, stamps and readings by what stands in columns whose names say nothing."""
        for k in range(len(self.meanings)):
            kind, cells = self.meanings[k].ours, self.grid.column(k)
            if k not in stated and kind == "face" and not any(map(_is_face, cells)):
                self.meanings[k] = Meaning("", "")
            if k not in stated and kind in ("", "angle") and not self.has("face") and all(map(_is_face, cells)):
                self._guess(k, "face")
            if k not in stated and kind == "" and not self.has("time") and self._are_stamps(k):
                self._guess(k, "time")
        if self.places(*READINGS):
            return
        left = [k for k, own in enumerate(self.meanings) if not own.ours and not own.other and k not in stated]
        if len(numeric := [k for k in left if self._are_numbers(k, _MOST)]) == 3:
            whole = np.array([all(self.is_number(row[k]) for k in numeric) for row in self.grid.rows])
            norms = lengths(np.column_stack([self.values(k, only=whole)[whole] for k in numeric]))
            if norms.size and 0 < norms.max() < _ALIKE * norms.min():
                for k, ours in zip(numeric, READINGS, strict=True):
                    self._guess(k, ours)

    def _recognise_numbers(self) -> None:
        """Find time and readings in columns without names."""
        places = [k for k in range(len(self.meanings)) if self._are_numbers(k, _MOST)]
        if len(places) < 3:
            return
        whole = np.array([all(self.is_number(row[k]) for k in places) for row in self.grid.rows])
        told = meanings_by_numbers(np.column_stack([self.values(k, only=whole)[whole] for k in places]))
        for place, meaning in zip(places, told, strict=True):
            if meaning.ours:
                self._guess(place, meaning.ours)

    def _guess(self, place: int, ours: str) -> None:
        self.meanings[place] = Meaning(ours, self.meanings[place].unit)
        self.guessed.append(self.grid.header[place])

    def _are_stamps(self, place: int) -> bool:
        cells = self.grid.column(place)
        if self._are_numbers(place) or not all(cell is not None for cell in cells):
            return False
        try:
            return bool(stamps_of(self.grid, "", cells))
        except InputError:
            return False

    def _are_numbers(self, place: int, share: float = 1.0) -> bool:
        """Whether at least this share of the cells of a column are numbers."""
        cells = self.grid.column(place)
        if self.numbers.values(cells) is not None:
            return True
        return sum(map(self.is_number, cells)) >= share * len(cells)

    def _refuse_doubles(self) -> None:
        kinds = [own.ours for own in self.meanings]
        for k, ours in enumerate(kinds):
            first = kinds.index(ours)
            if ours not in _SEVERAL and first != k:
                one, other = self.grid.header[first], self.grid.header[k]
                raise InputError(
                    f"{self.grid.name}: columns {one!r} and {other!r} are both taken for {ours}: say which it is, for "
                    f"example by --column {f'{one}={ours}'!r}; {HOW}."
                )


def _is_face(cell: Cell) -> bool:
    return isinstance(cell, str) and face_of(cell) is not None


def _meanings(grid: Grid, stated: Mapping[str, str]) -> list[Meaning]:
    """Return what the header and the user say; raises InputError for names that are not known."""
    for theirs, ours in stated.items():
        if theirs not in grid.header:
            raise InputError(f"{grid.name}: has no column {cut(theirs, 60)!r} (--column), it has {grid.names}.")
        if ours != "-" and not meaning_of(ours).ours:
            raise InputError(f"--column {theirs}={ours}: {cut(ours, 60)!r} is not known: use {KNOWN}, or - for none.")
    return meanings_of(grid.header, stated)


_MOST_OWN = 6  # rows of a table of own axes
_UP_DOWN = re.compile(r"([+\-−])\s*1\s*g", re.IGNORECASE)


def own_axes(columns: Columns) -> Floats | None:
    """What each axis reads up and down (3, 2), where a table holds no more than that: a row for each face with the
    reading of its own axis alone, or a row for each axis with those at +1 g and -1 g. None where it is another."""
    extremes = np.full((3, 2), np.nan)
    if len(columns.grid.rows) > _MOST_OWN:
        return None
    for axis, is_down, cell in _own_cells(columns):
        if not columns.is_number(cell):
            return None
        extremes[axis, int(is_down)] = columns.numbers.value(cell)
    return extremes if np.isfinite(extremes).all() else None


def _own_cells(columns: Columns) -> Iterator[tuple[int, bool, Cell]]:
    """Yield axis, whether it is down, and the reading of it."""
    grid, readings = columns.grid, columns.places(*READINGS)
    signs = {k: match[1] != "+" for k, name in enumerate(grid.header) if (match := _UP_DOWN.fullmatch(name.strip()))}
    for row in grid.rows:
        face = next((told for cell in row if isinstance(cell, str) and (told := face_of(cell))), None)
        if face and len(signs) == 2:
            yield from ((face[0], is_down, row[k]) for k, is_down in signs.items())
        elif face and len(readings) == 3:
            others = [row[k] for axis, k in enumerate(readings) if axis != face[0]]
            alone = all(cell is None or cell in ("-", "–", "—") for cell in others)
            yield face[0], face[1] < 0, row[readings[face[0]]] if alone else None


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
        places, count = _of_rising_numbers(columns, columns.places("time")), len(columns.grid.rows)
        if not places:
            return cls(_USUAL_PAUSE_S * np.arange(count, dtype=np.float64), None, "")
        unit, cells = columns.meanings[places[0]].unit, columns.grid.column(places[0])
        said, start_ns = f"time from {columns.named(places)}", None
        are_numbers = len(places) == 1 and (
            columns.numbers.values(cells) is not None or all(cell is None or columns.is_number(cell) for cell in cells)
        )
        if are_numbers or (len(places) == 1 and unit in TIME):
            values = columns.values(places[0], "a time", optional=True)
            unit = unit or unit_of_epoch(float(np.abs(values).max(initial=0.0))) or "s"
            said += f" in {unit}"
            elapsed_s = TIME[unit] * (values - values[0])
        else:
            stamps = _stamps(columns, places)
            elapsed_s = np.array([(stamp - stamps[0]).total_seconds() for stamp in stamps])
            said += "" if stamps[0].tzinfo else " (UTC, since no time zone is named)"
            start_ns = round((_in_utc(stamps[0]) - _FIRST).total_seconds()) * 10**9
        _refuse_disorder(columns, elapsed_s, places[0])
        return cls(elapsed_s - elapsed_s[0], start_ns, said)


def _of_rising_numbers(columns: Columns, places: list[int]) -> list[int]:
    """Return the first of several columns of numbers that go up, where there is one; else all, as of date and time."""
    for place in places if len(places) > 1 else ():
        values = columns.numbers.values(columns.grid.column(place))
        if values is not None and bool((np.diff(values) > 0.0).all()):
            return [place]
    return places


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
