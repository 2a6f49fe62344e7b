"""Samples that come as bytes over a link: one thread takes them in, whoever iterates understands them."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass

from kf_calib.bench.bench import Bench
from kf_calib.bench.keys import BenchKeys
from kf_calib.bench.raw_input import PLAIN
from kf_calib.bench.streams import Batch, Stream, bench_without_angles, with_accel, without_poses
from kf_calib.errors import BenchError, InputError
from kf_calib.sources.live.feed import IDLE_S, Feed, Link, Lost, Regained, nothing
from kf_calib.sources.live.protocols import Protocol
from kf_calib.sources.text.units import Units

_PACE_S = 0.012  # between reads: many small ones cost more than they bring; a serial port holds 4 KB meanwhile
_INBOX_BYTES = 1 << 25
_PUSHED_BYTES = 1 << 16  # understood at once: garbage of many short lines takes a quarter of a second
_AFTER_STOP_S = 1.0  # for what came before the end; longer only where garbage has piled up
_TICK_S = 0.1
_FIRST_WAIT_S = 0.1
_LONGEST_WAIT_S = 5.0
_POSE_WAIT_S = 0.5  # how long readings wait for the first angles, not recorded, where the axes are stated
_MOST_AHEAD = 1_000_000  # samples that may come before it is known how the platform is described


@dataclass(frozen=True)
class _Ended:
    """Nothing more comes."""


@dataclass
class _Outage:
    """From the loss of the link until something comes again: why, since when, and the wait before the next try."""

    reason: str
    since_s: float
    wait_s: float = 0.0

    def try_later(self) -> None:
        self.wait_s = min(max(2.0 * self.wait_s, _FIRST_WAIT_S), _LONGEST_WAIT_S)


class StreamedFeed(Feed):
    """give_up_s: how long a lost link is tried again. idle_s: ends where nothing came for so long. silent_s: a link
    that can break without a sign is opened again where nothing came for so long; before anything came it is left alone.
    angles: False to do without platform angles; poses that come are then left out.

    Raises InputError where the link cannot be opened.
    """

    def __init__(
        self,
        name: str,
        link: Link,
        overrides: BenchKeys,
        columns: Mapping[str, str],
        header: str,
        give_up_s: float,
        idle_s: float,
        silent_s: float = math.inf,
        *,
        angles: bool = True,
    ) -> None:
        super().__init__(name)
        self._angles, self._said = angles, list[str]()
        self.patient = link.patient
        self._link, self._overrides = link, overrides
        self._give_up_s, self._idle_s = give_up_s, idle_s
        self._silent_s = silent_s if link.breaks_unseen else math.inf
        self._came_s = self._stopped_s = math.inf
        self._outage: _Outage | None = None
        self._left_bytes = self._poses_left_out = 0
        self._protocol, self._input = Protocol(name, columns, header, angles, Units.of(overrides)), PLAIN
        self._ahead = deque[Batch | Lost | Regained]()
        self._inbox = deque[bytes | Lost | Regained | _Ended]()
        self._inbox_bytes = 0
        self._arrived = threading.Condition()
        self._items = self._understood()  # one: what is left of a block when the bench is known is not lost
        try:
            link.open()
        except OSError as error:
            raise InputError(
                f"{name}: cannot be opened ({_reason(error)}): check the address, and that it is on."
            ) from None
        self.link = "live"
        if link.starts_amid:
            self._protocol.form.joined_amid()
        self._reader = threading.Thread(target=self._read, name="reader", daemon=True)

    def begin(self) -> Bench:
        self._reader.start()
        ahead, readings, first_s = 0, 0, math.inf
        for item in self._items:
            if isinstance(item, Batch):
                ahead, readings = ahead + len(item.accel) + len(item.temperature), readings + len(item.accel)
                first_s = min(first_s, time.monotonic()) if ahead else first_s
            if not isinstance(item, Batch) or len(item.accel) or len(item.pose) or len(item.temperature):
                self._ahead.append(item)  # not what says that nothing came, which would pile up
            reader = self._protocol.reader
            if reader is None:
                continue
            if not self._angles:
                if readings:
                    bench, self._said = bench_without_angles(self.name, reader.stated(self.name, self._overrides))
                    return self._converting(bench)
                continue
            if not reader.pose_width and time.monotonic() - first_s > _POSE_WAIT_S:
                reader.pose_width = self._stated_width(reader.metadata)
            if reader.pose_width and readings:  # their names tell a unit
                return self._converting(reader.bench(self.name, self._overrides))
            if ahead > _MOST_AHEAD:
                break
        if self._angles and (reader := self._protocol.reader) is not None and reader.pose_width:  # angles alone came
            return self._converting(reader.bench(self.name, self._overrides))
        raise self._protocol.unusable(
            "no platform angles (--no-angles does without them)" if self._angles else "no readings"
        )

    def _converting(self, bench: Bench) -> Bench:
        """The bench, whose raw input all readings are converted by from now on."""
        self._input = bench.input
        return bench

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
            yield self._fitting(self._ahead.popleft(), width)
        for item in self._items:
            yield self._fitting(item, width)

    def _fitting(self, item: Batch | Lost | Regained, width: int) -> Batch | Lost | Regained:
        """What is handed on: batches with poses of this width, or none where no angles are used."""
        if not isinstance(item, Batch):
            return item
        item = with_accel(item, self._input.readings(item.accel.values))
        if self._angles:
            # a batch without poses was made before their width was known
            if item.pose.values.shape[1] == width:
                return item
            return Batch(item.accel, Stream.empty(width), item.temperature)
        self._poses_left_out += len(item.pose)
        return without_poses(item)

    @property
    def warnings(self) -> list[str]:
        left = f"{self.name}: {self._left_bytes} bytes that came shortly before the end were not read any more."
        unused = f"{self.name}: {self._poses_left_out} poses came too and are neither used nor recorded (--no-angles)."
        said = [unused] * bool(self._poses_left_out) + [left] * bool(self._left_bytes)
        return [*self._said, *super().warnings, *said]

    def close(self) -> None:
        self.stopping = True
        if self._reader.is_alive():
            self._reader.join(2.0)

    # -- the thread that iterates --

    def _understood(self) -> Iterator[Batch | Lost | Regained]:
        while True:
            item = self._next()
            match item:
                case bytes():
                    for at in range(0, len(item) or 1, _PUSHED_BYTES):
                        if self._is_late():
                            self._left_bytes += len(item) - at
                            break
                        yield self._protocol.push(item[at : at + _PUSHED_BYTES]) if item else nothing(0)
                case Lost():
                    self._protocol.form.cut_off()
                    yield item
                case Regained():
                    if self._link.starts_amid:
                        self._protocol.form.joined_amid()
                    yield item
                case _Ended():
                    yield self._protocol.form.rest()
            self.counts, self.lost = self._protocol.counts, self._protocol.form.lost
            if isinstance(item, _Ended):
                return

    def _is_late(self) -> bool:
        """Whether the end was asked for, and the time for what had come till then is over."""
        now = time.monotonic()
        self._stopped_s = min(self._stopped_s, now) if self.stopping else math.inf
        return now - self._stopped_s > _AFTER_STOP_S

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
        try:
            self._read_on()
        except Exception as error:  # of a library or a driver, in a way that is not known
            self.trouble = f"the link cannot be read on ({type(error).__name__}: {error})"
        finally:  # else the run would wait for ever
            with suppress(Exception):
                self._link.close()
            self._put(_Ended())

    def _read_on(self) -> None:
        self._came_s = opened_s = time.monotonic()
        while not self.stopping and time.monotonic() - self._came_s < self._idle_s:
            try:
                block = self._link.read()
                if not block and self.bytes and time.monotonic() - max(opened_s, self._came_s) > self._silent_s:
                    raise TimeoutError(f"nothing came for {self._silent_s:g} s")
            except EOFError:
                return
            except OSError as error:
                if not self._reopen(_reason(error)):
                    return
                opened_s = time.monotonic()
                continue
            if block:
                self._take_in(block)
                time.sleep(_PACE_S)

    def _take_in(self, block: bytes) -> None:
        self._came_s = time.monotonic()
        if self._outage is not None:  # only now: a server may accept and close at once
            self._put(Regained(self._came_s - self._outage.since_s))
            self._outage, self.link, self.trouble = None, "live", ""
            self.reconnects += 1
        self.bytes += len(block)
        self._put(block)

    def _put(self, item: bytes | Lost | Regained | _Ended) -> None:
        """Into the inbox; where that is full the link's own buffers have to hold what comes."""
        while isinstance(item, bytes) and self._inbox_bytes > _INBOX_BYTES and not self.stopping:
            time.sleep(IDLE_S)
        with self._arrived:
            self._inbox.append(item)
            self._inbox_bytes += len(item) if isinstance(item, bytes) else 0
            self._arrived.notify()

    def _reopen(self, reason: str) -> bool:
        """Opens the link again, waiting longer from try to try until something comes; False where it is given up."""
        self._link.close()
        if self._outage is None:
            self._put(Lost(reason))
            if not self._link.reopens:
                return False
            self._outage, self.link = _Outage(reason, time.monotonic()), "lost"
        outage, why = self._outage, reason
        while not self.stopping:
            now = time.monotonic()
            left_s = min(outage.since_s + self._give_up_s, self._came_s + self._idle_s) - now
            if left_s < 0.0:
                self.trouble = f"the link was lost ({why}) and did not come back within {now - outage.since_s:.0f} s."
                return False
            self.trouble = f"the link was lost ({why})"
            self._nap(min(outage.wait_s, left_s))
            outage.try_later()
            try:
                self._link.open()
            except OSError as error:
                why = f"{reason}; {_reason(error)}"
                continue
            self.trouble = f"the link was lost ({reason}); it is open again, and nothing has come yet"
            return True
        return False

    def _nap(self, seconds: float) -> None:
        end_s = time.monotonic() + seconds
        while not self.stopping and (left_s := end_s - time.monotonic()) > 0.0:
            time.sleep(min(left_s, _TICK_S))


def _reason(error: OSError) -> str:
    return str(error.strerror or error or type(error).__name__)
