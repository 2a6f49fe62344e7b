"""What the recorder writes, as the official tools see it, and what is left of it when it dies."""

import errno
import os
import random
import re
import struct
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.full_disk import full_disk
from helpers.long_runs import slow
from helpers.paths import ROOT
from helpers.recordings import BENCH, START_NS, assert_equal, count_missing, made_batch, read, record
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory

from kf_calib.bench.bench import Bench, parse_axes
from kf_calib.bench.streams import Batch, Stream
from kf_calib.errors import BenchError, InputError, KfCalibError
from kf_calib.sources.files import recorder as recorder_module
from kf_calib.sources.files.contents import BENCH_RECORD, CHECKSUM_KEY
from kf_calib.sources.files.mcap_records import HEAD, MAGIC
from kf_calib.sources.files.recorder import Recorder
from kf_calib.sources.files.recording import Recording

KILLS = int(os.environ.get("KF_CALIB_KILLS", "8"))


def decoded(path: Path) -> list:
    with path.open("rb") as file:
        return list(make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()]).iter_decoded_messages())


def test_the_official_reader_decodes_the_same_numbers(tmp_path: Path) -> None:
    batch = made_batch(500)
    messages = decoded(record(tmp_path / "a.mcap", batch, chunk_size=20_000))
    accel = [m for m in messages if m.channel.topic == "/accelerometer"]
    stamps = [m.decoded_message.header.stamp for m in accel]
    assert [s.sec * 10**9 + s.nanosec for s in stamps] == batch.accel.time_ns.tolist()
    assert [m.message.log_time for m in accel] == batch.accel.time_ns.tolist()
    readings = [m.decoded_message.linear_acceleration for m in accel]
    assert [[r.x, r.y, r.z] for r in readings] == batch.accel.values.tolist()
    assert accel[0].decoded_message.orientation_covariance[0] == -1
    assert accel[0].decoded_message.angular_velocity_covariance[0] == -1
    assert accel[0].decoded_message.linear_acceleration_covariance[0] == 0
    angles = [m.decoded_message for m in messages if m.channel.topic == "/platform/angles"]
    assert [m.position for m in angles] == batch.pose.values.tolist()
    assert {tuple(m.name) for m in angles} == {("outer", "middle", "inner")}
    heat = [m.decoded_message for m in messages if m.channel.topic == "/temperature"]
    assert [m.temperature for m in heat] == batch.temperature.values[:, 0].tolist()
    assert {m.header.frame_id for m in angles} == {"platform"}


def test_profile_metadata_and_order_are_as_the_format_says(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", made_batch(100))
    with path.open("rb") as file:
        reader = make_reader(file)
        assert reader.get_header().profile == "ros2"
        (metadata,) = reader.iter_metadata()
        summary = reader.get_summary()
    assert metadata.name == "kf_calib.bench"
    metadata.metadata.pop(CHECKSUM_KEY)
    assert metadata.metadata == BENCH.to_metadata()
    assert summary.metadata_indexes[0].offset < 100, "a killed recorder's file must have it"
    assert {c.message_encoding for c in summary.channels.values()} == {"cdr"}
    assert {s.encoding for s in summary.schemas.values()} == {"ros2msg"}
    assert all(index.compression == "zstd" and index.message_index_length for index in summary.chunk_indexes)
    times = [m.message.log_time for m in decoded(path)]
    assert times == sorted(times)


@pytest.mark.slow
def test_a_run_of_many_chunks_is_indexed_as_the_writer_does_it_in_few_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same file to the byte; a run of thirty hours has 200 000 chunks."""
    files, batch = dict[str, bytes](), made_batch(2_000)
    for name in ("packed", "plain"):
        if name == "plain":
            monkeypatch.setattr(recorder_module, "keep_packed", lambda _: None)
        with Recorder(tmp_path / name, BENCH) as recorder:
            for k in range(2_000):
                part = slice(k, k + 1)
                recorder.write(Batch(batch.accel[part], batch.pose[part]))
                recorder.flush()
            indexes = vars(recorder._writer)["_Writer__chunk_indices"]
            if name == "packed":
                assert len(indexes._packed) < 100 * 2_000
        files[name] = (tmp_path / name).read_bytes()
    assert files["packed"] == files["plain"] and len(decoded(tmp_path / "packed")) == len(batch.accel) + len(batch.pose)


@pytest.mark.parametrize(
    ("axes", "names"),
    [("z", ["axis0"]), ("y z", ["outer", "inner"]), ("x y z x", ["axis0", "axis1", "axis2", "axis3"])],
)
def test_joint_names_by_number_of_axes(tmp_path: Path, axes: str, names: list[str]) -> None:
    bench = Bench(parse_axes(axes), 9.81)
    batch = made_batch(50, pose_width=len(names))
    path = record(tmp_path / "a.mcap", batch, bench)
    assert {tuple(m.decoded_message.name) for m in decoded(path) if "angles" in m.channel.topic} == {tuple(names)}
    assert_equal(read(Recording(path)), batch)


def test_an_attitude_takes_the_place_of_angles(tmp_path: Path) -> None:
    bench, batch = Bench((), 9.81), made_batch(50, pose_width=4)
    path = record(tmp_path / "a.mcap", batch, bench)
    attitude = [m.decoded_message for m in decoded(path) if m.channel.topic == "/platform/attitude"]
    assert [[q.x, q.y, q.z, q.w] for q in (m.quaternion for m in attitude)] == batch.pose.values.tolist()
    recording = Recording(path)
    assert recording.bench == bench
    assert_equal(read(recording), batch)


def test_streams_are_merged_and_each_keeps_its_own_order(tmp_path: Path) -> None:
    """A stamp that jumps back is evidence of the clock: it stays where it came."""
    batch = made_batch(20)
    jumped = np.r_[0:8, 4:6, 8:20]
    accel = Stream(batch.accel.time_ns[jumped], batch.accel.values[jumped])
    path = record(tmp_path / "a.mcap", Batch(accel, batch.pose, batch.temperature))
    assert_equal(read(Recording(path)), Batch(accel, batch.pose, batch.temperature))
    with path.open("rb") as file:
        logged = [message.log_time for _, _, message in make_reader(file).iter_messages(log_time_order=False)]
    assert np.sum(np.diff(logged) < 0) == 1  # the jump, and nothing else out of order


def test_a_file_that_exists_is_kept_unless_told_otherwise(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", made_batch(50))
    before = path.read_bytes()
    with pytest.raises(InputError, match=r"exists already.*--overwrite"):
        Recorder(path, BENCH)
    assert path.read_bytes() == before
    with Recorder(path, BENCH, overwrite=True):
        pass
    assert len(read(Recording(path)).accel) == 0


def test_places_that_cannot_be_written_to(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be created"):
        Recorder(tmp_path / "absent" / "a.mcap", BENCH)


def test_an_exception_finishes_the_file(tmp_path: Path) -> None:
    path, batch = tmp_path / "a.mcap", made_batch(50)
    with pytest.raises(RuntimeError, match="stop"), Recorder(path, BENCH) as recorder:
        recorder.write(batch)
        raise RuntimeError("stop")
    recording = Recording(path)
    assert_equal(read(recording), batch)
    assert recording.warnings == []


def test_an_exception_amid_writing_leaves_what_is_safe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, batch = tmp_path / "a.mcap", made_batch(50)
    with pytest.raises(KeyboardInterrupt), Recorder(path, BENCH) as recorder:
        recorder.write(batch)
        recorder.end_dwell()
        monkeypatch.setattr(recorder._writer, "add_message", lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt))
        recorder.write(made_batch(50, START_NS + 10**12))
    recording = Recording(path)
    assert_equal(read(recording), batch)
    assert len(recording.warnings) == 1


@pytest.mark.parametrize(
    ("batch", "says"),
    [
        (made_batch(50, pose_width=2), "platform/angles do not fit.*holds 3 values"),
        (made_batch(50, start_ns=-(10**9)), "accelerometer do not fit.*1970"),
    ],
)
def test_samples_that_do_not_fit_are_refused_and_spoil_nothing(tmp_path: Path, batch: Batch, says: str) -> None:
    path, good = tmp_path / "a.mcap", made_batch(50)
    with Recorder(path, BENCH) as recorder:
        recorder.write(good)
        with pytest.raises(InputError, match=says):
            recorder.write(batch)
    assert_equal(read(Recording(path)), good)


def test_a_closed_recorder_refuses_more_and_closes_twice(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "a.mcap", BENCH)
    recorder.close()
    recorder.close()
    with pytest.raises(KfCalibError, match="is closed"):
        recorder.write(made_batch(10))


def test_samples_reach_the_disk_by_the_clock_and_at_the_end_of_a_dwell(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, now_s = tmp_path / "a.mcap", [0.0]
    monkeypatch.setattr(recorder_module, "time", SimpleNamespace(monotonic=lambda: now_s[0]))
    with Recorder(path, BENCH, flush_s=0.05) as recorder:
        recorder.write(made_batch(100))
        recorder.end_dwell()
        assert len(read(Recording(path)).accel) == 100
        recorder.write(made_batch(100, START_NS + 10**9))
        assert len(read(Recording(path)).accel) == 100
        now_s[0] = 0.06
        recorder.write(made_batch(100, START_NS + 2 * 10**9))
        assert len(read(Recording(path)).accel) == 300


def test_the_end_of_a_dwell_waits_for_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.mcap"
    sizes: list[int] = []
    monkeypatch.setattr(os, "fsync", lambda _: sizes.append(path.stat().st_size))
    with Recorder(path, BENCH) as recorder:
        recorder.write(made_batch(100))
        sizes.clear()
        recorder.end_dwell()
        assert sizes == [path.stat().st_size]
        sizes.clear()
    assert sizes == [path.stat().st_size]


def test_a_full_disk_is_told_and_what_was_written_stays(tmp_path: Path) -> None:
    path, dwell = tmp_path / "a.mcap", 0
    told = pytest.raises(KfCalibError, match=r"a\.mcap cannot be written on \(File too large\)")
    with told, full_disk(60_000), Recorder(path, BENCH, chunk_size=20_000) as recorder:
        for dwell in range(1000):
            recorder.write(made_batch(100, START_NS + dwell * 10**9))
            recorder.end_dwell()
    recording = Recording(path)
    found = read(recording)
    assert dwell * 100 <= len(found.accel) < (dwell + 1) * 100
    assert recording.warnings == [], "the file has an end"
    assert len([m for m in decoded(path) if m.channel.topic == "/accelerometer"]) == len(found.accel)
    count_missing(found, made_batch(10_000))


def test_a_disk_that_fails_in_the_background_is_told_by_the_next_call(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    recorder = Recorder(tmp_path / "a.mcap", BENCH, background=True, flush_s=0.01)
    recorder.write(made_batch(100))
    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(KfCalibError, match=r"cannot be written on \(Input/output error\): it holds what was"):
        for _ in range(100):
            time.sleep(0.02)
            recorder.tick()
    assert len(read(Recording(tmp_path / "a.mcap")).accel) == 100


@pytest.fixture(scope="module")
def unfinished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a recorder leaves that is killed after its tenth chunk."""
    path = tmp_path_factory.mktemp("unfinished") / "a.mcap"
    recorder = Recorder(path, BENCH)
    for k in range(10):
        recorder.write(made_batch(100, START_NS + k * 10**9))
        recorder.end_dwell()
    killed = path.with_name("killed.mcap")
    killed.write_bytes(path.read_bytes())
    recorder.close()
    return killed


def first_chunk(data: bytes) -> tuple[int, int]:
    """Bytes where the head of the file ends and the second chunk begins."""
    starts, position = [], len(MAGIC)
    while position < len(data):
        opcode, length = HEAD.unpack_from(data, position)
        starts += [position] if opcode == Opcode.CHUNK else []
        position += HEAD.size + length
    return starts[0], starts[1]


@pytest.mark.parametrize("trials", [30, *slow(3000)])
def test_a_flipped_bit_in_the_first_chunk_of_an_unfinished_file_costs_that_chunk(
    unfinished: Path, tmp_path: Path, trials: int
) -> None:
    """All that said what the messages are stood there, and nowhere else."""
    whole, data = read(Recording(unfinished)), unfinished.read_bytes()
    assert len(whole.accel) == 1000
    start, end = first_chunk(data)
    rng, path = random.Random(8), tmp_path / "flipped.mcap"
    head = [(start + byte, bit) for byte in range(HEAD.size) for bit in range(8)]
    for place, bit in [*head, *((rng.randrange(start, end), rng.randrange(8)) for _ in range(trials))]:
        flipped = bytearray(data)
        flipped[place] ^= 1 << bit
        path.write_bytes(flipped)
        recording = Recording(path)
        found = read(recording)
        assert recording.bench == BENCH
        count_missing(found, whole)
        assert len(found.accel) >= 900, (place - start, bit, recording.warnings)
        assert len(found.accel) == 1000 or len(recording.warnings) > 1


@pytest.mark.parametrize("step", [7, *slow(2)])
def test_a_flipped_bit_in_the_first_description_of_an_unfinished_file_is_made_good_by_the_second(
    unfinished: Path, tmp_path: Path, step: int
) -> None:
    """But for the letters that say that it is a description (14), and that it has a checksum (5)."""
    whole, data = read(Recording(unfinished)), unfinished.read_bytes()
    start, path = first_chunk(data)[0], tmp_path / "flipped.mcap"
    refused = 0
    for place in range(len(MAGIC), start, step):
        flipped = bytearray(data)
        flipped[place] ^= 1 << (place % 8)
        path.write_bytes(flipped)
        try:
            recording = Recording(path)
        except BenchError:
            refused += 1
            continue
        assert recording.bench == BENCH, place
        found = read(recording)
        assert len(found.accel) >= 900, (place, recording.warnings)
        count_missing(found, whole)
    assert refused <= 10


def test_what_is_repeated_takes_little_room_and_bothers_no_reader(unfinished: Path, tmp_path: Path) -> None:
    """Ten chunks: in the second, and each time that the file has doubled."""
    with unfinished.open("rb") as file:
        named = 0
        with pytest.raises((EndOfFile, struct.error)):
            for record in StreamReader(file, validate_crcs=True).records:
                named += isinstance(record, Channel) and record.topic == "/accelerometer"
    assert 3 <= named <= 5
    path = tmp_path / "a.mcap"
    with Recorder(path, BENCH, chunk_size=20_000) as recorder:
        for k in range(100):
            recorder.write(made_batch(100, START_NS + k * 10**9))
            recorder.flush()
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert sum(1 for _ in reader.iter_messages()) == 100 * 115
        summary = reader.get_summary()
        assert len(summary.channels) == len(summary.schemas) == 3 == summary.statistics.channel_count
        assert 5 <= sum(metadata.name == BENCH_RECORD for metadata in reader.iter_metadata()) <= 9
    assert len(read(Recording(path)).accel) == 10_000


def test_the_page_on_unfinished_files_opens_one_with_the_official_reader(
    unfinished: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = ROOT / "docs" / "recordings.md"
    (code,) = re.findall(r"^```python\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)
    monkeypatch.chdir(unfinished.parent)
    with pytest.raises(McapError), unfinished.open("rb") as file:
        make_reader(file).get_summary()  # as the page says
    exec(code, {})
    assert capsys.readouterr().out == "1000 readings\n"


CHILD = """
import sys, time
sys.path[:0] = [sys.argv[2]]
from helpers.recordings import BENCH, START_NS, made_batch
from kf_calib.sources.files.recorder import Recorder
with Recorder(sys.argv[1], BENCH, flush_s=0.01, chunk_size=30_000) as recorder:
    for dwell in range(100_000):
        recorder.write(made_batch(200, START_NS + dwell * 2 * 10**9))
        if dwell % 3 == 0:
            recorder.end_dwell()
            print((dwell + 1) * 200, flush=True)
"""


@pytest.mark.parametrize("seed", range(KILLS))
@pytest.mark.timeout(120)
def test_a_killed_recorder_loses_no_more_than_the_open_chunk(tmp_path: Path, seed: int) -> None:
    path = tmp_path / "killed.mcap"
    here = str(ROOT / "tests")
    with subprocess.Popen([sys.executable, "-c", CHILD, path, here], stdout=subprocess.PIPE, text=True) as child:
        child.stdout.readline()
        time.sleep(random.Random(seed).uniform(0, 0.3))
        child.kill()
        safe = int(["200", *child.stdout.read().split()][-1])
    recording = Recording(path)
    found = read(recording)
    assert safe <= len(found.accel) <= safe + 3 * 200
    assert recording.bench == BENCH
    assert recording.warnings and "was not finished" in recording.warnings[0]
    whole = made_batch(len(found.accel) + 1000)
    count_missing(found, whole)
    assert found.accel.time_ns[-1] == whole.accel.time_ns[len(found.accel) - 1], "no gap before the end"
