"""The files of a recording: one, or those of a ROS 2 bag's folder in the order in which they were written.

What kind of file a part is, is known by its first bytes; one that is compressed as a whole is unpacked.

Decisions of a bench that drives itself, in the metadata of its recording: what was decided, when, and why.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import tempfile
import weakref
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import Protocol, runtime_checkable

import zstandard
from mcap.opcode import Opcode
from mcap.records import Metadata

from kf_calib.errors import InputError, KfCalibError
from kf_calib.sources.files.mcap_file import McapFile, Warn, ignore
from kf_calib.sources.files.mcap_records import (
    DamagedError,
    Integers,
    MessageFinder,
    RecordBlock,
    Summary,
    allowed_sizes,
    parse_record,
)
from kf_calib.support.leaves import leaf
from kf_calib.support.text import cut, number_from

_PIECE = 1 << 20
_USUAL_RATIO = 20  # sizes of a recording unpacked and packed, at most
SQLITE, ROS1_BAG, _ZSTD = b"SQLite format 3\0", b"#ROSBAG V2.0", b"\x28\xb5\x2f\xfd"


class RecordFile(Protocol):
    """A file that gives out its records in blocks; ``trouble`` says what is wrong with its end."""

    path: Path
    size: int
    trouble: str

    @property
    def summary(self) -> Summary | None: ...

    def blocks(self, warn: Warn, *, growing: bool = False) -> Iterator[RecordBlock]: ...

    def record_at(self, position: int, opcode: int) -> bytes: ...


@runtime_checkable
class ListsMessages(Protocol):
    """A file of which messages need not be unpacked to be counted."""

    def receipts(self, warn: Warn) -> Iterator[tuple[int, Integers]]: ...

    def first(self, channel: int) -> bytes: ...


def open_record_file(path: Path, max_chunk: int, usable: frozenset[str]) -> RecordFile:
    """The MCAP or .db3 file at ``path``, or a bag of ROS 1. usable: types of messages wanted, and topics.

    Raises InputError where it is none of these.
    """
    place, said = path, ""
    if first_bytes(path).startswith(_ZSTD):
        place = _unpacked(path, max_chunk)
    elif first_bytes(path).startswith(ROS1_BAG):
        place, said = leaf("bags.ros1_bag", f"{path}, a bag of ROS 1,").mcap_of_bag(path)
    file: RecordFile
    try:
        if first_bytes(place).startswith(SQLITE):
            bags = leaf("bags.sqlite_bag", f"{path}, a bag in SQLite,")
            file = bags.SqliteBag(path, place, usable, max_chunk)
        else:
            file = McapFile(path, max_chunk, place)
    except BaseException:
        if place != path:
            _remove(place)
        raise
    file.trouble = " ".join(filter(None, (file.trouble, said)))
    if place != path:
        weakref.finalize(file, _remove, place)
    return file


def first_bytes(path: Path) -> bytes:
    """By which a recording is told from other files; none where the file cannot be read."""
    try:
        with path.open("rb") as file:
            return file.read(len(SQLITE))
    except OSError:  # said where the file is opened to be read
        return b""


def _remove(place: Path) -> None:
    with suppress(OSError):
        place.unlink()


def _unpacked(path: Path, max_chunk: int) -> Path:
    """A temporary file with what the compressed file holds; as large as a chunk may be, or as compression can
    explain."""
    descriptor, name = tempfile.mkstemp(prefix="kf_calib_", suffix=Path(path.stem).suffix)
    try:
        with os.fdopen(descriptor, "wb") as target, path.open("rb") as packed:
            most = max(max_chunk, _USUAL_RATIO * path.stat().st_size)
            reader = zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True)
            for piece in iter(partial(reader.read, _PIECE), b""):
                if target.tell() + len(piece) > most:
                    raise InputError(
                        f"{path} unpacks to {allowed_sizes(max_chunk)}: unpack it yourself if it is sound (zstd -d), "
                        "or allow more."
                    )
                target.write(piece)
            if not target.tell():
                raise zstandard.ZstdError("it ends before anything of it can be unpacked")
    except BaseException as error:
        Path(name).unlink()
        if isinstance(error, zstandard.ZstdError):
            raise InputError(f"{path} does not decompress ({error}): it is damaged, copy it anew.") from None
        if isinstance(error, OSError):
            raise InputError(
                f"{path} cannot be unpacked to {Path(name).parent} ({error.strerror}): make room there, or let the "
                "variable TMPDIR name another place."
            ) from None
        raise
    return Path(name)


_NUMBERED = re.compile(r"(.*)_(\d+)")
_SHOWN, _LONGEST_NAME = 6, 100  # names in a message, characters of one
_LISTED, _LARGEST_METADATA = "relative_file_paths:", 10_000_000


def files_of(path: Path) -> list[Path]:
    """The MCAP or .db3 files at ``path``, in order of time. Raises InputError where a folder is not one bag of such."""
    if not path.is_dir():
        return [path]
    listed = _files_in_metadata(path / "metadata.yaml")
    lost = [cut(name, _LONGEST_NAME) for name in listed if not _is_file(path / name)]
    if lost:
        names = ", ".join(lost[:_SHOWN]) + " ..." * (len(lost) > _SHOWN)
        raise InputError(
            f"{path} lacks {names}, which its metadata.yaml names: bring the whole bag, or give one of its files."
        )
    files = [path / name for name in listed if _is_part(name)] or _lying_in(path)
    if not files:
        raise InputError(
            f"{path} holds no .mcap and no .db3 file: give the folder of a ROS 2 bag, or one of its files."
        )
    if not listed and len({_place(file)[0] for file in files}) > 1:
        raise InputError(
            f"{path} holds several recordings ({', '.join(file.name for file in files[:_SHOWN])}"
            f"{' ...' * (len(files) > _SHOWN)}) and no metadata.yaml that makes them one: give one of them."
        )
    return files


def _is_file(path: Path) -> bool:
    """Whether there is such a file; a name that no file system allows is of none."""
    try:
        return path.is_file()
    except OSError:
        return False


def _lying_in(path: Path) -> list[Path]:
    """The files of a folder without metadata.yaml; of a file and its compressed copy, the file."""
    files = {file.name: file for file in path.iterdir() if _is_part(file.name) and file.is_file()}
    return sorted((file for name, file in files.items() if name.removesuffix(".zstd") == name
                   or name.removesuffix(".zstd") not in files), key=_place)  # fmt: skip


def _is_part(name: str) -> bool:
    return name.removesuffix(".zstd").endswith((".mcap", ".db3"))


def _place(file: Path) -> tuple[str, int]:
    """The name of the bag that a file is part of, and its number in it."""
    numbered = _NUMBERED.fullmatch(stem := file.name.partition(".")[0])
    return (numbered[1], int(numbered[2])) if numbered else (stem, 0)


def _files_in_metadata(metadata: Path) -> list[str]:
    """The files that a bag's metadata.yaml lists, in order; none where there is no such file."""
    try:
        if not metadata.is_file():
            return []
        with metadata.open(encoding="utf-8", errors="replace") as file:
            lines = file.read(_LARGEST_METADATA).split("\n")
    except OSError:
        return []
    begin = next((k for k, line in enumerate(lines) if line.strip() == _LISTED), len(lines))
    items = takewhile(lambda line: line.startswith("- "), (line.strip() for line in lines[begin + 1 :]))
    return [Path(item[2:].strip().strip("'\"")).name for item in items]


def fingerprint(path: Path) -> str:
    """SHA-256 of a recording, all files of a bag one after the other; raises InputError if it cannot be read."""
    digest = hashlib.sha256()
    try:
        for each in files_of(path):
            with each.open("rb") as file:
                hashlib.file_digest(file, lambda: digest)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}): name a recording.") from None
    return digest.hexdigest()


DECISION_RECORD = "kf_calib.decision"
"""Where something was decided: number, at_s, purpose, gimbal_deg (JSON list), stay_s, why."""
END_RECORD = "kf_calib.drive"
"""After the last decision: ended, why, stands_at_deg (JSON list), stopped, lasted_s."""


def decision_records(path: Path, name: str = DECISION_RECORD) -> list[Mapping[str, str]]:
    """The records of a name in an MCAP file, in their order; none in a file that is none or cannot be read."""
    find, records = MessageFinder(), list[Mapping[str, str]]()
    try:
        for block in McapFile(path).blocks(ignore):
            for opcode, content in find(block).others:
                if opcode == Opcode.METADATA and (record := parse_record(Metadata.read, content)).name == name:
                    records.append(record.metadata)
    except (KfCalibError, OSError, DamagedError):
        return records
    return records


def number_of(record: Mapping[str, str], key: str) -> float:
    """A number of a record; NaN where there is none."""
    try:
        return number_from(record[key])
    except (KeyError, ValueError):
        return math.nan


def angles_of(text: str) -> tuple[float, ...]:
    """The angles of a record, deg; none where the text is no list of numbers."""
    try:
        return tuple(float(angle) for angle in json.loads(text))
    except (TypeError, ValueError, RecursionError):
        return ()
