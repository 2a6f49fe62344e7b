"""Live sources: every sample that came is recorded, handed on and replayed the same; what was lost is counted."""

import json
import os
import random
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import serial
from helpers import sent_frames
from helpers.bounded import traced
from helpers.full_disk import full_disk
from helpers.links import (
    HEADER,
    KEYS,
    Given,
    Script,
    csv_rows,
    frame_rows,
    joined,
    json_rows,
    numbers,
    rows,
    scripted,
    wait_for,
)
from helpers.recordings import BENCH, START_NS, assert_equal, made_batch, read, streams_of
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from serial.rfc2217 import PortManager

from kf_calib.bench.streams import Batch
from kf_calib.errors import InputError
from kf_calib.estimation.calibration import calibrate
from kf_calib.sources.files.recorder import Recorder
from kf_calib.sources.files.recording import GAP_RECORD, Recording
from kf_calib.sources.live import LiveSource, Status, frames, open_live
from kf_calib.sources.live.clock import Continuity
from kf_calib.sources.live.feed import Lost, Regained
from kf_calib.sources.live.protocols import Protocol
from kf_calib.sources.live.streamed import StreamedFeed
from kf_calib.sources.text.reader import LineCounts


def server(*conversations: bytes) -> tuple[str, threading.Thread]:
    """A TCP server that sends one of these to each client in turn and closes the connection."""
    listening = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        with listening:
            for conversation in conversations:
                with listening.accept()[0] as client:
                    client.sendall(conversation)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    return f"socket://127.0.0.1:{listening.getsockname()[1]}", thread


# -- what comes is recorded, handed on and replayed --


@pytest.mark.parametrize("talk", [csv_rows, json_rows, frame_rows])
def test_what_a_server_sends_is_got_to_the_last_byte_and_replayed_the_same(tmp_path: Path, talk) -> None:
    url, _ = server(talk(0, 500))
    with open_live(f"{url}?give_up=0.05", KEYS, tmp_path / "a.mcap") as source:
        got = read(source)
    assert numbers(got) == list(range(500))
    assert_equal(read(Recording(tmp_path / "a.mcap")), got)
    status = source.status
    assert (status.link, status.samples, status.poses, status.recorded) == ("ended", 500, 500, 500)
    assert (status.refused, status.gaps, status.missing, status.dropped, status.reconnects) == (0, 0, 0, 0, 0)
    assert "did not come back" in source.warnings[-1]


@pytest.mark.parametrize("talk", [csv_rows, json_rows, frame_rows])
@pytest.mark.parametrize("size", [1, 7, 64, 100_000])
def test_however_the_bytes_are_cut_the_samples_are_the_same(talk, size: int) -> None:
    whole, protocol = talk(0, 40), Protocol("script", {}, "")
    got = [protocol.push(whole[k : k + size]) for k in range(0, len(whole), size)]
    assert [number for batch in [*got, protocol.form.rest()] for number in numbers(batch)] == list(range(40))
    assert protocol.counts.sentences() == []


def test_the_simulator_live_gives_what_a_replay_gives_bit_for_bit(tmp_path: Path) -> None:
    url = "sim://?speed=inf&dwell_s=4&orientations=8&sample_hz=50&slew_degps=90&seed=3"
    with open_live(url, None, tmp_path / "a.mcap") as source:
        live = calibrate(source)
    replayed = calibrate(Recording(tmp_path / "a.mcap"))
    assert live.estimate.state.tobytes() == replayed.estimate.state.tobytes()
    assert live.estimate.covariance.tobytes() == replayed.estimate.covariance.tobytes()
    assert live.counts == replayed.counts


def test_a_file_that_grows_is_followed_until_nothing_comes(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    begun = csv_rows(0, 11)
    path.write_bytes(begun[:-20])
    with open_live(f"{path}?idle=0.3", KEYS) as source, path.open("ab") as file:
        assert source.bench.pose_width == 3
        file.write(begun[-20:] + rows(11, 30))
        file.flush()
        assert numbers(read(source)) == list(range(30))


def test_a_file_that_is_replaced_is_begun_anew(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes(csv_rows(0, 10))
    with open_live(f"tail:{path}?idle=0.3", KEYS) as source:
        batches = iter(source)
        assert numbers(next(batches)) == list(range(10))
        (tmp_path / "new").write_bytes(csv_rows(10, 20))
        (tmp_path / "new").replace(path)
        assert [n for batch in batches for n in numbers(batch)] == list(range(10, 20))
    assert (source.status.reconnects, source.status.refused) == (1, 0)


def test_a_recording_being_written_is_followed_chunk_by_chunk(tmp_path: Path) -> None:
    path, early, late = tmp_path / "bag.mcap", made_batch(200), made_batch(200, START_NS + 10**10)
    with Recorder(path, BENCH) as recorder:
        recorder.write(early)
        recorder.end_dwell()
        with open_live(str(path), record=tmp_path / "copy.mcap") as source:
            batches = iter(source)
            first = next(batches)
            recorder.write(late)
            recorder.close()
            rest = list(batches)  # ends by itself: the file is finished
    whole = [first, *rest]
    joined = Batch(*(sum(streams[1:], streams[0]) for streams in zip(*map(streams_of, whole), strict=True)))
    assert_equal(joined, read(Recording(path)))
    assert_equal(joined, read(Recording(tmp_path / "copy.mcap")))
    assert source.bench == BENCH


def test_standard_input_is_read_to_its_end() -> None:
    code = (
        "from kf_calib.sources.live import open_live\n"
        f"with open_live('-', {KEYS!r}) as source: print(sum(len(batch.accel) for batch in source), source.warnings)"
    )
    words, given = [sys.executable, "-c", code], csv_rows(0, 50)[:-1]
    done = subprocess.run(words, input=given, capture_output=True, check=True, timeout=120)
    assert done.stdout.decode().strip() == "50 []"


@pytest.mark.skipif(sys.platform == "win32", reason="needs a pseudo-terminal")
def test_a_serial_port_joined_amid_a_row_loses_that_row_only() -> None:
    import tty

    ours, theirs = os.openpty()
    tty.setraw(theirs)
    with open_live(f"{os.ttyname(theirs)}?baud=921600&idle=0.5", KEYS, header=HEADER) as source:
        os.write(ours, rows(0, 20)[9:])
        assert numbers(read(source)) == list(range(1, 20))
    assert "may not be whole" in source.warnings[0] and source.status.refused == 1
    os.close(theirs)
    os.close(ours)


class TerminalServer(threading.Thread):
    """A serial port behind RFC 2217, by pyserial's own side of it; sends its bytes once the client has set the port."""

    def __init__(self, data: bytes) -> None:
        super().__init__(daemon=True)
        self.port, self._data = serial.serial_for_url("loop://", baudrate=9600, timeout=0), data
        self._server = socket.create_server(("127.0.0.1", 0))
        self.url = f"rfc2217://127.0.0.1:{self._server.getsockname()[1]}"
        self._client: socket.socket | None = None

    def write(self, data: bytes) -> None:
        assert self._client is not None
        self._client.sendall(data)

    def run(self) -> None:
        with self._server:
            self._client = self._server.accept()[0]
        with self._client:
            manager, waiting = PortManager(self.port, self), self._data
            self._client.settimeout(0.1)
            while True:
                try:
                    received = self._client.recv(1024)
                except TimeoutError:  # all is set
                    self.write(b"".join(manager.escape(waiting)))
                    waiting = b""
                    continue
                if not received:
                    return
                list(manager.filter(received))


@pytest.mark.filterwarnings("ignore:set(Daemon|Name):DeprecationWarning")  # pyserial's own
def test_a_port_on_a_terminal_server_is_set_and_read() -> None:
    """Bytes that mean something to telnet are among those of the frames."""
    server = TerminalServer(frame_rows(0, 300))
    server.start()
    with open_live(f"{server.url}?baud=57600&parity=E&idle=1", KEYS) as source:
        got = read(source)
    assert numbers(got) == list(range(300)) and source.status.refused == 0
    assert (server.port.baudrate, server.port.parity) == (57600, "E")
    server.join(5.0)


# -- lost links --


@pytest.mark.parametrize("talk", [csv_rows, json_rows, frame_rows])
def test_a_lost_link_costs_what_was_amid_and_is_marked_in_the_recording(tmp_path: Path, talk) -> None:
    path = tmp_path / "a.mcap"
    first, second = talk(0, 101), talk(150, 200)
    url, _ = server(first[:-30], second)
    with open_live(f"{url}?give_up=0.5", KEYS, path) as source:
        got = read(source)
    status = source.status
    lost = 200 - len(got.accel)
    assert lost in (49, 50)  # in frames the reading came before the pose that was cut
    assert (status.reconnects, status.gaps, status.missing, status.refused) == (1, 1, lost, 1)
    recording = Recording(path)
    assert_equal(read(recording), got)
    assert "the link to the bench was lost 1 times (first: the other side closed" in recording.warnings[0]
    with path.open("rb") as file:
        marks = [each.metadata for each in make_reader(file).iter_metadata() if each.name == GAP_RECORD]
    assert [mark["after_ns"] for mark in marks] == [str(START_NS + (numbers(got).index(150) - 1) * 1_000_000)]
    assert "closed the connection" in marks[0]["reason"] and float(marks[0]["seconds"]) > 0.0


def test_half_a_number_is_no_number() -> None:
    """Cut in its last cell, a row of CSV is still a row."""
    with scripted(csv_rows(0, 30) + rows(30, 31)[:-2], OSError("unplugged"), rows(31, 40)) as source:
        assert numbers(read(source)) == [*range(30), *range(31, 40)]
    assert source.status.refused == 1 and source.status.missing == 1


def test_what_cannot_be_opened_is_told_at_once(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as unused:
        port = unused.getsockname()[1]
    (tmp_path / "there.mcap").touch()
    for url, options, words in [
        (f"socket://127.0.0.1:{port}", {}, "cannot be opened .*refused"),
        ("socket://127.0.0.1", {}, "names no host and port"),
        ("/dev/no-such-port", {}, "cannot be opened"),
        ("/dev/ttyS0?boud=9600", {}, "'boud' is no setting of a port"),
        ("nonsense", {}, "neither a file nor a port"),
        ("missing.csv", {}, "cannot be opened"),
        ("missing.mcap", {}, "does not exist"),
        (str(tmp_path / "nothing"), {}, "neither a file nor a port"),
        (str(tmp_path / "run.xlsx"), {}, "use replay"),
        ("sim://?speed=0", {}, "speed=0 is not a positive number"),
        ("sim://?sped=3", {}, "no setting 'sped'"),
        ("sim://", {"record": tmp_path / "there.mcap"}, "exists already"),
        ("sim://", {"record": tmp_path / "no" / "a.mcap"}, "there is no folder"),
    ]:
        with pytest.raises(InputError, match=words) as caught:
            open_live(url, **options)
        assert "\n" not in str(caught.value)


# -- slow consumers, full disks, stopping --


def batches(count: int, size: int = 100) -> list[Batch]:
    return [made_batch(size, START_NS + i * size * 10_000_000) for i in range(count)]


def test_what_a_slow_consumer_missed_it_gets_from_the_recording(tmp_path: Path) -> None:
    parts, path = batches(60), tmp_path / "a.mcap"
    feed = Given(*parts)
    with LiveSource(feed, path, queued=500) as source:
        reader = iter(source)
        got = [next(reader)]
        wait_for(lambda: source.status.samples == 6000)
        assert source.status.waiting > 500
        feed.stop()
        got += list(reader)
    assert_equal(joined(got), joined(parts))
    assert_equal(read(Recording(path)), joined(parts))
    assert (source.status.dropped, source.status.waiting, source.warnings) == (0, 0, [])


def test_a_consumer_that_catches_up_amid_the_run_misses_nothing(tmp_path: Path) -> None:
    parts = batches(200, 20)

    class Paced(Given):
        def __iter__(self) -> Iterator[Batch | Lost | Regained]:
            for part in parts:
                time.sleep(0.001)
                yield part

    with LiveSource(Paced(), tmp_path / "a.mcap", queued=60) as source:
        got = []
        for k, batch in enumerate(source):
            got.append(batch)
            time.sleep(0.02 if k % 3 else 0.0)
    assert_equal(joined(got), joined(parts))


def test_without_a_recording_a_slow_consumer_is_told_what_it_missed() -> None:
    parts = batches(60)
    feed = Given(*parts)
    with LiveSource(feed, queued=500) as source:
        reader = iter(source)
        got = [next(reader)]
        wait_for(lambda: source.status.samples == 6000)
        got += list(reader)
    kept = sum(len(batch.accel) for batch in got)
    assert source.status.dropped == 6000 - kept > 0
    assert any(f"{6000 - kept} readings came faster" in said for said in source.warnings)


def test_a_patient_feed_waits_for_its_consumer() -> None:
    parts = batches(60)
    with LiveSource(Given(*parts, patient=True), queued=500) as source:
        assert_equal(joined(list(source)), joined(parts))
    assert source.status.dropped == 0


def test_a_full_disk_ends_the_recording_and_not_the_run(tmp_path: Path) -> None:
    parts, path = batches(300), tmp_path / "a.mcap"
    with full_disk(100_000), LiveSource(Given(*parts), path, queued=10**6) as source:
        got = joined(list(source))
    assert_equal(got, joined(parts))
    assert "a.mcap cannot be written on (File too large)" in source.status.recording_trouble
    recording = Recording(path)
    kept = read(recording)
    count = len(kept.accel)
    assert recording.warnings == [] and 0 < count < len(got.accel)
    assert kept.accel.values.tobytes() == got.accel.values[:count].tobytes()
    assert sum("cannot be written on" in said for said in source.warnings) == 1


def test_stop_ends_after_what_has_come_and_finishes_the_recording(tmp_path: Path) -> None:
    feed = Given(*batches(5))
    feed.gate.clear()
    with LiveSource(feed, tmp_path / "a.mcap") as source:
        reader = iter(source)
        got = len(next(reader).accel)
        source.stop()
        feed.gate.set()
        got += sum(len(batch.accel) for batch in reader)
    assert got == 500 and len(read(Recording(tmp_path / "a.mcap")).accel) == 500
    with pytest.raises(InputError, match="only once"):
        list(source)


def test_a_source_left_alone_is_recorded_all_the_same(tmp_path: Path) -> None:
    feed = Given(*batches(50))
    with LiveSource(feed, tmp_path / "a.mcap", queued=500) as source:
        source._worker.join(4.0)
    assert len(read(Recording(tmp_path / "a.mcap")).accel) == 5000


class Gated(Script):
    """A link whose last piece comes when ``gate`` is set."""

    gate: threading.Event

    def read(self) -> bytes:
        if len(self._pieces) == 1:
            self.gate.wait(0.02)
            if not self.gate.is_set():
                return b""
        return super().read()


@pytest.mark.parametrize("kind", ["json", "frames"])
def test_readings_are_recorded_though_no_angles_have_come_yet(tmp_path: Path, kind: str) -> None:
    """The stated axes say how many angles there will be; an hour before the first pose is not only in memory."""
    accel = [{"time_ns": START_NS + i * 1_000_000, "accel_mps2": [i, 9.8, -0.25]} for i in range(1500)]
    early = "".join(json.dumps(entry) + "\n" for entry in accel).encode()
    late = json_rows(1500, 1502)
    if kind == "frames":
        early = b"".join(
            sent_frames.sample(frames.ACCEL, i, START_NS + i * 1_000_000, (float(i), 9.8, -0.25)) for i in range(1500)
        )
        late = frame_rows(1500, 1502)
    link = Gated(early[: len(early) // 2], early[len(early) // 2 :], late)
    link.gate = threading.Event()
    out = tmp_path / "a.mcap"
    with LiveSource(StreamedFeed("gated", link, KEYS, {}, "", 1.0, float("inf")), out) as source:
        wait_for(lambda: source.status.recorded >= 1400)
        link.gate.set()
        got = joined(list(source))
    assert len(got.accel) == 1502 and len(got.pose) == 2 and got.pose.values.shape[1] == 3
    assert_equal(read(Recording(out)), got)


CHILD = """
import sys
from kf_calib.sources.live import open_live
from pathlib import Path
with open_live("-", {"axes": "y z x", "gravity_mps2": "9.81"}, Path(sys.argv[1])) as source:
    for batch in source:
        pass
"""


@pytest.mark.timeout(120)
def test_a_killed_process_leaves_all_but_the_end(tmp_path: Path) -> None:
    """tools/bench_live.py measures how much: here, that what is there is whole, without a gap."""
    path, count = tmp_path / "a.mcap", 0
    with subprocess.Popen([sys.executable, "-c", CHILD, path], stdin=subprocess.PIPE, bufsize=0) as child:
        child.stdin.write(f"{HEADER}\n".encode())
        end_s = time.monotonic() + 30.0
        while time.monotonic() < end_s:
            child.stdin.write(rows(count, count + 1))
            count += 1
            time.sleep(0.002)
            if end_s > time.monotonic() + 1.0 and path.exists() and path.stat().st_size > 5000:
                end_s = time.monotonic() + random.Random(1).uniform(0.2, 0.9)
        child.kill()
    found = numbers(read(Recording(path)))
    assert found == list(range(len(found))), "nothing is missing but the end"
    assert 0 < len(found) <= count


# -- hostile input --


@pytest.mark.parametrize("talk", [csv_rows, json_rows, frame_rows])
def test_garbage_amid_samples_costs_itself_only(talk) -> None:
    noise = np.random.default_rng(1).bytes(3 << 20)
    deep, huge = b"[" * 100_000 + b"\n", b"x" * (3 << 20) + b"\n"
    end = b"\0" if talk is frame_rows else b"\n"
    with scripted(talk(0, 50), noise, end, deep, huge, end, talk(50, 99)) as source:
        got = numbers(read(source))
    assert got == list(range(99))
    assert source.status.refused > 1 and "were malformed and skipped" in source.warnings[0]


def test_random_bytes_are_refused_with_counts_in_little_memory() -> None:
    noise = np.random.default_rng(2).bytes(1 << 20)
    refused = pytest.raises(InputError, match=r"no header of CSV.* in \d+ lines; \d+ of \d+ lines were malformed")
    with traced() as peak, refused:
        _ = scripted(*[noise] * 20).bench
    assert peak.bytes < 24 << 20


@pytest.mark.parametrize("cut", [0, 5, 60, 75, 90])
def test_a_row_of_units_below_the_names_is_read_however_it_comes(cut: int) -> None:
    """The recording has what one of the same readings in our units has; a logger that begins again sends both rows."""
    heading = b"time,ax,ay,az,outer,middle,inner\nns,g,g,g,deg,deg,deg\n"
    values = np.array([[0.5, 0.25, -1.0], [0.75, -0.5, 0.125]])
    sent_rows = [[START_NS + k * 1_000_000, *row, 90, 0, -45] for k, row in enumerate(values.tolist())]
    first, second = (",".join(map(str, row)).encode() + b"\n" for row in sent_rows)
    sent = heading + first + heading + second
    with scripted(*(part for part in (sent[:cut], sent[cut:]) if part)) as source:
        got = read(source)
    assert not source.status.refused
    np.testing.assert_allclose(got.accel.values, values * 9.80665, rtol=1e-15)
    np.testing.assert_allclose(got.pose.values, np.radians([[90.0, 0.0, -45.0]] * 2), rtol=1e-15)


@pytest.mark.parametrize("more", [[], [b"s,g,g,g,K\n"], [b"1,2,3,4,5\n"]])
def test_a_header_that_lacks_a_unit_is_told(more: list[bytes]) -> None:
    source = scripted(b"time_s,ax,ay,az,outer_deg\n", *more)
    with source, pytest.raises(InputError, match=r"ax_mps2|outer_deg"):
        list(source)


def test_garbage_below_a_header_that_says_all_costs_itself_only() -> None:
    """Words between other separators would be taken for the header of a file."""
    with scripted(f"{HEADER}\nnote; one; two; three; four; five; six\n".encode(), rows(0, 9)) as source:
        assert numbers(read(source)) == list(range(9))
    assert source.status.refused == 1


def test_stamps_no_recording_can_hold_are_refused(tmp_path: Path) -> None:
    early = rows(3, 4).replace(str(START_NS + 3_000_000).encode(), b"-5")
    with scripted(csv_rows(0, 3), early, rows(4, 6), record=tmp_path / "a.mcap") as source:
        assert numbers(read(source)) == [0, 1, 2, 4, 5]
    assert source.status.refused == 2 and "1970" in source.status.first_refusal  # a reading and a pose


# -- binary frames --


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=1200))
def test_cobs_has_no_zero_and_comes_back(data: bytes) -> None:
    encoded = sent_frames.cobs(data)
    assert b"\0" not in encoded and frames.uncobs(encoded) == data


def test_the_frame_is_what_the_documentation_says() -> None:
    import zlib

    body = struct.pack("<BBHIq3d", ord("A"), 1, 0, 7, START_NS, 1.0, 2.0, 3.0)
    data = body + struct.pack("<I", zlib.crc32(body))
    assert sent_frames.sample(frames.ACCEL, 7, START_NS, (1.0, 2.0, 3.0)) == sent_frames.cobs(data) + b"\0"


def test_every_damaged_byte_is_found_and_numbers_tell_what_is_lost() -> None:
    good = [sent_frames.sample(frames.ACCEL, i, START_NS + i, (float(i), 1.0, -2.0)) for i in range(60)]
    damaged = good.copy()
    for k in range(45):
        damaged[k + 5] = good[k + 5][:k] + bytes([good[k + 5][k] ^ 0x55 or 1]) + good[k + 5][k + 1 :]
    counts = LineCounts()
    reader = frames.FrameReader(counts)
    batch = reader.push(b"".join(damaged))
    assert batch.accel.values[:, 0].tolist() == [*range(5), *range(50, 60)]
    assert reader.lost == 45 and counts.malformed >= 45 and counts.what == "frames"


@settings(max_examples=100, deadline=None)
@given(st.lists(st.one_of(st.binary(max_size=80), st.just(b"\0"), st.just(frame_rows(0, 1))), max_size=8))
def test_no_bytes_upset_the_frames(pieces: list[bytes]) -> None:
    reader = frames.FrameReader(LineCounts())
    for piece in pieces:
        reader.push(piece)
    assert len(reader.push(b"\0" + frame_rows(5, 6)).accel) == 1


def test_poses_of_another_kind_and_numbers_that_are_not_finite_are_refused() -> None:
    counts = LineCounts()
    reader = frames.FrameReader(counts)
    batch = reader.push(
        sent_frames.sample(frames.ANGLES, 0, 1, (0.1, 0.2, 0.3))
        + sent_frames.sample(frames.ATTITUDE, 0, 2, (0.0, 0.0, 0.0, 1.0))
        + sent_frames.sample(frames.ANGLES, 1, 3, (0.1, 0.2))
        + sent_frames.sample(frames.ACCEL, 0, 4, (float("nan"), 0.0, 0.0))
        + sent_frames.sample(ord("?"), 0, 5, (1.0,))
    )
    assert (len(batch.pose), len(batch.accel), counts.malformed) == (1, 0, 4)


# -- continuity --


def counted(stamps: np.ndarray, size: int) -> tuple[int, int]:
    """Gaps, and readings missing in them, of stamps that come so many at a time."""
    found = Continuity()
    for k in range(0, len(stamps), size):
        found.add(stamps[k : k + size])
    return found.gaps, found.missing


@pytest.mark.parametrize("size", [1, 13, 500])
def test_gaps_are_counted_with_what_they_have_room_for(size: int) -> None:
    assert counted(START_NS + 1_000_000 * np.r_[0:100, 103:200, 201:400], size) == (2, 4)


def test_jitter_is_no_gap() -> None:
    jitter_ns = np.random.default_rng(0).integers(-400_000, 400_000, 5000)
    assert counted(START_NS + np.sort(1_000_000 * np.arange(5000) + jitter_ns), 5000) == (0, 0)


@pytest.mark.parametrize("size", [1, 7, 1000])
def test_readings_held_up_are_not_missing(size: int) -> None:
    """Stamped as they arrive: a halt of 77 ms, after which all follow at once; 50 that never come."""
    stamps = START_NS + 1_000_000 * np.arange(1000)
    stamps[400:477] = stamps[477] + 10_000 * (np.arange(77) - 77)
    assert counted(stamps[np.r_[0:700, 750:1000]], size) == (2, pytest.approx(50, abs=2))


def test_bursts_are_no_gaps_but_a_pause_between_them_is() -> None:
    arrival = START_NS + 8_000_000 * (np.arange(4000) // 8) + 20_000 * (np.arange(4000) % 8)
    arrival[2000:] += 50_000_000
    assert counted(arrival, 16) == (1, pytest.approx(50, abs=2))


def test_the_status_says_what_a_user_must_know() -> None:
    assert Status().sentences() == []
    told = Status(
        missing=3, gaps=2, dropped=4, reconnects=1, recording_trouble="x is full.", trouble="gone."
    ).sentences()
    assert [said[-1] for said in told] == ["."] * 5 and "3 readings" in told[1] and told[3:] == ["x is full.", "gone."]
