"""What is in a file before anything is made of it: topics with their types, counts, rates and gaps, and the bench."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

import numpy as np
from mcap.records import Channel
from numpy.typing import NDArray

from kf_calib.errors import MissingExtraError
from kf_calib.sources.containers.opening import dataset_of, datasets_in, kind_of_container
from kf_calib.sources.files.contents import POSES, READINGS, USABLE_SCHEMAS, Contents, RecordingParts, fields_by_role
from kf_calib.sources.files.field_messages import CDR, ENCODINGS, parser_of
from kf_calib.sources.files.fields import MessageError, paths_of
from kf_calib.sources.files.mcap_file import Warn
from kf_calib.sources.files.mcap_records import MAX_CHUNK_MB, MessageFinder, log_times
from kf_calib.sources.files.record_files import (
    ROS1_BAG,
    ListsMessages,
    RecordFile,
    files_of,
    first_bytes,
    open_record_file,
)
from kf_calib.sources.text.lines import Lines
from kf_calib.sources.text.units import Units

TopicTimes = NDArray[np.int64]
_GAP = 5  # times the usual interval
_USUAL = 1000  # intervals from which the usual one is taken
_LEAST = 10  # intervals, for one to be usual


@dataclass
class Topic:
    """Messages of one topic, or samples of one quantity of lines, by their times as they come.

    first_ns, last_ns: the earliest and the latest. gaps: intervals of more than five times the usual one;
    longest_gap_s, longest_gap_at_s: the longest, and when it began, from the first on. backward: times before the one
    that precedes them. paths: what a message holds, of JSON, protobuf, and types in CDR that are not known.
    is_looked_into: whether any message was looked into for that.
    """

    name: str
    schema: str
    encoding: str
    count: int = 0
    first_ns: int | None = None
    last_ns: int | None = None
    gaps: int = 0
    longest_gap_s: float = 0.0
    longest_gap_at_s: float = 0.0
    backward: int = 0
    paths: tuple[str, ...] = ()
    is_looked_into: bool = False
    _waiting: list[TopicTimes] = field(default_factory=list[TopicTimes])  # until it is known what is usual
    _latest_ns: int | None = None  # of those that were looked at
    _usual_ns: float = 0.0

    @property
    def rate_hz(self) -> float | None:
        """Messages a second, from the first to the last."""
        if self.first_ns is None or self.last_ns is None or self.last_ns == self.first_ns:
            return None
        return (self.count - 1) / (self.last_ns - self.first_ns) * 1e9

    def add(self, times: TopicTimes) -> None:
        if not len(times):
            return
        first, last = int(times.min()), int(times.max())
        self.first_ns = first if self.first_ns is None else min(self.first_ns, first)
        self.last_ns = last if self.last_ns is None else max(self.last_ns, last)
        self.count += len(times)
        self._waiting.append(times)
        if self._usual_ns or sum(map(len, self._waiting)) > _USUAL:
            self.settle()

    def settle(self) -> None:
        """Looks for gaps in what has come so far; to be called at the end."""
        before = [] if self._latest_ns is None else [np.array([self._latest_ns])]
        times = np.concatenate([np.empty(0, np.int64), *before, *self._waiting])
        self._waiting.clear()
        if len(times) < 2:
            return
        self._latest_ns = int(times[-1])
        intervals = np.diff(times)
        self.backward += int((intervals < 0).sum())
        if not self._usual_ns:
            self._usual_ns = float(np.median(intervals[:_USUAL])) if len(intervals) >= _LEAST else np.inf
        wide = intervals > _GAP * max(self._usual_ns, 1.0)
        self.gaps += int(wide.sum())
        at = int(intervals.argmax())
        if wide[at] and intervals[at] > self.longest_gap_s * 1e9:
            assert self.first_ns is not None
            self.longest_gap_s, self.longest_gap_at_s = intervals[at] / 1e9, (int(times[at]) - self.first_ns) / 1e9


@dataclass
class Inventory:
    """What a recording's files hold. has_readings: of an accelerometer, by a schema that is known. has_angles: the
    platform is described by angles; None: it is not described in a schema that is known. angles: how many, where that
    is known. is_bare: readings are in lines that name no unit."""

    path: Path
    format: str
    files: list[Path]
    size: int
    topics: list[Topic]
    bench: dict[str, str]
    has_readings: bool
    has_angles: bool | None
    warnings: list[str]
    angles: int | None = None
    is_bare: bool = False


def inventory_of(path: Path, fields: Sequence[str] = ()) -> Inventory:
    """All of a file or a bag's folder, read once. fields: as of a ``Recording``.

    Raises InputError.
    """
    stated, files = fields_by_role(fields), files_of(path)
    parts = RecordingParts(path, [open_record_file(file, int(MAX_CHUNK_MB * (1 << 20)), USABLE_SCHEMAS)
                                  for file in files])  # fmt: skip
    topics, warnings, kinds = dict[str, Topic](), list[str](), dict[str, None]()
    for file in parts.files:
        warnings += [file.trouble] if file.trouble else []
        parts.contents.append(Contents.listed_in(file, stated))
        _count(file, parts.contents[-1], topics, warnings.append)
        is_ros1 = first_bytes(file.path).startswith(ROS1_BAG)
        kinds["db3" if isinstance(file, ListsMessages) else "bag" if is_ros1 else "mcap"] = None
    for topic in topics.values():
        topic.settle()
    bench, poses = next((own.bench for own in parts.contents if own.bench), {}), parts.topics(POSES)
    has_angles = parts.having(poses[0]).has_angles(poses[0]) if poses else None
    return Inventory(path, "+".join(kinds), files, parts.size, list(topics.values()), bench,
                     bool(parts.topics(READINGS)), has_angles, warnings)  # fmt: skip


def inventory_of_lines(
    path: Path, columns: Mapping[str, str] = MappingProxyType({}), units: Units | None = None
) -> Inventory:
    """All of a log in lines of text, read once. columns, units: as of ``Lines``.

    Raises InputError.
    """
    lines = Lines(path, columns=columns, units=units, angles=False)
    topics = [Topic(name, "", "") for name in ("readings", "platform", "temperature")]
    for batch in lines.batches():
        for topic, stream in zip(topics, (batch.accel, batch.pose, batch.temperature), strict=True):
            topic.add(stream.time_ns)
    for topic in topics:
        topic.settle()
    said = lines.described
    assert said
    has_angles = said.has_angles if topics[1].count else None
    topics[1].name = "platform angles" if has_angles else "platform attitude"
    met = [topic for topic in topics if topic.count]
    kind = kind_of_container(path)
    form, met = (kind.name.lower(), [*met, *_other_datasets(path, units)]) if kind else ("lines", met)
    return Inventory(path, form, [path], path.stat().st_size, met, said.metadata, True, has_angles, lines.warnings,
                     said.pose_width if has_angles else None, said.unit == "")  # fmt: skip


def _other_datasets(path: Path, units: Units | None) -> Iterator[Topic]:
    """Return the datasets of a container beside that which is read, by their names."""
    read = dataset_of(path, units.dataset if units else "").name
    for dataset in datasets_in(path):
        if dataset.name != read:
            topic = Topic(dataset.name, "", "")
            topic.add(dataset.times_ns())
            topic.settle()
            topic.count = len(dataset)
            yield topic


def _count(file: RecordFile, contents: Contents, topics: dict[str, Topic], warn: Warn) -> None:
    """Adds what a file holds to the topics met so far."""
    for channel in contents.channels.values():
        _topic(channel, contents, topics)
        if isinstance(file, ListsMessages):
            _look_into(file.first(channel.id), channel.id, contents, topics)
    stray = 0
    lists_messages = isinstance(file, ListsMessages)
    for number, times in file.receipts(warn) if lists_messages else _from_blocks(file, contents, topics, warn):
        channel = contents.channels.get(number)
        if channel is None:
            stray += len(times)
        else:
            _topic(channel, contents, topics).add(times)
    if stray:
        warn(f"{file.path}: {stray} messages belong to no topic the file defines.")


def _topic(channel: Channel, contents: Contents, topics: dict[str, Topic]) -> Topic:
    schema = contents.schemas.get(channel.schema_id)
    made = Topic(channel.topic, schema.name if schema else "", channel.message_encoding)
    return topics.setdefault(channel.topic, made)


def _from_blocks(
    file: RecordFile, contents: Contents, topics: dict[str, Topic], warn: Warn
) -> Iterator[tuple[int, TopicTimes]]:
    """Yield channel and times of receipt of messages of it, and take note of what else there is."""
    find = MessageFinder()
    for block in file.blocks(warn):
        messages = find(block)
        for opcode, content in messages.others:
            contents.add(opcode, content, warn)
        for channel in contents.channels.values() if messages.others else ():
            _topic(channel, contents, topics)
        for number in dict.fromkeys(group.channel for group in messages.groups if len(group.at)):
            groups = [group for group in messages.groups if group.channel == number and len(group.at)]
            at = np.sort(np.concatenate([group.at for group in groups]))
            yield number, log_times(block.data, at)
            first = block.data[int(groups[0].at[0]) : int(groups[0].at[0]) + groups[0].size]
            _look_into(first, number, contents, topics)


def _is_told_by_fields(channel: Channel, contents: Contents) -> bool:
    """Whether what a message holds has to be looked up: it is of no type in CDR that is known."""
    schema = contents.schemas.get(channel.schema_id)
    is_foreign = channel.message_encoding == CDR and bool(schema) and schema.name not in USABLE_SCHEMAS
    return channel.message_encoding in ENCODINGS or is_foreign


def _look_into(message: bytes, number: int, contents: Contents, topics: dict[str, Topic]) -> None:
    """Takes note of what a message holds, of the first one."""
    channel = contents.channels.get(number)
    if channel is None or not _is_told_by_fields(channel, contents):
        return
    topic = _topic(channel, contents, topics)
    if not topic.is_looked_into:
        topic.is_looked_into = True
        try:
            parse = parser_of(channel.message_encoding, contents.schemas.get(channel.schema_id))
            topic.paths = tuple(paths_of(parse(message)))
        except (MessageError, MissingExtraError):
            pass
