"""Streams to record, and recordings read back whole."""

import json
import sqlite3
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
from mcap.writer import Writer

from kf_calib.bench.bench import Bench, axes_of
from kf_calib.bench.streams import Batch, Source, Stream
from kf_calib.sources.files import cdr
from kf_calib.sources.files.recorder import Recorder

START_NS = 1_750_000_000_123_456_789
BENCH = Bench(axes_of("yzx"), gravity_mps2=9.8153, latitude_deg=59.9, angle_sigma_deg=0.01, nominal={"theta1": 0.0})


def made_stream(count: int, step_ns: int, width: int, start_ns: int = START_NS) -> Stream:
    """Values that follow from the stamps, so that any part of the stream can be checked by itself."""
    time_ns = start_ns + step_ns * np.arange(count)
    return Stream(time_ns, values_at(time_ns, width))


def values_at(time_ns: np.ndarray, width: int) -> np.ndarray:
    return np.sin(((time_ns - START_NS) / 1e9)[:, None] * 977.0 + 5 * np.arange(width)) * 9.8


def made_batch(count: int, start_ns: int = START_NS, pose_width: int = 3) -> Batch:
    """``count`` readings at 100 Hz, a tenth as many poses, a twentieth as many temperatures."""
    return Batch(
        made_stream(count, 10_000_000, 3, start_ns),
        made_stream(count // 10, 100_000_000, pose_width, start_ns),
        made_stream(count // 20, 200_000_000, 1, start_ns),
    )


def record(path: Path, batch: Batch, bench: Bench = BENCH, **options: float) -> Path:
    with Recorder(path, bench, **options) as recorder:
        recorder.write(batch)
    return path


def read(source: Source) -> Batch:
    """All batches of a source in one."""
    whole = Batch(Stream.empty(3), Stream.empty(source.bench.pose_width))
    for batch in source:
        whole = Batch(whole.accel + batch.accel, whole.pose + batch.pose, whole.temperature + batch.temperature)
    return whole


def streams_of(batch: Batch) -> tuple[Stream, Stream, Stream]:
    return batch.accel, batch.pose, batch.temperature


def assert_equal(found: Batch, expected: Batch) -> None:
    for one, other in zip(streams_of(found), streams_of(expected), strict=True):
        assert np.array_equal(one.time_ns, other.time_ns)
        assert one.values.tobytes() == other.values.tobytes()


def count_missing(found: Batch, expected: Batch) -> int:
    """How many samples are lost, after making sure that those found are true, in order, and not doubled."""
    missing = 0
    for one, other in zip(streams_of(found), streams_of(expected), strict=True):
        at = np.searchsorted(other.time_ns, one.time_ns)
        assert np.all(np.diff(at) > 0) and (not len(at) or at[-1] < len(other))
        assert np.array_equal(other.time_ns[at], one.time_ns)
        assert other.values[at].tobytes() == one.values.tobytes()
        missing += len(other) - len(one)
    return missing


BATCH = made_batch(400)
JOINTS = cdr.joint_state_message("platform", ["outer", "middle", "inner"])
ACCEL = ("/accelerometer", cdr.IMU, cdr.imu_message("accelerometer"), BATCH.accel)
ANGLES = ("/platform/angles", cdr.JOINT_STATE, JOINTS, BATCH.pose)
HEAT = ("/temperature", cdr.TEMPERATURE, cdr.temperature_message(""), BATCH.temperature)
Topic = tuple[str, cdr.MessageType, bytes, Stream]


def write_officially(
    path: Path,
    topics: tuple[Topic, ...] = (ACCEL, ANGLES, HEAT),
    *,
    metadata: dict[str, str] | None = None,
    encoding: str = "cdr",
    schema_encoding: str = "ros2msg",
    extra: Callable[[Writer, int], None] = lambda *_: None,
    finish: bool = True,
    **options: object,
) -> Path:
    """A file by the official writer, messages in the order of their stamps; ``extra`` is called between messages."""
    with path.open("wb") as file:
        writer = Writer(file, **{"chunk_size": 8_000, **options})
        writer.start(profile="ros2")
        if metadata is None:
            metadata = BENCH.to_metadata()
        if metadata:
            writer.add_metadata("kf_calib.bench", metadata)
        messages: list[tuple[int, int, bytes]] = []
        for topic, kind, template, stream in topics:
            schema = writer.register_schema(kind.name, schema_encoding, kind.schema.encode())
            channel = writer.register_channel(topic, encoding, schema)
            packed = cdr.pack(kind, template, stream)
            messages += zip(stream.time_ns.tolist(), [channel] * len(packed), packed, strict=True)
        for i, (stamp, channel, data) in enumerate(sorted(messages, key=lambda message: message[0])):
            extra(writer, i)
            writer.add_message(channel, log_time=stamp, data=data, publish_time=stamp)
        if finish:
            writer.finish()
        else:
            writer.flush()
    return path


def stamped(topics: tuple[Topic, ...]) -> list[tuple[int, int, bytes]]:
    """Stamp, number of the topic (from 1) and bytes of each message, in the order of the stamps."""
    messages: list[tuple[int, int, bytes]] = []
    for k, (_, kind, template, stream) in enumerate(topics, 1):
        messages += [(stamp, k, data) for stamp, data in
                     zip(stream.time_ns.tolist(), cdr.pack(kind, template, stream), strict=True)]  # fmt: skip
    return sorted(messages, key=lambda message: message[0])


def write_db3(
    path: Path, topics: tuple[Topic, ...] = (ACCEL, ANGLES, HEAT), pack: Callable[[bytes], bytes] = bytes
) -> Path:
    """A bag's SQLite file with the tables that ROS 2 makes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with closing(sqlite3.connect(path)) as base, base:
        base.execute(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, "
            "serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL)"
        )
        base.execute(
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL, "
            "data BLOB NOT NULL)"
        )
        base.execute("CREATE INDEX timestamp_idx ON messages (timestamp ASC)")
        for k, (name, kind, *_) in enumerate(topics, 1):
            base.execute("INSERT INTO topics VALUES(?, ?, ?, 'cdr', '')", (k, name, kind.name))
        rows = [(k, stamp, pack(data)) for stamp, k, data in stamped(topics)]
        base.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)", rows)
    return path


def altered(path: Path, *statements: str) -> Path:
    """A bag's SQLite file that some statements have changed."""
    with closing(sqlite3.connect(path, isolation_level=None)) as base:
        for statement in statements:
            base.execute(statement)
    return path


def part_of(topic: Topic, number: int, count: int) -> Topic:
    """A share of the messages of a topic, of so many alike."""
    name, kind, template, stream = topic
    own = slice(len(stream) * number // count, len(stream) * (number + 1) // count)
    return name, kind, template, Stream(stream.time_ns[own], stream.values[own])


def write_messages(
    path: Path, topics: Mapping[str, Sequence[object]], encoding: str = "json", schema: str = ""
) -> Path:
    """Messages of each topic, 10 ms apart: bytes as they are, others in JSON."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        number = writer.register_schema(schema, "jsonschema", b"") if schema else 0
        for topic, messages in topics.items():
            channel = writer.register_channel(topic, encoding, number)
            for k, message in enumerate(messages):
                data = message if isinstance(message, bytes) else json.dumps(message).encode()
                writer.add_message(channel, START_NS + k * 10**7, data, 0)
        writer.finish()
    return path
