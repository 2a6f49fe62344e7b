"""A copy of an MCAP file with one more topic: all that was in it stays byte for byte, the new messages follow.

The data section of the original is copied as it is, up to its end; then come chunks with the messages of the new topic,
and a summary that has the original's records and the new ones. Readers find messages by time through the summary.
Messages of one topic have one size, so that a chunk of them is one numpy array: a million take a second or two.

The writer of a ``Recorder`` could not do it: it begins a file and cannot go on with one, as it numbers schemas and
channels from 1 and lists in its summary what it has written itself; and it takes ten times as long.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from pathlib import Path
from typing import IO

import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, DataEnd, Footer, McapRecord, Schema, Statistics, SummaryOffset
from numpy.typing import NDArray

from kf_calib.bench.arrays import Times
from kf_calib.bench.streams import Stream
from kf_calib.errors import InputError
from kf_calib.sources.files import cdr
from kf_calib.sources.files.mcap_file import McapFile
from kf_calib.sources.files.mcap_records import FOOTER_BYTES, HEAD, MAGIC, Summary, parse_record, records_of

_PIECE = 1 << 22
_MESSAGES = 1 << 14  # in a chunk
_NO_TIMES = np.empty(0, np.int64)
_GROUPS = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS, Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX,
           Opcode.METADATA_INDEX)  # fmt: skip


class TopicAppender:
    """A copy of ``source`` in the open file ``out``, to which messages of a new topic are added; ``finish`` ends it.

    kind, template: what a message is (``cdr``). on_progress: told the share of the original that is copied. Raises
    InputError where the source was not finished or is damaged, or has the topic already.
    """

    def __init__(
        self,
        source: McapFile,
        file: IO[bytes],
        topic: str,
        kind: cdr.MessageType,
        template: bytes,
        on_progress: Callable[[float], None] | None = None,
    ) -> None:
        if (summary := source.summary) is None:
            raise InputError(
                f"{source.trouble} Make a finished copy of it first: kf-calib record {source.path.name} whole.mcap."
            )
        self._out, self._topic = file, topic
        self._layout = kind.layout(template)
        self._crc = self._position = 0
        self._groups = dict[int, list[bytes]]({opcode: [] for opcode in _GROUPS})
        self._statistics = Statistics(0, 0, {}, 0, 0, 0, 0, 0, 0)
        self._read_summary(source, summary)
        self._channel = self._new_channel(source, summary, kind)
        self._count, self._waiting = 0, Stream.empty(self._layout.width)
        self._records = self._blank_records(template)
        self._copy(source, summary.start - len(_bytes(DataEnd(0))), on_progress)
        self._put_chunk(b"".join(self._defined))

    def add(self, stream: Stream) -> None:
        """Add a message for each sample; raises InputError where a stamp does not fit a message."""
        self._waiting += stream
        while len(self._waiting) >= _MESSAGES:
            self._put_messages(self._waiting[:_MESSAGES])
            self._waiting = self._waiting[_MESSAGES:]

    def finish(self) -> None:
        """Write what waits, and the end of the file; the file itself stays open."""
        if len(self._waiting):
            self._put_messages(self._waiting)
        self._put(_bytes(DataEnd(self._crc)))
        start = self._position
        self._groups[Opcode.STATISTICS] = [_bytes(self._statistics)]
        offsets, section = list[bytes](), 0
        for opcode in _GROUPS:
            group = b"".join(self._groups[opcode])
            if group:
                offsets.append(_bytes(SummaryOffset(opcode, self._position, len(group))))
                section = self._put(group, section)
        offset_start = self._position
        for each in offsets:
            section = self._put(each, section)
        footer = _bytes(Footer(start, offset_start, 0))
        self._put(footer[:-4] + zlib.crc32(footer[:-4], section).to_bytes(4, "little"))
        self._put(MAGIC)

    def _read_summary(self, source: McapFile, summary: Summary) -> None:
        """Take the records of the original's summary as they are; its statistics are counted on."""
        with source.open() as file:
            file.seek(summary.start)
            section = file.read(source.size - summary.start - FOOTER_BYTES)
        for opcode, content in records_of(section):
            if opcode == Opcode.STATISTICS:
                self._statistics = parse_record(Statistics.read, content)
            elif opcode in self._groups:
                self._groups[opcode].append(HEAD.pack(opcode, len(content)) + content)

    def _new_channel(self, source: McapFile, summary: Summary, kind: cdr.MessageType) -> int:
        """Return the number of the new channel; its definition goes into the data section and the summary."""
        topic, channels, schemas = self._topic, summary.channels, summary.schemas
        if any(channel.topic == topic for channel in channels):
            raise InputError(f"{source.path} has a topic {topic} already: take the one it was made from.")
        numbers = {channel.id for channel in channels}, {schema.id for schema in schemas}
        channel_id, schema = (next(k for k in range(1, 1 << 16) if k not in taken) for taken in numbers)
        definition = Schema(id=schema, data=kind.schema.encode(), encoding="ros2msg", name=kind.name)
        channel = Channel(id=channel_id, topic=topic, message_encoding="cdr", metadata={}, schema_id=schema)
        self._defined = _bytes(definition), _bytes(channel)
        self._groups[Opcode.SCHEMA].append(self._defined[0])
        self._groups[Opcode.CHANNEL].append(self._defined[1])
        self._statistics.schema_count += 1
        self._statistics.channel_count += 1
        return channel_id

    def _copy(self, source: McapFile, end: int, on_progress: Callable[[float], None] | None) -> None:
        """Copy the original up to ``end``, where the record begins that ends its data section."""
        with source.open() as file:
            while self._position < end:
                piece = file.read(min(_PIECE, end - self._position))
                if not piece:
                    raise InputError(f"{source.path} became shorter while it was read: read it when it is at rest.")
                self._put(piece)
                if on_progress is not None:
                    on_progress(self._position / end)
            if HEAD.unpack(file.read(HEAD.size))[0] != Opcode.DATA_END:
                raise InputError(
                    f"{source.path} is damaged before byte {end}: make a whole copy of it first: kf-calib record "
                    f"{source.path.name} whole.mcap."
                )

    def _put_messages(self, stream: Stream) -> None:
        """Write one chunk of messages; ``_records`` is used again for each, as little in it changes."""
        records, count = self._records[: len(stream)], len(stream)
        records["sequence"] = np.arange(self._count, self._count + count)
        records["log_time"] = records["publish_time"] = stream.time_ns
        try:
            cdr.fill(records["message"], stream)
        except cdr.MessageError as error:
            raise InputError(f"{self._topic} cannot be written: {error}.") from None
        self._put_chunk(records.view("u1").data, stream.time_ns)
        self._count += count

    def _blank_records(self, template: bytes) -> NDArray[np.void]:
        """Return as many records of messages as a chunk has, without what differs between them."""
        message = ("message", cdr.dtype_of(self._layout))
        kind = np.dtype([("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"),
                         ("log_time", "<u8"), ("publish_time", "<u8"), message])  # fmt: skip
        blank = np.zeros(1, kind)
        blank["opcode"], blank["length"] = Opcode.MESSAGE, kind.itemsize - HEAD.size
        blank["channel"] = self._channel
        record = blank.tobytes()[: -len(template)] + template
        return np.frombuffer(bytearray(record * _MESSAGES), kind)

    def _put_chunk(self, data: bytes | memoryview, times: Times = _NO_TIMES) -> None:
        """Write a chunk, with the index of its messages, of one size, if it has any; the summary has it, too."""
        start, count = self._position, len(times)
        first, last = (int(times.min()), int(times.max())) if count else (0, 0)
        packed = zstandard.ZstdCompressor(level=1).compress(data)
        self._put(_bytes(Chunk("zstd", packed, last, first, zlib.crc32(data), len(data))))
        length, offsets, statistics = self._position - start, dict[int, int](), self._statistics
        statistics.chunk_count += 1
        if count:
            offsets[self._channel] = self._position
            rows = np.column_stack([times, np.arange(count) * (len(data) // count)]).astype("<u8")
            content = self._channel.to_bytes(2, "little") + rows.nbytes.to_bytes(4, "little") + rows.tobytes()
            self._put(HEAD.pack(Opcode.MESSAGE_INDEX, len(content)) + content)
            counts, earliest = statistics.channel_message_counts, statistics.message_start_time
            counts[self._channel] = counts.get(self._channel, 0) + count
            statistics.message_start_time = min(earliest, first) if statistics.message_count else first
            statistics.message_end_time = max(statistics.message_end_time, last)
            statistics.message_count += count
        index = ChunkIndex(length, start, "zstd", len(packed), last, self._position - start - length, offsets, first,
                           len(data))  # fmt: skip
        self._groups[Opcode.CHUNK_INDEX].append(_bytes(index))

    def _put(self, data: bytes, section: int = 0) -> int:
        """Write bytes, keep the checksum of all so far, and return that of a section continued by them."""
        self._out.write(data)
        self._crc, self._position = zlib.crc32(data, self._crc), self._position + len(data)
        return zlib.crc32(data, section)


def _bytes(record: McapRecord) -> bytes:
    """Return a record as it lies in a file."""
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


def source_file(path: Path) -> McapFile:
    """The file of a recording that consists of one; raises InputError for the folder of a bag."""
    if path.is_dir():
        raise InputError(f"{path} is the folder of a bag: give one .mcap file of it, or join them first.")
    return McapFile(path)
