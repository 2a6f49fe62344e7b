"""Messages that a recorder compressed one by one (``ros2 bag record --compression-mode message``), unpacked."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
import zstandard

from kf_calib.sources.files.mcap_chunks import DamagedError, allowed_sizes, megabytes
from kf_calib.sources.files.mcap_messages import MESSAGE_FIELDS, MESSAGE_RECORD, MessageGroup, RecordBlock

_ZSTD = b"\x28\xb5\x2f\xfd"  # no CDR message begins so


def are_packed(block: RecordBlock, groups: Iterable[MessageGroup]) -> bool:
    """Whether any of these groups of CDR messages is of compressed ones."""
    return any(len(group.at) and block.data.startswith(_ZSTD, int(group.at[0])) for group in groups)


def unpacked(block: RecordBlock, groups: Iterable[MessageGroup], max_size: int) -> tuple[RecordBlock, list[str]]:
    """The block with its messages unpacked, and why those that are lost are. max_size: bytes of one, at most."""
    records, lost = list[bytes](), list[str]()
    for start, size in _in_order(groups):
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


def _in_order(groups: Iterable[MessageGroup]) -> Iterator[tuple[int, int]]:
    yield from sorted((start, group.size) for group in groups for start in group.at.tolist())


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
