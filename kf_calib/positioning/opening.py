"""Positioners that are opened by name: the simulated bench, ``hand``, or the name or the file of a profile.

The simulated bench is positioner and source in one: ``sim://?hide=second-order=20sigma&seed=3&fault=stall``.
"""

from __future__ import annotations

import hashlib
import math
import os
import queue
import stat
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, urlencode

from kf_calib.bench.bench import Bench
from kf_calib.bench.keys import BenchKeys
from kf_calib.bench.streams import Batch
from kf_calib.errors import InputError
from kf_calib.positioning.drive import Time, WallTime
from kf_calib.positioning.link import device_of
from kf_calib.positioning.positioner import HandPositioner, Positioner, PositionerError, Watchfulness
from kf_calib.positioning.profile import CommandPositioner, LinePositioner, is_shipped, read_profile
from kf_calib.sources.live.feed import Feed, nothing
from kf_calib.sources.simulation.driven import DrivenBench, Servo
from kf_calib.sources.simulation.options import options_from_query, simulation
from kf_calib.support import file_lock
from kf_calib.support.text import number_from

_OF_SERVO = {field.name: field.type for field in fields(Servo)}
_NAP_S = 0.05
_EVALUATION_S = 60.0  # at most, for the evaluation of what was measured

HAND = "hand"


class SimulatedPositioner:
    """The gimbals of a simulated bench, which a lost link reaches as it reaches those of a real one."""

    def __init__(self, bench: DrivenBench) -> None:
        self.bench = bench

    def move_to(self, gimbal_deg: Sequence[float]) -> None:
        with _told():
            self.bench.move_to(gimbal_deg)

    def read(self) -> tuple[float, ...]:
        with _told():
            return self.bench.read_deg()

    def stop(self) -> None:
        with _told():
            self.bench.stop()

    def fault(self) -> str:
        with _told():
            return self.bench.fault


@contextmanager
def _told() -> Iterator[None]:
    """Turn what a link raises into an error of the positioner."""
    try:
        yield
    except OSError as error:
        raise PositionerError(f"the positioner does not answer ({error})") from error


class DrivenFeed(Feed):
    """The readings of a bench that is driven, as its time passes."""

    patient = True

    def __init__(self, bench: Bench) -> None:
        super().__init__("the simulated bench")
        self._bench = bench
        self._batches = queue.SimpleQueue[Batch]()

    def put(self, batch: Batch) -> None:
        self._batches.put(batch)

    def begin(self) -> Bench:
        self.link = "live"
        return self._bench

    def __iter__(self) -> Iterator[Batch]:
        while not (self.stopping and self._batches.empty()):
            try:
                yield self._batches.get(timeout=_NAP_S)
            except queue.Empty:
                yield nothing(self._bench.pose_width)


class SimulatedTime:
    """The clock of a simulated bench: while the loop sleeps, the bench measures, and its readings are evaluated.

    speed: how much faster than the wall it goes at most. wait: for so many readings to be evaluated, at most so many
    seconds.
    """

    tick_s = 0.2

    def __init__(self, bench: DrivenBench, feed: DrivenFeed, speed: float = math.inf) -> None:
        self.bench, self._feed, self._speed = bench, feed, speed
        self.wait: Callable[[int, float], bool] = lambda readings, seconds: True
        self._readings, self._began_s = 0, time.monotonic()

    def now_s(self) -> float:
        return self.bench.now_s

    def sleep(self, seconds: float) -> None:
        batch = self.bench.advance(seconds)
        self._readings += len(batch.accel)
        self._feed.put(batch)
        ahead_s = self.bench.now_s / self._speed - (time.monotonic() - self._began_s)
        if ahead_s > 0.0:
            time.sleep(ahead_s)
        self.wait(self._readings, _EVALUATION_S)


def open_simulated(url: str, keys: BenchKeys) -> tuple[DrivenBench, float]:
    """The bench of a URL ``sim://?KEY=VALUE&...``, and its speed; keys: of the bench.

    Beside the settings of the simulator it takes those of ``Servo``, and ``speed``. Raises InputError.
    """
    pairs = parse_qsl(url.partition("?")[2], keep_blank_values=True)
    servo: dict[str, Any] = {
        key: text if key == "fault" else _number(key, text) for key, text in pairs if key in _OF_SERVO
    }
    speeds = [_number(key, text) for key, text in pairs if key == "speed"]
    if speeds and not speeds[-1] > 0.0:
        raise InputError(f"speed={speeds[-1]:g} is not positive: write for example speed=20.")
    rest = [pair for pair in pairs if pair[0] not in _OF_SERVO and pair[0] != "speed"]
    stated = {"rate_degps": keys.get("rate_degps"), "acceleration_degps2": keys.get("acceleration_degps2")}
    servo = {name: value for name, value in stated.items() if value is not None} | servo
    run = simulation(options_from_query(urlencode(rest)), keys)
    start_deg = [0.0] * len(run.bench.axes)
    return DrivenBench(run, Servo(**servo), start_deg), speeds[-1] if speeds else math.inf


def _number(name: str, text: str) -> float:
    try:
        return number_from(text)
    except ValueError:
        raise InputError(f"sim://: {name}={text} is not a number.") from None


@dataclass(frozen=True)
class Opened:
    """A positioner that is open. feed: of the readings that come with it; None where they come from elsewhere."""

    positioner: Positioner
    watch: Watchfulness
    clock: Time
    feed: DrivenFeed | None = None


def open_simulation(name: str, keys: BenchKeys) -> Opened:
    """The emulated bench of a URL, positioner and source in one; raises InputError."""
    bench, speed = open_simulated(name, keys)
    feed = DrivenFeed(bench.run.bench)
    return Opened(SimulatedPositioner(bench), Watchfulness(), SimulatedTime(bench, feed, speed), feed)


def programs_of(name: str) -> list[str]:
    """The commands that a profile of somebody's runs, each once; none of a shipped one, or where it speaks over a link.
    Raises InputError where there is no such profile."""
    if name == HAND or name.startswith("sim:") or is_shipped(Path(name)):
        return []
    profile = read_profile(Path(name), None)
    if profile.kind != "command":
        return []
    return list(dict.fromkeys([*profile.begin, *profile.move, *profile.read, *profile.stop, *profile.fault]))


@contextmanager
def open_positioner(name: str, bench: Bench, say: Callable[[str], None]) -> Iterator[Opened]:
    """The positioner of this name for a bench, locked against other programs until the end of the block.

    say: tells a person what to do. Raises InputError where it is not known or another program has it, PositionerError
    where it does not answer.
    """
    width = len(bench.axes)
    if not width:
        raise InputError("the bench has no gimbals that could be driven: state its axes, for example --axes 'y z x'.")
    if name == HAND:
        yield Opened(HandPositioner([0.0] * width, say), Watchfulness().by_hand(), WallTime())
        return
    profile = read_profile(Path(name), width)
    with _locked(profile.address or f"command {Path(name).resolve()}"):
        kind = {"lines": LinePositioner, "command": CommandPositioner}[profile.kind]
        positioner = kind(profile)
        try:
            yield Opened(positioner, profile.watch, WallTime())
        finally:
            with suppress(Exception):
                positioner.close()


@contextmanager
def _locked(address: str) -> Iterator[None]:
    """Keep other programs of this package from the same positioner."""
    number = hashlib.sha256(device_of(address).encode()).hexdigest()[:16]
    path = _own_folder() / f"positioner-{number}.lock"
    try:
        handle = os.open(
            path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0), 0o600
        )
    except OSError as error:
        raise InputError(f"{path}: cannot be locked ({error.strerror}): remove it.") from None
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise InputError(f"{path}: is no plain file, as a lock must be: remove it.")
    with os.fdopen(handle, "r+b") as file:
        if not file_lock.lock(file):
            holder = file_lock.writer(path) or "another run"
            raise InputError(f"{holder} drives the positioner at {address}: end it first.")
        yield


def _own_folder() -> Path:
    """Return a folder that only this user can write to; raises InputError where somebody else has put one there."""
    place = os.environ.get("XDG_RUNTIME_DIR")
    if place and Path(place).is_dir():
        folder = Path(place, "kf_calib")
    else:
        folder = Path(tempfile.gettempdir(), f"kf_calib-{getattr(os, 'getuid', lambda: 'user')()}")
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or (hasattr(os, "getuid") and found.st_uid != os.getuid()):
        raise InputError(f"{folder}: is not a folder of yours: remove it, since locks of positioners are kept there.")
    return folder
