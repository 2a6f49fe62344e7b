"""A live run goes on whatever its link and the bench's clock do, and says what they did."""

import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from helpers.links import HEADER, KEYS, Given, Script, csv_rows, joined, json_rows, numbers, scripted, wait_for
from helpers.paths import ROOT
from helpers.recordings import START_NS, assert_equal, made_batch, read
from hypothesis import given, settings
from hypothesis import strategies as st

from kf_calib.bench.bench import Bench
from kf_calib.bench.streams import Batch, Stream
from kf_calib.errors import InputError
from kf_calib.estimation.calibration import calibrate
from kf_calib.sources.files.recording import Recording
from kf_calib.sources.live import LiveSource, open_live, streamed
from kf_calib.sources.live.clock import Clock
from kf_calib.sources.live.feed import Tcp
from kf_calib.sources.live.streamed import StreamedFeed
from kf_calib.sources.simulation.options import options_from_query, simulation

SECOND_NS = 1_000_000_000
TCP_REPAIR = 19  # Linux: a connection under repair sends nothing


@contextmanager
def serving(talk: Callable[[socket.socket, int], None]) -> Iterator[tuple[str, list[float]]]:
    """A TCP server that has ``talk`` see to each client, by its number; when each client came."""
    came_s, held = list[float](), list[socket.socket]()

    def serve() -> None:
        while True:
            try:
                client = listening.accept()[0]
            except OSError:
                return
            came_s.append(time.monotonic())
            held.append(client)
            talk(client, len(came_s))

    with socket.create_server(("127.0.0.1", 0)) as listening:
        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield f"socket://127.0.0.1:{listening.getsockname()[1]}", came_s
        listening.shutdown(socket.SHUT_RDWR)
    thread.join(5.0)
    for client in held:
        client.close()


# -- links --


def once(client: socket.socket, number: int) -> None:
    """A server that has data for its first client, and then closes at once."""
    if number == 1:
        client.sendall(csv_rows(0, 50))
    client.close()


@pytest.mark.parametrize(("query", "words"), [("give_up=1.2", "did not come back within 1 s"), ("idle=1.2", "")])
def test_a_server_that_accepts_and_closes_is_tried_longer_and_longer_apart(query: str, words: str) -> None:
    """It was tried 1500 times a second, and neither limit held."""
    with serving(once) as (url, came_s):
        began_s = time.monotonic()
        with open_live(f"{url}?{query}", KEYS) as source:
            assert numbers(read(source)) == list(range(50))
        assert 1.0 < time.monotonic() - began_s < 4.0
    assert 4 <= len(came_s) <= 7  # at once, then after 0.1, 0.2, 0.4 ... s
    assert source.status.reconnects == 0 and words in source.status.trouble
    pauses = np.diff(came_s[1:])
    assert (pauses[1:3] > 1.5 * pauses[:2]).all()


def test_the_waits_begin_anew_once_something_has_come() -> None:
    def talk(client: socket.socket, number: int) -> None:
        if number % 3 == 1:
            client.sendall(csv_rows(20 * number, 20 * number + 20))
        client.close()

    with serving(talk) as (url, came_s), open_live(url, KEYS) as source:
        wait_for(lambda: source.status.samples >= 60)
        assert came_s[6] - came_s[0] < 1.5  # two outages of three tries each: at once, after 0.1 s, after 0.2 s
        source.stop()
        assert len(read(source).accel) >= 60
    assert source.status.reconnects >= 2


def test_a_server_that_falls_silent_is_asked_again(tmp_path: Path) -> None:
    """As after a loss of power: no end of the connection, no error, nothing."""

    def talk(client: socket.socket, number: int) -> None:
        client.sendall(csv_rows(100 * number, 100 * number + 50))

    with serving(talk) as (url, _), open_live(f"{url}?silent=0.3&idle=30", KEYS, tmp_path / "a.mcap") as source:
        wait_for(lambda: source.status.samples >= 100)
        source.stop()
        got = read(source)
    assert numbers(got)[:100] == [*range(100, 150), *range(200, 250)]
    assert source.status.gaps >= 1 and source.status.reconnects >= 1
    recording = Recording(tmp_path / "a.mcap")
    assert_equal(read(recording), got)
    assert "nothing came for 0.3 s" in recording.warnings[0]


def test_a_bench_that_has_not_begun_is_waited_for() -> None:
    def talk(client: socket.socket, _: int) -> None:
        threading.Timer(1.0, client.sendall, [csv_rows(0, 30)]).start()

    with serving(talk) as (url, came_s), open_live(f"{url}?silent=0.2", KEYS) as source:
        wait_for(lambda: source.status.samples == 30)
        assert len(came_s) == 1


def test_the_system_asks_a_silent_peer_within_seconds() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        link = Tcp(*listening.getsockname())
        link.open()
        connection = link.opened
        assert connection.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE) != 0
        names = ("TCP_KEEPIDLE", "TCP_KEEPINTVL", "TCP_KEEPCNT", "TCP_USER_TIMEOUT")
        found = [connection.getsockopt(socket.IPPROTO_TCP, getattr(socket, n)) for n in names if hasattr(socket, n)]
        link.close()
    assert found == [5, 2, 3, 11_000][: len(found)]


@pytest.mark.slow
def test_a_peer_that_was_switched_off_and_on_is_noticed() -> None:
    """Its connection is gone without a word; the system learns it when it asks (after 5 s; it was two hours)."""

    def talk(client: socket.socket, number: int) -> None:
        client.sendall(csv_rows(100 * number, 100 * number + 50))
        if number == 1:
            time.sleep(0.5)
            client.setsockopt(socket.IPPROTO_TCP, TCP_REPAIR, 1)
            client.close()

    with socket.socket() as trial:
        try:
            trial.setsockopt(socket.IPPROTO_TCP, TCP_REPAIR, 1)
        except OSError:
            pytest.skip("needs Linux and the rights of root")
    with serving(talk) as (url, _):
        began_s = time.monotonic()
        with open_live(f"{url}?silent=100", KEYS) as source:
            wait_for(lambda: source.status.samples >= 100)
            assert time.monotonic() - began_s < 15.0
            assert source.status.reconnects == 1


POWERLESS = """
import subprocess, sys, time
sys.path[:0] = sys.argv[1:]
from test_live_faults import KEYS, csv_rows, open_live, serving, wait_for
subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
with serving(lambda client, number: client.sendall(csv_rows(100 * number, 100 * number + 50))) as (url, _):
    with open_live(f"{url}?silent=1000", KEYS) as source:
        wait_for(lambda: source.status.samples == 50)
        subprocess.run(["ip", "link", "set", "lo", "down"], check=True)
        began_s = time.monotonic()
        wait_for(lambda: source.status.link == "lost")
        print(time.monotonic() - began_s)
        subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
        wait_for(lambda: source.status.samples == 100)
"""


@pytest.mark.slow
def test_a_loss_of_power_is_noticed_in_seconds() -> None:
    """A network of its own, which is cut: neither FIN nor RST. It took 119 minutes."""
    alone = ["unshare", "-n"]
    allowed = [*alone, "ip", "link"]
    if shutil.which("unshare") is None or subprocess.run(allowed, capture_output=True, timeout=120).returncode:
        pytest.skip("needs Linux and the rights of root")
    command = [*alone, sys.executable, "-c", POWERLESS, str(Path(__file__).parent), str(ROOT / "tests")]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=300)
    assert float(done.stdout) < 15.0


def test_a_link_that_fails_in_a_way_of_its_own_is_told_and_what_came_is_kept() -> None:
    link = Script(csv_rows(0, 30), OSError("pulled out"), csv_rows(30, 40), TypeError("unknown"))
    feed = StreamedFeed("script", link, KEYS, {}, "", 1.0, float("inf"))
    with LiveSource(feed) as source:
        assert numbers(read(source)) == list(range(40))
    assert "unknown" in source.status.trouble


def test_a_first_block_that_is_large_is_read_to_its_end() -> None:
    with scripted(json_rows(0, 5000)) as source:
        assert numbers(read(source)) == list(range(5000))


# -- the end of a run --


@pytest.mark.parametrize("garbage", [b"a\n", b"{a\n", b"1\n"])
def test_the_end_is_at_once_though_garbage_has_piled_up(
    garbage: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C after 50 MB took 136 s."""
    monkeypatch.setattr(streamed, "_AFTER_STOP_S", 0.1)  # a fast machine would read all of it in a second
    piece = garbage * ((1 << 18) // len(garbage))
    with scripted(json_rows(0, 50), *[piece] * 240, record=tmp_path / "a.mcap") as source:
        wait_for(lambda: source.status.samples == 50 and source.status.refused > 0)
        time.sleep(0.3)
        began_s = time.monotonic()
        source.stop()
        assert numbers(read(source)) == list(range(50))
        took_s = time.monotonic() - began_s
    assert took_s < 4.0
    assert any("were not read any more" in said for said in source.warnings)
    assert len(read(Recording(tmp_path / "a.mcap")).accel) == 50


def test_while_nothing_usable_comes_nothing_piles_up() -> None:
    class Quiet(Script):
        def read(self) -> bytes:
            return super().read() if self._pieces else b""

    feed = StreamedFeed("quiet", Quiet(json_rows(0, 1)[:20]), KEYS, {}, "", 1.0, 0.5)
    with LiveSource(feed) as source, pytest.raises(InputError):
        _ = source.bench
    assert len(feed._ahead) == 0


# -- the bench's clock --


def shifted(batch: Batch, by_s: float) -> Batch:
    by_ns = round(by_s * SECOND_NS)
    return Batch(*(Stream(each.time_ns + by_ns, each.values) for each in (batch.accel, batch.pose, batch.temperature)))


def at(seconds: float, count: int = 500) -> Batch:
    """Five seconds of a bench, from so many after the start."""
    return made_batch(count, START_NS + round(seconds * SECOND_NS))


@pytest.mark.parametrize("by_s", [-START_NS / SECOND_NS, -100.0, -7.0, 200_000.0])
def test_a_clock_that_is_set_goes_on_and_is_told(tmp_path: Path, by_s: float) -> None:
    """3299 of 5300 readings were left out, and nothing said so."""
    path, feed = tmp_path / "a.mcap", Given(at(0), shifted(at(5), by_s), shifted(at(10), by_s))
    with LiveSource(feed, path) as source:
        got = joined(list(source))
    assert (np.diff(got.accel.time_ns) > 0).all() and (np.diff(got.pose.time_ns) > 0).all()
    assert np.ptp(got.accel.time_ns) / SECOND_NS == pytest.approx(15.98, abs=0.5)
    assert got.pose.time_ns[50] == got.accel.time_ns[500] == got.temperature.time_ns[25]
    whole = joined([at(0), at(5), at(10)])
    assert got.accel.values.tobytes() == whole.accel.values.tobytes()
    status = source.status
    assert (status.clock_restarts, status.left_out, status.gaps, status.missing) == (1, 0, 1, 0)
    said = [said for said in source.warnings if "clock jumped" in said]
    assert len(said) == 1 and ("ahead" if by_s > 0 else "back") in said[0] and "after the first reading" in said[0]
    recording = Recording(path)
    assert_equal(read(recording), got)
    assert recording.warnings == [f"{path}: the bench's clock was set during the run 1 times (first: {said_of(said)})."]


def said_of(said: list[str]) -> str:
    return said[0].partition(": ")[2].partition(",")[0]


def test_a_clock_that_is_set_again_and_again() -> None:
    parts = [at(0), shifted(at(5), -1e6), shifted(at(10), -2e6), shifted(at(15), 1e6)]
    with LiveSource(Given(*parts)) as source:
        got = joined(list(source))
    assert (np.diff(got.accel.time_ns) > 0).all() and (np.diff(got.pose.time_ns) > 0).all()
    assert source.status.clock_restarts == 3 and "set 3 times in all" in source.status.clock_trouble


def test_a_clock_that_stands_still_is_told_while_it_does(tmp_path: Path) -> None:
    batch = at(0, 1000)
    stuck = batch.accel.time_ns.copy()
    stuck[400:700] = stuck[399]
    accel, go_on = Stream(stuck, batch.accel.values), threading.Event()

    class Halting(Given):
        def __iter__(self) -> Iterator[Batch]:
            yield Batch(accel[:700], batch.pose)
            go_on.wait(30.0)
            yield Batch(accel[700:], batch.pose[:0])

    with LiveSource(Halting(), tmp_path / "a.mcap") as source:
        wait_for(lambda: source.status.samples == 700)
        assert "stands still at 3.990 s after the first reading" in source.status.clock_trouble
        go_on.set()
        got = joined(list(source))
    assert (source.status.left_out, source.status.clock_restarts, source.status.clock_trouble) == (300, 0, "")
    assert any("300 readings have stamps" in said for said in source.warnings)
    assert_equal(read(Recording(tmp_path / "a.mcap")), got)
    assert len(got.accel) == 1000  # recorded all the same


def test_damaged_stamps_and_pauses_set_no_clock() -> None:
    batch = at(0, 1000)
    stamps = batch.accel.time_ns.copy()
    stamps[[100, 200, 201]] += np.array([10**17, -(10**16), -(10**15)])
    stamps[500:] += 600 * SECOND_NS
    with LiveSource(Given(Batch(Stream(stamps, batch.accel.values), batch.pose))) as source:
        got = joined(list(source))
    assert got.accel.time_ns.tolist() == stamps.tolist()
    assert (source.status.clock_restarts, source.status.left_out) == (0, 3)


@pytest.mark.parametrize("back_s", [5.5, 7.0, 9.9, 30.0])
@pytest.mark.parametrize("size", [1, 1000])
def test_one_stamp_that_lies_back_sets_no_clock(back_s: float, size: int) -> None:
    stamps = at(0, 1000).accel.time_ns.copy()
    stamps[900] -= round(back_s * SECOND_NS)
    clock = Clock()
    for k in range(0, 1000, size):
        clock.push(Batch(Stream(stamps[k : k + size], np.zeros((len(stamps[k : k + size]), 3))), at(0, 0).pose), 0.0)
    assert (clock.restarts, clock.left_out) == ([], 1)


def test_readings_that_are_seldom_are_no_leaps() -> None:
    stamps, clock = START_NS + 15 * SECOND_NS * np.arange(20), Clock()
    parts = [clock.push(Batch(Stream(stamps[k : k + 1], np.ones((1, 3))), at(0, 0).pose), 0.0) for k in range(20)]
    got = [t for part in [*parts, clock.rest()] for t in part.accel.time_ns.tolist()]
    assert got == stamps.tolist() and clock.left_out == 0


def test_a_bench_that_sends_all_again_has_set_no_clock() -> None:
    """A server of a file that begins it again with each connection."""
    with LiveSource(Given(at(0, 1000), at(0, 1000), at(10, 1000))) as source:
        got = joined(list(source))
    assert len(got.accel) == 3000
    assert (source.status.clock_restarts, source.status.left_out) == (0, 1000)


CHANGES = st.lists(
    st.tuples(st.integers(6, 60), st.sampled_from([-1e6, -3600.0, -20.0, -2.0, 0.0, 30.0, 1e6])), max_size=6
)


@settings(max_examples=60, deadline=None)
@given(CHANGES, st.integers(1, 200), st.integers(1, 200))
def test_however_samples_come_in_batches_their_stamps_are_the_same(changes, one: int, other: int) -> None:
    steps = [np.full(40, 10_000_000)]
    for count, by_s in changes:
        steps.append(np.r_[round(by_s * SECOND_NS), np.full(count, 10_000_000)])
    stamps = START_NS + np.cumsum(np.concatenate(steps))
    stream = Stream(stamps, np.random.default_rng(0).normal(size=(len(stamps), 3)))

    def timed(size: int) -> list[int]:
        clock = Clock()
        parts = [clock.push(Batch(stream[k : k + size], stream[:0]), 0.0) for k in range(0, len(stream), size)]
        return [t for part in [*parts, clock.rest()] for t in part.accel.time_ns.tolist()]

    assert timed(one) == timed(other)
    assert len(timed(one)) == len(stamps)


def test_a_run_through_a_restart_replays_bit_for_bit(tmp_path: Path) -> None:
    run = simulation(options_from_query("dwell_s=6&orientations=10&sample_hz=50&slew_degps=90&seed=3"), {}, 97)
    parts = list(run)

    class Restarted(Given):
        def begin(self) -> Bench:
            return run.bench

    feed = Restarted(*parts[:20], *(shifted(part, -1.7e9) for part in parts[20:]), patient=True)
    with LiveSource(feed, tmp_path / "a.mcap") as source:
        live = calibrate(source)
    replayed, undisturbed = calibrate(Recording(tmp_path / "a.mcap")), calibrate(run)
    assert source.status.clock_restarts == 1 and live.counts.backward == live.counts.repeated == 0
    assert live.counts.used == pytest.approx(undisturbed.counts.used, abs=100)
    assert live.estimate.state.tobytes() == replayed.estimate.state.tobytes()
    assert live.estimate.covariance.tobytes() == replayed.estimate.covariance.tobytes()


def test_a_logger_whose_clock_starts_at_zero_again(tmp_path: Path) -> None:
    """As lines, through a lost link: the bench was switched off and on."""
    late = "".join(f"{i * 1_000_000},{i},9.8,-0.25,0.1,0.2,0.3\n" for i in range(200, 300)).encode()
    again = f"{HEADER}\n".encode() + late
    with scripted(csv_rows(0, 200), OSError("gone"), again, record=tmp_path / "a.mcap") as source:
        got = read(source)
    assert numbers(got) == list(range(300)) and (np.diff(got.accel.time_ns) > 0).all()
    assert (np.diff(got.pose.time_ns) > 0).all()
    assert (source.status.clock_restarts, source.status.gaps, source.status.left_out) == (1, 1, 0)
    assert_equal(read(Recording(tmp_path / "a.mcap")), got)
