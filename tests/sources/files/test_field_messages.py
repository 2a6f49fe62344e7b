"""JSON and protobuf messages give the streams that the same samples recorded here give."""

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.recordings import BATCH, BENCH, START_NS, assert_equal, read, record
from mcap.writer import CompressionType, Writer

from kf_calib.bench.bench import Bench
from kf_calib.bench.streams import Batch, Stream
from kf_calib.errors import InputError, KfCalibError
from kf_calib.sources.files.fields import Fields, time_ns
from kf_calib.sources.files.recording import Recording

KEYS = BENCH.to_metadata()
Shape = Callable[[int, list[float]], Any]


def stamp(at: int) -> dict[str, int]:
    return {"sec": at // 10**9, "nsec": at % 10**9}


def xyz(values: list[float]) -> dict[str, float]:
    return dict(zip("xyzw", values, strict=False))


def ros_time(at: int) -> dict[str, Any]:
    return {"stamp": {"sec": at // 10**9, "nanosec": at % 10**9}, "frame_id": ""}


ROS: dict[str, tuple[str, Shape]] = {
    "/imu": ("sensor_msgs/msg/Imu", lambda at, v: {"header": ros_time(at), "linear_acceleration": xyz(v)}),
    "/joints": ("sensor_msgs/JointState", lambda at, v: {"header": ros_time(at), "name": ["inner", "outer", "middle"],
                                                         "position": [v[2], v[0], v[1]]}),
    "/heat": ("sensor_msgs/msg/Temperature", lambda at, v: {"header": ros_time(at), "temperature": v[0]}),
}  # fmt: skip
OWN: dict[str, tuple[str, Shape]] = {
    "/imu": ("my.Accel", lambda at, v: {"t_ns": at, "acc": v}),
    "/gimbal": ("", lambda at, v: {"timestamp": stamp(at), "q": {"o": v[0], "list": [{"v": v[1]}, {"v": v[2]}]}}),
    "/heat": ("", lambda at, v: {"deg": v[0]}),
}
OWN_FIELDS = ("accel=/imu:acc@t_ns", "angles=/gimbal:q.o,q.list.v", "temperature=/heat:deg")
FOXGLOVE: dict[str, tuple[str, Shape]] = {
    "/imu": ("my.Accel", lambda at, v: {"timestamp": stamp(at), "a": xyz(v)}),
    "/joints": ("foxglove.JointStates", lambda at, v: {"timestamp": stamp(at), "joints": [
        {"name": name, "position": v[k]} for name, k in (("wheel", 0), ("gimbal_inner", 2), ("gimbal_middle", 1),
                                                         ("gimbal_outer", 0))]}),
}  # fmt: skip


def write_json(path: Path, topics: Mapping[str, tuple[str, Shape]], batch: Batch = BATCH, **options: object) -> Path:
    """By the official writer; a schema without a name is none."""
    with path.open("wb") as file:
        writer = Writer(file, **{"chunk_size": 8_000, **options})
        writer.start()
        messages = list[tuple[int, int, bytes]]()
        for (topic, (schema, shape)), stream in zip(
            topics.items(), (batch.accel, batch.pose, batch.temperature), strict=False
        ):
            number = writer.register_schema(schema, "jsonschema", b"{}") if schema else 0
            channel = writer.register_channel(topic, "json", number)
            for at, values in zip(stream.time_ns.tolist(), stream.values.tolist(), strict=True):
                messages.append((at, channel, json.dumps(shape(at, values)).encode()))
        for at, channel, data in sorted(messages, key=lambda message: message[0]):
            writer.add_message(channel, log_time=at, data=data, publish_time=at)
        writer.finish()
    return path


def test_messages_of_ros_in_json(tmp_path: Path) -> None:
    expected = read(Recording(record(tmp_path / "run.mcap", BATCH)))
    recording = Recording(write_json(tmp_path / "json.mcap", ROS), KEYS)
    for _ in range(2):
        assert_equal(read(recording), expected)
    assert len(recording.warnings) == 1 and "the gimbals are, by their names" in recording.warnings[0]


def test_messages_of_any_schema_in_json(tmp_path: Path) -> None:
    recording = Recording(write_json(tmp_path / "json.mcap", OWN), KEYS, fields=OWN_FIELDS)
    assert_equal(read(recording), BATCH)
    assert [text for text in recording.warnings if "/heat: its messages have no time of their own" in text]


def test_joints_of_foxglove_are_chosen_by_name(tmp_path: Path) -> None:
    path = write_json(tmp_path / "json.mcap", FOXGLOVE)
    found = read(Recording(path, KEYS, fields=["accel=/imu:a.x,a.y,a.z"]))
    assert_equal(found, Batch(BATCH.accel, BATCH.pose))
    stated = KEYS | {"joints": "gimbal_inner gimbal_middle gimbal_outer"}
    assert read(Recording(path, stated, fields=["accel=/imu:a.x,a.y,a.z"])).pose.values.tolist() == [
        row[::-1] for row in BATCH.pose.values.tolist()
    ]


def test_attitude_by_fields(tmp_path: Path) -> None:
    batch = Batch(BATCH.accel, Stream(BATCH.pose.time_ns, np.insert(BATCH.pose.values, 3, 1.0, axis=1)))
    topics = {"/imu": ROS["/imu"], "/pose": ("", lambda at, v: {"stamp": at / 1e9, "q": v})}
    bench = Bench((), gravity_mps2=9.81)
    recording = Recording(
        write_json(tmp_path / "j.mcap", topics, batch), bench.to_metadata(), fields=["attitude=/pose:q"]
    )
    found = read(recording)
    assert found.pose.values.tobytes() == batch.pose.values.tobytes()
    assert abs(found.pose.time_ns - batch.pose.time_ns).max() < 200  # what a float of seconds since 1970 holds


def test_a_path_to_x_y_z_and_w_is_one_to_all_of_them(tmp_path: Path) -> None:
    """Whatever their order is, as the pose of a tool and the list of transforms of a robot have them; not to other
    objects."""
    batch = Batch(BATCH.accel, Stream(BATCH.pose.time_ns, np.insert(BATCH.pose.values, 3, 1.0, axis=1)))
    topics = {
        "/imu": ("", lambda at, v: {"header": ros_time(at), "a": xyz(v)}),
        "/pose": ("", lambda at, v: {"header": ros_time(at), "pose": {"orientation": dict([*xyz(v).items()][::-1])}}),
        "/tf": ("", lambda at, v: {"transforms": [{"header": ros_time(at), "rotation": xyz(v)}]}),
    }
    path, bench = tmp_path / "j.mcap", Bench((), gravity_mps2=9.81).to_metadata()
    for field in ("/pose:pose.orientation", "/tf:transforms.0.rotation@transforms.0.header.stamp"):
        topic = field.partition(":")[0]
        write_json(path, {key: topics[key] for key in ("/imu", topic)}, batch)
        assert_equal(read(Recording(path, bench, fields=["accel=/imu:a", f"attitude={field}"])), batch)
    write_json(path, {key: topics[key] for key in ("/imu", "/pose")}, batch)
    with pytest.raises(KfCalibError, match="pose in a message is an object with orientation in place of a number"):
        read(Recording(path, bench, fields=["accel=/imu:a", "attitude=/pose:pose"]))


@pytest.mark.parametrize(
    ("message", "path", "expected"),
    [
        ({"t": 1.25}, "t", 1_250_000_000),
        ({"t": 1750000000.1234567}, "t", 1_750_000_000_123_456_700),
        ({"t_ms": 12}, "t_ms", 12_000_000),
        ({"t": {"us": 3}}, "t.us", 3_000),
        ({"t": {"seconds": 2, "nanos": 5}}, "t", 2_000_000_005),
        ({"t": {"sec": 2}}, "t", 2_000_000_000),
        ({"t": "2026-05-04T12:00:00.000000001Z"}, "t", 1_777_896_000_000_000_001),
    ],
)
def test_times(message: Any, path: str, expected: int) -> None:
    assert time_ns(message, path) == expected


def test_what_is_not_a_number_is_passed_on(tmp_path: Path) -> None:
    topics = {**ROS, "/imu": ("", lambda at, v: {"t_ns": at, "acc": [None, 10**400, v[2]]})}
    path = write_json(tmp_path / "json.mcap", topics)
    first = read(Recording(path, KEYS, fields=["accel=/imu:acc@t_ns"])).accel.values[0]
    assert math.isnan(first[0]) and math.isinf(first[1])


BROKEN: dict[str, tuple[Shape, str]] = {
    "another name": (lambda at, v: {"t_ns": at, "acceleration": v}, "a message has no acc: it has t_ns, acceleration"),
    "too few": (lambda at, v: {"t_ns": at, "acc": v[:2]}, "acc gives 2 numbers a message in place of 3"),
    "text": (lambda at, v: {"t_ns": at, "acc": ["a", "b", "c"]}, "acc in a message is 'a' in place of a number"),
    "objects": (lambda at, v: {"t_ns": at, "acc": xyz(v) | {"t": 0}}, "acc in a message is an object with x, y, z, t"),
    "no time": (lambda at, v: {"acc": v}, "a message has no t_ns: it has acc"),
    "time of text": (lambda at, v: {"t_ns": "noon", "acc": v}, "t_ns in a message is 'noon', not a time such as 2026"),
    "time of nothing": (lambda at, v: {"t_ns": None, "acc": v}, "t_ns in a message is no time: name another"),
    "time too large": (lambda at, v: {"t_ns": 10**30, "acc": v}, "t_ns in a message is too large for a time"),
    "endless time": (lambda at, v: {"t_ns": math.inf, "acc": v}, "t_ns in a message is inf, which is no time"),
    "a list": (lambda at, v: v, "acc in a message is|a message has no acc"),
}


@pytest.mark.parametrize("broken", BROKEN)
def test_messages_that_are_not_as_stated_are_told_in_one_sentence(tmp_path: Path, broken: str) -> None:
    shape, says = BROKEN[broken]
    path = write_json(tmp_path / "json.mcap", {**ROS, "/imu": ("", shape)})
    with pytest.raises(InputError, match=says) as refused:
        read(Recording(path, KEYS, fields=["accel=/imu:acc@t_ns"]))
    assert str(refused.value).startswith(f"{path}: topic /imu cannot be used: ") and "\n" not in str(refused.value)


def test_what_is_no_json_is_told(tmp_path: Path) -> None:
    path = tmp_path / "bad.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for topic, data in (("/imu", b"[[" * 100_000), ("/joints", b"{")):
            schema = writer.register_schema(
                {"/imu": "sensor_msgs/Imu", "/joints": "sensor_msgs/JointState"}[topic], "", b""
            )
            channel = writer.register_channel(topic, "json", schema)
            writer.add_message(channel, log_time=START_NS, data=data, publish_time=START_NS)
        writer.finish()
    with pytest.raises(InputError, match=r"topic /imu cannot be used: a message is not JSON, it begins with b'\[\["):
        read(Recording(path, KEYS))


def test_a_message_that_is_no_json_is_left_out_and_told(tmp_path: Path) -> None:
    path = write_json(tmp_path / "json.mcap", ROS, enable_crcs=False, compression=CompressionType.NONE)
    content = path.read_bytes()
    where = content.index(b'{"header"', len(content) // 2)
    path.write_bytes(content[:where] + b"[" + content[where + 1 :])
    recording = Recording(path, KEYS)
    found = read(recording)
    streams = (found.accel, found.pose, found.temperature)
    assert sum(map(len, streams)) == len(BATCH.accel) + len(BATCH.pose) + len(BATCH.temperature) - 1
    assert [said for said in recording.warnings if "1 messages are left out (first: a message is not JSON" in said]


@pytest.mark.parametrize(
    ("field", "says"),
    [
        ("accel", "cannot be read: write QUANTITY=TOPIC:PATH"),
        ("speed=/imu:v", "accel, angles, attitude or temperature for the quantity"),
        ("accel=acc.x", "cannot be read: write QUANTITY=TOPIC:PATH"),
        ("accel=/imu:acc x", "'acc x' is no path"),
        ("accel=/imu:a,,b", "'' is no path"),
        ("angles=/j:position[name", "is no path"),
        ("angles=/j:a,b[name]", "is no path"),
    ],
)
def test_fields_that_cannot_be_read(field: str, says: str) -> None:
    with pytest.raises(InputError, match=says):
        Fields.of(field)


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        (("accel=/other:acc",), "no accelerometer topic '/other', it has /imu .*or of another type by"),
        (("accel=/imu:a", "accel=/imu:b"), "says twice where the accelerometer is"),
    ],
)
def test_fields_that_do_not_fit_the_file(tmp_path: Path, fields: tuple[str, ...], says: str) -> None:
    with pytest.raises(InputError, match=says):
        Recording(write_json(tmp_path / "json.mcap", ROS), KEYS, fields=fields)


def write_protobuf(path: Path, *, schema: bytes | None = None, data: bytes | None = None) -> Path:
    """A file with bench.Accel and bench.Angles in protobuf, whose descriptors depend on each other."""
    pb2 = pytest.importorskip("google.protobuf.descriptor_pb2", reason="protobuf is not there: pip install it")
    from google.protobuf import descriptor_pool, message_factory, timestamp_pb2

    double, message = pb2.FieldDescriptorProto.TYPE_DOUBLE, pb2.FieldDescriptorProto.TYPE_MESSAGE
    vector = pb2.FileDescriptorProto(name="vector.proto", package="bench", syntax="proto3")
    kind = vector.message_type.add(name="Vector")
    for number, axis in enumerate("xyz", 1):
        kind.field.add(name=axis, number=number, type=double, label=1)
    bench = pb2.FileDescriptorProto(
        name="bench.proto",
        package="bench",
        syntax="proto3",
        dependency=["vector.proto", "google/protobuf/timestamp.proto"],
    )
    for name in ("Accel", "Angles"):
        kind = bench.message_type.add(name=name)
        kind.field.add(name="at", number=1, type=message, type_name=".google.protobuf.Timestamp", label=1)
        kind.field.add(name="v", number=2, type=message, type_name=".bench.Vector", label=1)
        kind.field.add(name="list", number=3, type=double, label=3)
    time = pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(time)
    files = pb2.FileDescriptorSet(file=[bench, vector, time])
    pool = descriptor_pool.DescriptorPool()
    for each in (time, vector, bench):
        pool.Add(each)
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=8_000)
        writer.start()
        for name, stream in (("Accel", BATCH.accel), ("Angles", BATCH.pose)):
            number = writer.register_schema(f"bench.{name}", "protobuf", schema or files.SerializeToString())
            channel = writer.register_channel(f"/{name.lower()}", "protobuf", number)
            make = message_factory.GetMessageClass(pool.FindMessageTypeByName(f"bench.{name}"))
            for at, values in zip(stream.time_ns.tolist(), stream.values.tolist(), strict=True):
                made = make(v=xyz(values), list=values)
                made.at.seconds, made.at.nanos = divmod(at, 10**9)
                writer.add_message(channel, at, data or made.SerializeToString(), at)
        writer.finish()
    return path


IN_PROTOBUF = ("accel=/accel:v.x,v.y,v.z@at", "angles=/angles:list@at")


def test_messages_in_protobuf(tmp_path: Path) -> None:
    recording = Recording(write_protobuf(tmp_path / "run.mcap"), KEYS, fields=IN_PROTOBUF)
    assert_equal(read(recording), Batch(BATCH.accel, BATCH.pose))
    assert recording.warnings == []


@pytest.mark.parametrize(
    ("options", "fields", "says"),
    [
        ({"schema": b"nothing"}, IN_PROTOBUF, "its schema 'bench.Accel' does not say what its protobuf messages are"),
        ({"data": b"\xff\xff"}, IN_PROTOBUF, "a message is no bench.Accel in protobuf"),
        ({}, ("accel=/accel:w", IN_PROTOBUF[1]), "a message has no w: it has at, v, list"),
        ({}, ("accel=/accel:at", IN_PROTOBUF[1]), "at in a message is an object with"),
    ],
)
def test_broken_messages_in_protobuf(tmp_path: Path, options: Any, fields: Any, says: str) -> None:
    with pytest.raises(KfCalibError, match=says):
        read(Recording(write_protobuf(tmp_path / "run.mcap", **options), KEYS, fields=fields))
