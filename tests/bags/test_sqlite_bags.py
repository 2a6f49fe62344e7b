"""Bags in SQLite hold what the same samples recorded as MCAP do, compressed or not, in one file or several."""

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
import zstandard
from helpers.recordings import (
    ACCEL,
    ANGLES,
    BATCH,
    BENCH,
    HEAT,
    Topic,
    altered,
    assert_equal,
    part_of,
    read,
    record,
    write_db3,
)

from kf_calib.bench.streams import Stream
from kf_calib.sources.files.recording import Recording

KEYS = BENCH.to_metadata()
TEXT: Topic = ("/chatter", ACCEL[1], ACCEL[2], ACCEL[3])


def compress(data: bytes) -> bytes:
    return zstandard.ZstdCompressor().compress(data)


def pack_file(path: Path) -> Path:
    packed = path.with_name(f"{path.name}.zstd")
    packed.write_bytes(compress(path.read_bytes()))
    path.unlink()
    return packed


def test_streams_are_those_of_the_recorder(tmp_path: Path) -> None:
    expected = read(Recording(record(tmp_path / "run.mcap", BATCH)))
    found = Recording(write_db3(tmp_path / "run.db3"), KEYS)
    assert_equal(read(found), expected)
    assert found.fraction == 1.0 and found.warnings == []
    assert_equal(read(found), expected)  # a second time


def test_messages_compressed_one_by_one(tmp_path: Path) -> None:
    assert_equal(read(Recording(write_db3(tmp_path / "run.db3", pack=compress), KEYS)), BATCH)


@pytest.mark.parametrize("with_metadata", [True, False])
@pytest.mark.parametrize("packed", [True, False])
def test_files_of_one_run_follow_each_other(tmp_path: Path, packed: bool, with_metadata: bool) -> None:
    bag = tmp_path / "bag"
    files = [write_db3(bag / f"bag_{n}.db3", tuple(part_of(topic, k, 3) for topic in (ACCEL, ANGLES, HEAT)))
             for k, n in enumerate((0, 2, 10))]  # fmt: skip
    if packed:
        files = [pack_file(file) for file in files]
    if with_metadata:
        names = "\n".join(f"    - {file.name}" for file in files)
        (bag / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  relative_file_paths:\n{names}\n")
    assert_equal(read(Recording(bag, KEYS)), BATCH)


def test_what_was_unpacked_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place = tmp_path / "place"
    place.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(place))
    recording = Recording(pack_file(write_db3(tmp_path / "run.db3")), KEYS)
    assert len(list(place.iterdir())) == 1
    assert_equal(read(recording), BATCH)
    del recording
    assert list(place.iterdir()) == []


def test_other_topics_are_not_fetched(tmp_path: Path) -> None:
    path = write_db3(tmp_path / "run.db3", (TEXT, ACCEL, ANGLES, HEAT))
    altered(path, "UPDATE topics SET type='std_msgs/msg/String' WHERE id=1",
            "UPDATE messages SET data=zeroblob(100000) WHERE topic_id=1")  # fmt: skip
    recording = Recording(path, KEYS)
    assert_equal(read(recording), BATCH)
    assert recording.warnings == []


def test_a_write_ahead_log_that_was_left_is_read(tmp_path: Path) -> None:
    path = write_db3(tmp_path / "run.db3")
    with closing(sqlite3.connect(path)) as base:  # still open, as after a recorder that was killed
        base.execute("PRAGMA journal_mode=WAL")
        base.execute("INSERT INTO messages(topic_id, timestamp, data) SELECT topic_id, timestamp, data FROM messages "
                     "WHERE topic_id=1 ORDER BY id DESC LIMIT 1")  # fmt: skip
        base.commit()
        assert path.with_name("run.db3-wal").stat().st_size
        assert len(read(Recording(path, KEYS)).accel) == len(BATCH.accel) + 1


def test_damage_within_costs_the_messages_around_it(tmp_path: Path) -> None:
    path = write_db3(tmp_path / "run.db3", tuple((*topic[:3], _longer(topic[3])) for topic in (ACCEL, ANGLES)))
    whole = len(read(Recording(path, KEYS)).accel)
    content = bytearray(path.read_bytes())
    middle = len(content) // 2 // 4096 * 4096
    content[middle : middle + 4096] = b"\xff" * 4096
    path.write_bytes(content)
    recording = Recording(path, KEYS)
    found = read(recording)
    assert whole // 3 < len(found.accel) < whole
    assert len(recording.warnings) == 1 and "of its 22000 messages are lost" in recording.warnings[0]


def _longer(stream: Stream) -> Stream:
    """Fifty times the stream, one after the other."""
    step = int(stream.time_ns[-1] - stream.time_ns[0]) + 10_000_000
    return sum((Stream(stream.time_ns + k * step, stream.values) for k in range(1, 50)), stream)


def test_messages_that_do_not_decompress_are_told(tmp_path: Path) -> None:
    path = write_db3(tmp_path / "run.db3", pack=compress)
    altered(path, "UPDATE messages SET data=substr(data, 1, 20) WHERE id % 10 = 0")
    recording = Recording(path, KEYS)
    lost = len(BATCH.accel) + len(BATCH.pose) + len(BATCH.temperature)
    assert len(read(recording).accel) < len(BATCH.accel)
    assert (
        f": {lost // 10} messages before byte" in recording.warnings[0] and "do not decompress" in recording.warnings[0]
    )
