"""A recording (MCAP file, FORMAT.md) as a source of batches, one a chunk.

Topics are found by their schema. What is whole in a damaged or unfinished file is used, what is lost is told in
``warnings``. Sample time is ``header.stamp``. Memory is that of a few chunks, however long the recording.
"""

from __future__ import annotations

import math
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from types import MappingProxyType

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Metadata, Schema

from kf_calib.bench import Bench
from kf_calib.errors import BenchError, InputError
from kf_calib.samples import Batch, Source, Stream
from kf_calib.sources.cdr import IMU, JOINT_STATE, QUATERNION, TEMPERATURE, CdrError, Decoder, MessageType
from kf_calib.sources.mcap_file import Block, DamagedError, McapFile, MessageFinder, Messages, Warn, parse

BENCH_RECORD = "kf_calib.bench"
CHECKSUM_KEY = "crc32"
"""Key of the bench record with the checksum of the others: gravity and axes lie outside every chunk's CRC."""

GAP_RECORD = "kf_calib.gap"
"""Metadata record at a place where the link to the bench was down: after_ns, seconds, reason."""

ACCEL_TOPIC = "/accelerometer"
ANGLES_TOPIC = "/platform/angles"
ATTITUDE_TOPIC = "/platform/attitude"
TEMPERATURE_TOPIC = "/temperature"


def bench_checksum(metadata: Mapping[str, str]) -> str:
    """CRC-32 in hexadecimal of keys and values, sorted, each ended by NUL; the checksum's own key is left out."""
    text = "".join(f"{key}\0{value}\0" for key, value in sorted(metadata.items()) if key != CHECKSUM_KEY)
    return f"{zlib.crc32(text.encode()):08x}"


@dataclass(frozen=True)
class _Role:
    """What a topic is wanted for. ``preferred`` topics win, in this order, where several have a fitting schema."""

    quantity: str
    option: str
    kinds: tuple[MessageType, ...]
    preferred: tuple[str, ...]

    def kind(self, schema: str) -> MessageType | None:
        """The message type of that schema name, if this role can use it; older names lack the ``msg/``."""
        return next((kind for kind in self.kinds if schema in (kind.name, kind.name.replace("/msg/", "/"))), None)

    @property
    def schemas(self) -> str:
        return " or ".join(kind.name for kind in self.kinds)


_ACCEL = _Role("accelerometer", "--accel-topic", (IMU,), (ACCEL_TOPIC,))
_POSE = _Role("angle or attitude", "--pose-topic", (JOINT_STATE, QUATERNION), (ANGLES_TOPIC, ATTITUDE_TOPIC))
_TEMPERATURE = _Role("temperature", "--temperature-topic", (TEMPERATURE,), (TEMPERATURE_TOPIC,))


@dataclass
class _Contents:
    """Topics of a file and its bench's description, as far as they have been met."""

    path: Path
    schemas: dict[int, Schema] = field(default_factory=dict[int, Schema])
    channels: dict[int, Channel] = field(default_factory=dict[int, Channel])
    bench: dict[str, str] | None = None
    bench_damaged: bool = False

    def add(self, opcode: int, content: bytes, warn: Warn) -> None:
        """Takes note of a record that is not a message."""
        try:
            match opcode:
                case Opcode.SCHEMA:
                    schema = parse(Schema.read, content)
                    self.schemas.setdefault(schema.id, schema)
                case Opcode.CHANNEL:
                    channel = parse(Channel.read, content)
                    self.channels.setdefault(channel.id, channel)
                case Opcode.METADATA:
                    self._add_metadata(content)
                case _:
                    pass
        except DamagedError:
            warn(f"{self.path}: a record that describes a topic or the bench is damaged and not used.")

    def _add_metadata(self, content: bytes) -> None:
        try:
            record = parse(Metadata.read, content)
        except DamagedError:
            self.bench_damaged |= self.bench is None
            raise
        if record.name == BENCH_RECORD and self.bench is None:
            stated = record.metadata.pop(CHECKSUM_KEY, None)
            self.bench_damaged = stated is not None and stated != bench_checksum(record.metadata)
            self.bench = {} if self.bench_damaged else record.metadata

    def topics(self, role: _Role) -> list[str]:
        """Topics with a schema that ``role`` can use, in the order of the file."""
        fitting = [channel.topic for channel in self.channels.values() if role.kind(self._schema(channel))]
        return list(dict.fromkeys(fitting))

    def ids(self, topic: str) -> list[int]:
        return [channel.id for channel in self.channels.values() if channel.topic == topic]

    def choose(self, role: _Role, wanted: str | None) -> str | None:
        """The topic to use for ``role``, None where there is none. Raises InputError where the choice is not clear."""
        candidates = self.topics(role)
        for topic in role.preferred if wanted is None else (wanted,):
            if topic in candidates:
                return topic
        if wanted is not None:
            raise InputError(
                f"{self.path} has no {role.quantity} topic {wanted!r}, it has {self}: give one of schema "
                f"{role.schemas} by {role.option}."
            )
        if len(candidates) > 1:
            raise InputError(
                f"{self.path} has several {role.quantity} topics, {', '.join(candidates)}: choose one by {role.option}."
            )
        return candidates[0] if candidates else None

    def kind(self, role: _Role, topic: str) -> MessageType:
        """What the messages of a chosen topic are. Raises InputError where they are not encoded as in ROS 2."""
        channel = self.channels[self.ids(topic)[0]]
        schema = self.schemas[channel.schema_id]
        kind = role.kind(schema.name)
        if kind is None or channel.message_encoding != "cdr" or schema.encoding not in ("ros2msg", "ros2idl"):
            raise InputError(
                f"{self.path}: topic {topic} has {channel.message_encoding!r} messages with a schema {schema.name} in "
                f"{schema.encoding!r}, only 'cdr' with 'ros2msg' can be read: convert the file to ROS 2 first."
            )
        return kind

    def _schema(self, channel: Channel) -> str:
        schema = self.schemas.get(channel.schema_id)
        return schema.name if schema else "no schema"

    def __str__(self) -> str:
        topics = {channel.topic: self._schema(channel) for channel in self.channels.values()}
        return ", ".join(f"{topic} ({schema})" for topic, schema in topics.items()) or "no topics"


class Recording:
    """A recording as a ``Source``: iterating reads it from its start.

    overrides: bench metadata keys (FORMAT.md) that win over those in the file.
    accel_scale: factor on the readings, one for all or one a sensor (9.80665 for a file in g).
    accel_topic, pose_topic, temperature_topic: which to use where the file has several of the kind.
    Raises InputError where the file, or what it holds, cannot be used.
    """

    def __init__(
        self,
        path: str | PathLike[str],
        overrides: Mapping[str, str] = MappingProxyType({}),
        accel_scale: float | tuple[float, float, float] = 1.0,
        *,
        accel_topic: str | None = None,
        pose_topic: str | None = None,
        temperature_topic: str | None = None,
    ) -> None:
        self.path = Path(path)
        self.fraction = 0.0
        self._scale = np.asarray(accel_scale, float)
        self._wanted = {_ACCEL: accel_topic, _POSE: pose_topic, _TEMPERATURE: temperature_topic}
        self._file = McapFile(self.path)
        self.warnings = [self._file.trouble] if self._file.trouble else []
        self._contents = self._survey()
        self._accel = self._require(_ACCEL, "convert the readings to sensor_msgs/msg/Imu")
        self._pose = self._require(_POSE, "record the angles too, as sensor_msgs/msg/JointState by the same clock")
        self._contents.choose(_TEMPERATURE, temperature_topic)  # optional, but not to be guessed
        self.bench = self._describe_bench(overrides)
        self._opening_warnings = len(self.warnings)

    def __iter__(self) -> Iterator[Batch]:
        return self._batches(growing=False)

    def following(self) -> Iterator[Batch]:
        """The batches of a file that is being written, from its start; an empty one: nothing more has come yet."""
        return self._batches(growing=True)

    def _batches(self, growing: bool) -> Iterator[Batch]:
        del self.warnings[self._opening_warnings :]
        self.fraction = 0.0
        passage = _Passage(self._contents, self.warnings.append)
        accel = passage.track(_ACCEL, self._accel, 3)
        pose = passage.track(_POSE, self._pose, self.bench.pose_width)
        temperature = None
        for block in self._file.blocks(self.warnings.append, growing=growing):
            messages = passage.find(block)
            if not temperature and (topic := self._contents.choose(_TEMPERATURE, self._wanted[_TEMPERATURE])):
                temperature = passage.track(_TEMPERATURE, topic, 1)
            readings = accel.read(block, messages)
            batch = Batch(
                Stream(readings.time_ns, readings.values * self._scale),
                pose.read(block, messages),
                temperature.read(block, messages) if temperature else Stream.empty(1),
            )
            self.fraction = math.nan if growing else min(block.end / self._file.size, 1.0)
            if growing or len(batch.accel) or len(batch.pose) or len(batch.temperature):
                yield batch
        self.fraction = 1.0
        passage.account(self._file.summary.message_counts if self._file.summary else {})

    def _survey(self) -> _Contents:
        """Topics and bench: from the summary, else by reading on until no better choice of topics can come."""
        contents, summary = _Contents(self.path), self._file.summary
        if summary:
            contents.schemas = {schema.id: schema for schema in summary.schemas}
            contents.channels = {channel.id: channel for channel in summary.channels}
            for index in summary.metadata:
                if index.name == BENCH_RECORD and contents.bench is None:
                    self._look_up_bench(contents, index.offset)
        lists_topics = bool(contents.channels and contents.schemas)
        if lists_topics and (contents.bench is not None or contents.bench_damaged):
            return contents
        find = MessageFinder()
        for block in self._file.blocks(warn=_ignore):
            for opcode, content in find(block).others:
                contents.add(opcode, content, warn=_ignore)
            if lists_topics or self._is_settled(contents):
                break
        return contents

    def _is_settled(self, contents: _Contents) -> bool:
        for role, wanted in self._wanted.items():
            sought = role.preferred if wanted is None else (wanted,)
            is_optional = role is _TEMPERATURE and wanted is None
            if not is_optional and not set(sought) & set(contents.topics(role)):
                return False
        return True

    def _look_up_bench(self, contents: _Contents, position: int) -> None:
        try:
            contents.add(Opcode.METADATA, self._file.record_at(position, Opcode.METADATA), warn=_ignore)
        except DamagedError:
            contents.bench_damaged = True

    def _require(self, role: _Role, advice: str) -> str:
        topic = self._contents.choose(role, self._wanted[role])
        if topic is None:
            state = " and is not whole" if self._file.trouble else ""
            raise InputError(
                f"{self.path} has no {role.quantity} topic ({role.schemas}), it has {self._contents}{state}: {advice}."
            )
        return topic

    def _describe_bench(self, overrides: Mapping[str, str]) -> Bench:
        contents = self._contents
        damage = f"{self.path}: the description of the bench in it is damaged"
        if contents.bench_damaged:
            self.warnings.append(f"{damage}: only what options give is used.")
        has_angles = contents.kind(_POSE, self._pose) is JOINT_STATE
        try:
            return Bench.from_metadata({**(contents.bench or {}), **overrides}, has_angles)
        except BenchError as error:
            where = f"{damage}, so give it by options" if contents.bench_damaged else str(self.path)
            raise BenchError(f"{where}: {error}") from error


def opened(source: Source | str | PathLike[str]) -> Source:
    """The source itself, or the recording at a path."""
    return Recording(source) if isinstance(source, str | PathLike) else source


class _Passage:
    """One reading of a file from its start, with the account of the messages met."""

    def __init__(self, contents: _Contents, warn: Warn) -> None:
        self.contents = contents
        self.warn = warn
        self._find = MessageFinder()
        self._tracks: list[_Track] = []
        self._met = Counter[int]()
        self._gaps = list[Mapping[str, str]]()

    def track(self, role: _Role, topic: str, width: int) -> _Track:
        track = _Track(self.contents, topic, Decoder(self.contents.kind(role, topic), width))
        self._tracks.append(track)
        return track

    def find(self, block: Block) -> Messages:
        messages = self._find(block)
        for opcode, content in messages.others:
            self.contents.add(opcode, content, self.warn)
            self._gaps += _gap(opcode, content)
        if messages.lost:
            self.warn(f"{self.contents.path}: {messages.lost} bytes of records before byte {block.end} make no sense.")
        for group in messages.groups:
            self._met[group.channel] += len(group.at)
        return messages

    def account(self, stated: Mapping[int, int]) -> None:
        """Warns of messages that the file should have (``stated``, by channel) but that were not met, and of gaps."""
        if self._gaps:
            reason = self._gaps[0].get("reason", "unknown")
            self.warn(
                f"{self.contents.path}: the link to the bench was lost {len(self._gaps)} times (first: {reason})."
            )
        for track in self._tracks:
            ids = self.contents.ids(track.topic)
            total = sum(stated.get(channel, 0) for channel in ids)
            lost = total - sum(self._met[channel] for channel in ids)
            if lost > 0:
                self.warn(f"{self.contents.path}: {lost} of {total} messages of {track.topic} are lost.")
        stray = sum(count for channel, count in self._met.items() if channel not in self.contents.channels)
        if stray:
            self.warn(f"{self.contents.path}: {stray} messages belong to no topic the file defines and are left out.")


@dataclass(frozen=True)
class _Track:
    """One topic on its way from blocks to a stream."""

    contents: _Contents
    topic: str
    decode: Decoder

    def read(self, block: Block, messages: Messages) -> Stream:
        """The topic's samples in ``block``. Raises InputError where a message is not what its schema says."""
        ids = self.contents.ids(self.topic)
        groups = [group for group in messages.groups if group.channel in ids]
        try:
            parts = [self.decode(block.data, group.at, group.size) for group in groups]
        except CdrError as error:
            raise InputError(f"{self.contents.path}: topic {self.topic} cannot be used: {error}.") from error
        if len(parts) == 1:
            return parts[0]
        joined = sum(parts, Stream.empty(self.decode.width))
        order = np.argsort(np.concatenate([np.empty(0, np.int64), *(group.at for group in groups)]))
        return Stream(joined.time_ns[order], joined.values[order])


def _gap(opcode: int, content: bytes) -> list[Mapping[str, str]]:
    """The facts of a record that marks a gap; none of any other."""
    if opcode != Opcode.METADATA:
        return []
    try:
        record = parse(Metadata.read, content)
    except DamagedError:  # told already
        return []
    return [record.metadata] if record.name == GAP_RECORD else []


def _ignore(_: str) -> None:
    """While surveying: the warnings come again when the file is read."""
