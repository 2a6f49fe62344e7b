"""Bags that no recorder writes: reading them ends soon, in bounded memory, and uses what is sound in them."""

import random
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
import zstandard
from helpers.bounded import bounded
from helpers.long_runs import slow
from helpers.recordings import ACCEL, ANGLES, BATCH, BENCH, HEAT, altered, assert_equal, read, write_db3

from kf_calib.errors import InputError, KfCalibError
from kf_calib.sources.files.fields import paths_of
from kf_calib.sources.files.inventory import inventory_of
from kf_calib.sources.files.record_files import files_of
from kf_calib.sources.files.recording import Recording

KEYS = BENCH.to_metadata()
ENDLESS = ("SELECT n AS id, 1 AS topic_id, n AS timestamp, zeroblob(100) AS data FROM (WITH RECURSIVE c(n) AS "
           "(SELECT 1 UNION ALL SELECT n+1 FROM c) SELECT n FROM c)")  # fmt: skip
HUGE = "SELECT 1 AS id, 1 AS topic_id, 1 AS timestamp, zeroblob(900000000) AS data"


def changed(path: Path, *statements: str) -> Path:
    return altered(write_db3(path), *statements)


def refused(path: Path) -> str:
    with bounded(), pytest.raises(InputError) as error:
        read(Recording(path, KEYS))
    with bounded(), pytest.raises(InputError):
        inventory_of(path)
    return str(error.value)


@pytest.mark.parametrize("view", [ENDLESS, HUGE])
def test_a_view_is_no_table(view: str, tmp_path: Path) -> None:
    path = changed(tmp_path / "a.db3", "DROP TABLE messages", f"CREATE VIEW messages AS {view}")
    assert "its messages are no table but computed" in refused(path)


def test_computed_columns_are_no_messages(tmp_path: Path) -> None:
    columns = "id INTEGER PRIMARY KEY, topic_id INT, timestamp INT, data BLOB GENERATED ALWAYS AS (zeroblob(900000000))"
    path = changed(tmp_path / "a.db3", "DROP TABLE messages", f"CREATE TABLE messages({columns})",
                   "INSERT INTO messages(topic_id, timestamp) VALUES (1, 1), (1, 2)")  # fmt: skip
    assert "its table messages has columns that are computed" in refused(path)


def test_a_virtual_table_is_none(tmp_path: Path) -> None:
    path = changed(tmp_path / "a.db3", "DROP TABLE messages",
                   "CREATE VIRTUAL TABLE messages USING fts5(id, topic_id, timestamp, data)")  # fmt: skip
    assert "its messages are no table but computed" in refused(path)


def test_a_trigger_is_never_run(tmp_path: Path) -> None:
    path = changed(tmp_path / "a.db3", "CREATE TRIGGER t AFTER INSERT ON messages BEGIN DELETE FROM messages; END",
                   "CREATE VIEW other AS " + ENDLESS)  # fmt: skip
    with bounded():
        assert_equal(read(Recording(path, KEYS)), BATCH)


def test_numbers_up_to_the_last_that_there_is(tmp_path: Path) -> None:
    """Rows that cannot be read around 2^63 - 1: the loop over numbers has to end."""
    path = changed(
        tmp_path / "a.db3", f"UPDATE messages SET id = {2**63 - 1} WHERE id = (SELECT max(id) FROM messages)"
    )
    content = bytearray(path.read_bytes())
    for page in range(8, len(content) // 4096 - 1, 2):  # every other one, which leaves holes of any size
        content[4096 * page : 4096 * page + 100] = b"\xff" * 100
    path.write_bytes(content)
    with bounded():
        recording = Recording(path, KEYS)
        rest = read(recording)
    assert 0 < len(rest.accel) < len(BATCH.accel)
    assert "is damaged (" in recording.warnings[0] and "messages are lost" in recording.warnings[0]


def test_negative_numbers_are_read_as_they_are_counted(tmp_path: Path) -> None:
    path = changed(tmp_path / "a.db3", "UPDATE messages SET id = id - 1000000")
    assert_equal(read(Recording(path, KEYS)), BATCH)
    assert sum(topic.count for topic in inventory_of(path).topics) == sum(map(len, (ACCEL[3], ANGLES[3], HEAT[3])))


def test_what_is_unfit_is_left_out_and_counted(tmp_path: Path) -> None:
    """Ids that are text, a topic twice, a message without bytes, one of no topic: the rest of the bag is used."""
    path = tmp_path / "a.db3"
    write_db3(path)
    with closing(sqlite3.connect(path, isolation_level=None)) as base:
        rows = base.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY id").fetchall()
        topics = base.execute("SELECT id, name, type FROM topics").fetchall()
        base.execute("DROP TABLE messages")
        base.execute("DROP TABLE topics")
        base.execute("CREATE TABLE topics(id, name, type, serialization_format)")
        base.execute("CREATE TABLE messages(id TEXT, topic_id, timestamp, data)")
        base.executemany("INSERT INTO topics VALUES(?, ?, ?, 'cdr')", [(f"t{k}", *rest) for k, *rest in topics])
        base.execute("INSERT INTO topics VALUES('t1', '/again', 'x/msg/Y', 'cdr'), ('t9', NULL, x'00', 'cdr')")
        base.executemany("INSERT INTO messages VALUES(?, ?, ?, ?)",
                         [(f"m{k}", f"t{row[0]}", *row[1:]) for k, row in enumerate(rows)])  # fmt: skip
        base.execute("INSERT INTO messages VALUES(NULL, 't1', 1, NULL), ('x', 't1', NULL, ''), ('y', 't7', 1, x'00')")
    with bounded():
        recording = Recording(path, KEYS)
        assert_equal(read(recording), BATCH)
        counted = inventory_of(path)
    assert recording.warnings == [
        f"{path}: 2 of its topics have no name or the id of another one, and are left out.",
        f"{path}: 2 messages are empty and left out.",
    ]
    assert any("1 messages are of no topic that it lists" in said for said in counted.warnings)


def test_one_message_that_is_too_long_costs_itself_alone(tmp_path: Path) -> None:
    path = changed(tmp_path / "a.db3", "UPDATE messages SET data = zeroblob(3000000) WHERE id = "
                   "(SELECT id FROM messages WHERE topic_id = 1 LIMIT 1 OFFSET 100)")  # fmt: skip
    recording = Recording(path, KEYS, max_chunk_mb=2.0)
    kept = read(recording)
    assert len(kept.accel) == len(BATCH.accel) - 1 and len(kept.pose) == len(BATCH.pose)
    assert "up to 1 of its" in recording.warnings[0] and "too big" in recording.warnings[0]


@pytest.mark.parametrize("name", ["a.db3.zstd", "a.mcap.zstd"])
def test_a_packed_file_unpacks_to_a_bounded_one(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    packer, begin = zstandard.ZstdCompressor(), b"SQLite format 3\0"
    with (tmp_path / name).open("wb") as file, packer.stream_writer(file) as writer:
        writer.write(begin)
        for _ in range(300):
            writer.write(bytes(1 << 20))
    assert (tmp_path / name).stat().st_size < 100_000
    with bounded(), pytest.raises(InputError, match="more than the 256 MB that --max-chunk-mb allows"):
        Recording(tmp_path / name, KEYS)
    assert not list(folder.iterdir())


@pytest.mark.parametrize("text", [" " * 200_000, "relative_file_paths:\n- a" + " " * 200_000 + "b\n",
                                  "relative_file_paths:" + " " * 200_000, ("- " * 100_000)])  # fmt: skip
def test_metadata_of_many_spaces_takes_no_time(text: str, tmp_path: Path) -> None:
    write_db3(tmp_path / "bag" / "bag_0.db3")
    (tmp_path / "bag" / "metadata.yaml").write_text(text)
    with bounded(seconds=2.0):
        try:
            files_of(tmp_path / "bag")
        except InputError as error:
            assert "which its metadata.yaml names" in str(error)


def test_messages_that_are_nested_without_end(tmp_path: Path) -> None:
    """A type of protobuf that holds itself, files of descriptors in a row, and lists in lists."""
    from google.protobuf import descriptor_pb2
    from google.protobuf.descriptor_pool import DescriptorPool
    from google.protobuf.message_factory import GetMessageClass
    from mcap.writer import Writer

    files = descriptor_pb2.FileDescriptorSet()
    node = files.file.add(name="node.proto", package="p")
    kind = node.message_type.add(name="Node")
    kind.field.add(name="x", number=1, type=1, label=1)
    for k in range(2, 6):
        kind.field.add(name=f"next{k}", number=k, type=11, label=1, type_name=".p.Node")
    pool = DescriptorPool()
    pool.Add(node)
    with bounded():
        assert len(list(paths_of(GetMessageClass(pool.FindMessageTypeByName("p.Node"))()))) == 1000
    for k in range(3000):
        files.file.add(name=f"f{k}.proto", dependency=[f"f{k + 1}.proto"] if k < 2999 else [])
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("p.Node", "protobuf", files.SerializeToString())
        channel = writer.register_channel("/deep", "protobuf", schema)
        plain = writer.register_channel("/json", "json", writer.register_schema("q", "jsonschema", b"{}"))
        writer.add_message(channel, 1, b"", 1)
        writer.add_message(plain, 1, b'{"a": ' + b"[" * 600 + b"1" + b"]" * 600 + b"}", 1)
        writer.finish()
    with bounded():
        assert {topic.name for topic in inventory_of(path).topics} == {"/deep", "/json"}
    for fields in ("accel=/deep:x,x,x", "accel=/json:a"):
        with bounded(), pytest.raises(InputError):
            read(Recording(path, KEYS, fields=[fields], angles=False))


@pytest.mark.parametrize("cases", [25, *slow(2000)])
def test_mutated_bags_are_read_or_refused_in_a_sentence(cases: int, tmp_path: Path) -> None:
    rng, path, whole = random.Random(11), tmp_path / "a.db3", 0
    write_db3(path)
    plain = path.read_bytes()
    for _ in range(cases):
        path.write_bytes(mutated(plain, rng))
        with bounded():
            try:
                whole += len(read(Recording(path, KEYS)).accel) > 0
                inventory_of(path)
            except KfCalibError as error:
                assert "\n" not in str(error) and len(str(error)) < 1500
    assert 0.1 * cases < whole < 0.99 * cases


def mutated(content: bytes, rng: random.Random) -> bytes:
    """A bag with bytes of it flipped, overwritten or copied from elsewhere, at the heads of pages above all."""
    made = bytearray(content)
    for _ in range(rng.choice([1, 2, 5, 20])):
        page = 4096 * rng.randrange(len(made) // 4096)
        at = page + rng.choice([rng.randrange(16), rng.randrange(120), rng.randrange(4096)])
        size = rng.choice([1, 2, 8, 100])
        kind = rng.randrange(4)
        if kind == 0:
            made[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            made[at : at + size] = rng.randbytes(size)
        elif kind == 2:
            other = 4096 * rng.randrange(len(made) // 4096)
            made[page : page + 4096] = made[other : other + 4096]
        else:
            made[at : at + size] = rng.choice([b"\x00", b"\xff", b"\x7f"]) * size
    made = made[: len(content)]
    return bytes(made[: rng.randrange(100, len(made))]) if rng.random() < 0.1 else bytes(made)
