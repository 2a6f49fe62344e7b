"""Where the chunks of a recording that is being written lie, in few bytes: a run of a day has hundreds of thousands.

The official writer keeps an object of half a kilobyte for each of them until the file is finished.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator

from mcap.records import ChunkIndex
from mcap.writer import Writer

_FIXED, _OFFSET = struct.Struct("<7QB"), struct.Struct("<HQ")


class ChunkIndexes:
    """A sequence of chunk indexes of one compression, as far as the writer uses one: ``append`` and iteration."""

    def __init__(self) -> None:
        self._packed, self._compression = bytearray(), ""

    def append(self, index: ChunkIndex) -> None:
        self._compression = index.compression
        self._packed += _FIXED.pack(
            index.message_start_time, index.message_end_time, index.chunk_start_offset, index.chunk_length,
            index.message_index_length, index.compressed_size, index.uncompressed_size,
            len(index.message_index_offsets),
        )  # fmt: skip
        for channel, offset in index.message_index_offsets.items():
            self._packed += _OFFSET.pack(channel, offset)

    def __iter__(self) -> Iterator[ChunkIndex]:
        at = 0
        while at < len(self._packed):
            start, end, offset, length, indexed, compressed, size, count = _FIXED.unpack_from(self._packed, at)
            at += _FIXED.size
            offsets = dict(_OFFSET.unpack_from(self._packed, at + k * _OFFSET.size) for k in range(count))
            at += count * _OFFSET.size
            yield ChunkIndex(
                chunk_length=length, chunk_start_offset=offset, compression=self._compression,
                compressed_size=compressed, message_end_time=end, message_index_length=indexed,
                message_index_offsets=offsets, message_start_time=start, uncompressed_size=size,
            )  # fmt: skip


def keep_packed(writer: Writer) -> None:
    """Have a writer keep its chunk indexes so."""
    assert not vars(writer)["_Writer__chunk_indices"]
    vars(writer)["_Writer__chunk_indices"] = ChunkIndexes()  # the writer has no call for this
