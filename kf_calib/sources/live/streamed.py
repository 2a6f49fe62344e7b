"""Samples that come as bytes over a link: one thread takes them in, whoever iterates understands them."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from kf_calib.bench import Bench
from kf_calib.errors import BenchError, InputError
from kf_calib.samples import Batch, Stream
from kf_calib.sources.lines import described
from kf_calib.sources.live.feed import IDLE_S, Feed, Lost, Regained, nothing
from kf_calib.sources.live.links import Link
from kf_calib.sources.live.protocols import Protocol

_PACE_S = 0.012  # between reads: many small ones cost more than they bring; a serial port holds 4 KB meanwhile
_INBOX_BYTES = 1 << 25
_PUSHED_BYTES = 1 << 20
_TICK_S = 0.1
_FIRST_WAIT_S = 0.1
_LONGEST_WAIT_S = 5.0
_POSE_WAIT_S = 0.5  # how long readings wait for the first angles, not recorded, where the axes are stated
_MOST_AHEAD = 1_000_000  # samples that may come before it is known how the platform is described


@dataclass(frozen=True)
class _Ended:
    """Nothing more comes."""


class StreamedFeed(Feed):
    """give_up_s: how long a lost link is tried again. idle_s: ends where nothing came for so long.

    Raises InputError where the link cannot be opened.
    """

    def __init__(
        self,
        name: str,
        link: Link,
        overrides: Mapping[str, str],
        columns: Mapping[str, str],
        header: str,
        give_up_s: float,
        idle_s: float,
    ) -> None:
        super().__init__(name)
        self.patient = link.patient
        self._link, self._overrides = link, overrides
        self._give_up_s, self._idle_s = give_up_s, idle_s
        self._protocol = Protocol(name, columns, header)
        self._ahead = deque[Batch | Lost | Regained]()
        self._inbox = deque[bytes | Lost | Regained | _Ended]()
        self._inbox_bytes = 0
        self._arrived = threading.Condition()
        try:
            link.open()
        except OSError as error:
            raise InputError(
                f"{name}: cannot be opened ({_reason(error)}): check the address, and that it is on."
            ) from None
        self.link = "live"
        if link.starts_amid:
            self._protocol.joined_amid()
        self._reader = threading.Thread(target=self._read, name="reader", daemon=True)

    def begin(self) -> Bench:
        self._reader.start()
        ahead, first_s = 0, math.inf
        for item in self._understood():
            if isinstance(item, Batch):
                ahead += len(item.accel) + len(item.temperature)
                first_s = min(first_s, time.monotonic()) if ahead else first_s
            self._ahead.append(item)
            reader = self._protocol.reader
            if reader is None:
                continue
            if not reader.pose_width and time.monotonic() - first_s > _POSE_WAIT_S:
                reader.pose_width = self._stated_width(reader.metadata)
            if reader.pose_width:
                return described(self.name, reader, self._overrides)
            if ahead > _MOST_AHEAD:
                break
        raise self._protocol.unusable("no platform angles")

    def _stated_width(self, metadata: Mapping[str, str]) -> int:
        """How many angles a pose will have, by the axes that are stated; 0 where they are not."""
        try:
            return Bench.from_metadata({**metadata, **self._overrides}).pose_width
        except BenchError:
            return 0

    def __iter__(self) -> Iterator[Batch | Lost | Regained]:
        reader = self._protocol.reader
        width = reader.pose_width if reader else 0
        while self._ahead:
            item = self._ahead.popleft()
            yield _widened(item, width) if isinstance(item, Batch) else item
        for item in self._understood():
            yield _widened(item, width) if isinstance(item, Batch) else item

    def close(self) -> None:
        self.stopping = True
        if self._reader.is_alive():
            self._reader.join(2.0)

    # -- the thread that iterates --

    def _understood(self) -> Iterator[Batch | Lost | Regained]:
        while True:
            item = self._next()
            self.account, self.lost = self._protocol.account, self._protocol.lost
            match item:
                case bytes():
                    yield self._protocol.push(item) if item else nothing(0)
                case Lost():
                    self._protocol.cut_off()
                    yield item
                case Regained():
                    if self._link.starts_amid:
                        self._protocol.joined_amid()
                    yield item
                case _Ended():
                    yield self._protocol.rest()
                    self.account, self.lost = self._protocol.account, self._protocol.lost
                    return
            self.account, self.lost = self._protocol.account, self._protocol.lost

    def _next(self) -> bytes | Lost | Regained | _Ended:
        """All bytes that wait, up to a number, or one event; b"" where nothing comes."""
        with self._arrived:
            if not self._inbox:
                self._arrived.wait(_TICK_S)
            if not self._inbox:
                return b""
            if not isinstance(self._inbox[0], bytes):
                return self._inbox.popleft()
            taken, size = list[bytes](), 0
            while self._inbox and isinstance(block := self._inbox[0], bytes) and size < _PUSHED_BYTES:
                taken.append(block)
                size += len(block)
                self._inbox.popleft()
            self._inbox_bytes -= size
        return taken[0] if len(taken) == 1 else b"".join(taken)

    # -- the thread that reads --

    def _read(self) -> None:
        last_s = time.monotonic()
        while not self.stopping and time.monotonic() - last_s < self._idle_s:
            try:
                block = self._link.read()
            except EOFError:
                break
            except OSError as error:
                if not self._regain(_reason(error)):
                    break
                last_s = time.monotonic()
                continue
            if block:
                last_s = time.monotonic()
                self.bytes += len(block)
                self._put(block)
                time.sleep(_PACE_S)
        self._link.close()
        self._put(_Ended())

    def _put(self, item: bytes | Lost | Regained | _Ended) -> None:
        """Into the inbox; where that is full the link's own buffers have to hold what comes."""
        while isinstance(item, bytes) and self._inbox_bytes > _INBOX_BYTES and not self.stopping:
            time.sleep(IDLE_S)
        with self._arrived:
            self._inbox.append(item)
            self._inbox_bytes += len(item) if isinstance(item, bytes) else 0
            self._arrived.notify()

    def _regain(self, reason: str) -> bool:
        """Opens the link again, waiting longer from try to try; False where it is given up."""
        self._link.close()
        self._put(Lost(reason))
        if not self._link.reopens:
            return False
        self.link, self.trouble = "lost", f"the link was lost ({reason})"
        lost_s, wait_s = time.monotonic(), _FIRST_WAIT_S
        while not self.stopping:
            down_s = time.monotonic() - lost_s
            if down_s > min(self._give_up_s, self._idle_s):
                self.trouble = f"the link was lost ({reason}) and did not come back within {down_s:.0f} s."
                return False
            try:
                self._link.open()
            except OSError as error:
                self.trouble = f"the link was lost ({reason}; {_reason(error)})"
                self._nap(min(wait_s, max(min(self._give_up_s, self._idle_s) - down_s, 0.0)))
                wait_s = min(2.0 * wait_s, _LONGEST_WAIT_S)
                continue
            self.link, self.trouble = "live", ""
            self.reconnects += 1
            self._put(Regained(time.monotonic() - lost_s))
            return True
        return False

    def _nap(self, seconds: float) -> None:
        end_s = time.monotonic() + seconds
        while not self.stopping and (left_s := end_s - time.monotonic()) > 0.0:
            time.sleep(min(left_s, _TICK_S))


def _widened(batch: Batch, width: int) -> Batch:
    """A batch without poses, made before their width was known, with that width."""
    if batch.pose.values.shape[1] == width:
        return batch
    return Batch(batch.accel, Stream.empty(width), batch.temperature)


def _reason(error: OSError) -> str:
    return str(error.strerror or error or type(error).__name__)
