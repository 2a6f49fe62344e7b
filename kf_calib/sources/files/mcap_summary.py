"""The summary at the end of a finished MCAP file."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, field
from typing import IO

from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, MetadataIndex, Schema, Statistics

from kf_calib.sources.files.mcap_chunks import (
    DamagedError,
    parse,
)
from kf_calib.sources.files.mcap_messages import HEAD, MAGIC

_FOOTER = struct.Struct("<BQQQI")  # opcode, length, start of the summary, of its offsets, CRC
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
        footer_start = size - _FOOTER.size - len(MAGIC)
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
        position = 0
        while position < len(content):
            opcode, record, position = _record_at(content, position)
            match opcode:
                case Opcode.SCHEMA:
                    self.schemas.append(parse(Schema.read, record))
                case Opcode.CHANNEL:
                    self.channels.append(parse(Channel.read, record))
                case Opcode.CHUNK_INDEX:
                    self.chunks.append(parse(ChunkIndex.read, record))
                case Opcode.METADATA_INDEX:
                    self.metadata.append(parse(MetadataIndex.read, record))
                case Opcode.STATISTICS:
                    self.message_counts = parse(Statistics.read, record).channel_message_counts
                case _:
                    pass
        self.chunks.sort(key=lambda index: index.chunk_start_offset)


def _record_at(data: bytes, position: int) -> tuple[int, bytes, int]:
    if position + HEAD.size > len(data):
        raise DamagedError("a record has no room for its head")
    opcode, length = HEAD.unpack_from(data, position)
    start = position + HEAD.size
    if start + length > len(data):
        raise DamagedError("a record ends outside its section")
    return opcode, data[start : start + length], start + length
