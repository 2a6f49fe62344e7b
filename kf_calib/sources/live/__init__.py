"""A bench while it runs, as a source of batches that are on the disk before anything else is done with them.

``open_live(url)`` opens a serial port, a TCP server, standard input, a file that grows or the simulator::

    bytes -> [reader] -> samples -> [worker: recording, then a queue] -> whoever iterates

Reader and worker are threads of their own, so that neither a slow consumer nor a slow disk keeps bytes from being
taken in. See docs/live.md for the URLs and what a bench has to send.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any
from urllib.parse import parse_qsl, urlencode, urlsplit

from kf_calib.bench.bench import Bench
from kf_calib.bench.keys import UNSTATED, BenchKeys
from kf_calib.bench.streams import Batch, bench_without_angles, without_poses
from kf_calib.errors import BenchError, InputError
from kf_calib.sources.files.fields import as_columns
from kf_calib.sources.files.recording import Recording
from kf_calib.sources.live.feed import IDLE_S, Feed, GrowingFile, Link, SerialPort, StandardInput, Status, Tcp, nothing
from kf_calib.sources.live.source import LiveSource
from kf_calib.sources.live.streamed import StreamedFeed
from kf_calib.sources.simulation.simulator import Simulation
from kf_calib.sources.text.grid import EXCEL_SUFFIXES
from kf_calib.support.output_files import Outputs
from kf_calib.support.text import number_from

__all__ = ["LiveSource", "Status", "files_of", "open_live"]


_TEXT_FILES = (".csv", ".jsonl", ".txt", ".tsv", ".log")
_PORT_SETTINGS: dict[str, tuple[str, Callable[[str], Any]]] = {
    "baud": ("baudrate", int), "parity": ("parity", str.upper), "bytesize": ("bytesize", int),
    "stopbits": ("stopbits", float), "rtscts": ("rtscts", lambda text: text != "0"),
    "xonxoff": ("xonxoff", lambda text: text != "0"),
}  # fmt: skip


def open_live(
    url: str,
    overrides: BenchKeys | None = None,
    record: Path | None = None,
    overwrite: bool = False,
    *,
    columns: Mapping[str, str] = MappingProxyType({}),
    header: str = "",
    give_up_s: float = 600.0,
    idle_s: float = math.inf,
    silent_s: float = 60.0,
    angles: bool = True,
) -> LiveSource:
    """A bench while it runs: a serial port, ``socket://host:port``, ``-``, a growing file, ``sim://?speed=20``.

    overrides: bench metadata keys that win over what the bench says. record: file to record to. columns: our name for
    each foreign column or key. header: of CSV rows that come without one. give_up_s: how long a lost link is tried
    again. idle_s: ends the source where nothing has come for so long. silent_s: a connection over a network on which
    nothing more has come for so long is opened again.
    angles: False to do without platform angles: readings only are taken and recorded.
    Raises InputError where it cannot be opened.
    """
    Outputs({"--record": record}, files_of(url), overwrite)
    overrides = overrides or UNSTATED
    address, query = _split(url)
    give_up_s, idle_s = query.pop("give_up", give_up_s), query.pop("idle", idle_s)
    silent_s = query.pop("silent", silent_s)
    scheme = url.partition("://")[0] if "://" in url else ""
    if scheme == "sim":
        feed = _simulated_feed(url.partition("://")[2], overrides, angles)
    elif (path := _bag(address)) is not None:
        feed = BagFeed(path, lambda path: Recording(path, overrides, angles=angles), idle_s)
    else:
        link = _link(address)
        name = "standard input" if address == "-" else address.removeprefix("tail:")
        columns = {**as_columns(overrides.get("joints", "")), **columns}
        feed = StreamedFeed(name, link, overrides, columns, header, give_up_s, idle_s, silent_s, angles=angles)
    return LiveSource(feed, record, overwrite)


def files_of(url: str) -> list[Path]:
    """Files that a live source of this URL is read from, and so must not be written."""
    scheme, separator, rest = url.partition("://")
    if separator and scheme == "sim":
        return [Path(text) for key, text in parse_qsl(rest.partition("?")[2]) if key == "plan"]
    address = _split(url)[0]
    return [] if separator or address == "-" else [Path(address.removeprefix("tail:").partition("?")[0])]


def _split(url: str) -> tuple[str, dict[str, float]]:
    """The address with what its query says of a serial port (baud, parity ...), and give_up, idle and silent of it."""
    if url.startswith("sim:"):
        return url, {}
    address, _, query = url.partition("?")
    ours = {key: text for key, text in parse_qsl(query) if key in ("give_up", "idle", "silent")}
    rest = urlencode([pair for pair in parse_qsl(query, keep_blank_values=True) if pair[0] not in ours])
    return address + ("?" + rest) * bool(rest), {key: _positive(key, text) for key, text in ours.items()}


def _bag(address: str) -> Path | None:
    """The MCAP file at this address, if it is one: that file, or the latest in the folder of a bag."""
    path = Path(address.removeprefix("tail:"))
    if path.is_dir():
        files = sorted(path.glob("*.mcap"), key=lambda file: file.stat().st_mtime)
        if not files:
            raise InputError(
                f"{path} holds no .mcap file to follow: bags in SQLite are read when they are finished, by replay."
            )
        return files[-1]
    if path.suffix in (".db3", ".zstd"):
        raise InputError(f"{path} can be read when it is finished, not while it is recorded: use replay.")
    if path.suffix in EXCEL_SUFFIXES:
        raise InputError(f"{path} is a table of a run that is finished, not one that goes on: use replay.")
    return path if path.suffix == ".mcap" else None


def _link(address: str) -> Link:
    if address == "-":
        return StandardInput()
    if address.startswith("socket://"):
        return _tcp(address)
    if address.startswith("tail:"):
        return GrowingFile(Path(address.removeprefix("tail:")))
    plain, _, query = address.partition("?")
    if "://" not in address and (Path(plain).is_file() or Path(plain).suffix in _TEXT_FILES):
        return GrowingFile(Path(plain))
    if "://" not in address and not (plain.startswith("/dev/") or plain.upper().startswith("COM")):
        raise InputError(
            f"{address} is neither a file nor a port: give a path, /dev/ttyUSB0?baud=115200, COM3, socket://HOST:PORT, "
            "rfc2217://HOST:PORT, - or sim://."
        )
    settings: dict[str, Any] = {"baudrate": 115200}
    left = list[tuple[str, str]]()
    for key, text in parse_qsl(query, keep_blank_values=True):
        if key in _PORT_SETTINGS:
            name, kind = _PORT_SETTINGS[key]
            try:
                settings[name] = kind(text)
            except ValueError:
                raise InputError(f"{address}: {key}={text} is not a number.") from None
        else:
            left.append((key, text))
    if left and "://" not in plain:
        names = ", ".join([*_PORT_SETTINGS, "give_up", "idle", "silent"])
        raise InputError(f"{address}: {left[0][0]!r} is no setting of a port: use one of {names}.")
    return SerialPort(plain + ("?" + urlencode(left)) * bool(left), settings)


def _tcp(address: str) -> Tcp:
    parts = urlsplit(address)
    try:
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
    if not host or port is None:
        raise InputError(
            f"{address} names no host and port: write socket://HOST:PORT, for example socket://10.0.0.5:5000."
        )
    return Tcp(host, port)


def _simulated_feed(rest: str, overrides: BenchKeys, angles: bool) -> Feed:
    from kf_calib.sources.simulation.options import options_from_query, simulation

    pairs = parse_qsl(rest.partition("?")[2], keep_blank_values=True)
    speeds = [text for key, text in pairs if key == "speed"]
    speed = _positive("speed", speeds[-1]) if speeds else 1.0
    options = options_from_query(urlencode([pair for pair in pairs if pair[0] != "speed"]))
    size = batch_samples(options.sample_hz, speed)
    return SimulatedFeed(simulation(options, overrides, size), speed, angles)


def _positive(name: str, text: str) -> float:
    try:
        value = number_from(text)
    except ValueError:
        value = math.nan
    if not value > 0.0:
        raise InputError(f"{name}={text} is not a positive number: write for example {name}=20.")
    return value


_SURVEY_S = 0.2


class BagFeed(Feed):
    """Every chunk as soon as it is whole; ends when the file is finished, or where nothing came for ``idle_s``."""

    patient = True

    def __init__(self, path: Path, open_recording: Callable[[Path], Recording], idle_s: float) -> None:
        super().__init__(str(path))
        self._path, self._open, self._idle_s = path, open_recording, idle_s
        self._recording: Recording | None = None
        if not path.exists():
            raise InputError(f"{path} does not exist: check the path.")

    @property
    def warnings(self) -> list[str]:
        return [] if self._recording is None else self._recording.warnings_while_read

    def begin(self) -> Bench:
        began_s = time.monotonic()
        while True:
            try:
                self._recording = self._open(self._path)
            except BenchError:
                raise
            except InputError:  # its topics may still come
                if self.stopping or time.monotonic() - began_s > self._idle_s:
                    raise
                time.sleep(_SURVEY_S)
                continue
            self.link = "live"
            return self._recording.bench

    def __iter__(self) -> Iterator[Batch]:
        assert self._recording is not None
        last_s = time.monotonic()
        for batch in self._recording.following():
            if len(batch.accel) or len(batch.pose) or len(batch.temperature):
                last_s = time.monotonic()
            elif self.stopping or time.monotonic() - last_s > self._idle_s:
                return
            else:
                time.sleep(IDLE_S)
            yield batch
            if self.stopping:
                return


BATCH_S = 0.01
"""How much of the time on the wall one batch of a simulated bench holds."""

_NAP_S = 0.1


class SimulatedFeed(Feed):
    """A simulated run at ``speed`` times real time (infinity: as fast as it can be made).

    angles: False for its readings only.
    """

    patient = True

    def __init__(self, run: Simulation, speed: float, angles: bool = True) -> None:
        super().__init__("the simulated bench")
        self._run, self._speed, self._angles = run, speed, angles
        self._bench = run.bench if angles else bench_without_angles(self.name, run.bench.to_metadata())[0]

    def begin(self) -> Bench:
        self.link = "live"
        return self._bench

    def __iter__(self) -> Iterator[Batch]:
        started_s, first_ns = time.monotonic(), None
        for batch in self._run:
            last_ns = int(batch.accel.time_ns[-1])
            first_ns = int(batch.accel.time_ns[0]) if first_ns is None else first_ns
            due_s = started_s + (last_ns - first_ns) * 1e-9 / self._speed
            while not self.stopping and (left_s := due_s - time.monotonic()) > 0.0:
                time.sleep(min(left_s, _NAP_S))
                if left_s > _NAP_S:
                    yield nothing(self._bench.pose_width)
            if self.stopping:
                return
            self.fraction = self._run.fraction
            yield batch if self._angles else without_poses(batch)
        self.fraction = 1.0


def batch_samples(sample_hz: float, speed: float) -> int:
    """Readings of a batch at that speed."""
    return max(1, round(sample_hz * speed * BATCH_S)) if math.isfinite(speed) else 65536
