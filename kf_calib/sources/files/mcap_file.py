"""An MCAP file read in bulk: whole chunks of records, whatever state the file is in.

A file is a sequence of records (opcode u8, length u64, content), most of them packed into chunks with a checksum.
A recorder that was killed leaves no footer; a failing disk flips bits. Everything whole is read, everything lost is
told in one sentence through ``warn``. Where the summary at the file's end is whole (it has a checksum of its own), its
list of chunks leads past damage; without it the next chunk is known by its head. Memory is that of a few blocks, or of
one chunk where that is larger: what claims to unpack to more than is allowed is passed over.
"""

from __future__ import annotations

import struct
import zlib
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Header, Metadata, Schema

from kf_calib.errors import InputError
from kf_calib.sources.files.mcap_records import (
    CHUNK,
    HEAD,
    MAGIC,
    MAX_CHUNK_MB,
    MESSAGE_FIELDS,
    DamagedError,
    RecordBlock,
    Summary,
    allowed_sizes,
    chunk_heads,
    megabytes,
    packed_start,
    parse_record,
    unpack_chunk,
)

Warn = Callable[[str], None]


def ignore(said: str) -> None:
    """A ``Warn`` where nothing can be lost, or what is lost is told another time."""


_BLOCK = 1 << 22  # smaller chunks are joined: every block costs some hundred microseconds besides its messages
_PIECE = 1 << 20
_AHEAD = 2 * _BLOCK  # bytes unpacked and not yet asked for
_LONGEST_SPAN_S = 1e7  # a longer one is damage itself
_TIMES = struct.Struct("<QQ")  # first and last, with which a chunk begins

# What may stand in the data section, with the least length of its content
_LEAST: dict[int, int] = {
    Opcode.HEADER: 8, Opcode.SCHEMA: 14, Opcode.CHANNEL: 16, Opcode.MESSAGE: MESSAGE_FIELDS, Opcode.CHUNK: 40,
    Opcode.MESSAGE_INDEX: 6, Opcode.ATTACHMENT: 36, Opcode.METADATA: 8, Opcode.DATA_END: 4,
}  # fmt: skip
_PARSED: dict[int, Callable[[ReadDataStream], object]] = {
    Opcode.HEADER: Header.read, Opcode.SCHEMA: Schema.read, Opcode.CHANNEL: Channel.read,
    Opcode.METADATA: Metadata.read,
}  # fmt: skip
_FIRST_PRIVATE_OPCODE = 0x80
_NOTHING_YET = -1  # in place of an opcode: the next record of a growing file is not whole


class McapFile:
    """An MCAP file on disk. ``summary`` is None where the file's end is missing or damaged: ``trouble`` says so.

    max_chunk: bytes that a chunk may take, packed or unpacked. place: where the file lies, if not at ``path``, which
    messages name.
    """

    def __init__(self, path: Path, max_chunk: int = int(MAX_CHUNK_MB * (1 << 20)), place: Path | None = None) -> None:
        self.path = path
        self._place = place or path
        self.max_chunk = max_chunk
        self.summary: Summary | None = None
        self.trouble = ""
        with self.open() as file:
            self.size = file.seek(0, 2)
            file.seek(0)
            if not self.size:
                raise InputError(f"{path} is empty: nothing was recorded in it.")
            head = file.read(HEAD_BYTES)
            if not head.startswith(MAGIC):
                raise InputError(advice(path, head))
            try:
                self.summary = Summary.read(file, self.size)
            except DamagedError as damage:
                self.trouble = f"{path} was not finished or has lost its end ({damage}): what is whole in it is used."

    def open(self) -> IO[bytes]:
        try:
            return self._place.open("rb")
        except FileNotFoundError:
            raise InputError(f"{self.path} does not exist: check the path.") from None
        except IsADirectoryError:
            raise InputError(f"{self.path} is a directory: give a .mcap file in it.") from None
        except OSError as error:
            raise InputError(f"{self.path} cannot be read ({error.strerror}): check its permissions.") from error

    def record_at(self, position: int, opcode: int) -> bytes:
        """The content of the record at byte ``position``. Raises DamagedError where there is none of that opcode."""
        with self.open() as file:
            file.seek(min(position, self.size))
            head = file.read(HEAD.size).ljust(HEAD.size, b"\x00")
            found, length = HEAD.unpack(head)
            if found != opcode or length > self.size - position - HEAD.size:
                raise DamagedError("a record is not where it should be")
            return file.read(length)

    def blocks(
        self, warn: Warn, start: int = 0, end: int | None = None, growing: bool = False
    ) -> Iterator[RecordBlock]:
        """Every whole stretch of records, from the start; ``warn`` is told what is lost. Raises InputError.

        start, end: bytes between which whole records lie, where not all are wanted. growing: the file is being written;
        an empty block means that no further record is whole yet.
        """
        with self.open() as file:
            walk = _Walk(self, file, warn, start, end, growing)
            try:
                yield from map(walk.unpack, walk.parcels()) if growing else _ahead(walk.unpack, walk.parcels())
            except OSError as error:
                raise InputError(f"{self.path} cannot be read ({error.strerror}): check its medium.") from error
            walk.compare_checksum()


@dataclass
class _Parcel:
    """Records (start, opcode, content) taken from the file to become one block of ``size`` bytes."""

    records: list[tuple[int, int, bytes]] = field(default_factory=list[tuple[int, int, bytes]])
    size: int = 0
    end: int = 0


def _ahead(unpack: Callable[[_Parcel], RecordBlock], parcels: Iterable[_Parcel]) -> Iterator[RecordBlock]:
    """``map(unpack, parcels)``, some MB ahead in a thread: unpacking and checksums leave the interpreter free."""
    with ThreadPoolExecutor(max_workers=1) as worker:
        coming: deque[tuple[int, Future[RecordBlock]]] = deque()
        for parcel in parcels:
            coming.append((parcel.size, worker.submit(unpack, parcel)))
            while sum(size for size, _ in coming) > _AHEAD:
                yield coming.popleft()[1].result()
        while coming:
            yield coming.popleft()[1].result()


class _Walk:
    """One passage through the data section, keeping the checksum of all that it passed."""

    def __init__(
        self, mcap: McapFile, file: IO[bytes], warn: Warn, start: int = 0, end: int | None = None, growing: bool = False
    ) -> None:
        self.path = mcap.path
        self.max_chunk = mcap.max_chunk
        self.growing = growing
        self.file = file
        self.warn = warn
        self.end = end or (mcap.summary.start if mcap.summary else file.seek(0, 2))
        self.chunks = {index.chunk_start_offset: index for index in mcap.summary.chunks} if mcap.summary else {}
        self.chunk_starts = sorted(start for start in self.chunks if start < self.end)
        self.indexed = mcap.summary is not None
        self.position = file.seek(start)
        self.crc = self.crc_before_end = self.stated_crc = 0
        self.whole = not start  # nothing lost so far
        self.unchecked = False  # readings were passed that no chunk's checksum covers
        self.next_chunk = 0  # found by its head; nothing before it is one
        if not start:
            self._take(len(MAGIC))

    def parcels(self) -> Iterator[_Parcel]:
        parcel = _Parcel()
        for start, opcode, content in self._records():
            stated = CHUNK.unpack_from(content)[2] if opcode == Opcode.CHUNK else len(content)
            size = stated if stated <= self.max_chunk else 0  # a chunk of more is passed over
            is_full = bool(parcel.records) and parcel.size + size > _BLOCK and opcode != Opcode.MESSAGE_INDEX
            if opcode == _NOTHING_YET or is_full:
                yield parcel
                parcel = _Parcel()
            if opcode not in (Opcode.HEADER, _NOTHING_YET):
                parcel.records.append((start, opcode, content))
                parcel.size += size
                parcel.end = self.position
        if parcel.records:
            yield parcel

    def unpack(self, parcel: _Parcel) -> RecordBlock:
        parts: list[bytes] = []
        borders = [0]
        index = [np.empty(0, np.int64)]
        for start, opcode, content in parcel.records:
            if opcode == Opcode.MESSAGE_INDEX:  # it follows its chunk, and counts from the chunk's start
                index.append(np.frombuffer(content[6:], "<i8")[1::2] + borders[max(len(parts) - 1, 0)])
                continue
            part = self._unpack_chunk(start, content) if opcode == Opcode.CHUNK else self._loose(opcode, content)
            parts.append(part)
            borders.append(borders[-1] + len(part))
        data = parts[0] if len(parts) == 1 else b"".join(parts)
        return RecordBlock(data, tuple(borders[1:]), np.sort(np.concatenate(index), kind="stable"), parcel.end)

    def compare_checksum(self) -> None:
        """Checks what lies outside chunks, once all has been read and unpacked."""
        if self.stated_crc and self.whole and self.crc_before_end != self.stated_crc:
            self.warn(
                f"{self.path}: data section CRC mismatch although all chunks are whole, so something between "
                "them is damaged: check the bench's description."
            )
        if self.unchecked and not self.stated_crc:
            self.warn(f"{self.path} carries no checksums of its readings: damage in it would pass unnoticed.")

    def _records(self) -> Iterator[tuple[int, int, bytes]]:
        """Start, opcode and content of record after record; attachments and kinds not known are passed over."""
        while self.growing or self.position < self.end:
            if self.growing and not self._has_come():
                yield self.position, _NOTHING_YET, b""
                continue
            start, limit, crc = self.position, self._limit(), self.crc
            head = self._take(min(HEAD.size, limit - start))
            opcode, length = HEAD.unpack(head.ljust(HEAD.size, b"\x00"))
            if not self._plausible(start, opcode, length, limit):
                self._lose(start, opcode, limit)
                continue
            if opcode == Opcode.ATTACHMENT or opcode >= _FIRST_PRIVATE_OPCODE or length > self.max_chunk + _PIECE:
                self._pass_over(opcode, length)
                continue
            content = self._take(length)
            if opcode == Opcode.DATA_END:
                self.crc_before_end, self.stated_crc = crc, int.from_bytes(content[:4], "little")
                return
            if not _consistent(opcode, content):
                self.whole = False
                if opcode in (Opcode.HEADER, Opcode.MESSAGE_INDEX):
                    what = f"the record at byte {start} is damaged"
                    self.warn(f"{self.path}: {what}: its {length} bytes are passed over.")
                else:
                    yield start, opcode, content  # whoever wants it tells what is lost
                if not self.indexed:  # its length may be what is damaged
                    self._go_to(min(self._chunk_after(start), self.position))
                continue
            yield start, opcode, content

    def _has_come(self) -> bool:
        """Whether the record at the present position is whole, or will never be."""
        self.end = self.file.seek(0, 2)
        self.file.seek(self.position)
        head = self.file.read(HEAD.size)
        self.file.seek(self.position)
        if len(head) < HEAD.size:
            return False
        opcode, length = HEAD.unpack(head)
        return length > self.max_chunk + _PIECE or not opcode or self.position + HEAD.size + length <= self.end

    def _take(self, length: int) -> bytes:
        data = self.file.read(length)
        if len(data) != length:
            raise InputError(f"{self.path} became shorter while it was read: read it again when it is at rest.")
        self.crc = zlib.crc32(data, self.crc)
        self.position += length
        return data

    def _limit(self) -> int:
        """Where the record at the present position must have ended: at the next chunk known of, or the end."""
        later = bisect_right(self.chunk_starts, self.position)
        return self.chunk_starts[later] if later < len(self.chunk_starts) else self.end

    def _plausible(self, start: int, opcode: int, length: int, limit: int) -> bool:
        if start in self.chunks and (opcode, length + HEAD.size) != (Opcode.CHUNK, self.chunks[start].chunk_length):
            return False
        known = opcode >= _FIRST_PRIVATE_OPCODE or length >= _LEAST.get(opcode, length + 1)
        return known and start + HEAD.size + length <= limit

    def _pass_over(self, opcode: int, length: int) -> None:
        start = self.position - HEAD.size
        if opcode == Opcode.CHUNK:
            what = f"the chunk at byte {start} takes {megabytes(length)} MB, {allowed_sizes(self.max_chunk)}"
            self.warn(f"{self.path}: {what}: it is passed over.")
        elif opcode != Opcode.ATTACHMENT:
            self.warn(f"{self.path}: the record of kind {opcode} at byte {start} ({length} bytes) is passed over.")
        for taken in range(0, length, _PIECE):
            self._take(min(_PIECE, length - taken))

    def _lose(self, start: int, opcode: int, limit: int) -> None:
        """Goes on at ``limit``, or the next chunk: nothing tells where the record at ``start`` ends."""
        self.whole = False
        index, times = self.chunks.get(start), self.file.read(_TIMES.size) if opcode == Opcode.CHUNK else b""
        if index:
            span = _span(index.message_start_time, index.message_end_time)
        else:
            span = _span(*_TIMES.unpack(times)) if len(times) == _TIMES.size else ""
        resumed = limit if self.indexed else self._chunk_after(start)
        count = resumed - start
        if self.indexed or resumed < limit:
            self.warn(f"{self.path} is damaged at byte {start}: {count} bytes{span} are lost.")
        elif opcode in _LEAST or count < HEAD.size:
            self.warn(f"{self.path} breaks off in a record: the {count} bytes{span} from byte {start} on are lost.")
        else:
            self.warn(f"{self.path} is damaged at byte {start}: the {count} bytes from there to its end are lost.")
        self._go_to(resumed)

    def _go_to(self, position: int) -> None:
        self.position = self.file.seek(position)

    def _chunk_after(self, start: int) -> int:
        """Where the first packed chunk behind ``start`` begins, by all of its head; the end where there is none."""
        if self.next_chunk > start:
            return self.next_chunk
        overlap = HEAD.size + CHUNK.size + 4 + 8  # the longest head
        place, self.next_chunk = start + 1, self.end
        while place < self.end and self.next_chunk == self.end:
            self.file.seek(place)
            piece = self.file.read(min(_PIECE + overlap, self.end - place))
            ends = ((place + at, place + at + HEAD.size + HEAD.unpack_from(piece, at)[1]) for at in chunk_heads(piece))
            self.next_chunk = next((start for start, end in ends if end <= self.end), self.end)
            place += _PIECE
        return self.next_chunk

    def _loose(self, opcode: int, content: bytes) -> bytes:
        self.unchecked |= opcode == Opcode.MESSAGE
        return HEAD.pack(opcode, len(content)) + content

    def _unpack_chunk(self, start: int, content: bytes) -> bytes:
        first_ns, last_ns, _, crc, _ = CHUNK.unpack_from(content)
        self.unchecked |= crc == 0
        try:
            return unpack_chunk(content, self.max_chunk)
        except DamagedError as damage:
            self.whole = False
            lost = f"its {len(content)} bytes{_span(first_ns, last_ns)} are lost"
            self.warn(f"{self.path}: the chunk at byte {start} is damaged ({damage}): {lost}.")
            return b""


def _consistent(opcode: int, content: bytes) -> bool:
    """Whether a record is as long as what it holds; of loose messages, nothing in them tells."""
    if opcode == Opcode.MESSAGE_INDEX:
        size = len(content) - 6
        return int.from_bytes(content[2:6], "little") == size and size % 16 == 0
    if opcode == Opcode.CHUNK:
        return bool(packed_start(content))
    try:
        return opcode not in _PARSED or bool(parse_record(_PARSED[opcode], content))
    except DamagedError:
        return False


def _span(first_ns: int, last_ns: int) -> str:
    seconds = (last_ns - first_ns) / 1e9
    return f", about {seconds:.3g} s of readings," if 0 <= seconds < _LONGEST_SPAN_S else ""


_GZIP = b"\x1f\x8b"
HEAD_BYTES = 1024
"""Bytes from its start by which a file is known."""


def advice(path: Path, head: bytes) -> str:
    """What a file is that begins with ``head``, and how to make a recording of it."""
    if is_lines(head):
        made = path.with_suffix(".mcap") if path.suffix != ".mcap" else path.with_name(f"{path.stem}_recorded.mcap")
        return (
            f"{path} is not an MCAP file, it holds lines of text: evaluate them as they are, by `kf-calib replay "
            f"{path}`, or record them, by `kf-calib record {made} {path}`, and give {made}."
        )
    if head.startswith(_GZIP):
        return f"{path} is packed by gzip, in which only lines of text are read: unpack it first, by `gunzip`."
    return (
        f"{path} is not an MCAP file (its first bytes differ): give one, or have kf-calib record make one of CSV or "
        "JSON lines."
    )


def is_lines(head: bytes) -> bool:
    """JSON lines, or a table."""
    text = head.decode("utf-8-sig", errors="replace")[:-1]  # the last character may be cut
    first = text.lstrip().partition("\n")[0]
    is_printed = "\ufffd" not in text and not any(c < " " and c not in "\t\r\n\f" for c in text)
    return is_printed and (first[:1] in ("{", "[") or any(c in text for c in ",;\t") or len(first.split()) > 2)
