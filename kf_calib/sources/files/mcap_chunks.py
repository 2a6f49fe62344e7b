"""Chunks of an MCAP file: their heads, and what they unpack to, bounded in size."""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable, Iterator
from io import BytesIO
from typing import TypeVar

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode

from kf_calib.sources.files.mcap_messages import HEAD

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


def parse(read: Callable[[ReadDataStream], _Record], content: bytes) -> _Record:
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


def chunk_times(content: bytes) -> tuple[int, int]:
    """First and last time in the first bytes of a chunk's content; no times at all where they are not there."""
    return struct.unpack("<QQ", content) if len(content) == 16 else (1, 0)
