"""A recording (MCAP or .db3 files, docs/format.md) as a source of batches, one a chunk.

Topics are found by their schema. What is whole in a damaged or unfinished file is used, what is lost is told in
``warnings``. Sample time is ``header.stamp``. Memory is that of a few chunks, however long the recording.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import cache
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Metadata

from kf_calib.bench.bench import Bench
from kf_calib.bench.keys import UNSTATED, BenchKeys, checked_keys
from kf_calib.bench.raw_input import Conversion, RawInput, conversion, merged_metadata
from kf_calib.bench.streams import Batch, Stream, bench_without_angles
from kf_calib.errors import BenchError, InputError
from kf_calib.sources.files.cdr import Decoder
from kf_calib.sources.files.contents import (
    BENCH_RECORD,
    POSES,
    READINGS,
    TEMPERATURES,
    USABLE_SCHEMAS,
    Contents,
    RecordingParts,
    Role,
    fields_by_role,
)
from kf_calib.sources.files.field_messages import FieldDecoder
from kf_calib.sources.files.fields import Joints, MessageError
from kf_calib.sources.files.mcap_file import Warn, ignore
from kf_calib.sources.files.mcap_records import (
    MAX_CHUNK_MB,
    DamagedError,
    Integers,
    MessageFinder,
    Messages,
    RecordBlock,
    are_packed,
    log_times,
    parse_record,
    unpacked,
)
from kf_calib.sources.files.record_files import RecordFile, files_of, open_record_file
from kf_calib.sources.files.time_order import TimeOrder
from kf_calib.support.text import parse_date

_MOST_DAMAGES = 100  # told one by one; a file can be made that has a million
GAP_RECORD = "kf_calib.gap"
"""Metadata record at a place where the link to the bench was down: after_ns, seconds, reason."""
CLOCK_RECORD = "kf_calib.clock"
"""Where the bench's clock was set: after_ns, begin_ns (the first new stamp), shift_ns (from there on), reason."""
RUN_RECORD = "kf_calib.run"
"""Before the first reading, where stamps are no dates: when the computer received it (received, ISO 8601)."""
_DecoderOf = Callable[[Role, str], Decoder | FieldDecoder]
_MARKS = {GAP_RECORD: "the link to the bench was lost", CLOCK_RECORD: "the bench's clock was set during the run"}


class Recording:
    """A recording as a ``Source``: iterating reads it from its start.

    path: a file, or the folder of a ROS 2 bag, whose files follow each other. overrides: bench metadata keys
    (docs/format.md) that win over those in the file.
    accel_scale: m/s^2 of one unit of the readings, of all or of each channel (9.80665 for a file in g); the bench keys
    accel_scale and accel_unit say the same. angle_scale: factor on the gimbal angles (0.017453 for a file in degrees).
    input: what the device sends, where neither the file nor the overrides state it.
    accel_topic, pose_topic, temperature_topic: which to use where the file has several of the kind.
    fields: where the numbers are in messages of another type, for example ``"accel=/imu:acc.x,acc.y,acc.z"``
    (docs/bags.md).
    max_chunk_mb: chunks that unpack to more are passed over, and told.
    angles: False to do without angles and attitudes; the file may then have none, and the batches have none. None to
    do so where the file has none and states no axes.
    Raises InputError where the file, or what it holds, cannot be used.
    """

    def __init__(
        self,
        path: str | PathLike[str],
        overrides: BenchKeys = UNSTATED,
        accel_scale: float | tuple[float, float, float] | None = None,
        *,
        input: RawInput | None = None,
        angle_scale: float = 1.0,
        accel_topic: str | None = None,
        pose_topic: str | None = None,
        temperature_topic: str | None = None,
        fields: Sequence[str] = (),
        max_chunk_mb: float = MAX_CHUNK_MB,
        angles: bool | None = True,
    ) -> None:
        self.path = Path(path)
        self.fraction, self._begin_ns = 0.0, None
        self.received: datetime | None = None
        """When the first reading was received, as far as that is recorded; known when it has been read."""
        self._angle_scale = angle_scale
        self._stated = fields_by_role(fields)
        wanted = {READINGS: accel_topic, POSES: pose_topic, TEMPERATURES: temperature_topic}
        self._wanted = wanted | {role: stated.topic for role, stated in self._stated.items()}
        self._limit = int(max_chunk_mb * (1 << 20))
        usable = USABLE_SCHEMAS | {stated.topic for stated in self._stated.values()}
        files = [open_record_file(file, self._limit, usable) for file in files_of(self.path)]
        self._parts = RecordingParts(self.path, files)
        self.warnings = [file.trouble for file in self._parts.files if file.trouble]
        self._parts.contents = [self._survey(file) for file in self._parts.files]
        self._accel = self._require(
            READINGS, "convert the readings to sensor_msgs/msg/Imu, or say where they are by --field"
        )
        self._pose = None
        self._are_lacking = angles is None and not self._parts.topics(POSES) and not self._parts.bench[0]
        if angles is not False and not self._are_lacking:
            advice = (
                "record the angles too, as sensor_msgs/msg/JointState by the same clock, say where they are by "
                "--field, or do without them (--no-angles)"
            )
            self._pose = self._require(POSES, advice)
        self._parts.choose(TEMPERATURES, self._wanted[TEMPERATURES])  # optional, but not to be guessed
        if accel_scale is not None:
            overrides = checked_keys({**overrides, **RawInput.of_factors(accel_scale).scale_metadata()})
        self.bench, self._convert = self._describe_bench(overrides, input)
        self._opening_warnings = len(self.warnings)

    def __iter__(self) -> Iterator[Batch]:
        return self._batches(growing=False)

    def following(self) -> Iterator[Batch]:
        """The batches of a file that is being written, from its start; an empty one: nothing more has come yet."""
        return self._batches(growing=True)

    def begin_ns(self) -> int | None:
        """Stamp of the first reading; None where there is none. Reads the recording as far as to there, unless it has
        been read."""
        if self._begin_ns is None:
            next((batch for batch in self if len(batch.accel)), None)
        return self._begin_ns

    @property
    def warnings_while_read(self) -> list[str]:
        """Those that are not of the file's end, which one that is still being written has not."""
        return self.warnings[self._opening_warnings :]

    def _batches(self, growing: bool) -> Iterator[Batch]:
        del self.warnings[self._opening_warnings :]
        self.fraction, begun, parts = 0.0, 0, self._parts
        joints = Joints(len(self.bench.axes), self.bench.joints, self.bench.axis_letters, self._warn_of_joints)

        @cache
        def decoder(role: Role, topic: str) -> Decoder | FieldDecoder:
            """What reads the messages of a topic, in all of the files."""
            width = {READINGS: 3, POSES: self.bench.pose_width, TEMPERATURES: 1}[role]
            of_poses = joints if role is POSES else None
            return parts.having(topic).decoder(role, topic, width, of_poses, self.warnings.append)

        for file, contents in zip(parts.files, parts.contents, strict=True):
            passage = _Passage(contents, self._limit, self._warn_of_damage)
            batches = self._part(file, passage, decoder, growing and file is parts.files[-1])
            for end, batch in batches if growing else self._ordered(batches, file.size):
                self.fraction = math.nan if growing else min((begun + end) / parts.size, 1.0)
                if self._begin_ns is None and len(batch.accel):
                    self._begin_ns, self.received = int(batch.accel.time_ns[0]), passage.received
                if growing or len(batch.accel) or len(batch.pose) or len(batch.temperature):
                    yield batch
            passage.account(file.summary.message_counts if file.summary else {}, self.warnings.append)
            begun += file.size
        if joints.others and not joints.found:
            raise InputError(
                f"{self.path}: no message of topic {self._pose} names the joints {' '.join(self.bench.joints)}, it "
                f"names {' '.join(joints.others)}: name the gimbals, outer to inner, by --joints."
            )
        self.fraction = 1.0

    def _part(
        self, file: RecordFile, passage: _Passage, decoder: _DecoderOf, growing: bool
    ) -> Iterator[tuple[int, Batch]]:
        """The batches of one file, and up to which byte it has been read then."""
        accel = passage.track(self._accel, decoder(READINGS, self._accel))
        pose = passage.track(self._pose, decoder(POSES, self._pose)) if self._pose else None
        temperature = None
        for block in file.blocks(self._warn_of_damage, growing=growing):
            block, messages = passage.find(block)
            if not temperature and (topic := self._parts.choose(TEMPERATURES, self._wanted[TEMPERATURES])):
                temperature = passage.track(topic, decoder(TEMPERATURES, topic))
            batch = Batch(
                self._converted(accel.read(block, messages)),
                _scaled(pose.read(block, messages), self._angle_scale) if pose else Stream.empty(self.bench.pose_width),
                temperature.read(block, messages) if temperature else Stream.empty(1),
            )
            yield block.end, batch

    def _ordered(self, batches: Iterator[tuple[int, Batch]], size: int) -> Iterator[tuple[int, Batch]]:
        """The batches with the samples of each topic in order of time, as far as a short memory can bring them."""
        accel, pose, temperature = orders = TimeOrder(), TimeOrder(), TimeOrder()
        for end, batch in batches:
            yield end, Batch(accel(batch.accel), pose(batch.pose), temperature(batch.temperature))
        yield size, Batch(accel.rest(3), pose.rest(self.bench.pose_width), temperature.rest(1))
        if late := sum(order.late for order in orders):
            self.warnings.append(f"{self.path}: {late} messages came after later ones of their topic, and were sorted.")

    def _converted(self, stream: Stream) -> Stream:
        return Stream(stream.time_ns, self._convert(stream.values))

    def _warn_of_damage(self, said: str) -> None:
        if len(self.warnings) < _MOST_DAMAGES:
            self.warnings.append(said)
        elif len(self.warnings) == _MOST_DAMAGES:
            self.warnings.append(f"{self.path} is damaged in more places than can be told.")

    def _warn_of_joints(self, said: str) -> None:
        self.warnings.append(f"{self.path}: topic {self._pose}: {said}.")

    def _survey(self, file: RecordFile) -> Contents:
        """Topics and bench: from the summary, else by reading on until no better choice of topics can come, and where
        something is damaged the bench. Warnings come when the file is read."""
        contents = Contents.listed_in(file, self._stated)
        for index in file.summary.metadata if file.summary else ():
            if index.name == BENCH_RECORD and contents.bench is None:
                try:
                    contents.add(Opcode.METADATA, file.record_at(index.offset, Opcode.METADATA), warn=ignore)
                except DamagedError:
                    contents.bench_damaged = True
        lists_topics = bool(contents.channels and contents.schemas)
        if lists_topics and (contents.bench is not None or contents.bench_damaged):
            return contents
        find, damage = MessageFinder(), list[str]()
        for block in file.blocks(warn=damage.append):
            for opcode, content in find(block).others:
                contents.add(opcode, content, warn=ignore)
            may_come_again = contents.bench is None and bool(contents.bench_damaged or damage)
            if lists_topics or (self._is_settled(contents) and not may_come_again):
                break
        return contents

    def _is_settled(self, contents: Contents) -> bool:
        for role, wanted in self._wanted.items():
            sought = role.preferred if wanted is None else (wanted,)
            is_optional = role is TEMPERATURES and wanted is None
            if not is_optional and not set(sought) & set(contents.topics(role)):
                return False
        return True

    def _require(self, role: Role, advice: str) -> str:
        topic = self._parts.choose(role, self._wanted[role])
        if topic is None:
            is_whole = not any(file.trouble for file in self._parts.files)
            state = "" if is_whole else " and is not whole"
            if not is_whole and not any(contents.channels for contents in self._parts.contents):
                advice = "nothing of it can be used, so copy it anew from where it was recorded"
            raise InputError(
                f"{self.path} has no {role.quantity} topic ({role.schemas}), it has {self._parts}{state}: {advice}."
            )
        self._parts.having(topic).refuse_unreadable(role, topic)
        return topic

    def _describe_bench(self, overrides: BenchKeys, default: RawInput | None) -> tuple[Bench, Conversion]:
        """The bench, and how the numbers of the file become readings."""
        recorded, is_damaged = self._parts.bench
        damage = f"{self.path}: the description of the bench in it is damaged"
        if is_damaged:
            self.warnings.append(f"{damage}: only what options give is used.")
        stated = self._keys_of_bench(recorded, overrides, default)
        if self._pose is None:
            bench, said = bench_without_angles(str(self.path), stated, are_lacking=self._are_lacking)
            self.warnings += said
            return bench, conversion(recorded, stated)
        has_angles = self._parts.having(self._pose).has_angles(self._pose)
        if not has_angles and self._angle_scale != 1.0:
            raise InputError(
                f"{self.path}: topic {self._pose} has attitudes, which have no unit: leave out --angle-unit."
            )
        try:
            return Bench.from_metadata(stated, has_angles), conversion(recorded, stated)
        except BenchError as error:
            where = f"{damage}, so give it by options" if is_damaged else str(self.path)
            raise BenchError(f"{where}: {error}") from error

    def _keys_of_bench(
        self, recorded: Mapping[str, str], overrides: BenchKeys, default: RawInput | None
    ) -> dict[str, Any]:
        """The keys of the bench: those of the file, and of options over them."""
        try:
            return merged_metadata(recorded, overrides, "the recording", default)
        except BenchError as error:
            raise BenchError(f"{self.path}: {error}") from None


class _Passage:
    """One reading of a file from its start, with the account of the messages met."""

    def __init__(self, contents: Contents, max_message: int, warn: Warn) -> None:
        self.contents, self._max_message = contents, max_message
        self.warn = warn
        self._find = MessageFinder()
        self._tracks: list[_Track] = []
        self._met = Counter[int]()
        self._marks = list[Metadata]()

    def track(self, topic: str, decode: Decoder | FieldDecoder) -> _Track:
        """Return a track that takes the messages of a topic from the blocks that are read."""
        track = _Track(self.contents, topic, decode)
        self._tracks.append(track)
        return track

    def find(self, block: RecordBlock) -> tuple[RecordBlock, Messages]:
        """The messages in a block, and the block that they are in."""
        messages = self._find(block)
        for opcode, content in messages.others:
            self.contents.add(opcode, content, self.warn)
            self._marks += _mark(opcode, content)
        if messages.lost:
            self.warn(f"{self.contents.path}: {messages.lost} bytes of records before byte {block.end} make no sense.")
        for group in messages.groups:
            self._met[group.channel] += len(group.at)
        in_cdr = (group for group in messages.groups if self._is_in_cdr(group.channel))
        return self._unpacked(block, messages) if are_packed(block, in_cdr) else (block, messages)

    @property
    def received(self) -> datetime | None:
        """When the first reading was received; None where no record so far says it."""
        try:
            said = next((mark.metadata["received"] for mark in self._marks if mark.name == RUN_RECORD), None)
            return None if said is None else parse_date(said)
        except (KeyError, ValueError):
            return None

    def _is_in_cdr(self, number: int) -> bool:
        channel = self.contents.channels.get(number)
        return channel is not None and channel.message_encoding == "cdr"

    def _unpacked(self, block: RecordBlock, messages: Messages) -> tuple[RecordBlock, Messages]:
        whole, lost = unpacked(block, messages.groups, self._max_message)
        if lost:
            self.warn(f"{self.contents.path}: {len(lost)} messages before byte {block.end} are lost ({lost[0]}).")
        return whole, self._find(whole)

    def account(self, stated: Mapping[int, int], warn: Warn) -> None:
        """Warns of messages that the file should have (``stated``, by channel) but that were not met, and of gaps."""
        for name, what in _MARKS.items():
            if marks := [mark for mark in self._marks if mark.name == name]:
                reason = marks[0].metadata.get("reason", "unknown")
                warn(f"{self.contents.path}: {what} {len(marks)} times (first: {reason}).")
        for track in self._tracks:
            if isinstance(track.decode, FieldDecoder) and (unread := track.decode.take_unread()):
                said = f"{self.contents.path}: topic {track.topic}"
                warn(f"{said}: {len(unread)} messages are left out (first: {unread[0]}).")
            if track.by_receipt:
                warn(
                    f"{self.contents.path}: topic {track.topic}: its stamps (header.stamp) are all 0, so the times of "
                    "receipt (log_time) are used."
                )
            ids = self.contents.ids(track.topic)
            total = sum(stated.get(channel, 0) for channel in ids)
            lost = total - sum(self._met[channel] for channel in ids)
            if lost > 0:
                warn(f"{self.contents.path}: {lost} of {total} messages of {track.topic} are lost.")
        stray = sum(count for channel, count in self._met.items() if channel not in self.contents.channels)
        if stray:
            warn(f"{self.contents.path}: {stray} messages belong to no topic the file defines and are left out.")


@dataclass
class _Track:
    """One topic on its way from blocks to a stream. by_receipt: whether its messages have no stamps of their own."""

    contents: Contents
    topic: str
    decode: Decoder | FieldDecoder
    by_receipt: bool = False

    def read(self, block: RecordBlock, messages: Messages) -> Stream:
        """The topic's samples in ``block``. Raises InputError where a message is not what its schema says."""
        ids = self.contents.ids(self.topic)
        groups = [group for group in messages.groups if group.channel in ids]
        try:
            parts = [self.decode.stream_with_offsets(block.data, group.at, group.size) for group in groups]
            parts = [(at, self._stamped(stream, at, block.data)) for at, stream in parts]
        except MessageError as error:
            raise InputError(f"{self.contents.path}: topic {self.topic} cannot be used: {error}.") from error
        if len(parts) == 1:
            return parts[0][1]
        joined = sum((stream for _, stream in parts), Stream.empty(self.decode.width))
        order = np.argsort(np.concatenate([np.empty(0, np.int64), *(at for at, _ in parts)]))
        return Stream(joined.time_ns[order], joined.values[order])

    def _stamped(self, stream: Stream, at: Integers, data: bytes) -> Stream:
        """The stream, stamped by the times of receipt where nobody has filled its own stamps: all of them are 0."""
        self.by_receipt |= len(stream) > 1 and not stream.time_ns.any()
        if not self.by_receipt:
            return stream
        return Stream(np.where(stream.time_ns == 0, log_times(data, at), stream.time_ns), stream.values)


def _scaled(stream: Stream, scale: float) -> Stream:
    with np.errstate(over="ignore"):  # what damage has made too large becomes infinite, and is counted as such
        return Stream(stream.time_ns, stream.values * scale)


def _mark(opcode: int, content: bytes) -> list[Metadata]:
    """A record that says what happened to the link or the clock, or when the run began; none of any other."""
    if opcode != Opcode.METADATA:
        return []
    try:
        record = parse_record(Metadata.read, content)
    except DamagedError:  # told already
        return []
    return [record] if record.name in (*_MARKS, RUN_RECORD) else []
