"""Broken bags: each is refused in one sentence that names the file and says what to do, and nothing else is printed."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import zstandard
from helpers.recordings import ACCEL, ANGLES, altered, write_db3, write_messages, write_officially

OPTIONS = ("--axes", "y z x", "--gravity", "9.81")
LISTED = "rosbag2_bagfile_information:\n  relative_file_paths:\n"
JSON = {"t": 1.0, "acc": [0.0, 1.0, 0.0], "deg": [0.0, 0.0, 0.0], "text": "up"}
BY_FIELDS = ("--field", "accel=/imu:acc@t", "--field", "angles=/imu:deg@t")


def changed(*statements: str) -> Callable[[Path], Path]:
    """A bag in SQLite that some statements have changed."""
    return lambda folder: altered(write_db3(folder / "run.db3"), *statements)


def content(data: bytes, name: str = "run.mcap") -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / name).write_bytes(data)
        return folder / name

    return make


def cut(share: float, sqlite: bool = True) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        path = write_db3(folder / "run.db3") if sqlite else write_officially(folder / "run.mcap")
        path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])
        return path

    return make


def official(**options: Any) -> Callable[[Path], Path]:
    return lambda folder: write_officially(folder / "run.mcap", **options)


def in_json(*messages: object, encoding: str = "json", count: int = 20) -> Callable[[Path], Path]:
    """Messages of one topic, the same ``count`` times."""
    return lambda folder: write_messages(folder / "run.mcap", {"/imu": messages * count}, encoding)


def folder_of(*names: str, listed: str = "") -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (bag := folder / "bag").mkdir()
        for name in names:
            write_db3(bag / name)
        if listed:
            (bag / "metadata.yaml").write_text(LISTED + listed)
        return bag

    return make


def packed(folder: Path) -> Path:
    """A compressed file that has lost its end."""
    path = write_db3(folder / "run.db3")
    data = zstandard.ZstdCompressor().compress(path.read_bytes())
    (folder / "run.db3.zstd").write_bytes(data[: len(data) // 2])
    return folder / "run.db3.zstd"


def half_a_bag(folder: Path) -> Path:
    """A bag of which the second file is none."""
    bag = folder_of("a_0.db3", "a_1.db3")(folder)
    (bag / "a_1.db3").write_bytes(b"nothing")
    return bag


BROKEN: dict[str, tuple[Callable[[Path], Path], tuple[str, ...], str]] = {
    "no tables": (changed("DROP TABLE messages"), (), "cannot be read as a ROS 2 bag (it has no table messages)"),
    "other tables": (changed("ALTER TABLE topics RENAME COLUMN type TO k"), (), "no such column: type"),
    "no topics": (changed("DELETE FROM topics"), (), "has no accelerometer topic"),
    "no messages": (changed("DELETE FROM messages"), (), "holds no accelerometer readings"),
    "no accelerometer": (changed("DELETE FROM topics WHERE id=1"), (), "has no accelerometer topic"),
    "no angles": (changed("UPDATE topics SET type='nav_msgs/msg/Path' WHERE id=2"), (), "no angle or attitude topic"),
    "two accelerometers": (lambda folder: write_db3(folder / "a.db3", (("/a", *ACCEL[1:]), ("/b", *ACCEL[1:]), ANGLES)),
                           (), "has several accelerometer topics, /a, /b: choose one by --accel-topic"),
    "another serialisation": (changed("UPDATE topics SET serialization_format='cbor'"), (), "'cbor' messages"),
    "messages of another type": (changed("UPDATE topics SET type='sensor_msgs/msg/Imu' WHERE id=3",
                                         "DELETE FROM topics WHERE id=1"), (), "/temperature cannot be used: "),
    "short messages": (changed("UPDATE messages SET data=substr(data, 1, 30)"), (), "cannot be used: "),
    "no bytes": (changed("UPDATE messages SET data=zeroblob(0)"), (), "holds no accelerometer readings"),
    "text for bytes": (changed("UPDATE messages SET data='nothing'"), (), "cannot be used: "),
    "big-endian": (changed("UPDATE messages SET data=CAST(x'00000000' || substr(data, 5) AS BLOB)"), (),
                   "only 00 01 (little-endian CDR"),
    "the head of a database": (lambda folder: content(b"SQLite format 3\0" + bytes(84), "a.db3")(folder), (),
                               "cannot be read as a ROS 2 bag"),
    "a database cut short": (cut(0.02), (), "a damaged one may be mended by `sqlite3 "),
    "a compressed file cut short": (packed, (), "run.db3.zstd does not decompress"),
    "an empty file": (content(b""), (), "is empty"),
    "zeros": (content(bytes(4000)), (), "is not an MCAP file"),
    "a bag of ROS 1": (content(b"#ROSBAG V2.0\n....", "old.bag"), (), "is a bag of ROS 1 that cannot be read"),
    "the head of an MCAP file": (content(b"\x89MCAP0\r\n"), (), "has no accelerometer topic"),
    "an MCAP file cut short": (cut(0.01, sqlite=False), (), "and is not whole"),
    "lines of text": (content(b'{"time_s": 1}\n', "a.jsonl"), (), "no platform angles in 1 lines: name"),
    "schemas of another language": (official(schema_encoding="flatbuffer"), (), "can be read: convert the file"),
    "messages of ROS 1": (official(encoding="ros1", schema_encoding="ros1msg"), (), "topic /accelerometer has 'ros1'"),
    "JSON that is none": (in_json(b"{acc"), BY_FIELDS, "a message is not JSON, it begins with b'{acc'"),
    "no such field": (in_json({"t": 1.0}), BY_FIELDS, "a message has no acc: it has t, so name what is to be used"),
    "text for numbers": (in_json(JSON | {"acc": "up"}), BY_FIELDS, "acc in a message is 'up' in place of a number"),
    "two numbers for three": (in_json(JSON | {"acc": [0, 1]}), BY_FIELDS, "acc gives 2 numbers a message in place of"),
    "no time": (in_json(JSON | {"t": "noon"}), BY_FIELDS, "t in a message is 'noon', not a time such as"),
    "a field that cannot be read": (in_json(JSON), ("--field", "acc=/imu"), "--field 'acc=/imu' cannot be read: write"),
    "protobuf without a schema": (in_json(b"\1", encoding="protobuf"), BY_FIELDS, "does not say what its protobuf"),
    "a topic that is not there": (official(), ("--accel-topic", "/foo"), "has no accelerometer topic '/foo', it has"),
    "a folder without a bag": (lambda folder: folder, (), "holds no .mcap and no .db3 file: give the folder"),
    "a folder of two bags": (folder_of("a.db3", "b.db3"), (), "holds several recordings (a.db3, b.db3)"),
    "a file that is listed and lost": (folder_of("a_0.db3", listed="    - a_0.db3\n    - a_1.db3\n"), (),
                                       "lacks a_1.db3, which its metadata.yaml names: bring the whole bag"),
    "half a bag": (half_a_bag, (), "a_1.db3 is not an MCAP file"),
    "nothing there": (lambda folder: folder / "none.mcap", (), "does not exist"),
}  # fmt: skip


@pytest.mark.parametrize("what", BROKEN)
def test_a_broken_bag_is_one_sentence(what: str, run: Any, tmp_path: Path) -> None:
    make, options, expected = BROKEN[what]
    said = run.refused("replay", make(tmp_path), *OPTIONS, *options)
    assert expected in said and said.endswith(".\n") and len(said) < 700


def test_the_bag_that_is_broken_here_is_sound(run: Any, tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    shutil.copytree(Path(__file__).parents[2] / "recordings" / "bench_bag", bag)
    assert run.json("replay", bag, *OPTIONS, "--angle-sigma", "0.2")["dwells"] == 6
    (bag / "bench_bag_1.db3.zstd").unlink()
    said = run.refused("replay", bag, *OPTIONS)
    assert "lacks bench_bag_1.db3.zstd, which its metadata.yaml names" in said
