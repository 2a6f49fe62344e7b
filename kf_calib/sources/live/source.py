"""The live source: recording first, then a queue that a slow consumer cannot clog."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from kf_calib.bench.bench import Bench
from kf_calib.bench.streams import Batch, Stream
from kf_calib.errors import InputError, KfCalibError
from kf_calib.sources.files.recorder import Recorder
from kf_calib.sources.files.recording import CLOCK_RECORD, GAP_RECORD, RUN_RECORD
from kf_calib.sources.live.clock import Clock, Continuity, Restart
from kf_calib.sources.live.feed import Feed, Lost, Regained, Status
from kf_calib.support.output_files import refuse_output
from kf_calib.support.text import date_of_stamp, format_date

_FLUSH_S = 0.5  # with the time that flushing takes, less than the second that a kill may cost
QUEUED = 200_000
"""Samples, of all kinds, that wait for the consumer at most."""

_TAKEN = 1 << 16  # samples of one batch, where several wait
_RATE_S = 2.0
_LATEST_NS = (1 << 31) * 1_000_000_000


@dataclass
class _Counts:
    readings: int = 0
    poses: int = 0
    temperatures: int = 0
    dropped: int = 0


@dataclass
class _Queue:
    """Batches on their way to the consumer.

    behind_from: byte of the recording from which on the consumer has to read what did not fit in here; nothing is put
    in here meanwhile.
    """

    limit: int
    batches: deque[Batch] = field(default_factory=deque[Batch])
    samples: int = 0
    behind_from: int | None = None
    behind: int = 0

    def fits(self, size: int) -> bool:
        return not self.batches or self.samples + size <= self.limit

    def push(self, batch: Batch) -> None:
        self.batches.append(batch)
        self.samples += _size(batch)

    def pop(self) -> Batch | None:
        """All that waits, up to some number of samples, in one batch; None where nothing does."""
        taken = list[Batch]()
        while self.batches and sum(map(_size, taken)) < _TAKEN:
            taken.append(self.batches.popleft())
        if not taken:
            return None
        self.samples -= sum(map(_size, taken))
        return Batch(*map(Stream.joined, zip(*map(_streams, taken), strict=True)))

    @property
    def waiting(self) -> int:
        return self.behind + sum(len(batch.accel) for batch in self.batches)


def _streams(batch: Batch) -> tuple[Stream, Stream, Stream]:
    return batch.accel, batch.pose, batch.temperature


def _size(batch: Batch) -> int:
    return sum(map(len, _streams(batch)))


class LiveSource(AbstractContextManager["LiveSource"]):
    """A ``Source`` that is read while it comes; iterated once. A context manager that finishes the recording.

    Batches hold exactly the samples, in each stream in the order, that a replay of the recording gives. A consumer that
    falls behind gets from the recording what did not fit into the queue of ``queued`` samples; without a recording that
    is dropped, and counted. Raises InputError where the recording cannot be begun.
    """

    def __init__(self, feed: Feed, record: Path | None = None, overwrite: bool = False, queued: int = QUEUED) -> None:
        if record is not None:
            refuse_output(record, overwrite)
        self.name = feed.name
        self._feed, self._record, self._overwrite = feed, record, overwrite
        self._lock = threading.Condition()  # of all that follows
        self._queue = _Queue(queued)
        self._counts, self._continuity = _Counts(), Continuity()
        self._clock, self._begins = Clock(), list[int]()
        self._arrivals = deque[tuple[float, int]]()
        self._recorder: Recorder | None = None
        self._recording_trouble = ""
        self._bench: Bench | None = None
        self._begin_ns: int | None = None
        self.received: datetime | None = None
        """When the first reading came, where its stamp is no date, from a bench that is read as it speaks."""
        self._failure: BaseException | None = None
        self._is_finished = self._is_exhausted = False
        self._worker = threading.Thread(target=self._work, name="acquisition", daemon=True)
        self._worker.start()

    @property
    def bench(self) -> Bench:
        """The bench; waits until it has told what is needed of it. Raises InputError where it has not."""
        with self._lock:
            self._wait_until(lambda: self._bench is not None or self._is_finished)
            if self._bench is None:
                raise self._failure or InputError(f"{self.name}: stopped before the bench was known.")
            return self._bench

    @property
    def warnings(self) -> list[str]:
        return [*self._feed.warnings, *(f"{self.name}: {said}" for said in self.status.sentences())]

    @property
    def failure(self) -> BaseException | None:
        """What ended it, where it did not end by itself."""
        return self._failure

    @property
    def fraction(self) -> float:
        return self._feed.fraction

    @property
    def status(self) -> Status:
        """How things stand now."""
        feed, first = self._feed, self._feed.counts.first_malformed
        with self._lock:
            now, recorder = time.monotonic(), self._recorder
            return Status(
                link=feed.link,
                trouble=feed.trouble,
                rate_hz=sum(count for at_s, count in self._arrivals if at_s >= now - _RATE_S) / _RATE_S,
                samples=self._counts.readings,
                poses=self._counts.poses,
                temperatures=self._counts.temperatures,
                refused=feed.counts.malformed,
                first_refusal=f"{first[0]}: {first[1]}" if first else "",
                gaps=self._continuity.gaps,
                missing=self._continuity.missing if feed.lost is None else feed.lost,
                clock_restarts=len(self._clock.restarts),
                left_out=self._clock.left_out,
                clock_trouble=self._clock.trouble,
                dropped=self._counts.dropped,
                waiting=self._queue.waiting,
                reconnects=feed.reconnects,
                bytes=feed.bytes,
                recorded=recorder.flushed if recorder else 0,
                sync_age_s=now - recorder.synced_s if recorder and self._is_recording else None,
                recording_trouble=self._recording_trouble,
            )

    @property
    def _is_recording(self) -> bool:
        return self._recorder is not None and not self._recording_trouble and not self._is_finished

    def begin_ns(self) -> int | None:
        """Stamp of the first reading; None where none has come yet."""
        return self._begin_ns

    def mark(self, name: str, facts: Mapping[str, str]) -> None:
        """Puts a metadata record among the samples that came so far, where the run is recorded; from any thread."""
        with self._lock:
            self._store_if_open(lambda recorder: recorder.mark(name, facts))

    def stop(self) -> None:
        """Ends the iteration after what has come; from any thread, or a signal handler."""
        self._feed.stop()

    def close(self) -> None:
        """Stops, and waits until the recording is finished."""
        self.stop()
        self._worker.join()

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[Batch]:
        if self._is_exhausted:
            raise InputError(f"{self.name} can be read only once: record it, and replay the recording.")
        _ = self.bench  # so that a bench that cannot be used is told first
        queue = self._queue
        while True:
            with self._lock:
                self._wait_until(lambda: queue.batches or queue.behind_from is not None or self._is_finished)
                batch = queue.pop()
                self._lock.notify_all()  # there is room again
                stretch = self._caught_up() if batch is None else None
            if batch is not None:
                yield batch
            elif stretch is not None:
                yield from stretch
            else:
                break
        self._is_exhausted = True
        if self._failure is not None:
            raise self._failure

    def _wait_until(self, is_so: Callable[[], Any]) -> None:
        while not is_so():
            self._lock.wait(0.2)  # not for ever: where a lock is waited for, Windows does not hear Ctrl-C

    def _caught_up(self) -> Iterator[Batch] | None:
        """What is in the recording and did not fit into the queue, which is used again from now on."""
        start, recorder = self._queue.behind_from, self._recorder
        if start is None or recorder is None:
            return None
        if not self._is_finished:
            self._store(recorder.flush)
        self._queue.behind_from, self._queue.behind = None, 0
        return recorder.read_back(start, recorder.size) if recorder.size > start else iter(())

    # -- what the worker does --

    def _work(self) -> None:
        try:
            bench = self._feed.begin()
            if self._record is not None:
                self._recorder = Recorder(
                    self._record, bench, flush_s=_FLUSH_S, overwrite=self._overwrite, background=True
                )
            with self._lock:
                self._bench = bench
                self._lock.notify_all()
            reason = ""
            for item in self._feed:
                match item:
                    case Batch():
                        self._take(self._by_one_clock(item, time.monotonic()))
                    case Lost(reason):
                        self._continuity.cut()
                    case Regained(after_s):
                        self._mark_gap(reason, after_s)
            self._take(self._clock.rest())
        except BaseException as error:  # the consumer is told, after what came before
            self._failure = error
        self._feed.close()
        with self._lock:
            if self._recorder:
                self._store(self._recorder.finish)
            self._feed.link = "ended"
            self._is_finished = True
            self._lock.notify_all()

    def _by_one_clock(self, batch: Batch, now: float) -> Batch:
        """The samples that can be stored, by stamps that go on though the bench's clock was set."""
        batch, known = Batch(*map(self._storable, _streams(batch))), len(self._clock.restarts)
        with self._lock:
            batch = self._clock.push(batch, 0.0 if self._feed.patient else now)
        for restart in self._clock.restarts[known:]:
            self._mark_restart(restart)
        return Batch(*map(self._storable, _streams(batch)))

    def _take(self, batch: Batch) -> None:
        """One batch: recorded, handed on."""
        size, queue = _size(batch), self._queue
        with self._lock:
            if not size:
                self._store_if_open(Recorder.tick)
                return
            if not (self._feed.patient or queue.fits(size)) and queue.behind_from is None:
                queue.behind_from = self._store_if_open(Recorder.flush)
            if self._begin_ns is None and len(batch.accel):
                self._begin_ns = int(batch.accel.time_ns[0])
                if date_of_stamp(self._begin_ns) is None and not self._feed.patient:
                    self.received = datetime.now(UTC)
                    facts = {"received": format_date(self.received)}
                    self._store_if_open(lambda recorder: recorder.mark(RUN_RECORD, facts))
            self._store_if_open(lambda recorder: recorder.write(batch))
            self._count(batch)
            while self._feed.patient and not queue.fits(size) and not self._feed.stopping:
                self._lock.wait(0.1)
                self._store_if_open(Recorder.tick)
            self._hand_on(batch, size)
            self._lock.notify_all()

    def _hand_on(self, batch: Batch, size: int) -> None:
        queue = self._queue
        if queue.behind_from is not None and self._is_recording:
            queue.behind += len(batch.accel)
        elif queue.behind_from is None and (self._feed.patient or queue.fits(size)):
            queue.push(batch)
        else:
            self._counts.dropped += len(batch.accel)

    def _store_if_open(self, write: Callable[[Recorder], int | None]) -> int | None:
        recorder = self._recorder
        return self._store(lambda: write(recorder)) if recorder else None

    def _store(self, write: Callable[[], int | None]) -> int | None:
        """What ``write`` returns; None where the disk refuses, or has: that ends the recording and nothing else."""
        recorder = self._recorder
        if self._recording_trouble or recorder is None:
            return None
        try:
            return write()
        except KfCalibError as error:
            self._recording_trouble = str(error)
            if self._queue.behind_from is not None:  # what was to be read back from the chunk that is lost
                self._counts.dropped += recorder.readings - recorder.flushed
                self._queue.behind -= recorder.readings - recorder.flushed
            return None

    def _mark_gap(self, reason: str, seconds: float) -> None:
        after_ns = str(self._continuity.last_ns or 0)
        self.mark(GAP_RECORD, {"after_ns": after_ns, "seconds": f"{seconds:.6f}", "reason": reason})

    def _mark_restart(self, restart: Restart) -> None:
        facts = {"after_ns": restart.after_ns, "begin_ns": restart.begin_ns, "shift_ns": restart.shift_ns}
        texts = {key: str(value) for key, value in facts.items()} | {"reason": restart.reason}
        self._begins.append(restart.begin_ns)
        self.mark(CLOCK_RECORD, texts)

    def _storable(self, stream: Stream) -> Stream:
        """The samples whose stamps a recording can hold; the others are refused."""
        fits = (stream.time_ns >= 0) & (stream.time_ns < _LATEST_NS)
        if fits.all():
            return stream
        counts = self._feed.counts
        for _ in range(int((~fits).sum())):
            counts.refuse(counts.lines, "its time stamp is not between 1970 and 2038")
        return stream[fits]

    def _count(self, batch: Batch) -> None:
        counts, now = self._counts, time.monotonic()
        counts.readings += len(batch.accel)
        counts.poses += len(batch.pose)
        counts.temperatures += len(batch.temperature)
        begins, self._begins = self._begins, []
        self._continuity.add(batch.accel.time_ns, begins)
        self._arrivals.append((now, len(batch.accel)))
        while self._arrivals[0][0] < now - _RATE_S:
            self._arrivals.popleft()
