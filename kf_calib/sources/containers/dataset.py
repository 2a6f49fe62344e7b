"""A dataset of a container: columns side by side, given out as lines of CSV to the one reader of text."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kf_calib.errors import InputError
from kf_calib.sources.text.names import TIME, Meaning, is_nameless, meanings_by_numbers, meanings_of, unit_of_epoch
from kf_calib.support.text import cut

ArrayColumn = NDArray[Any]
_BLOCK_ROWS = 4096
_TELLING_ROWS = 1000
_READINGS = ("ax", "ay", "az")
_SHOWN = 8  # names in a message


@dataclass(frozen=True)
class Dataset:
    """Columns (n,) of numbers or texts by their names. said: what was added to them; is_log: whether they are samples
    in time, whatever they look like."""

    name: str
    columns: Mapping[str, ArrayColumn]
    said: tuple[str, ...] = ()
    is_log: bool = False

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), ()))

    @cached_property
    def meanings(self) -> Sequence[Meaning]:
        """What the columns are, by their names or, where they have none, by their numbers."""
        names = list(self.columns)
        if not is_nameless(names):
            return meanings_of(names, MappingProxyType({}))
        first = [column[:_TELLING_ROWS] for column in self.columns.values()]
        are_numbers = all(column.dtype.kind in "biuf" for column in first)
        return meanings_by_numbers(np.column_stack(first).astype(float)) if are_numbers else []

    @property
    def has_readings(self) -> bool:
        """Whether three columns are the accelerometer's."""
        return len(self) > 1 and set(_READINGS) <= {meaning.ours for meaning in self.meanings}

    @property
    def has_readings_twice(self) -> bool:
        """Whether more columns than one are the same reading, as of two units side by side."""
        counts = Counter(meaning.ours for meaning in self.meanings)
        return any(counts[ours] > 1 for ours in _READINGS)

    @property
    def has_time(self) -> bool:
        """Whether a column gives the time; a plain ``t`` does."""
        return any(own.ours == "time" for own in self.meanings) or "t" in {name.lower() for name in self.columns}

    def times_ns(self) -> NDArray[np.int64]:
        """The stamps of the rows; none where no column of numbers gives them."""
        for (name, column), own in zip(self.columns.items(), self.meanings, strict=False):
            if (own.ours == "time" or name.lower() == "t") and column.dtype.kind in "iuf":
                finite = column[np.isfinite(column)].astype(float)
                unit = own.unit or unit_of_epoch(float(np.abs(finite).max(initial=0.0))) or "s"
                return np.rint(finite * TIME[unit] * 1e9).astype(np.int64)
        return np.zeros(0, np.int64)

    def lines(self) -> Iterator[bytes]:
        """The header and the rows as CSV in UTF-8, some thousand rows at a time; numbers come back exactly."""
        yield (",".join(map(_cell, self.columns)) + "\n").encode()
        for begin in range(0, len(self), _BLOCK_ROWS):
            cells = [_texts(column[begin : begin + _BLOCK_ROWS]) for column in self.columns.values()]
            yield ("\n".join(map(",".join, zip(*cells, strict=True))) + "\n").encode()


def _texts(values: ArrayColumn) -> list[str]:
    """Return the cells of a column."""
    if values.dtype.kind == "M":  # a stamp of a calendar, since 1970
        values = values.astype("datetime64[ns]").astype(np.int64)
    if values.dtype == np.float32:
        return [f"{value:.9g}" for value in values.tolist()]
    if values.dtype.kind == "b":
        values = values.astype(np.uint8)
    plain = values.tolist()
    return list(map(repr, plain)) if values.dtype.kind in "iuf" else [_cell(_text(value)) for value in plain]


def _text(value: object) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)


def _cell(text: str) -> str:
    """Return a text as a cell of CSV."""
    text = " ".join(text.split())
    quoted = text.replace('"', '""')
    return f'"{quoted}"' if "," in text or '"' in text else text


def chosen(datasets: Sequence[Dataset], name: str, path: object) -> Dataset:
    """The dataset of a name, or where none is stated that with readings which has the most rows, the first of equals;
    what was not chosen is said. Raises InputError where there is none."""
    if name:
        found = next((each for each in datasets if each.name == name), None)
        if found is None:
            raise InputError(f"{path}: has no dataset {cut(name, 60)!r} (--accel-topic), it has {_listed(datasets)}.")
        return found
    usable = [each for each in datasets if each.has_readings]
    if not usable:
        raise InputError(
            f"{path}: no dataset holds three readings of an accelerometer side by side, it has {_listed(datasets)}: "
            "choose one by --accel-topic and name its columns by --column, or save its readings as a CSV file "
            "(docs/own_csv.md)."
        )
    best = max(usable, key=len)
    others = [each for each in usable if each is not best]
    if not others:
        return best
    said = f"{best.name} was read, not {_listed(others)}: --accel-topic chooses another"
    return replace(best, said=(*best.said, said))


def _listed(datasets: Sequence[Dataset]) -> str:
    """Return the names of datasets with their sizes."""
    shown = ", ".join(f"{cut(each.name, 60)} ({len(each)} rows)" for each in datasets[:_SHOWN])
    return (shown + " ..." * (len(datasets) > _SHOWN)) or "no array of numbers"
