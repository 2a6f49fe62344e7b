"""Which recordings a fleet is of: from files, folders, globs, lists of them, here or in any store that fsspec knows,
and the row of each run in the table: what it says, and of which type each column is.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import PurePosixPath
from typing import Any

import fsspec
import numpy as np
import pyarrow as pa
from fsspec.core import url_to_fs
from fsspec.implementations.local import LocalFileSystem
from numpy.typing import NDArray

from kf_calib.bench.arrays import Mask
from kf_calib.bench.paper_parameters import STATES
from kf_calib.errors import InputError
from kf_calib.fleet.run_factor import RunFactor

_LONGEST = 4096  # characters of a name
_RECORDINGS = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")
_BAG = "metadata.yaml"
_STORES = ("file", "s3", "gs", "gcs", "az", "abfs", "abfss")
"""Schemes of URLs that a list may name: no other scheme of fsspec is a plain store of files. Some join a computer of a
stranger's and run what it answers (dask), or lead to an address inside another one (``::``)."""

_CHANGING = ("size", "mtime", "ETag", "etag", "LastModified", "last_modified", "updated", "md5", "version_id")
"""What stores say of a file that differs when its content does."""


@dataclass(frozen=True)
class ListedRun:
    """One recording, before it is read.

    - place: absolute path, or URL, by which it is known.
    - size: in bytes; 0 where it is not known.
    - version: what its store says of it (size, time, checksum): while this is the same, so is the content.
    - folder: whether it is the folder of a ROS 2 bag.
    - unit, bench, date: what a list says of it; None to take what the recording says itself.
    - refused: why it is not read, where a list names what no list may; "" elsewhere.
    """

    place: str
    size: int = 0
    version: str = ""
    folder: bool = False
    unit: str | None = None
    bench: str | None = None
    date: datetime | None = None
    refused: str = ""


def runs_of(words: Iterable[str]) -> list[ListedRun]:
    """The recordings that words name, each once, in the order of the words and then of their names.

    A word is a recording, the folder of a bag, a folder of recordings (with all folders in it), a glob, or a list: a
    .txt file with one of these a line, or a .csv file with the column ``run`` and, if known, ``unit``, ``bench`` and
    ``date``. Each may be a URL such as ``s3://bucket/campaign/``. Raises InputError where a word leads to no recording.
    """
    runs = dict[str, ListedRun]()
    for word in words:
        named = list(_named_by(word))
        for run in named:
            runs.setdefault(run.place, run)
        if not named:
            raise InputError(
                f"{word} leads to no recording: name .mcap or .db3 files, folders of them, globs, or a list of these."
            )
    return list(runs.values())


@contextmanager
def refused_by_store(name: str, what: str, advice: str = "the access") -> Iterator[None]:
    """Raise InputError in place of the errors that each store has of its own."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        why = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{name}: cannot be {what} ({why}): check the name and {advice}.") from None


def _named_by(word: str) -> Iterator[ListedRun]:
    """Yield the recordings of one word."""
    with refused_by_store(word, "looked up"):
        try:
            files, path = url_to_fs(word)
            path = str(path)
            if fsspec.core.has_magic(path) and not files.exists(path):
                yield from _in_listing(files, files.glob(path, detail=True))
            elif files.isdir(path):
                listing = files.find(path, detail=True)
                yield from _in_listing(files, listing, recordings_only=True)
            elif (lines := _listed(files, path)) is not None:
                yield from _of_list(word, files, path, lines)
            else:
                yield _run(files, path, files.info(path))
        except FileNotFoundError:
            raise InputError(f"{word} is not there: name recordings, folders, globs, or a list of these.") from None


def _in_listing(
    files: Any, listing: Mapping[str, Mapping[str, Any]], recordings_only: bool = False
) -> Iterator[ListedRun]:
    """Yield the recordings among files with their descriptions, a bag's folder as one."""
    folders = {str(PurePosixPath(name).parent) for name in listing if PurePosixPath(name).name == _BAG}
    for folder in sorted(folders):
        inside = {name: info for name, info in listing.items() if str(PurePosixPath(name).parent) == folder}
        versions = "; ".join(_version(inside[name]) for name in sorted(inside))
        size = sum(int(info.get("size") or 0) for info in inside.values())
        yield ListedRun(_place(files, folder), size, versions, True)
    for name, info in sorted(listing.items()):
        if str(PurePosixPath(name).parent) in folders:
            continue
        if info["type"] == "directory":
            yield from _in_listing(files, files.find(name, detail=True), recordings_only=True)
        elif not recordings_only or name.endswith(_RECORDINGS):
            yield _run(files, name, info)


def _run(files: Any, name: str, info: Mapping[str, Any]) -> ListedRun:
    return ListedRun(_place(files, name), int(info.get("size") or 0), _version(info))


def _place(files: Any, name: str) -> str:
    return name if isinstance(files, LocalFileSystem) else files.unstrip_protocol(name)


def _version(info: Mapping[str, Any]) -> str:
    return " ".join(str(info[key]) for key in _CHANGING if info.get(key) is not None)


def _listed(files: Any, path: str) -> list[dict[str, str]] | None:
    """Return the lines of a list as columns; None where the file is no list."""
    if not path.endswith((".txt", ".csv")) or files.info(path)["type"] == "other":  # a pipe, say
        return None
    with files.open(path, "r", encoding="utf-8-sig", newline="") as file:
        if path.endswith(".txt"):
            return [{"run": text} for line in file if (text := line.partition("#")[0].strip())]
        first = file.readline()
        file.seek(0)
        table = csv.DictReader(file, delimiter=max(",;\t", key=first.count))
        columns = [name.strip().lower() for name in table.fieldnames or ()]
        if "run" not in columns:
            if {"unit", "bench"} & {*columns}:
                raise InputError(
                    f"{path}: has no column run: a list names its runs there, beside unit, bench and date."
                )
            return None  # a table of orientations, which is one run itself
        return [dict(zip(columns, (str(cell or "").strip() for cell in row.values()), strict=False)) for row in table]


def _of_list(word: str, files: Any, path: str, lines: list[dict[str, str]]) -> Iterator[ListedRun]:
    """Yield the recordings of a list; what one line names that is not there becomes a run, whose row will say so."""
    folder = _place(files, str(PurePosixPath(path).parent))
    for line in lines:
        name = line["run"]
        if not name:
            continue
        refused = _why_not(name)
        if not refused and "://" not in name and not name.startswith("/"):
            name = f"{folder}/{name}"
        stated: dict[str, Any] = {"unit": line.get("unit") or None, "bench": line.get("bench") or None}
        try:
            stated["date"] = _date(line)
        except InputError as error:
            refused = refused or str(error)
        if name == word or name.endswith(".txt"):
            raise InputError(f"{word}: names the list {name}: a list names recordings, folders and globs only.")
        if refused:
            yield ListedRun(name, refused=f"{word}: {refused}", **stated)
            continue
        try:
            yield from (replace(run, **stated) for run in _named_by(name))
        except InputError:
            yield ListedRun(name, **stated)


def _why_not(name: str) -> str:
    """Why a list may not name this, in words; "" where it may. A list may be a stranger's."""
    shown = ascii(name if len(name) <= _LONGEST else f"{name[:_LONGEST]}...")
    if len(name) > _LONGEST or not name.isprintable():
        return f"{shown} is no name of a recording: write one a line."
    scheme, is_url, _ = name.partition("://")
    if "::" in name or (is_url and scheme.lower() not in _STORES):
        return (
            f"{shown} is not opened: a list names paths and plain addresses in {', '.join(_STORES[:3])}, az or abfs; "
            "name others on the command line."
        )
    return ""


def _date(line: Mapping[str, str]) -> datetime | None:
    """Return the date that a line states, in UTC if it names no time zone."""
    if not (text := line.get("date")):
        return None
    try:
        date = datetime.fromisoformat(text)
    except ValueError:
        raise InputError(f"{text!r} of {line['run']} is no date: write it as 2026-05-31 or with the time.") from None
    return date if date.tzinfo else date.replace(tzinfo=UTC)


_WORDS = pa.list_(pa.string())
_PARAMETER = pa.struct({
    "symbol": pa.string(), "value": pa.float64(), "sigma": pa.float64(), "unit": pa.string(), "nominal": pa.float64(),
})  # fmt: skip
_HYPOTHESIS = pa.struct({"effects": _WORDS, "formula": pa.string(), "probability": pa.float64()})
_FAMILY = pa.struct({"family": pa.string(), "probability": pa.float64()})
_FACTOR = pa.struct({
    "columns": _WORDS, "width": pa.int32(), "upper": pa.list_(pa.float64()), "rows": pa.int64(),
    "constants": pa.list_(pa.struct({"effect": pa.string(), "value": pa.float64()})),
    "nominal": pa.list_(pa.float64()), "noise_estimated": pa.bool_(),
})  # fmt: skip

SCHEMA = pa.schema({
    "run": pa.string(), "unit": pa.string(), "bench": pa.string(), "date": pa.timestamp("ms", "UTC"),
    "error": pa.string(), "sha256": pa.string(), "version": pa.string(), "bytes": pa.int64(), "settings": pa.string(),
    "evaluated": pa.timestamp("us", "UTC"), "cpu_s": pa.float64(), "host": pa.string(),
    "samples": pa.int64(), "dwells": pa.int32(), "orientations": pa.int32(), "model": _WORDS,
    "parameters": pa.list_(_PARAMETER),
    "consistent": pa.bool_(), "p_value": pa.float64(), "nis_per_dof": pa.float64(),
    "residual_rms_mps2": pa.float64(), "held_out_rms_mps2": pa.float64(), "held_out_floor_mps2": pa.float64(),
    "verdict": pa.string(), "missing": pa.string(), "all_missing": _WORDS, "ambiguity_set": _WORDS,
    "hypotheses": pa.list_(_HYPOTHESIS), "families": pa.list_(_FAMILY), "warnings": _WORDS,
    "replay": pa.string(), "diagnosis": pa.string(), "factor": _FACTOR,
})  # fmt: skip
"""Columns of the table, docs/fleet.md says what is in each."""

SENTENCES = ("error", "verdict", "replay", "diagnosis")
"""Columns of text that may say where the recording is."""

Row = dict[str, Any]
_LARGEST = 1e50
"""Of the numbers of a factor: far beyond those of any run, and products of four are numbers still."""
_OF_REPLAY = (
    "samples", "dwells", "orientations", "model", "parameters", "residual_rms_mps2", "held_out_rms_mps2",
    "held_out_floor_mps2", "warnings",
)  # fmt: skip
_OF_DIAGNOSIS = (
    "consistent", "p_value", "verdict", "missing", "all_missing", "ambiguity_set", "hypotheses", "families",
)  # fmt: skip


def of_replay(document: Mapping[str, Any]) -> Row:
    """The columns that come from the JSON document of ``replay``, and the document itself.

    ``consistent`` and ``p_value`` are those of the misfit as a whole until a diagnosis replaces them.
    """
    judged = document["consistency"]
    row: Row = {key: document[key] for key in _OF_REPLAY}
    row |= {"consistent": judged["consistent"], "p_value": judged["p_value"], "nis_per_dof": judged["nis_per_dof"]}
    return row | {"replay": _text(document)}


def of_diagnosis(document: Mapping[str, Any]) -> Row:
    """The columns that come from the JSON document of ``diagnose``, and the document itself."""
    return {key: document[key] for key in _OF_DIAGNOSIS if key in document} | {"diagnosis": _text(document)}


def of_factor(factor: RunFactor) -> Row:
    """The column of the reduced factor: its upper triangle, row by row."""
    return {
        "factor": {
            "columns": list(factor.columns),
            "width": factor.width,
            "upper": factor.factor[np.triu_indices(len(factor.factor))],
            "rows": factor.rows,
            "constants": [{"effect": name, "value": value} for name, value in factor.constants.items()],
            "nominal": factor.nominal,
            "noise_estimated": factor.noise_estimated,
        }
    }


def factor_of(row: Mapping[str, Any]) -> RunFactor | None:
    """The reduced factor from a row as Arrow gives it; None where the run has none, as one that failed."""
    kept, date = row["factor"], row["date"]
    if kept is None:
        return None
    size = len(kept["columns"]) + 1
    upper = np.zeros((size, size))
    upper[np.triu_indices(size)] = np.asarray(kept["upper"])
    return RunFactor(
        row["run"], row["unit"], row["bench"], None if date is None else date.isoformat(timespec="milliseconds"),
        tuple(kept["columns"]), kept["width"], upper,
        kept["rows"], {each["effect"]: each["value"] for each in kept["constants"]}, np.asarray(kept["nominal"]),
        kept["noise_estimated"],
    )  # fmt: skip


def are_whole(factors: pa.StructArray) -> Mask:
    """Which factors (n,) have as many numbers as their columns ask for, none of them absurd; that of a run that failed,
    which has none, counts as whole."""
    lengths = {name: _lengths(factors.field(name)) for name in ("columns", "upper", "nominal", "constants")}
    size, width = lengths["columns"] + 1, factors.field("width").fill_null(-1).to_numpy(zero_copy_only=False)
    right = (lengths["upper"] == size * (size + 1) // 2) & (lengths["nominal"] == len(STATES))
    right &= (lengths["constants"] >= 0) & (width >= 0) & (width < size)
    for name in ("rows", "noise_estimated"):
        right &= factors.field(name).is_valid().to_numpy(zero_copy_only=False)
    for name in ("upper", "nominal"):
        right &= _in_all(factors.field(name), _are_numbers)
    right &= _in_all(factors.field("columns"), _are_there)
    right &= _in_all(
        factors.field("constants"), lambda each: _have(each, ("effect",)) & _are_numbers(each.field("value"))
    )
    return right | factors.is_null().to_numpy(zero_copy_only=False)


def name_their_parameters(lists: pa.ListArray) -> Mask:
    """In which rows (n,) every parameter has symbol, unit and nominal value, and no number is absurd; a run that failed
    has none."""
    return _in_all(lists, lambda each: _have(each, ("symbol", "unit", "nominal"))
                   & _are_numbers(each.field("nominal")) & _are_numbers(each.field("value").fill_null(0.0))
                   & _are_numbers(each.field("sigma").fill_null(0.0)))  # fmt: skip


def _in_all(lists: pa.ListArray, are_right: Callable[[Any], Mask]) -> Mask:
    """Tell in which lists (n,) all elements are right; no list has none."""
    ends = np.concatenate([[0], np.cumsum(np.maximum(_lengths(lists), 0))])
    return np.diff(np.concatenate([[0], np.cumsum(~are_right(lists.flatten()))])[ends]) == 0


def _are_there(values: pa.Array) -> Mask:
    return values.is_valid().to_numpy(zero_copy_only=False)


def _have(structures: pa.StructArray, names: Sequence[str]) -> Mask:
    """Tell which structures (n,) are there and have these fields."""
    return np.logical_and.reduce([_are_there(structures), *(_are_there(structures.field(name)) for name in names)])


def _are_numbers(values: pa.Array) -> Mask:
    """Tell which values (n,) are numbers that a run may have."""
    return np.abs(values.to_numpy(zero_copy_only=False)) < _LARGEST  # that of null is not a number


def _lengths(lists: pa.ListArray) -> NDArray[np.int64]:
    """Return the lengths (n,) of lists, -1 where there is none."""
    return lists.value_lengths().fill_null(-1).to_numpy(zero_copy_only=False).astype(np.int64)


def _text(document: Mapping[str, Any]) -> str:
    return json.dumps(document, ensure_ascii=False, allow_nan=False)
