"""Which recordings a fleet is of: from files, folders, globs, lists of them, here or in any store that fsspec knows."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import PurePosixPath
from typing import Any

import fsspec
from fsspec.core import url_to_fs
from fsspec.implementations.local import LocalFileSystem

from kf_calib.errors import InputError

_RECORDINGS = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")
_BAG = "metadata.yaml"
_CHANGING = ("size", "mtime", "ETag", "etag", "LastModified", "last_modified", "updated", "md5", "version_id")
"""What stores say of a file that differs when its content does."""


@dataclass(frozen=True)
class Run:
    """One recording, before it is read.

    - place: absolute path, or URL, by which it is known.
    - size: in bytes; 0 where it is not known.
    - version: what its store says of it (size, time, checksum): while this is the same, so is the content.
    - folder: whether it is the folder of a ROS 2 bag.
    - unit, bench, date: what a list says of it; None to take what the recording says itself.
    """

    place: str
    size: int = 0
    version: str = ""
    folder: bool = False
    unit: str | None = None
    bench: str | None = None
    date: datetime | None = None


def runs_of(words: Iterable[str]) -> list[Run]:
    """The recordings that words name, each once, in the order of the words and then of their names.

    A word is a recording, the folder of a bag, a folder of recordings (with all folders in it), a glob, or a list: a
    .txt file with one of these a line, or a .csv file with the column ``run`` and, if known, ``unit``, ``bench`` and
    ``date``. Each may be a URL such as ``s3://bucket/campaign/``. Raises InputError where a word leads to no recording.
    """
    runs = dict[str, Run]()
    for word in words:
        named = list(_named_by(word))
        for run in named:
            runs.setdefault(run.place, run)
        if not named:
            raise InputError(
                f"{word} leads to no recording: name .mcap or .db3 files, folders of them, globs, or a list of these."
            )
    return list(runs.values())


def _named_by(word: str) -> Iterator[Run]:
    """Yield the recordings of one word."""
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
    except (OSError, ValueError, ImportError) as error:
        raise InputError(f"{word}: cannot be looked up ({_in_words(error)}): check the name and the access.") from None


def _in_words(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def _in_listing(files: Any, listing: Mapping[str, Mapping[str, Any]], recordings_only: bool = False) -> Iterator[Run]:
    """Yield the recordings among files with their descriptions, a bag's folder as one."""
    folders = {str(PurePosixPath(name).parent) for name in listing if PurePosixPath(name).name == _BAG}
    for folder in sorted(folders):
        inside = {name: info for name, info in listing.items() if str(PurePosixPath(name).parent) == folder}
        yield _bag(files, folder, inside)
    for name, info in sorted(listing.items()):
        if str(PurePosixPath(name).parent) in folders:
            continue
        if info["type"] == "directory":
            yield from _in_listing(files, files.find(name, detail=True), recordings_only=True)
        elif not recordings_only or name.endswith(_RECORDINGS):
            yield _run(files, name, info)


def _run(files: Any, name: str, info: Mapping[str, Any]) -> Run:
    return Run(_place(files, name), int(info.get("size") or 0), _version(info))


def _bag(files: Any, folder: str, inside: Mapping[str, Mapping[str, Any]]) -> Run:
    versions = "; ".join(_version(inside[name]) for name in sorted(inside))
    return Run(_place(files, folder), sum(int(info.get("size") or 0) for info in inside.values()), versions, True)


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


def _of_list(word: str, files: Any, path: str, lines: list[dict[str, str]]) -> Iterator[Run]:
    """Yield the recordings of a list; what one line names that is not there becomes a run, whose row will say so."""
    folder = _place(files, str(PurePosixPath(path).parent))
    for line in lines:
        name = line["run"]
        if not name:
            continue
        if "://" not in name and not name.startswith("/"):
            name = f"{folder}/{name}"
        stated: dict[str, Any] = {
            "unit": line.get("unit") or None,
            "bench": line.get("bench") or None,
            "date": _date(word, line),
        }
        if name == word or name.endswith(".txt"):
            raise InputError(f"{word}: names the list {name}: a list names recordings, folders and globs only.")
        try:
            yield from (replace(run, **stated) for run in _named_by(name))
        except InputError:
            yield Run(name, **stated)


def _date(word: str, line: Mapping[str, str]) -> datetime | None:
    """Return the date that a line states, in UTC if it names no time zone."""
    if not (text := line.get("date")):
        return None
    try:
        date = datetime.fromisoformat(text)
    except ValueError:
        raise InputError(
            f"{word}: {text!r} of {line['run']} is no date: write it as 2026-05-31 or with the time."
        ) from None
    return date if date.tzinfo else date.replace(tzinfo=UTC)
