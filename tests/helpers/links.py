"""Links and feeds that give what a test has written."""

import json
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from helpers import sent_frames
from helpers.recordings import BENCH, START_NS, streams_of
from kf_calib.bench.bench import Bench
from kf_calib.bench.streams import Batch
from kf_calib.sources.live import LiveSource, frames
from kf_calib.sources.live.feed import Feed, Link, Lost, Regained
from kf_calib.sources.live.streamed import StreamedFeed

KEYS = {"axes": "y z x", "gravity_mps2": "9.81"}


HEADER = "time_ns,ax_mps2,ay_mps2,az_mps2,outer_rad,middle_rad,inner_rad"


def row(i: int) -> str:
    return f"{START_NS + i * 1_000_000},{i},9.8,-0.25,0.1,0.2,0.3"


def rows(start: int, end: int) -> bytes:
    return "".join(f"{row(i)}\n" for i in range(start, end)).encode()


def json_rows(start: int, end: int) -> bytes:
    entries = (
        {"time_ns": START_NS + i * 1_000_000, "accel_mps2": [i, 9.8, -0.25], "angles_rad": [0.1, 0.2, 0.3]}
        for i in range(start, end)
    )
    return "".join(json.dumps(entry) + "\n" for entry in entries).encode()


def frame_rows(start: int, end: int) -> bytes:
    out = [sent_frames.bench(KEYS)]
    for i in range(start, end):
        out.append(sent_frames.sample(frames.ACCEL, i, START_NS + i * 1_000_000, (float(i), 9.8, -0.25)))
        out.append(sent_frames.sample(frames.ANGLES, i, START_NS + i * 1_000_000, (0.1, 0.2, 0.3)))
    return b"".join(out)


def csv_rows(start: int, end: int) -> bytes:
    return f"{HEADER}\n".encode() + rows(start, end)


class Script(Link):
    """A link that gives these pieces, then ends; an exception among them breaks it there."""

    def __init__(self, *pieces: bytes | Exception, starts_amid: bool = False) -> None:
        self._pieces = list(pieces)
        self.starts_amid = starts_amid
        self.opened = 0

    def open(self) -> None:
        self.opened += 1

    def read(self) -> bytes:
        if not self._pieces:
            raise EOFError
        piece = self._pieces.pop(0)
        if isinstance(piece, Exception):
            raise piece
        return piece

    def close(self) -> None: ...


def scripted(
    *pieces: bytes | Exception, header: str = "", amid: bool = False, record: Path | None = None
) -> LiveSource:
    feed = StreamedFeed("script", Script(*pieces, starts_amid=amid), KEYS, {}, header, 1.0, float("inf"))
    return LiveSource(feed, record)


class Given(Feed):
    """A feed of items made beforehand; one that waits for ``gate`` before it ends."""

    def __init__(self, *items: Batch | Lost | Regained, patient: bool = False) -> None:
        super().__init__("given")
        self.patient, self._items = patient, items
        self.gate = threading.Event()
        self.gate.set()

    def begin(self) -> Bench:
        return BENCH

    def __iter__(self) -> Iterator[Batch | Lost | Regained]:
        yield from self._items
        self.gate.wait(4.0)


def numbers(batch: Batch) -> list[int]:
    return batch.accel.values[:, 0].astype(int).tolist()


def joined(parts: list[Batch]) -> Batch:
    return Batch(*(sum(streams[1:], streams[0]) for streams in zip(*map(streams_of, parts), strict=True)))


def wait_for(is_so: Callable[[], bool]) -> None:
    """However busy the machine is: a thread that has half a minute has had its turn."""
    end_s = time.monotonic() + 30.0
    while not is_so():
        assert time.monotonic() < end_s
        time.sleep(0.001)
