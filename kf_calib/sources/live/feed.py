"""Where a live source gets its samples from: what every kind of feed has, and how the source stands at one moment.

Bytes come over links: TCP, serial ports, standard input, a file that grows. A link is opened, read and closed by one
thread. ``read`` gives what has come, b"" where nothing comes for a moment, and raises OSError where the link broke,
EOFError where it ended.
"""

from __future__ import annotations

import contextlib
import math
import os
import select
import socket
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kf_calib.bench.bench import Bench
from kf_calib.bench.streams import Batch, Stream
from kf_calib.sources.text.reader import LineCounts
from kf_calib.support.text import counted

IDLE_S = 0.02
"""How long is waited for more where nothing has come."""


@dataclass(frozen=True)
class Lost:
    """The link broke, and why: what follows, if anything does, comes after a gap."""

    reason: str


@dataclass(frozen=True)
class Regained:
    """The link is up again, after so many seconds."""

    after_s: float


def nothing(pose_width: int) -> Batch:
    """What a feed gives while nothing comes, so that there is time to see to the recording."""
    return Batch(Stream.empty(3), Stream.empty(pose_width))


class Feed(ABC):
    """Iterated once, by one thread; ``stop`` may be called from any other, and from a signal handler.

    counts: what could not be used. link: connecting, live, lost or ended. patient: nothing is lost where samples are
    asked for later, as of a file. lost: readings known to be lost on the way, where the bench numbers them.
    """

    patient = False

    def __init__(self, name: str) -> None:
        self.name = name
        self.counts = LineCounts()
        self.link = "connecting"
        self.trouble = ""
        self.reconnects = 0
        self.bytes = 0
        self.lost: int | None = None
        self.fraction = math.nan
        self.stopping = False

    @property
    def warnings(self) -> list[str]:
        """What was lost, and what was not understood, a sentence each."""
        return [f"{self.name}: {said}" for said in self.counts.sentences()]

    @abstractmethod
    def begin(self) -> Bench:
        """Reads on until the bench is known. Raises InputError where it will not be."""

    @abstractmethod
    def __iter__(self) -> Iterator[Batch | Lost | Regained]:
        """All samples, with an empty batch every now and then where none come."""

    def stop(self) -> None:
        """Ends the iteration after what has come. Only sets a flag: a signal handler must not wait for a lock."""
        self.stopping = True

    def close(self) -> None:  # noqa: B027 - most hold nothing open
        """Lets go of what is open; called by the thread that iterates."""


@dataclass(frozen=True, slots=True)
class Status:
    """A live source at one moment.

    link: connecting, live, lost (being tried again) or ended; trouble: why it is down. rate_hz: readings a second, of
    the last two seconds. samples: readings; poses: angle messages. refused: lines or frames that could not be used,
    with the reason of the first. gaps: places where the stamps leap or the link broke; missing: readings lost on the
    way, exact where the bench numbers its frames, else what the gaps have room for. clock_restarts: how often the
    bench's clock was set during the run; left_out: readings whose stamps are damaged or not later than those before
    them, which the evaluation leaves out; clock_trouble: what is wrong with the clock, or was. dropped: readings that
    the consumer was too slow for and that are in no recording; waiting: readings on their way to it. recorded: readings
    in whole chunks of the recording; sync_age_s: age of the newest that the disk is known to hold, None without an open
    recording; recording_trouble: why it ended early.
    """

    link: str = "connecting"
    trouble: str = ""
    rate_hz: float = 0.0
    samples: int = 0
    poses: int = 0
    temperatures: int = 0
    refused: int = 0
    first_refusal: str = ""
    gaps: int = 0
    missing: int = 0
    clock_restarts: int = 0
    left_out: int = 0
    clock_trouble: str = ""
    dropped: int = 0
    waiting: int = 0
    reconnects: int = 0
    bytes: int = 0
    recorded: int = 0
    sync_age_s: float | None = None
    recording_trouble: str = ""

    def sentences(self) -> list[str]:
        """What a user must know once the run has ended."""
        said = [
            (self.reconnects, f"the link was lost and regained {counted(self.reconnects, 'time')}"),
            (self.missing, f"{counted(self.missing, 'reading')} lost on the way, in {counted(self.gaps, 'gap')}"),
            (self.clock_trouble, self.clock_trouble),
            (
                self.left_out,
                f"{self.left_out} readings have stamps that are damaged or not later than those before them, and are "
                "left out: check the bench's clock",
            ),
            (self.dropped, f"{self.dropped} readings came faster than they could be evaluated and were left out"),
            (self.recording_trouble, self.recording_trouble.removesuffix(".")),
            (self.trouble, self.trouble.removesuffix(".")),
        ]
        return [f"{text}." for condition, text in said if condition]


_BLOCK_BYTES = 1 << 18
_WAIT_S = 0.1
_CONNECT_S = 5.0
_SILENT_S = 5  # before the other side is asked whether it is still there
_ASKED = (2, 3)  # every so many seconds, and so many times


class Link(ABC):
    """reopens: it may come back after it broke. patient: what is not read yet stays where it is. breaks_unseen: the
    other side may be gone without a sign. opened: what is to be closed, if anything is open that is ours."""

    reopens = True
    patient = False
    breaks_unseen = False
    starts_amid = False
    """What is read first after opening may be the end of a line."""
    opened: Any = None

    @abstractmethod
    def open(self) -> None: ...

    @abstractmethod
    def read(self) -> bytes: ...

    def close(self) -> None:
        opened, self.opened = self.opened, None
        if opened is not None:
            opened.close()


class Tcp(Link):
    """A TCP server. (pyserial's socket:// drops what came before it was first read, and what came before the end.)"""

    breaks_unseen = True

    def __init__(self, host: str, port: int) -> None:
        self._address = (host, port)

    def open(self) -> None:
        try:
            self.opened = socket.create_connection(self._address, timeout=_CONNECT_S)
        except UnicodeError as error:  # a name that cannot be one
            raise OSError(str(error)) from None
        _ask_when_silent(self.opened)
        self.opened.settimeout(_WAIT_S)

    def read(self) -> bytes:
        try:
            block = self.opened.recv(_BLOCK_BYTES)
        except TimeoutError:
            return b""
        if not block:
            raise ConnectionError("the other side closed the connection")
        return block


def _ask_when_silent(connection: socket.socket) -> None:
    """Has the system ask the other side, when it is silent, whether it is still there: one that lost its power, or
    its cable, says nothing. It is then known after 11 s, where the system lets this be set (else hours)."""
    every_s, times = _ASKED
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    settings = {
        "TCP_KEEPIDLE": _SILENT_S,
        "TCP_KEEPALIVE": _SILENT_S,  # its name on macOS
        "TCP_KEEPINTVL": every_s,
        "TCP_KEEPCNT": times,
        "TCP_USER_TIMEOUT": 1000 * (_SILENT_S + every_s * times),
    }
    for name, value in settings.items():
        if (option := getattr(socket, name, None)) is not None:
            with contextlib.suppress(OSError):  # a system may know the name and not the option
                connection.setsockopt(socket.IPPROTO_TCP, option, value)


class SerialPort(Link):
    """Whatever pyserial opens: /dev/ttyUSB0, COM3, rfc2217://host:port, loop://."""

    starts_amid = True

    def __init__(self, url: str, settings: Mapping[str, Any]) -> None:
        self._url, self._settings = url, settings
        self.breaks_unseen = url.startswith(("rfc2217://", "socket://"))

    def open(self) -> None:
        import serial

        try:
            self.opened = serial.serial_for_url(self._url, timeout=_WAIT_S, **self._settings)
        except ValueError as error:  # settings that the port does not know
            raise OSError(str(error)) from None

    def read(self) -> bytes:
        try:
            return self.opened.read(min(max(self.opened.in_waiting, 1), _BLOCK_BYTES))
        except OSError:
            raise
        except Exception as error:  # pyserial lets TypeError, termios.error ... through where a port is pulled out
            raise OSError(str(error) or type(error).__name__) from error


class StandardInput(Link):
    """Bytes piped in; their end is the end."""

    reopens = False
    patient = True

    def open(self) -> None:
        self._descriptor = sys.stdin.fileno()

    def read(self) -> bytes:
        if sys.platform != "win32" and not select.select([self._descriptor], [], [], _WAIT_S)[0]:
            return b""  # elsewhere pipes cannot be waited for, and stopping waits for the next bytes
        block = os.read(self._descriptor, _BLOCK_BYTES)
        if not block:
            raise EOFError
        return block


class GrowingFile(Link):
    """A text file that a logger appends to, from its start; a file that was cut or replaced is begun anew."""

    patient = True

    def __init__(self, path: Path) -> None:
        self._path = path

    def open(self) -> None:
        self.opened = self._path.open("rb", buffering=0)

    def read(self) -> bytes:
        block = self.opened.read(_BLOCK_BYTES)
        if not block:
            here, now = os.fstat(self.opened.fileno()), self._path.stat()
            if now.st_size < self.opened.tell() or (here.st_ino, here.st_dev) != (now.st_ino, now.st_dev):
                raise OSError("the file was cut or replaced")
            time.sleep(IDLE_S)
        return block
