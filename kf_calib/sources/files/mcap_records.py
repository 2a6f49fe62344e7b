"""Records of an MCAP file: chunks with their heads and what they unpack to, bounded in size; the messages in a block of
them, found by array operations rather than by walking from one to the next; the summary at the end of a finished file.
"""

from __future__ import annotations

import re
import struct
import zlib
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from typing import IO, Any, TypeVar

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, MetadataIndex, Schema, Statistics
from numpy.typing import DTypeLike, NDArray

MAX_CHUNK_MB = 256.0
"""A chunk that unpacks to more is passed over: recorders write some MB, and a few kB of zeros claim a GB."""
CHUNK = struct.Struct("<QQQII")  # first and last time, size and CRC uncompressed, length of the compression's name
_PACKED_HEADS = tuple(struct.pack("<I", len(name)) + name for name in (b"zstd", b"lz4"))
_Record = TypeVar("_Record")


class DamagedError(Exception):
    """A stretch of the file is not what MCAP says it must be; the text says how."""


class _ExactStream(ReadDataStream):
    def read(self, length: int) -> bytes:
        data = super().read(length)
        if len(data) != length:
            raise EndOfFile
        return data


def parse_record(read: Callable[[ReadDataStream], _Record], content: bytes) -> _Record:
    """The record in ``content``; ``read`` is its class's reader. Raises DamagedError unless it fits exactly."""
    stream = _ExactStream(BytesIO(content))
    try:
        record = read(stream)
    except (McapError, struct.error, ValueError) as error:
        raise DamagedError("a record does not parse") from error
    if stream.count != len(content):
        raise DamagedError("a record is longer than what it holds")
    return record


def unpack_chunk(content: bytes, max_chunk: int) -> bytes:
    """The records in the content of a chunk record. Raises DamagedError where size or checksum do not fit."""
    _, _, size, crc, _ = CHUNK.unpack_from(content)
    start = packed_start(content)
    if not start:
        raise DamagedError("its lengths contradict each other")
    if size > max_chunk:
        raise DamagedError(f"it claims to hold {megabytes(size)} MB, {allowed_sizes(max_chunk)}")
    data = _decompress(content[CHUNK.size : start - 8], content[start:], size)
    if len(data) != size:
        raise DamagedError(f"it holds {len(data)} bytes in place of {size}")
    if crc and zlib.crc32(data) != crc:
        raise DamagedError("its checksum does not fit")
    return data


def packed_start(content: bytes) -> int:
    """Where the packed records begin in the content of a chunk record; 0 where its lengths contradict each other."""
    start = CHUNK.size + CHUNK.unpack_from(content)[-1] + 8
    fits = start <= len(content) and int.from_bytes(content[start - 8 : start], "little") == len(content) - start
    return start if fits else 0


def megabytes(size: int) -> str:
    return f"{size / (1 << 20):.0f}"


def allowed_sizes(max_chunk: int) -> str:
    return f"more than the {megabytes(max_chunk)} MB that --max-chunk-mb allows"


def _decompress(compression: bytes, data: bytes, size: int) -> bytes:
    try:
        match compression:
            case b"":
                return data
            case b"zstd":
                if zstandard.frame_content_size(data) not in (-1, size):  # the frame's claim is what gets allocated
                    raise DamagedError("its sizes contradict each other")
                return zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
            case b"lz4":
                return lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
            case _:
                raise DamagedError(f"its compression {compression.decode(errors='replace')!r} is not known")
    except (zstandard.ZstdError, RuntimeError, MemoryError) as error:
        raise DamagedError("it does not decompress") from error


def chunk_heads(piece: bytes) -> Iterator[int]:
    """Where heads of packed chunks begin in ``piece``, ascending: opcode, name and both lengths agree."""
    before = HEAD.size + CHUNK.size - 4
    places = sorted(hit.start() - before for head in _PACKED_HEADS for hit in re.finditer(re.escape(head), piece))
    for at in places:
        if at < 0 or piece[at] != Opcode.CHUNK:
            continue
        name = piece[at + before]  # the length of the name, one byte of it
        rest = at + HEAD.size + CHUNK.size + name + 8
        length = HEAD.unpack_from(piece, at)[1]
        if int.from_bytes(piece[rest - 8 : rest], "little") == length - (rest - at - HEAD.size):
            yield at


MAGIC = b"\x89MCAP0\r\n"
HEAD = struct.Struct("<BQ")  # opcode, length of the content
MESSAGE_FIELDS = 22  # channel u16, sequence u32, log time u64, publish time u64; then the message itself
MESSAGE_RECORD = struct.Struct("<BQHIQQ")  # head and fields of a message's record
_LOG_TIME_BEFORE = 16  # bytes before the message itself
Integers = NDArray[np.int64]
_MOST_KINDS = 16  # of record heads; beyond that, searching for them costs more than walking
_FEW_OTHERS = 256  # among messages that are found all at once
_MOST_OTHERS = 1 << 17  # records of a block that are no messages: every schema and channel there can be


@dataclass(frozen=True)
class RecordBlock:
    """Records of the file as they lie in it: what some chunks hold, and what lies outside chunks, joined together.

    borders: bytes of ``data`` where its parts end, ascending, the last one its size; damage does not spread over them.
    index: bytes of ``data`` where messages start, if the file's index is right: no checksum of a chunk covers it.
    end: byte of the file up to which it has been read.
    """

    data: bytes
    borders: tuple[int, ...]
    index: Integers
    end: int


@dataclass(frozen=True)
class MessageGroup:
    """Messages of one channel and one length: byte of the block where each starts (n,), bytes that each takes."""

    channel: int
    at: Integers
    size: int


@dataclass(frozen=True)
class Messages:
    """What a block holds: messages, opcode and content of other records, and how many bytes make no sense."""

    groups: list[MessageGroup]
    others: list[tuple[int, bytes]]
    lost: int


_MESSAGE = int(Opcode.MESSAGE)  # a plain int: comparing a whole block with an enum would widen it first
_LEAST_MESSAGE = HEAD.size + MESSAGE_FIELDS
_SPARSE = 16  # bytes to one with a message's opcode, at least: of random bytes it is one of 256
_HEADS = np.dtype([("opcode", "u1"), ("length", "<i8"), ("channel", "<u2")])
_CHANNEL_SHIFT, _LENGTH_SHIFT = 8, 24


class MessageFinder:
    """Finds the messages of block after block.

    Where records may start is known from the file's index, or is every byte with a message's opcode. Of these are kept
    the ones whose head (length and channel) was met before, all at once. They are right if each record ends where
    the next begins, from the block's first byte to its last; if not, the block is walked through record by record.
    """

    def __init__(self) -> None:
        self._known: list[int] = []

    def __call__(self, block: RecordBlock) -> Messages:
        data, borders = block.data, block.borders
        return (
            self._chain(data, block.index, borders)
            or self._chain(data, _candidates(data), borders)
            or self._walk(data, borders)
        )

    def _chain(self, data: bytes, start: Integers, borders: tuple[int, ...]) -> Messages | None:
        """The messages, if all of them are among the records at ``start`` (ascending), and between them are at most a
        few whole records of other kinds."""
        start = start[np.searchsorted(start, 0) : np.searchsorted(start, len(data) - _LEAST_MESSAGE, side="right")]
        if not self._known or not len(start):
            return None
        kind = _kinds(data, start)
        masks = [kind == known for known in self._known]
        found = np.logical_or.reduce(masks)
        first, end = start[found], start[found] + HEAD.size + (kind[found] >> _LENGTH_SHIFT)
        begins, ends = np.append(0, end), np.append(first, len(data))
        if np.any(begins > ends):
            return None
        others: list[tuple[int, bytes]] = []
        for gap in np.flatnonzero(begins != ends).tolist():
            between = _others(data, int(begins[gap]), int(ends[gap]), borders)
            if between is None or len(others) > _FEW_OTHERS:
                return None
            others += between
        groups = [_group(known, start[mask]) for known, mask in zip(self._known, masks, strict=True)]
        return Messages(groups, others, lost=0)

    def _walk(self, data: bytes, borders: tuple[int, ...]) -> Messages:
        starts: list[int] = []
        others: list[tuple[int, bytes]] = []
        position = lost = 0
        for border in borders:
            while position < border:
                opcode, length = HEAD.unpack_from(data, position) if position + HEAD.size <= border else (0, 0)
                content = position + HEAD.size
                if not opcode or content + length > border or (opcode == _MESSAGE and length < MESSAGE_FIELDS):
                    lost += border - position
                    break
                if opcode == _MESSAGE:
                    starts.append(position)
                elif len(others) < _MOST_OTHERS:
                    others.append((opcode, data[content : content + length]))
                else:
                    lost += border - position
                    break
                position = content + length
            position = border
        start = np.array(starts, np.int64)
        kind = _kinds(data, start)
        kinds: list[int] = np.unique(kind).tolist()
        self._known = sorted({*self._known, *kinds})
        if len(self._known) > _MOST_KINDS:
            self._known = []
        return Messages([_group(known, start[kind == known]) for known in kinds], others, lost)


def _others(data: bytes, begin: int, end: int, borders: tuple[int, ...]) -> list[tuple[int, bytes]] | None:
    """The records from one byte to another; None where one of them is a message or no whole record of its part."""
    others: list[tuple[int, bytes]] = []
    while begin < end:
        opcode, length = HEAD.unpack_from(data, begin) if begin + HEAD.size <= end else (0, 0)
        content = begin + HEAD.size
        begin, border = content + length, borders[bisect_right(borders, begin)]
        if opcode in (0, _MESSAGE) or begin > min(end, border) or len(others) > _FEW_OTHERS:
            return None
        others.append((opcode, data[content:begin]))
    return others


def _candidates(data: bytes) -> Integers:
    """Bytes with a message's opcode; none where far too many have it to be worth looking at."""
    has_opcode = np.frombuffer(data, np.uint8) == _MESSAGE
    is_sparse = np.count_nonzero(has_opcode) <= len(data) // _SPARSE
    return np.flatnonzero(has_opcode) if is_sparse else np.empty(0, np.int64)


def at_every_byte(data: bytes, dtype: DTypeLike) -> NDArray[Any]:
    """What would stand at each byte if it began there, as a view."""
    kind = np.dtype(dtype)
    return np.ndarray((max(len(data) - kind.itemsize + 1, 0),), kind, data, strides=(1,))


def log_times(data: bytes, at: Integers) -> Integers:
    """When the messages of a block that start at these bytes were received, ns, as its records say."""
    received = at_every_byte(data, "<u8")[at - _LOG_TIME_BEFORE]
    return np.minimum(received, np.iinfo(np.int64).max).astype(np.int64)


def _kinds(data: bytes, start: Integers) -> Integers:
    """Opcode, channel and length of the records at ``start`` in one number each."""
    heads = at_every_byte(data, f"V{_HEADS.itemsize}")[start].view(_HEADS)
    channel = heads["channel"].astype(np.int64) << _CHANNEL_SHIFT
    return (heads["length"] << _LENGTH_SHIFT) | channel | heads["opcode"]


def _group(kind: int, start: Integers) -> MessageGroup:
    channel, length = (kind >> _CHANNEL_SHIFT) & 0xFFFF, kind >> _LENGTH_SHIFT
    return MessageGroup(channel, start + _LEAST_MESSAGE, length - MESSAGE_FIELDS)


_ZSTD = b"\x28\xb5\x2f\xfd"  # no CDR message begins so


def are_packed(block: RecordBlock, groups: Iterable[MessageGroup]) -> bool:
    """Whether any of these groups of CDR messages is of compressed ones."""
    return any(len(group.at) and block.data.startswith(_ZSTD, int(group.at[0])) for group in groups)


def unpacked(block: RecordBlock, groups: Iterable[MessageGroup], max_size: int) -> tuple[RecordBlock, list[str]]:
    """The block with its messages unpacked, and why those that are lost are. max_size: bytes of one, at most."""
    records, lost = list[bytes](), list[str]()
    for start, size in sorted((start, group.size) for group in groups for start in group.at.tolist()):
        opcode, _, *fields = MESSAGE_RECORD.unpack_from(block.data, start - MESSAGE_RECORD.size)
        try:
            message = _unpack(block.data[start : start + size], max_size)
        except DamagedError as damage:
            lost.append(str(damage))
            continue
        records.append(MESSAGE_RECORD.pack(opcode, MESSAGE_FIELDS + len(message), *fields) + message)
    starts = np.cumsum([0, *map(len, records)])[:-1].astype(np.int64)
    data = b"".join(records)
    return RecordBlock(data, (len(data),), starts, block.end), lost


def _unpack(data: bytes, max_size: int) -> bytes:
    if not data.startswith(_ZSTD):
        return data
    try:
        size = zstandard.frame_content_size(data)
        if size > max_size:
            raise DamagedError(f"one claims to hold {megabytes(size)} MB, {allowed_sizes(max_size)}")
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=max_size if size < 0 else 0)
    except (zstandard.ZstdError, MemoryError):
        raise DamagedError("they do not decompress") from None


_FOOTER = struct.Struct("<BQQQI")  # opcode, length, start of the summary, of its offsets, CRC
FOOTER_BYTES = _FOOTER.size + len(MAGIC)
_SUMMARY_LIMIT = 1 << 28


@dataclass
class Summary:
    """What the end of a finished file tells of the whole; ``start`` is the byte where that end begins."""

    start: int
    schemas: list[Schema] = field(default_factory=list[Schema])
    channels: list[Channel] = field(default_factory=list[Channel])
    chunks: list[ChunkIndex] = field(default_factory=list[ChunkIndex])
    metadata: list[MetadataIndex] = field(default_factory=list[MetadataIndex])
    message_counts: dict[int, int] = field(default_factory=dict[int, int])

    @classmethod
    def read(cls, file: IO[bytes], size: int) -> Summary:
        """The summary of a file of ``size`` bytes. Raises DamagedError where there is none or it is not whole."""
        footer_start = size - FOOTER_BYTES
        if footer_start < len(MAGIC):
            raise DamagedError("it has no footer")
        file.seek(footer_start)
        footer, magic = file.read(_FOOTER.size), file.read(len(MAGIC))
        opcode, length, start, _, crc = _FOOTER.unpack(footer)
        if magic != MAGIC or (opcode, length) != (Opcode.FOOTER, _FOOTER.size - HEAD.size):
            raise DamagedError("it has no footer")
        start = start or footer_start
        if not footer_start - _SUMMARY_LIMIT <= start <= footer_start or start < len(MAGIC):
            raise DamagedError("its footer is damaged")
        file.seek(start)
        content = file.read(footer_start - start)
        if crc and zlib.crc32(footer[:-4], zlib.crc32(content)) != crc:
            raise DamagedError("the checksum of its summary does not fit")
        summary = cls(start)
        summary._fill(content)
        return summary

    def _fill(self, content: bytes) -> None:
        for opcode, record in records_of(content):
            match opcode:
                case Opcode.SCHEMA:
                    self.schemas.append(parse_record(Schema.read, record))
                case Opcode.CHANNEL:
                    self.channels.append(parse_record(Channel.read, record))
                case Opcode.CHUNK_INDEX:
                    self.chunks.append(parse_record(ChunkIndex.read, record))
                case Opcode.METADATA_INDEX:
                    self.metadata.append(parse_record(MetadataIndex.read, record))
                case Opcode.STATISTICS:
                    self.message_counts = parse_record(Statistics.read, record).channel_message_counts
                case _:
                    pass
        self.chunks.sort(key=lambda index: index.chunk_start_offset)


def records_of(section: bytes) -> Iterator[tuple[int, bytes]]:
    """Opcode and content of each record. Raises DamagedError where one is not whole."""
    end = 0
    while end < len(section):
        start = end + HEAD.size
        if start > len(section):
            raise DamagedError("a record has no room for its head")
        opcode, length = HEAD.unpack_from(section, end)
        end = start + length
        if end > len(section):
            raise DamagedError("a record ends outside its section")
        yield opcode, section[start:end]
