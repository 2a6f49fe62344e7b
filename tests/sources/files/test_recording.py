"""Reading recordings: our own, others', unfinished, damaged and impossible ones."""

import random
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from helpers.bounded import traced
from helpers.long_runs import slow
from helpers.recordings import (
    ACCEL,
    ANGLES,
    BATCH,
    BENCH,
    HEAT,
    JOINTS,
    START_NS,
    Topic,
    assert_equal,
    count_missing,
    made_batch,
    made_stream,
    read,
    record,
    streams_of,
    write_officially,
)
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from mcap_ros2.decoder import DecoderFactory

from kf_calib.bench.bench import Bench
from kf_calib.bench.streams import Batch, Stream
from kf_calib.errors import BenchError, InputError
from kf_calib.sources.files import cdr, mcap_file, mcap_records
from kf_calib.sources.files.mcap_records import HEAD, MAGIC
from kf_calib.sources.files.recorder import Recorder
from kf_calib.sources.files.recording import Recording


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Several blocks in a small file: the first is walked through, the later ones are searched."""
    monkeypatch.setattr(mcap_file, "_BLOCK", 10_000)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return record(tmp_path / "own.mcap", BATCH, chunk_size=8_000)


def records(data: bytes | bytearray) -> list[tuple[int, int, int]]:
    """Start, opcode and length of each record of a file."""
    position, found = len(MAGIC), []
    while position < len(data) - len(MAGIC):
        opcode, length = HEAD.unpack_from(data, position)
        found.append((position, opcode, length))
        position += HEAD.size + length
    return found


def place_of(data: bytes | bytearray, opcode: int, which: int = 0) -> int:
    return [start for start, found, _ in records(data) if found == opcode][which]


def patched(path: Path, position: int, content: bytes) -> Path:
    data = bytearray(path.read_bytes())
    data[position : position + len(content)] = content
    path.write_bytes(data)
    return path


# Whole files


def test_round_trip_is_exact_whenever_it_is_read(path: Path) -> None:
    recording = Recording(path)
    assert recording.bench == BENCH
    next(iter(recording))
    for _ in range(2):
        assert_equal(read(recording), BATCH)
    assert recording.warnings == []
    assert recording.fraction == 1.0


def test_values_that_are_not_numbers_pass_through(tmp_path: Path) -> None:
    values = np.array([[np.nan, np.inf, -0.0], [5e-324, -np.inf, 1.7976931348623157e308]])
    batch = Batch(Stream(START_NS + np.arange(2), values), Stream.empty(3))
    assert_equal(read(Recording(record(tmp_path / "a.mcap", batch))), batch)


def test_fraction_grows_to_one(tmp_path: Path) -> None:
    recording = Recording(record(tmp_path / "a.mcap", made_batch(20_000)))
    fractions = [recording.fraction for _ in recording]
    assert len(fractions) > 3
    assert fractions == sorted(fractions) and fractions[0] < 0.5


def test_the_real_file_reads_as_by_the_official_reader(ferraris: Path) -> None:
    expected: dict[str, list[tuple[int, list[float]]]] = {"/accelerometer": [], "/platform/angles": []}
    with ferraris.open("rb") as file:
        for item in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            message = item.decoded_message
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            reading = getattr(message, "linear_acceleration", None)
            values = [reading.x, reading.y, reading.z] if reading else message.position
            expected[item.channel.topic].append((stamp, values))
    recording = Recording(ferraris)
    found = read(recording)
    for stream, rows in zip(streams_of(found), expected.values(), strict=False):
        assert stream.time_ns.tolist() == [stamp for stamp, _ in rows]
        assert stream.values.tolist() == [values for _, values in rows]
    assert len(found.accel) == 5443
    assert recording.bench.gravity_mps2 == 9.81
    assert recording.warnings == []


# Files from elsewhere


@pytest.mark.parametrize(
    "options",
    [
        {"index_types": IndexType.NONE},
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.NONE},
        {"use_chunking": False, "enable_data_crcs": True},
        {"repeat_channels": False, "repeat_schemas": False},
        {"use_statistics": False, "use_summary_offsets": False, "index_types": IndexType.CHUNK},
        {"enable_data_crcs": True},
        {"chunk_size": 100},
    ],
)
def test_files_of_the_official_writer_in_all_its_ways(tmp_path: Path, options: dict[str, object]) -> None:
    recording = Recording(write_officially(tmp_path / "a.mcap", **options))
    assert_equal(read(recording), BATCH)
    assert recording.warnings == []
    assert recording.bench == BENCH


@pytest.mark.parametrize("options", [{"use_chunking": False}, {"enable_crcs": False}])
def test_a_file_without_checksums_is_read_with_a_warning(tmp_path: Path, options: dict[str, object]) -> None:
    recording = Recording(write_officially(tmp_path / "a.mcap", **options))
    assert_equal(read(recording), BATCH)
    assert len(recording.warnings) == 1 and "carries no checksums of its readings" in recording.warnings[0]


@pytest.mark.parametrize("options", [{}, {"use_chunking": False, "enable_data_crcs": True}, {"chunk_size": 2_000}])
def test_unrelated_topics_attachments_and_metadata_are_passed_over(tmp_path: Path, options: dict[str, object]) -> None:
    ids: list[int] = []

    def extra(writer: Writer, i: int) -> None:
        if not ids:
            schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
            ids.append(writer.register_channel("/chatter", "cdr", schema))
            ids.append(writer.register_channel("/raw", "json", 0))
        writer.add_message(ids[i % 2], log_time=START_NS, data=bytes(i % 97), publish_time=START_NS)
        if i % 100 == 50:
            writer.add_attachment(0, 0, "photo", "image/jpeg", bytes(3_000_000))
            writer.add_metadata("other", {"a": "b"})

    recording = Recording(write_officially(tmp_path / "a.mcap", extra=extra, **options))
    assert_equal(read(recording), BATCH)
    assert recording.warnings == []


def test_messages_whose_length_changes(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=8_000)
        writer.start(profile="ros2")
        writer.add_metadata("kf_calib.bench", BENCH.to_metadata())
        ids = [
            writer.register_channel(topic, "cdr", writer.register_schema(kind.name, "ros2msg", b""))
            for topic, kind, *_ in (ACCEL, ANGLES)
        ]
        for i in range(len(BATCH.accel)):
            frame = "f" * (i * i % 41)
            data = cdr.pack(cdr.IMU, cdr.imu_message(frame), BATCH.accel[i : i + 1])[0]
            writer.add_message(ids[0], log_time=0, data=data, publish_time=0)
            for angles in range(i // 10, (i + 1) // 10):
                template = cdr.joint_state_message(frame, ["outer", "middle", "inner"])
                data = cdr.pack(cdr.JOINT_STATE, template, BATCH.pose[angles : angles + 1])[0]
                writer.add_message(ids[1], log_time=0, data=data, publish_time=0)
        writer.finish()
    assert_equal(read(Recording(path)), Batch(BATCH.accel, BATCH.pose))


def test_topics_are_found_by_schema_under_any_name_old_ones_and_two_channels_on_one(tmp_path: Path) -> None:
    topics = tuple((f"/elsewhere{topic}", *rest) for topic, *rest in (ACCEL, ANGLES, HEAT))
    assert_equal(read(Recording(write_officially(tmp_path / "other.mcap", topics))), BATCH)
    old = cdr.MessageType("sensor_msgs/Imu", cdr.IMU.schema, cdr.IMU.layout)
    halves = BATCH.accel[:200], BATCH.accel[200:]
    topics = (*(("/accelerometer", old, ACCEL[2], half) for half in halves), ANGLES, HEAT)
    assert_equal(read(Recording(write_officially(tmp_path / "a.mcap", topics))), BATCH)


def test_the_formats_own_topic_names_win(tmp_path: Path) -> None:
    others = made_stream(100, 10**7, 3, START_NS + 5)
    topics = (
        ("/body/imu", cdr.IMU, ACCEL[2], others),
        ("/arm/joints", cdr.JOINT_STATE, JOINTS, others),
        ("/platform/attitude", cdr.QUATERNION, cdr.quaternion_message(""), made_stream(100, 10**7, 4)),
        ACCEL,
        ANGLES,
        HEAT,
    )
    path = write_officially(tmp_path / "a.mcap", topics)
    assert_equal(read(Recording(path)), BATCH)
    found = read(Recording(path, accel_topic="/body/imu", pose_topic="/arm/joints"))
    assert_equal(found, Batch(others, others, BATCH.temperature))
    assert Recording(path, pose_topic="/platform/attitude").bench.axes == ()


@pytest.mark.parametrize("finish", [True, False])
def test_several_candidates_must_be_chosen_from(tmp_path: Path, finish: bool) -> None:
    topics = (("/a", *ACCEL[1:]), ("/b", *ACCEL[1:]), ANGLES)
    path = write_officially(tmp_path / "a.mcap", topics, finish=finish)
    with pytest.raises(InputError, match="several accelerometer topics, /a, /b: choose one by --accel-topic"):
        Recording(path)
    assert_equal(read(Recording(path, accel_topic="/b")), Batch(BATCH.accel, BATCH.pose))


def test_a_wanted_topic_that_is_not_there(path: Path) -> None:
    with pytest.raises(InputError, match=r"no temperature topic '/t', it has .*/temperature \(sensor_msgs.*--temp"):
        Recording(path, temperature_topic="/t")


@pytest.mark.parametrize(
    ("topics", "says"),
    [
        ((ANGLES,), r"no accelerometer topic \(sensor_msgs/msg/Imu\), it has /platform/angles \(sensor.*JointState\)"),
        ((ACCEL,), "no angle or attitude topic .* record the angles too"),
        ((), "it has no topics"),
    ],
)
def test_missing_topics(tmp_path: Path, topics: tuple[Topic, ...], says: str) -> None:
    with pytest.raises(InputError, match=says):
        Recording(write_officially(tmp_path / "a.mcap", topics))


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"encoding": "json"}, "/accelerometer cannot be used: a message is not JSON, it begins with b"),
        ({"encoding": "ros1"}, "'ros1' messages"),
        ({"schema_encoding": "protobuf"}, "in 'protobuf', only 'cdr' with 'ros2msg', 'json' and 'protobuf' can"),
    ],
)
def test_other_encodings(tmp_path: Path, options: dict[str, str], says: str) -> None:
    with pytest.raises(InputError, match=says):
        read(Recording(write_officially(tmp_path / "a.mcap", **options)))


@pytest.mark.parametrize(
    ("topics", "says"),
    [
        ((ACCEL, ("/j", cdr.JOINT_STATE, cdr.joint_state_message("", ["a", "b"]), made_stream(9, 5, 2))), "2 .* 3 g"),
        ((("/a", cdr.IMU, ACCEL[2][:-72] + struct.pack("<d", -1) + bytes(64), BATCH.accel), ANGLES), "not measured"),
        ((("/a", cdr.IMU, b"\0\0" + ACCEL[2][2:], BATCH.accel), ANGLES), "/a .* 00 00, only 00 01"),
    ],
)
def test_messages_that_cannot_be_used(tmp_path: Path, topics: tuple[Topic, ...], says: str) -> None:
    recording = Recording(write_officially(tmp_path / "a.mcap", topics))
    with pytest.raises(InputError, match=says):
        read(recording)


def test_scale_of_the_readings(path: Path) -> None:
    expected = BATCH.accel.values
    assert np.array_equal(read(Recording(path, accel_scale=9.80665)).accel.values, expected * 9.80665)
    each = (1.0, 2.0, -3.0)
    assert np.array_equal(read(Recording(path, accel_scale=each)).accel.values, expected * np.array(each))


# The bench's description


def test_options_win_over_the_file(path: Path) -> None:
    bench = Recording(path, {"gravity_mps2": "9.8", "axes": "x y z"}).bench
    assert (bench.gravity_mps2, bench.axes[0]) == (9.8, (1.0, 0.0, 0.0))
    assert bench.latitude_deg == BENCH.latitude_deg


def test_a_file_without_description_needs_options(tmp_path: Path) -> None:
    path = write_officially(tmp_path / "a.mcap", metadata={})
    with pytest.raises(BenchError, match=r"a\.mcap: the gimbal axes are not stated"):
        Recording(path)
    assert Recording(path, {"axes": "y z x", "gravity_mps2": "9.81"}).bench.gravity_mps2 == 9.81


def test_a_description_at_the_end_of_the_file_is_found(tmp_path: Path) -> None:
    def extra(writer: Writer, i: int) -> None:
        if i == 300:
            writer.add_metadata("kf_calib.bench", BENCH.to_metadata())

    path = write_officially(tmp_path / "a.mcap", metadata={}, extra=extra)
    assert Recording(path).bench == BENCH


def test_a_damaged_description_is_never_used(path: Path) -> None:
    at = path.read_bytes().index(b"9.8153")
    patched(path, at, b"9.8253")
    with pytest.raises(BenchError, match="description of the bench in it is damaged, so give it by options"):
        Recording(path)
    recording = Recording(path, {"axes": "y z x", "gravity_mps2": "9.8153"})
    assert recording.bench == Bench(BENCH.axes, 9.8153)
    assert_equal(read(recording), BATCH)
    assert any("only what options give is used" in warning for warning in recording.warnings)
    assert any("data section CRC mismatch" in warning for warning in recording.warnings)


# Files that are no recordings


def test_paths_and_contents_that_are_no_recording(tmp_path: Path) -> None:
    empty, other = tmp_path / "empty.mcap", tmp_path / "other.mcap"
    empty.touch()
    other.write_text("time_s,ax_mps2\n")
    with pytest.raises(InputError, match=r"absent\.mcap does not exist"):
        Recording(tmp_path / "absent.mcap")
    with pytest.raises(InputError, match=r"empty\.mcap is empty"):
        Recording(empty)
    with pytest.raises(InputError, match="is not an MCAP file"):
        Recording(other)


def test_a_file_without_permission(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(InputError, match=r"cannot be read \(Permission denied\): check its permissions"):
        Recording(path)


# Unfinished and damaged files


def test_an_unfinished_file_gives_all_that_was_flushed(tmp_path: Path) -> None:
    recording = Recording(write_officially(tmp_path / "a.mcap", finish=False))
    assert_equal(read(recording), BATCH)
    assert len(recording.warnings) == 1 and "was not finished" in recording.warnings[0]


@pytest.mark.parametrize("compression", list(CompressionType))
def test_an_incomplete_last_chunk_is_dropped_and_told(tmp_path: Path, compression: CompressionType) -> None:
    path = write_officially(tmp_path / "a.mcap", finish=False, compression=compression)
    data = path.read_bytes()
    last = place_of(data, Opcode.CHUNK, -1)
    path.write_bytes(data[: last + 300])
    recording = Recording(path)
    found = read(recording)
    assert 0 < count_missing(found, BATCH) < 50
    assert f"breaks off in a record: the 300 bytes, about 0.11 s of readings, from byte {last}" in recording.warnings[1]


def test_a_damaged_chunk_costs_only_itself(path: Path) -> None:
    data = path.read_bytes()
    start = place_of(data, Opcode.CHUNK, 3)
    patched(path, start + 500, bytes([data[start + 500] ^ 0x10]))
    recording = Recording(path)
    missing = count_missing(read(recording), BATCH)
    assert 15 <= missing <= 30
    assert f"the chunk at byte {start} is damaged" in recording.warnings[0]
    assert "about 0.2 s of readings, are lost" in recording.warnings[0]
    lost = [int(w.split(": ")[1].split(" of ")[0]) for w in recording.warnings[1:] if " messages of /" in w]
    assert sum(lost) == missing


def test_damage_to_the_first_chunk_does_not_lose_the_topics(path: Path) -> None:
    start = place_of(path.read_bytes(), Opcode.CHUNK)
    recording = Recording(patched(path, start + 60, bytes(50)))
    assert 15 <= count_missing(read(recording), BATCH) <= 30


@pytest.mark.parametrize(
    ("opcode", "length"),
    [
        *((opcode, length) for opcode in (Opcode.CHUNK, Opcode.MESSAGE_INDEX) for length in (1 << 60, 5_000, 1, 0)),
        (Opcode.CHUNK, 100),
    ],
)
def test_an_absurd_length_is_jumped_over_by_the_summary(path: Path, opcode: Opcode, length: int) -> None:
    start = place_of(path.read_bytes(), opcode, 3)
    recording = Recording(patched(path, start + 1, struct.pack("<Q", length)))
    assert count_missing(read(recording), BATCH) <= 30
    assert f"damaged at byte {start}" in recording.warnings[0]


@pytest.mark.parametrize(
    ("offset", "content", "says"),
    [
        (25, struct.pack("<Q", 1 << 50), f"hold {1 << 30} MB, more than the 256 MB that --max-chunk-mb allows"),
        (25, struct.pack("<Q", 1 << 27), "sizes contradict"),
        (37, struct.pack("<I", 1 << 31), "lengths contradict"),
        (41, b"zzzz", "compression 'zzzz' is not known"),
        (33, bytes([1, 2, 3, 4]), "checksum does not fit"),
    ],
)
def test_damage_to_the_head_of_a_chunk(path: Path, offset: int, content: bytes, says: str) -> None:
    start = place_of(path.read_bytes(), Opcode.CHUNK, 2)
    recording = Recording(patched(path, start + offset, content))
    with traced() as peak:
        missing = count_missing(read(recording), BATCH)
    assert peak.bytes < 10_000_000
    assert 20 <= missing <= 30
    assert says in recording.warnings[0]


@pytest.mark.parametrize("states_size", [True, False])
@pytest.mark.parametrize("packing", ["zstd", "lz4"])
def test_a_chunk_that_unpacks_to_more_than_it_says(tmp_path: Path, states_size: bool, packing: str) -> None:
    path = write_officially(tmp_path / "a.mcap", finish=False)
    if packing == "zstd":
        packed = zstandard.ZstdCompressor(write_content_size=states_size).compress(bytes(300_000_000))
    else:
        packed = lz4.frame.compress(bytes(300_000_000), store_size=states_size)
    content = struct.pack("<QQQII", 0, 0, 1000, 0, len(packing)) + packing.encode()
    content += struct.pack("<Q", len(packed)) + packed
    path.write_bytes(path.read_bytes() + HEAD.pack(Opcode.CHUNK, len(content)) + content)
    recording = Recording(path)
    with traced() as peak:
        assert_equal(read(recording), BATCH)
    assert peak.bytes < 10_000_000
    assert "is damaged" in recording.warnings[1]


def chunk_of(unit: bytes, size: int, packing: str) -> bytes:
    """A chunk record that unpacks to ``size`` bytes, made piece by piece: this process must not need the room."""
    piece = unit * ((1 << 16) // len(unit))
    if packing == "zstd":
        packer, begin = zstandard.ZstdCompressor().compressobj(), b""
    else:
        packer = lz4.frame.LZ4FrameCompressor()
        begin = packer.begin()
    count, crc, packed = size // len(piece), 0, [begin]
    for _ in range(count):
        packed.append(packer.compress(piece))
        crc = zlib.crc32(piece, crc)
    data = b"".join([*packed, packer.flush()])
    head = struct.pack("<QQQII", 0, 0, count * len(piece), crc, len(packing)) + packing.encode()
    content = head + struct.pack("<Q", len(data)) + data
    return HEAD.pack(Opcode.CHUNK, len(content)) + content


READ = """
import sys, time
from pathlib import Path
from kf_calib.sources.files.recording import Recording
def memory(key):
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith(key)).split()[1]) >> 10
before, started = memory("VmRSS:"), time.monotonic()
recording = Recording(sys.argv[1], max_chunk_mb=float(sys.argv[2]))
print(sum(len(batch.accel) for batch in recording), memory("VmHWM:") - before, time.monotonic() - started)
print(*recording.warnings, sep="\\n")
"""
BOMBS = {
    "zeros": (bytes(1), "zstd"),
    "every byte looks like a message": (b"\x05", "zstd"),
    "a million empty records": (HEAD.pack(0x80, 0), "zstd"),
    "empty messages": (HEAD.pack(Opcode.MESSAGE, 22) + bytes(22), "zstd"),
    "empty schemas": (HEAD.pack(Opcode.SCHEMA, 0), "lz4"),
}


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="peak memory is read from /proc")
@pytest.mark.parametrize("limit_mb", [32, *slow(256)])
@pytest.mark.parametrize("name", BOMBS)
def test_chunks_that_unpack_to_gigabytes_take_the_memory_allowed(tmp_path: Path, name: str, limit_mb: int) -> None:
    """104 kB took 10.3 GB. One chunk is within the limit, twice, and one beyond it."""
    unit, packing = BOMBS[name]
    path = write_officially(tmp_path / "a.mcap", finish=False)
    allowed, beyond = (chunk_of(unit, mb << 20, packing) for mb in (limit_mb, limit_mb * 5 // 4))
    path.write_bytes(path.read_bytes() + beyond + 2 * allowed)
    words = [sys.executable, "-c", READ, path, str(limit_mb)]
    done = subprocess.run(words, capture_output=True, text=True, check=True, timeout=100)
    first, *told = done.stdout.splitlines()
    readings, peak_mb, seconds = map(float, first.split())
    assert readings == 400
    assert peak_mb < 4 * limit_mb + 60, f"{peak_mb} MB for chunks of {limit_mb} MB, in {seconds:.1f} s"
    assert f"more than the {limit_mb} MB that --max-chunk-mb allows" in told[1]
    assert len(told) <= 102


def test_a_chunk_that_takes_more_in_the_file_than_allowed_is_passed_over(tmp_path: Path) -> None:
    path = write_officially(tmp_path / "a.mcap", finish=False)
    content = struct.pack("<QQQII", 0, 0, 10, 0, 4) + b"zstd" + struct.pack("<Q", 4 << 20) + bytes(4 << 20)
    path.write_bytes(path.read_bytes() + HEAD.pack(Opcode.CHUNK, len(content)) + content)
    recording = Recording(path, max_chunk_mb=1)
    assert_equal(read(recording), BATCH)
    assert "takes 4 MB, more than the 1 MB that --max-chunk-mb allows: it is passed over." in recording.warnings[1]


@pytest.mark.parametrize(
    ("compression", "length", "most"),
    [
        *((CompressionType.NONE, length, 400) for length in (1 << 60, 1 << 30, 5_000, 1, 0)),
        *((compression, 1 << 60, 31) for compression in (CompressionType.LZ4, CompressionType.ZSTD)),
    ],
)
def test_without_a_summary_the_next_chunk_is_found_behind_damage(
    tmp_path: Path, compression: CompressionType, length: int, most: int
) -> None:
    path = write_officially(tmp_path / "a.mcap", finish=False, compression=compression)
    start = place_of(path.read_bytes(), Opcode.CHUNK, 6)
    recording = Recording(patched(path, start + 1, struct.pack("<Q", length)))
    assert 20 <= count_missing(read(recording), BATCH) < most
    assert len(recording.warnings) >= 2 and f"byte {start}" in "".join(recording.warnings[1:])


@pytest.mark.parametrize(
    "damage",
    [
        lambda offsets: offsets[::-1],
        lambda offsets: offsets[[0, *range(len(offsets) - 1)]],
        lambda offsets: offsets + 1,
        lambda offsets: offsets + (1 << 62),
        lambda offsets: -offsets,
        lambda offsets: offsets * 0,
    ],
)
def test_a_wrong_message_index_changes_nothing(tmp_path: Path, damage: Callable[[np.ndarray], np.ndarray]) -> None:
    path = write_officially(tmp_path / "a.mcap", chunk_size=30_000)
    data = bytearray(path.read_bytes())
    for start, opcode, length in records(data):
        if opcode == Opcode.MESSAGE_INDEX:
            entries = np.frombuffer(data, "<i8", (length - 6) // 8, start + HEAD.size + 6).copy()
            entries[1::2] = damage(entries[1::2])
            data[start + HEAD.size + 6 : start + HEAD.size + length] = entries.tobytes()
    path.write_bytes(data)
    recording = Recording(path)
    assert_equal(read(recording), BATCH)
    assert recording.warnings == []


@pytest.mark.parametrize("index_types", [IndexType.ALL, IndexType.NONE])
def test_only_the_first_block_is_walked_through(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, index_types: IndexType
) -> None:
    walk, walked = mcap_records.MessageFinder._walk, []
    monkeypatch.setattr(
        mcap_records.MessageFinder, "_walk", lambda self, *block: walked.append(block) or walk(self, *block)
    )
    recording = Recording(write_officially(tmp_path / "a.mcap", index_types=index_types | IndexType.METADATA))
    walked.clear()
    assert len(list(recording)) > 5
    assert len(walked) == 1


def test_a_message_index_of_odd_length_is_told(tmp_path: Path) -> None:
    path = write_officially(tmp_path / "a.mcap", finish=False)
    path.write_bytes(path.read_bytes() + HEAD.pack(Opcode.MESSAGE_INDEX, 11) + struct.pack("<HI", 1, 5) + bytes(5))
    recording = Recording(path)
    assert_equal(read(recording), BATCH)
    assert "11 bytes are passed over" in recording.warnings[1]


def test_a_torn_chunk_with_a_valid_checksum_costs_only_its_end(tmp_path: Path) -> None:
    """As a recorder leaves it that was interrupted between the head of a message and the message."""
    path = write_officially(tmp_path / "a.mcap", finish=False, compression=CompressionType.NONE, enable_crcs=False)
    data = path.read_bytes()
    start = place_of(data, Opcode.CHUNK, 2)
    message = data.index(HEAD.pack(Opcode.MESSAGE, 354)[:9], start + 3_000)
    recording = Recording(patched(path, message + 1, bytes(8)))
    assert 0 < count_missing(read(recording), BATCH) < 30
    assert any("make no sense" in warning for warning in recording.warnings)


def test_messages_of_an_undefined_channel_are_told(tmp_path: Path) -> None:
    path = write_officially(tmp_path / "a.mcap", use_chunking=False, enable_data_crcs=True)
    start = place_of(path.read_bytes(), Opcode.MESSAGE, 5)
    recording = Recording(patched(path, start + HEAD.size, b"\x07"))
    assert count_missing(read(recording), BATCH) == 1
    told = " ".join(recording.warnings)
    assert "1 messages belong to no topic" in told and "CRC mismatch" in told and "1 of 400 messages" in told


SMALL = made_batch(200)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("small") / "small.mcap"
    with Recorder(path, BENCH, chunk_size=12_000) as recorder:
        recorder.write(SMALL)
    return path.read_bytes()


def check_damaged(path: Path, data: bytes) -> None:
    """A warning or an InputError, never a wrong number, never anything else; and at once."""
    path.write_bytes(data)
    started = time.monotonic()
    try:
        recording = Recording(path)
        found = read(recording)
    except InputError as error:
        assert str(error).startswith(str(path)) and str(error).endswith(".")
    else:
        assert recording.bench == BENCH
        assert recording.warnings, "the damage must be told"
        count_missing(found, SMALL)
    assert time.monotonic() - started < 2.0


@pytest.mark.parametrize("trials", [60, *slow(200)])
def test_truncated_anywhere(tmp_path: Path, small: bytes, trials: int) -> None:
    for cut in random.Random(1).sample(range(1, len(small)), trials):
        check_damaged(tmp_path / "cut.mcap", small[:cut])


def outside_chunks(data: bytes) -> list[int]:
    chunks = [range(start + 60, start + length) for start, opcode, length in records(data) if opcode == Opcode.CHUNK]
    return [i for i in range(len(data)) if not any(i in chunk for chunk in chunks)]


FLIPPED: dict[str, Callable[[bytes], tuple[bytes, Sequence[int]]]] = {
    "anywhere": lambda data: (data, range(len(data))),
    "outside the chunks": lambda data: (data, outside_chunks(data)),
    "in an unfinished file": lambda data: (data[: (end := place_of(data, Opcode.DATA_END))], range(end)),
}


@pytest.mark.parametrize("trials", [50, *slow(200)])
@pytest.mark.parametrize("where", FLIPPED)
def test_a_flipped_bit(tmp_path: Path, small: bytes, where: str, trials: int) -> None:
    rng, (sound, places) = random.Random(5), FLIPPED[where](small)
    for position in rng.sample(places, trials):
        data = bytearray(sound)
        data[position] ^= 1 << rng.randrange(8)
        check_damaged(tmp_path / "flipped.mcap", bytes(data))


# Size


def test_memory_does_not_grow_with_the_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    peaks: list[int] = []
    for count in (50_000, 200_000):
        path = record(tmp_path / f"{count}.mcap", made_batch(count), chunk_size=500_000)
        recording = Recording(path)
        with traced() as peak:
            assert sum(len(batch.accel) for batch in recording) == count
        peaks.append(peak.bytes)
    assert peaks[1] < 1.6 * peaks[0], "four times the samples"
    assert peaks[1] < 25_000_000, "the readings unpacked take 80 MB"
