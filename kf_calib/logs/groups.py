"""Arrays in groups, as MATLAB's structs, the groups of HDF5 and archives of NumPy hold them, and the datasets they are.

All arrays beneath a group that have the same length are one dataset: nothing but their lengths tells which time belongs
to which readings and angles. A group in which a reading is there twice is a dataset for each group in it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from kf_calib.sources.containers.dataset import ArrayColumn, Dataset
from kf_calib.sources.text.names import NAMELESS

_MOST_COLUMNS = 64  # of an array whose rows are those of a log
_OF_MATLAB = "#refs#"  # in which a file of version 7.3 keeps what its structs and cells point to
_FEW = 16  # rows of an array that lies on its side
_TIMES = {"t", "time"}
_RATES = {"fs", "f_s", "rate", "sample_rate", "samplerate", "sampling_rate", "sampling_frequency", "frequency", "hz"}
_STEPS = {"dt", "ts", "sample_time", "sampletime", "sampling_interval", "sampling_period", "period"}
_NUMBERS, _KINDS = "iuf", "biufMSU"  # of arrays that tell a rate, and of those that can be columns

Path = tuple[str, ...]


class Values(NamedTuple):
    """An array and the unit that its file states for it."""

    array: ArrayColumn
    unit: str = ""


@dataclass
class ArrayGroup:
    """Arrays by their names, and groups beneath; a single number is an array of no dimension."""

    arrays: dict[str, Values] = field(default_factory=dict[str, Values])
    groups: dict[str, ArrayGroup] = field(default_factory=dict[str, "ArrayGroup"])

    def put(self, path: Sequence[str], array: Any, unit: str = "") -> None:
        """Put an array at a path; texts of one cell, objects and arrays of three dimensions have no place."""
        values = np.asarray(array)
        if values.dtype.names:
            for name in values.dtype.names:
                self.put((*path, name), values[name])
        elif values.dtype.kind in _KINDS and values.ndim <= 2 and values.size and path and path[0] != _OF_MATLAB:
            group = self
            for name in path[:-1]:
                group = group.groups.setdefault(name, ArrayGroup())
            group.arrays[path[-1]] = Values(values, unit)

    def beneath(self, above: Path = ()) -> Iterator[tuple[Path, Values]]:
        """The arrays of the group and of all groups in it, by their paths from here."""
        for name, values in self.arrays.items():
            yield (*above, name), values
        for name, group in self.groups.items():
            yield from group.beneath((*above, name))


def datasets_of(root: ArrayGroup) -> list[Dataset]:
    """The datasets of a file; that of its whole root is ``/``."""
    return list(_datasets(root, "", {}))


def _datasets(group: ArrayGroup, place: str, shared: Mapping[Path, Values]) -> Iterator[Dataset]:
    """Return the datasets of a group; shared: arrays beside it that may belong to it."""
    arrays = {**shared, **dict(group.beneath())}
    own = {_length(values.array) for path, values in group.beneath()} - {0}
    made = [Dataset(place or "/", _columns(arrays, length)) for length in sorted(own, reverse=True)]
    if group.groups and any(each.has_readings_twice for each in made):
        beside = {(name,): values for name, values in group.arrays.items()}
        for name, child in group.groups.items():
            if not _has_readings(child):
                beside |= dict(child.beneath((name,)))
        for name, child in group.groups.items():
            if _has_readings(child):
                yield from _datasets(child, f"{place}/{name}", {**shared, **beside})
        return
    is_alone = sum(each.has_readings for each in made) == 1
    for each in made:
        named = each if (is_alone and each.has_readings) or len(made) == 1 else _named_by_first(place, each)
        yield _timed(named, arrays)


def _has_readings(group: ArrayGroup) -> bool:
    arrays = dict(group.beneath())
    lengths = {_length(values.array) for values in arrays.values()} - {0}
    return any(Dataset("", _columns(arrays, length)).has_readings for length in lengths)


def _rows(array: ArrayColumn) -> ArrayColumn:
    """Return an array (n, k) of n rows, which may lie on its side."""
    if array.ndim < 2:
        return array.reshape(-1, 1)
    return array.T if array.shape[0] == 1 or array.shape[0] < min(array.shape[1], _FEW) else array


def _length(array: ArrayColumn) -> int:
    """Return how many rows an array has; 0 where it is none of a log."""
    rows = _rows(array)
    return len(rows) if array.ndim and len(rows) > 1 and rows.shape[1] <= _MOST_COLUMNS else 0


def _columns(arrays: Mapping[Path, Values], length: int) -> dict[str, ArrayColumn]:
    """Return the columns of the arrays of a length, by names; those of one array alone are without names."""
    chosen = {path: values for path, values in arrays.items() if _length(values.array) == length}
    while len({path[0] for path in chosen}) == 1 and min(map(len, chosen)) > 1:
        chosen = {path[1:]: values for path, values in chosen.items()}
    if len(chosen) == 1:
        rows = _rows(next(iter(chosen.values())).array)
        if rows.shape[1] > 3:
            return {NAMELESS.format(k + 1): column for k, column in enumerate(rows.T)}
    last = [path[-1].lower() for path in chosen]
    columns = dict[str, ArrayColumn]()
    for path, (array, unit) in chosen.items():
        rows, end = _rows(array), path[-1].lower()
        name = end if end in _TIMES and last.count(end) == 1 else "/".join(path)
        channels = {1: ("",), 3: ("_x", "_y", "_z")}.get(rows.shape[1]) or [f"_{k}" for k in range(rows.shape[1])]
        columns |= {name + channel + f" [{unit}]" * bool(unit): rows[:, k] for k, channel in enumerate(channels)}
    return columns


def _named_by_first(place: str, dataset: Dataset) -> Dataset:
    """Return one of several datasets of a group under the name of its first column that is no time."""
    timeless = [name for name, own in zip(dataset.columns, dataset.meanings, strict=False)
                if own.ours != "time" and name not in _TIMES]  # fmt: skip
    name = (timeless or list(dataset.columns))[0].partition(" [")[0].removesuffix("_x")
    return replace(dataset, name=f"{place}/{name}")


def _timed(dataset: Dataset, arrays: Mapping[Path, Values]) -> Dataset:
    """Return a dataset of some of the arrays with a column of time where it has none, and a number is called a rate or
    a step: the one that stands nearest to its arrays, if they have one alone."""
    if dataset.has_time or not dataset.has_readings:
        return dataset
    places = [path for path, values in arrays.items() if _length(values.array) == len(dataset)]
    rates = _nearest(_rates_in(arrays), places)
    if len({rate for _, rate in rates}) != 1:
        return dataset
    name, rate = rates[0]
    said = f"time of {dataset.name} from {rate:g} rows a second, as {name!r} states"
    columns = {"time_s": np.arange(len(dataset)) / rate, **dataset.columns}
    return replace(dataset, columns=columns, said=(said,), is_log=True)


def _rates_in(arrays: Mapping[Path, Values]) -> dict[Path, tuple[str, float]]:
    """Return the first number of each group that is called a rate or a step, by the group: its name, and the rate."""
    rates = dict[Path, tuple[str, float]]()
    for (*group, name), (array, _) in arrays.items():
        if array.size == 1 and array.dtype.kind in _NUMBERS and name.lower() in _RATES | _STEPS:
            value = float(array.item())
            if np.isfinite(value) and value > 0.0:
                rates.setdefault(tuple(group), (name, value if name.lower() in _RATES else 1.0 / value))
    return rates


def _nearest(rates: Mapping[Path, tuple[str, float]], places: Sequence[Path]) -> list[tuple[str, float]]:
    """Return of each array the rate that is stated for it alone, or for the smallest group that it is in; all of them
    where no array is in such a group."""
    groups = [[place[:count] for count in range(len(place), -1, -1) if place[:count] in rates] for place in places]
    return [rates[own[0]] for own in groups if own] or [*rates.values()]
