"""What is in the files of a recording besides samples: topics, found by their schema, and the bench's description."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Channel, Metadata, Schema

from kf_calib.errors import InputError
from kf_calib.sources.files.cdr import IMU, JOINT_STATE, QUATERNION, TEMPERATURE, Decoder, MessageType
from kf_calib.sources.files.field_messages import CDR, ENCODINGS, FieldDecoder
from kf_calib.sources.files.fields import Fields, Joints, MessageError, known_fields
from kf_calib.sources.files.mcap_file import Warn
from kf_calib.sources.files.mcap_records import DamagedError, Summary, parse_record
from kf_calib.sources.files.record_files import RecordFile

BENCH_RECORD = "kf_calib.bench"
CHECKSUM_KEY = "crc32"
"""Key of the bench record with the checksum of the others: gravity and axes lie outside every chunk's CRC."""

ACCEL_TOPIC = "/accelerometer"
ANGLES_TOPIC = "/platform/angles"
ATTITUDE_TOPIC = "/platform/attitude"
TEMPERATURE_TOPIC = "/temperature"
CALIBRATED_TOPIC = "/accelerometer/calibrated"
CALIBRATION_FORMAT = "kf_calib.calibration"
"""What a saved calibration names itself in its first lines."""
"""Of corrected readings, which nobody calibrates again unless he names it."""


def bench_checksum(metadata: Mapping[str, str]) -> str:
    """CRC-32 in hexadecimal of keys and values, sorted, each ended by NUL; the checksum's own key is left out."""
    text = "".join(f"{key}\0{value}\0" for key, value in sorted(metadata.items()) if key != CHECKSUM_KEY)
    return f"{zlib.crc32(text.encode()):08x}"


@dataclass(frozen=True)
class Role:
    """What a topic is wanted for. ``preferred`` topics win, in this order, where several have a fitting schema.

    fields: what the numbers of its kinds are called in ``Fields``.
    """

    quantity: str
    option: str
    kinds: tuple[MessageType, ...]
    preferred: tuple[str, ...]
    fields: tuple[str, ...]

    def kind(self, schema: str) -> MessageType | None:
        """The message type of that schema name, if this role can use it."""
        return next((kind for kind in self.kinds if schema in kind.names), None)

    @property
    def schemas(self) -> str:
        return " or ".join(kind.name for kind in self.kinds)


READINGS = Role("accelerometer", "--accel-topic", (IMU,), (ACCEL_TOPIC,), ("accel",))
POSES = Role(
    "angle or attitude", "--pose-topic", (JOINT_STATE, QUATERNION), (ANGLES_TOPIC, ATTITUDE_TOPIC),
    ("angles", "attitude"),
)  # fmt: skip
TEMPERATURES = Role("temperature", "--temperature-topic", (TEMPERATURE,), (TEMPERATURE_TOPIC,), ("temperature",))
ROLES = (READINGS, POSES, TEMPERATURES)
USABLE_SCHEMAS = frozenset(name for role in ROLES for kind in role.kinds for name in kind.names)


def fields_by_role(fields: Sequence[str]) -> dict[Role, Fields]:
    """Fields as they are written, by what they are of. Raises InputError."""
    by_role = dict[Role, Fields]()
    for text in fields:
        stated = Fields.of(text)
        role = next(role for role in ROLES if stated.quantity in role.fields)
        if role in by_role:
            raise InputError(f"--field says twice where the {role.quantity} is: say it once.")
        by_role[role] = stated
    return by_role


@dataclass
class Contents:
    """Topics of a file and its bench's description, as far as they have been met."""

    path: Path
    stated: Mapping[Role, Fields] = field(default_factory=dict[Role, Fields])
    """Where a topic's numbers are, by ``--field``."""
    schemas: dict[int, Schema] = field(default_factory=dict[int, Schema])
    channels: dict[int, Channel] = field(default_factory=dict[int, Channel])
    bench: dict[str, str] | None = None
    bench_damaged: bool = False

    @classmethod
    def listed_in(cls, file: RecordFile, stated: Mapping[Role, Fields]) -> Contents:
        """What the summary of a file lists."""
        summary = file.summary or Summary(0)
        schemas = {schema.id: schema for schema in summary.schemas}
        return cls(file.path, stated, schemas, {channel.id: channel for channel in summary.channels})

    def add(self, opcode: int, content: bytes, warn: Warn) -> None:
        """Takes note of a record that is not a message."""
        try:
            match opcode:
                case Opcode.SCHEMA:
                    schema = parse_record(Schema.read, content)
                    self.schemas.setdefault(schema.id, schema)
                case Opcode.CHANNEL:
                    channel = parse_record(Channel.read, content)
                    self.channels.setdefault(channel.id, channel)
                case Opcode.METADATA:
                    self._add_metadata(content)
                case _:
                    pass
        except DamagedError:
            warn(f"{self.path}: a record that describes a topic or the bench is damaged and not used.")

    def _add_metadata(self, content: bytes) -> None:
        try:
            record = parse_record(Metadata.read, content)
        except DamagedError:
            self.bench_damaged |= self.bench is None
            raise
        if record.name != BENCH_RECORD:
            return
        stated = record.metadata.pop(CHECKSUM_KEY, None)
        if stated is not None and stated != bench_checksum(record.metadata):
            self.bench_damaged |= self.bench is None
            raise DamagedError("the bench's description does not fit its checksum")
        if self.bench is None:  # the first whole one; recorders repeat it
            self.bench, self.bench_damaged = record.metadata, False

    def topics(self, role: Role) -> list[str]:
        """Topics with a schema that ``role`` can use, in the order of the file."""
        fitting = [channel.topic for channel in self.channels.values() if self._quantity(role, channel) in role.fields]
        return list(dict.fromkeys(fitting))

    def _quantity(self, role: Role, channel: Channel) -> str:
        """What the messages of a channel give, as ``Fields`` call it; empty where nothing is known to be of use."""
        if channel.message_encoding in ENCODINGS or role in self.stated:
            fields = self._fields(role, channel)
            return fields.quantity if fields else ""
        kind = role.kind(self._schema(channel))
        return role.fields[role.kinds.index(kind)] if kind else ""

    def _fields(self, role: Role, channel: Channel) -> Fields | None:
        stated = self.stated.get(role)
        if stated:
            return stated if stated.topic == channel.topic else None
        return known_fields(self._schema(channel))

    def ids(self, topic: str) -> list[int]:
        return [channel.id for channel in self.channels.values() if channel.topic == topic]

    def has_angles(self, topic: str) -> bool:
        """Whether a chosen topic gives the platform's angles, not its attitude."""
        return self._quantity(POSES, self.channels[self.ids(topic)[0]]) == "angles"

    def refuse_unreadable(self, role: Role, topic: str) -> None:
        """Raises InputError where nothing reads the messages of a chosen topic."""
        channel = self.channels[self.ids(topic)[0]]
        schema = self.schemas.get(channel.schema_id)
        is_ros = channel.message_encoding == CDR and schema and schema.encoding in ("ros2msg", "ros2idl")
        if channel.message_encoding not in ENCODINGS and not is_ros:
            described = f"a schema {schema.name} in {schema.encoding!r}" if schema else "no schema"
            raise InputError(
                f"{self.path}: topic {channel.topic} has {channel.message_encoding!r} messages with {described}, only "
                "'cdr' with 'ros2msg', 'json' and 'protobuf' can be read: convert the file to ROS 2 first."
            )

    def decoder(self, role: Role, topic: str, width: int, joints: Joints | None, warn: Warn) -> Decoder | FieldDecoder:
        """What reads the messages of a chosen topic. Raises InputError where nothing does."""
        self.refuse_unreadable(role, topic)
        channel = self.channels[self.ids(topic)[0]]
        has_fields = channel.message_encoding in ENCODINGS or role in self.stated
        if kind := None if has_fields else role.kind(self._schema(channel)):
            return Decoder(kind, width, joints)
        fields = self._fields(role, channel)
        assert fields  # else the topic would not have been chosen
        schema, said = self.schemas.get(channel.schema_id), f"{self.path}: topic {topic}"
        try:
            return FieldDecoder(
                channel.message_encoding, schema, fields, width, joints, lambda text: warn(f"{said}: {text}.")
            )
        except MessageError as error:
            raise InputError(f"{said} cannot be used: {error}.") from None

    @property
    def schemas_of_topics(self) -> dict[str, str]:
        return {channel.topic: self._schema(channel) for channel in self.channels.values()}

    def _schema(self, channel: Channel) -> str:
        schema = self.schemas.get(channel.schema_id)
        return schema.name if schema else "no schema"


@dataclass
class RecordingParts:
    """The files of a recording, which follow each other."""

    path: Path
    files: list[RecordFile]
    contents: list[Contents] = field(default_factory=list[Contents])

    @property
    def size(self) -> int:
        return sum(file.size for file in self.files)

    @property
    def bench(self) -> tuple[Mapping[str, str], bool]:
        """Keys of the first description of the bench, and whether it is damaged."""
        described = (own for own in self.contents if own.bench is not None or own.bench_damaged)
        first = next(described, Contents(self.path))
        return first.bench or {}, first.bench_damaged

    def topics(self, role: Role) -> list[str]:
        """Topics with a schema that ``role`` can use, in the order of the files."""
        return list(dict.fromkeys(topic for own in self.contents for topic in own.topics(role)))

    def choose(self, role: Role, wanted: str | None) -> str | None:
        """The topic to use for ``role``, None where there is none. Raises InputError where the choice is not clear."""
        candidates = self.topics(role)
        for topic in role.preferred if wanted is None else (wanted,):
            if topic in candidates:
                return topic
        if wanted is not None:
            raise InputError(
                f"{self.path} has no {role.quantity} topic {wanted!r}, it has {self}: give one of schema "
                f"{role.schemas} by {role.option}, or of another type by --field."
            )
        candidates = [topic for topic in candidates if topic != CALIBRATED_TOPIC] or candidates
        if len(candidates) > 1:
            raise InputError(
                f"{self.path} has several {role.quantity} topics, {', '.join(candidates)}: choose one by {role.option}."
            )
        return candidates[0] if candidates else None

    def having(self, topic: str) -> Contents:
        """Those of the first file that has a chosen topic."""
        return next(own for own in self.contents if own.ids(topic))

    def __str__(self) -> str:
        topics = {topic: schema for own in self.contents for topic, schema in own.schemas_of_topics.items()}
        return ", ".join(f"{topic} ({schema})" for topic, schema in topics.items()) or "no topics"
