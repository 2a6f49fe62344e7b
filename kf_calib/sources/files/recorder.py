"""Writes batches to an MCAP recording (docs/format.md) that survives its writer being killed at any moment."""

from __future__ import annotations

import math
import os
import struct
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import IO

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Schema
from mcap.writer import Writer

from kf_calib.bench.bench import Bench
from kf_calib.bench.raw_input import CONVERTED
from kf_calib.bench.streams import Batch, Stream
from kf_calib.errors import InputError, KfCalibError
from kf_calib.sources.files import cdr
from kf_calib.sources.files.contents import (
    ACCEL_TOPIC,
    ANGLES_TOPIC,
    ATTITUDE_TOPIC,
    BENCH_RECORD,
    CHECKSUM_KEY,
    TEMPERATURE_TOPIC,
    bench_checksum,
)
from kf_calib.sources.files.fields import Joints, gimbal_names
from kf_calib.sources.files.mcap_file import McapFile, ignore
from kf_calib.sources.files.mcap_records import HEAD, MAGIC, MessageFinder
from kf_calib.support.output_files import Growing, refuse_output

_REPEAT_BYTES = 1 << 26
"""So far apart, at most, topics and bench are written again; a few kB each time."""
_END = (  # of a file without a summary: all fields are zero
    HEAD.pack(Opcode.DATA_END, 4) + bytes(4) + HEAD.pack(Opcode.FOOTER, 20) + bytes(20) + MAGIC
)


class Recorder(AbstractContextManager["Recorder"]):
    """An open recording of ``bench``; a context manager that finishes the file.

    An earlier file of that name (``overwrite``) stays till the first readings are on the disk; a failure before that
    leaves it as it was, and no file where there was none.
    flush_s: a write that comes this long (wall clock) after the last one brought to the disk is brought there too.
    chunk_size: bytes of readings packed into one chunk at most. background: the disk is waited for in a thread of its
    own, and what it refuses is told by the next call.
    Raises InputError where the file exists (unless ``overwrite``) or cannot be made, KfCalibError where it cannot be
    written on; the file is then finished without a summary, and what was written till then stays readable.
    """

    def __init__(
        self,
        path: str | PathLike[str],
        bench: Bench,
        *,
        flush_s: float = 1.0,
        chunk_size: int = 1 << 20,
        overwrite: bool = False,
        background: bool = False,
    ) -> None:
        self.path = Path(path)
        self.readings = 0
        """Readings written."""
        self.flushed = 0
        """Of these, readings in whole chunks of the file, which survive this process."""
        self.size = 0
        """Bytes of the file with whole chunks; another reader sees them."""
        self.synced_s = time.monotonic()
        """When what the disk is known to hold was written (``time.monotonic``)."""
        self._place = Growing(self.path)
        self._file: IO[bytes] | None = self._create(overwrite)
        self._flush_s = flush_s
        self._flushed_s = self.synced_s
        self._disk = ThreadPoolExecutor(1, "disk") if background else None
        self._pending: Future[None] | None = None
        self._writer = Writer(self._file, chunk_size=chunk_size, enable_data_crcs=True)
        keep_packed(self._writer)
        self._joints = bench.joints or gimbal_names(len(bench.axes))
        self._channels = (
            _Channel(ACCEL_TOPIC, cdr.IMU, cdr.imu_message("accelerometer")),
            _Channel(ANGLES_TOPIC, cdr.JOINT_STATE, cdr.joint_state_message("platform", self._joints))
            if bench.axes
            else _Channel(ATTITUDE_TOPIC, cdr.QUATERNION, cdr.quaternion_message("platform")),
            _Channel(TEMPERATURE_TOPIC, cdr.TEMPERATURE, cdr.temperature_message("accelerometer")),
        )
        self._head: float = math.inf  # bytes of the file before the first reading
        metadata = bench.to_metadata() | ({} if bench.input.is_plain else {CONVERTED: "true"})
        self._described = metadata | {CHECKSUM_KEY: bench_checksum(metadata)}
        with self._storing():
            self._writer.start(profile="ros2")
            self._writer.add_metadata(BENCH_RECORD, self._described)
            for channel in self._channels[: 1 + bench.angles]:  # even a recording without samples says what it is
                channel.register(self._writer)
            self._sync()
        self._head = self._repeated_at = self.size

    def write(self, batch: Batch) -> None:
        """Adds the samples of ``batch``, the streams merged by their stamps. Raises InputError where they do not fit.

        Each stream keeps the order in which it came: a stamp that jumps back is evidence, and stays where it is.
        """
        streams = (batch.accel, batch.pose, batch.temperature)
        messages: list[bytes] = []
        ids: list[int] = []
        for channel, stream in zip(self._channels, streams, strict=True):
            if len(stream):
                messages += self._pack(channel, stream)
                ids += [channel.register(self._writer)] * len(stream)
        stamps = np.concatenate([stream.time_ns for stream in streams])
        reached = np.concatenate([np.maximum.accumulate(stream.time_ns) for stream in streams])
        order = np.argsort(reached, kind="stable")
        with self._storing():
            self._repeat_when_due()
            for i, stamp in zip(order.tolist(), stamps[order].tolist(), strict=True):
                self._writer.add_message(ids[i], log_time=stamp, data=messages[i], publish_time=stamp)
            self.readings += len(batch.accel)
            self._sync_when_due()

    def tick(self) -> None:
        """To be called while nothing comes to be written: what was written last is brought to the disk when due."""
        with self._storing():
            self._sync_when_due()

    def flush(self) -> int:
        """Ends the chunk at hand; the bytes up to which another reader sees the file."""
        with self._storing():
            self._flush()
        return self.size

    def mark(self, name: str, facts: Mapping[str, str]) -> None:
        """Puts a metadata record among the samples, after those written so far."""
        with self._storing():
            self._flush()
            self._writer.add_metadata(name, dict(facts))
            self._flush()
            if not self.readings:
                self._head = self.size

    def end_dwell(self) -> None:
        """Brings all samples so far to the disk: they are safe when this returns."""
        with self._storing():
            self._sync()

    def read_back(self, start: int, end: int) -> Iterator[Batch]:
        """What was written between two sizes that the file had after a ``flush``, as a replay gives it."""
        find, joints = MessageFinder(), Joints(len(self._joints), self._joints)
        decoders = [cdr.Decoder(channel.kind, channel.width, joints) for channel in self._channels]
        for block in McapFile(self._place.at).blocks(ignore, start, end):
            streams = [Stream.empty(channel.width) for channel in self._channels]
            for group in find(block).groups:
                k = next(k for k, channel in enumerate(self._channels) if channel.id == group.channel)
                streams[k] += decoders[k](block.data, group.at, group.size)
            yield Batch(*streams)

    def close(self) -> None:
        """Finishes the file. A second call does nothing."""
        if self._file is None:
            return
        with self._storing():
            self._flush()
            self._writer.finish()
            self._file.flush()
            self._wait()
            os.fsync(self._file.fileno())
            self._file.close()
            self._place.settle()
            self._file, self.flushed = None, self.readings
        if self._disk:
            self._disk.shutdown()

    def finish(self) -> None:
        """Finishes a file that holds readings; where none has come, leaves no file, and an earlier one as it was."""
        if self._file is None or self.readings:
            self.close()
            return
        file, self._file = self._file, None
        if self._disk:
            self._disk.shutdown()
        with suppress(OSError):
            file.close()
        self._place.discard()

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.close()
        else:
            self.finish()

    def _create(self, overwrite: bool) -> IO[bytes]:
        refuse_output(self.path, overwrite)
        try:
            return self._place.open()
        except OSError as error:
            raise InputError(f"{self.path} cannot be created ({error.strerror}): choose another place.") from error

    def _pack(self, channel: _Channel, stream: Stream) -> list[bytes]:
        try:
            return cdr.pack(channel.kind, channel.template, stream)
        except cdr.MessageError as error:
            raise InputError(f"samples for {channel.topic} do not fit into {self.path}: {error}.") from error

    def _repeat_when_due(self) -> None:
        """Topics and bench once more in a file that has become twice as long, or longer by 64 MiB: of a file without
        an end, they are all that says what its messages are, and damage to one place must not lose them."""
        size = self._file.tell() if self._file else 0
        if size >= min(2 * self._repeated_at, self._repeated_at + _REPEAT_BYTES):
            self._writer.add_metadata(BENCH_RECORD, self._described)
            for channel in self._channels:
                channel.repeat(self._writer)
            self._repeated_at = size

    def _sync_when_due(self) -> None:
        if time.monotonic() - self._flushed_s >= self._flush_s:
            self._sync()

    def _flush(self) -> None:
        if self._file is not None:
            self._writer.flush()
            self.size, self.flushed = self._file.tell(), self.readings
            if self.readings and not self._place.settled:
                os.fsync(self._file.fileno())
                self._place.settle()

    def _sync(self) -> None:
        if self._file is None:
            return
        self._flush()
        self._flushed_s = time.monotonic()
        if self._disk is None:
            self._bring(self._file.fileno(), self._flushed_s)
        elif self._pending is None or self._pending.done():  # else the disk is slow: the next time is soon
            self._wait()
            self._pending = self._disk.submit(self._bring, self._file.fileno(), self._flushed_s)

    def _bring(self, descriptor: int, written_s: float) -> None:
        os.fsync(descriptor)
        self.synced_s = written_s

    def _wait(self) -> None:
        """Waits for the disk; raises what it refused."""
        pending, self._pending = self._pending, None
        if pending:
            pending.result()

    @contextmanager
    def _storing(self) -> Iterator[None]:
        """Gives the file up on any failure in here: the chunk in hand may be half there, what precedes it is whole."""
        if self._file is None:
            raise KfCalibError(f"{self.path} is closed: nothing more can be recorded in it.")
        try:
            yield
        except BaseException as error:
            file, self._file = self._file, None
            if self._disk:
                wait([self._pending] if self._pending else [])
                self._disk.shutdown()
            with suppress(OSError):  # what is left in its buffer fails again
                file.close()
            kept = self._keep_intact_part(isinstance(error, OSError))
            if isinstance(error, OSError):
                raise KfCalibError(f"{self.path} cannot be written on ({error.strerror}): {kept}.") from error
            raise

    def _keep_intact_part(self, is_full: bool) -> str:
        """Keeps what is whole of a file that was given up, where anything is, and says so."""
        size = 0
        with suppress(OSError):  # then it stays as it is, and readable all the same
            size = self._place.at.stat().st_size
            size = self.size = _finish(self._place.at) if is_full else size
        with suppress(OSError):
            if size <= self._head:
                self._place.discard()
                return "nothing was recorded; make room and begin anew"
            self._place.settle()
        return "it holds what was recorded till then; make room and record the rest into a new file"


def _finish(path: Path) -> int:
    """Cuts a file behind its last whole record and ends it there: that takes less room than it makes."""
    with path.open("r+b") as file:
        size, whole = file.seek(0, os.SEEK_END), len(MAGIC)
        while whole + HEAD.size <= size:
            file.seek(whole)
            end = whole + HEAD.size + HEAD.unpack(file.read(HEAD.size))[1]
            if end > size:
                break
            whole = end
        file.truncate(whole)
        file.seek(whole)
        file.write(_END)
        return whole


@dataclass
class _Channel:
    topic: str
    kind: cdr.MessageType
    template: bytes
    id: int = 0
    schema: int = 0

    @property
    def width(self) -> int:
        return self.kind.layout(self.template).width

    def register(self, writer: Writer) -> int:
        """The channel's number in the file, made known there on first use."""
        if not self.id:
            self.schema = writer.register_schema(self.kind.name, "ros2msg", self.kind.schema.encode())
            self.id = writer.register_channel(self.topic, "cdr", self.schema)
        return self.id

    def repeat(self, writer: Writer) -> None:
        """Makes a channel that is known in the file known there again, in the chunk at hand."""
        if self.id:  # the writer has no call for this: to register again is to make another channel
            chunk = vars(writer)["_Writer__chunk_builder"]
            chunk.add_schema(Schema(self.schema, self.kind.schema.encode(), "ros2msg", self.kind.name))
            chunk.add_channel(Channel(self.id, self.topic, "cdr", {}, self.schema))


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
