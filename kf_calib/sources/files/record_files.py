"""What kind of file a part of a recording is, by its first bytes; one that is compressed as a whole is unpacked."""

from __future__ import annotations

import os
import tempfile
import weakref
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import IO, Protocol

import zstandard

from kf_calib.errors import InputError
from kf_calib.sources.files.mcap_chunks import allowed_sizes
from kf_calib.sources.files.mcap_file import McapFile, Warn
from kf_calib.sources.files.mcap_messages import RecordBlock
from kf_calib.sources.files.mcap_summary import Summary
from kf_calib.sources.files.sqlite_bag import SqliteBag

_USUAL_RATIO = 20  # sizes of a recording unpacked and packed, at most
_SQLITE, _ZSTD = b"SQLite format 3\0", b"\x28\xb5\x2f\xfd"


class RecordFile(Protocol):
    """A file that gives out its records in blocks; ``trouble`` says what is wrong with its end."""

    path: Path
    size: int
    trouble: str

    @property
    def summary(self) -> Summary | None: ...

    def blocks(self, warn: Warn, *, growing: bool = False) -> Iterator[RecordBlock]: ...

    def record_at(self, position: int, opcode: int) -> bytes: ...


def open_record_file(path: Path, max_chunk: int, usable: frozenset[str]) -> RecordFile:
    """The MCAP or .db3 file at ``path``. usable: types of messages wanted, and topics.

    Raises InputError where it is neither.
    """
    place = path
    if _head(path).startswith(_ZSTD):
        place = _unpacked(path, max_chunk)
    file: RecordFile
    try:
        if _head(place).startswith(_SQLITE):
            file = SqliteBag(path, place, usable, max_chunk)
        else:
            file = McapFile(path, max_chunk, place)
    except BaseException:
        _remover(place, path)()
        raise
    weakref.finalize(file, _remover(place, path))
    return file


def _head(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(len(_SQLITE))
    except OSError:  # said where the file is opened to be read
        return b""


def _remover(place: Path, path: Path) -> Callable[[], None]:
    """Removes what was unpacked, where anything was."""

    def remove() -> None:
        if place != path:
            with suppress(OSError):
                place.unlink()

    return remove


class _Bounded:
    """A file that holds no more than so many bytes."""

    def __init__(self, file: IO[bytes], most: int) -> None:
        self._file, self._left = file, most

    def write(self, data: bytes) -> int:
        self._left -= len(data)
        if self._left < 0:
            raise _TooLargeError
        return self._file.write(data)


class _TooLargeError(Exception):
    pass


def _unpacked(path: Path, max_chunk: int) -> Path:
    """A temporary file with what the compressed file holds; as large as a chunk may be, or as compression can
    explain."""
    descriptor, name = tempfile.mkstemp(prefix="kf_calib_", suffix=Path(path.stem).suffix)
    try:
        with os.fdopen(descriptor, "wb") as target, path.open("rb") as packed:
            bounded = _Bounded(target, max(max_chunk, _USUAL_RATIO * path.stat().st_size))
            _, written = zstandard.ZstdDecompressor().copy_stream(packed, bounded)  # pyright: ignore[reportArgumentType]
            if not written:
                raise zstandard.ZstdError("it ends before anything of it can be unpacked")
    except BaseException as error:
        Path(name).unlink()
        if isinstance(error, _TooLargeError):
            raise InputError(
                f"{path} unpacks to {allowed_sizes(max_chunk)}: unpack it yourself if it is sound (zstd -d), or allow "
                "more."
            ) from None
        if isinstance(error, zstandard.ZstdError):
            raise InputError(f"{path} does not decompress ({error}): it is damaged, copy it anew.") from None
        if isinstance(error, OSError):
            raise InputError(
                f"{path} cannot be unpacked to {Path(name).parent} ({error.strerror}): make room there, or let the "
                "variable TMPDIR name another place."
            ) from None
        raise
    return Path(name)
