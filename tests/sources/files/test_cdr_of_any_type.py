"""Messages in CDR of types that nobody knows are read by their definition in the file."""

import sqlite3
import struct
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import zstandard
from helpers.recordings import ANGLES, BATCH, BENCH, assert_equal, read, record, stamped, write_db3
from mcap.writer import Writer

from kf_calib.bench.streams import Batch, Stream
from kf_calib.errors import InputError
from kf_calib.sources.files.cdr import JOINT_STATE
from kf_calib.sources.files.recording import Recording

pytest.importorskip("mcap_ros2", reason="mcap-ros2-support is not there")

KIND = "bench_msgs/msg/Accel"
DEFINITION = """uint64 t_ns
string serial
Vector force
================================================================================
MSG: bench_msgs/Vector
float64[3] xyz
"""
FIELDS = ("accel=/block:force.xyz@t_ns",)
KEYS = BENCH.to_metadata()
EXPECTED = Batch(BATCH.accel, BATCH.pose, Stream.empty(1))


def messages() -> list[tuple[int, bytes]]:
    """Each reading as a message of the type above, in CDR: the string ends where the numbers have to be aligned."""
    return [(at, b"\0\1\0\0" + struct.pack("<QI4s3d", at, 4, b"417\0", *force)) for at, force in
            zip(BATCH.accel.time_ns.tolist(), BATCH.accel.values.tolist(), strict=True)]  # fmt: skip


def write_mcap(path: Path, *, definition: str = DEFINITION, language: str = "ros2msg", cut: int | None = None) -> Path:
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=8_000)
        writer.start(profile="ros2")
        block = writer.register_channel("/block", "cdr", writer.register_schema(KIND, language, definition.encode()))
        known = writer.register_schema(JOINT_STATE.name, "ros2msg", JOINT_STATE.schema.encode())
        angles = writer.register_channel("/platform/angles", "cdr", known)
        both = [(at, block, data[:cut]) for at, data in messages()]
        both += [(at, angles, data) for at, _, data in stamped((ANGLES,))]
        for at, channel, data in sorted(both):
            writer.add_message(channel, at, data, at)
        writer.finish()
    return path


def write_bag(path: Path, *, defined: bool = True, packed: bool = False) -> Path:
    write_db3(path, (ANGLES,))
    pack = zstandard.ZstdCompressor().compress if packed else bytes
    with closing(sqlite3.connect(path)) as base, base:
        base.execute("INSERT INTO topics VALUES(2, '/block', ?, 'cdr', '')", (KIND,))
        if defined:
            base.execute("CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type, encoding, "
                         "encoded_message_definition, type_description_hash)")  # fmt: skip
            base.execute("INSERT INTO message_definitions VALUES(1, ?, 'ros2msg', ?, '')", (KIND, DEFINITION))
        base.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES(2, ?, ?)",
                         [(at, pack(data)) for at, data in messages()])  # fmt: skip
    return path


@pytest.mark.parametrize("packed", [False, True])
def test_in_sqlite(tmp_path: Path, packed: bool) -> None:
    assert_equal(read(Recording(write_bag(tmp_path / "a.db3", packed=packed), KEYS, fields=FIELDS)), EXPECTED)


def test_in_mcap(tmp_path: Path) -> None:
    recording = Recording(write_mcap(tmp_path / "a.mcap"), KEYS, fields=FIELDS)
    for _ in range(2):
        assert_equal(read(recording), EXPECTED)
    assert recording.warnings == []


def test_a_known_type_by_its_fields(tmp_path: Path) -> None:
    path = record(tmp_path / "run.mcap", BATCH)
    fields = [f"accel=/accelerometer:{','.join(f'linear_acceleration.{axis}' for axis in 'xyz')}",
              "angles=/platform/angles:position[name]"]  # fmt: skip
    assert_equal(read(Recording(path, fields=fields)), BATCH)


@pytest.mark.parametrize("write", [write_mcap, write_bag])
def test_info_shows_what_is_in_them(write: Any, run: Any, tmp_path: Path) -> None:
    path = write(tmp_path / "run")
    found = run.json("info", path)
    paths = {topic["topic"]: topic["fields"] for topic in found["topics"]}
    assert paths == {"/block": ["t_ns", "serial", "force.xyz"], "/platform/angles": []}
    assert "--field accel=TOPIC:X,Y,Z@TIME" in found["command"] and "--field angles" not in found["command"]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"definition": ""}, "/block cannot be used: the file does not define its messages, bench_msgs/msg/Accel"),
        ({"definition": "float64["}, "the definition of its messages, bench_msgs/msg/Accel, cannot be read"),
        ({"language": "ros2idl"}, "are defined in 'ros2idl' and can be read if defined in 'ros2msg': convert the file"),
        ({"language": "omgidl"}, "only 'cdr' with 'ros2msg', 'json' and 'protobuf' can be read"),
        ({"cut": 20}, "a message is no bench_msgs/msg/Accel in CDR"),
        ({"definition": DEFINITION.replace("xyz", "v")}, "a message has no force.xyz: it has v, so name what is to be"),
    ],
)
def test_what_cannot_be_read_is_told(options: dict[str, Any], says: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        read(Recording(write_mcap(tmp_path / "a.mcap", **options), KEYS, fields=FIELDS))
    assert says in str(caught.value)


def test_a_bag_without_definitions_says_how_to_get_them(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="convert it to MCAP, which does, by `ros2 bag convert`"):
        read(Recording(write_bag(tmp_path / "a.db3", defined=False), KEYS, fields=FIELDS))
