"""Cuts the power of a recorder at random moments: what the disk holds then is read, and compared with what was sent.

    .venv/bin/python tools/power_cuts.py --cuts 100000 --seed 1

The file under the recorder is that of a disk: what was written since it was last told to bring everything there
(fsync) may be lost, in pieces of 512 bytes, in any order; the file may already be as long as it was to become, with
zeros where nothing came. After each cut the recording has to be readable, to hold every reading that was on the disk,
and none that was never sent. ``--only N`` plays one cut again.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import IO, Any

import click
import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench, axes_of
from kf_calib.bench.streams import Batch, Stream
from kf_calib.errors import KfCalibError
from kf_calib.sources.files import recorder
from kf_calib.sources.files.recording import Recording

SECTOR = 512
FLUSH_S = 0.5
"""After how long a live run brings its readings to the disk."""
BENCH = Bench(axes_of("yzx"), 9.81)
START_NS = 1_750_000_000_000_000_000


@dataclass
class Disk:
    """What reached a file, in its order: (place, bytes) of a write, or None where all before it is on the disk; and how
    many readings had been sent by then."""

    events: list[tuple[int, bytes] | None] = field(default_factory=list)
    sent: list[int] = field(default_factory=list)
    count: int = 0

    def note(self, event: tuple[int, bytes] | None) -> None:
        self.events.append(event)
        self.sent.append(self.count)


class DiskFile:
    """An open file whose writes are noted."""

    def __init__(self, file: IO[bytes], disk: Disk) -> None:
        self._file, self._disk = file, disk

    def write(self, content: bytes) -> int:
        self._disk.note((self._file.tell(), bytes(content)))
        return self._file.write(content)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


@contextmanager
def noted(disk: Disk) -> Iterator[None]:
    """Within this, recorders write to such a disk."""
    create, sync = recorder.Recorder._create, os.fsync

    def made(self: recorder.Recorder, overwrite: bool) -> Any:
        return DiskFile(create(self, overwrite), disk)

    def synced(descriptor: int) -> None:
        disk.note(None)

    recorder.Recorder._create = made  # type: ignore[method-assign]
    os.fsync = synced
    try:
        yield
    finally:
        recorder.Recorder._create = create  # type: ignore[method-assign]
        os.fsync = sync


def readings(seed: int) -> Batch:
    """Half a minute of readings at 200 Hz, angles at 50 Hz and temperatures at 1 Hz."""
    rng, time_ns = np.random.default_rng(seed), START_NS + np.arange(6000) * 5_000_000
    accel, pose = Stream(time_ns, rng.normal(size=(6000, 3))), Stream(time_ns[::4], rng.normal(size=(1500, 3)))
    return Batch(accel, pose, Stream(time_ns[::200], rng.normal(size=(30, 1))))


@cache
def recorded(seed: int) -> tuple[Disk, Batch]:
    """What reaches the disk of a run, and its readings."""
    disk, batch = Disk(), readings(seed)
    rng = np.random.default_rng([seed, 1])
    with tempfile.TemporaryDirectory() as folder, noted(disk):
        chunk_size = int(rng.integers(2_000, 60_000))
        made = recorder.Recorder(Path(folder, "run.mcap"), BENCH, chunk_size=chunk_size, flush_s=1e9)
        first = 0
        while first < 6000:
            last = min(first + int(rng.integers(1, 120)), 6000)
            low_ns, high_ns = START_NS + first * 5_000_000, START_NS + last * 5_000_000
            parts = [_between(stream, low_ns, high_ns) for stream in (batch.accel, batch.pose, batch.temperature)]
            disk.count = last
            made.write(Batch(*parts))
            if rng.random() < 0.1:
                made.end_dwell()
            if rng.random() < 0.03:
                made.mark("decision", {"number": str(first), "why": "x" * int(rng.integers(1, 400))})
            first = last
        made.close()
    return disk, batch


def _between(stream: Stream, low_ns: int, high_ns: int) -> Stream:
    part = slice(*np.searchsorted(stream.time_ns, [low_ns, high_ns]).tolist())
    return Stream(stream.time_ns[part], stream.values[part])


def after_cut(disk: Disk, rng: np.random.Generator) -> tuple[bytes, int]:
    """What the disk holds after a cut at a random moment, and how many readings it must hold."""
    moment = int(rng.integers(1, len(disk.events) + 1))
    synced = max((k for k in range(moment) if disk.events[k] is None), default=-1)
    safe = [event for event in disk.events[: synced + 1] if event is not None]
    unsafe = [event for event in disk.events[synced + 1 : moment] if event is not None]
    content = bytearray()
    for place, written in safe:
        _put(content, place, written)
    kept = bytearray(content)
    share = rng.random()
    for place, written in unsafe:
        ends = [*range((place // SECTOR + 1) * SECTOR, place + len(written), SECTOR), place + len(written)]
        begin = place
        for end in ends:
            if rng.random() < share:
                _put(kept, begin, written[begin - place : end - place])
            begin = end
    if unsafe and rng.random() < 0.5:  # its length was on the disk, its content was not
        longest = max(place + len(written) for place, written in unsafe)
        kept.extend(bytes(max(longest - len(kept), 0)))
    return bytes(kept), disk.sent[synced] if synced >= 0 else 0


def _put(content: bytearray, place: int, written: bytes) -> None:
    content.extend(bytes(max(place - len(content), 0)))
    content[place : place + len(written)] = written


def play(number: int, seed: int) -> str:
    """What is wrong after this cut; "" where nothing is."""
    rng = np.random.default_rng([seed, number])
    disk, batch = recorded(int(rng.integers(0, 40)))
    content, safe = after_cut(disk, rng)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "run.mcap")
        path.write_bytes(content)
        try:
            parts = [part.accel for part in Recording(path)]
        except KfCalibError as error:
            return f"it cannot be read ({error})" if safe else ""
        except Exception as error:
            return f"it cannot be read ({type(error).__name__}: {error})"
    time_ns = np.concatenate([np.zeros(0, np.int64), *(part.time_ns for part in parts)])
    values = np.concatenate([np.zeros((0, 3)), *(part.values for part in parts)])
    numbers = (time_ns - START_NS) // 5_000_000
    if len(np.unique(numbers)) != len(numbers):
        return "readings come twice"
    known = (numbers >= 0) & (numbers < 6000)
    if not known.all() or not np.array_equal(batch.accel.time_ns[numbers], time_ns):
        return "there are readings that were never sent"
    if not np.array_equal(batch.accel.values[numbers], values):
        return "there are readings with other values than were sent"
    lost = np.setdiff1d(np.arange(safe), numbers)
    return f"{len(lost)} of {safe} readings that were on the disk are lost" if len(lost) else ""


def ages_s(seconds: float, jobs: int, path: Path) -> Floats:
    """Age in s of the oldest reading that the disk is not known to hold, every 20 ms of a recording at 5 kHz, while so
    many processes compute and one writes to the same disk without a break."""
    busy = [get_context("spawn").Process(target=_compute, daemon=True) for _ in range(jobs)]
    busy.append(get_context("spawn").Process(target=_write, args=(path.parent,), daemon=True))
    for each in busy:
        each.start()
    rng, ages, began_s = np.random.default_rng(1), list[float](), time.monotonic()
    made = recorder.Recorder(path, BENCH, flush_s=FLUSH_S, background=True)
    due_s, count = began_s, 0
    while due_s < began_s + seconds:
        time_ns = START_NS + (count + np.arange(100)) * 200_000
        made.write(Batch(Stream(time_ns, rng.normal(size=(100, 3))), Stream(time_ns[:2], rng.normal(size=(2, 3))),
                         Stream(time_ns[:0], np.zeros((0, 1)))))  # fmt: skip
        ages.append(time.monotonic() - made.synced_s)
        due_s, count = due_s + 0.02, count + 100
        time.sleep(max(due_s - time.monotonic(), 0.0))
    made.close()
    for each in busy:
        each.kill()
        each.join()
    return np.array(ages)


def _compute() -> None:
    while True:
        sum(range(100_000))


def _write(folder: Path) -> None:
    with tempfile.TemporaryFile(dir=folder) as file:
        while True:
            file.seek(0)
            file.write(os.urandom(1 << 20) * 64)
            os.fsync(file.fileno())


def _played(numbers: range, seed: int) -> list[tuple[int, str]]:
    return [(number, said) for number in numbers if (said := play(number, seed))]


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--cuts", type=click.IntRange(min=1), default=1000, show_default=True, help="How often the power goes.")
@click.option("--seed", type=int, default=1, show_default=True, help="Of all cuts.")
@click.option("--only", type=int, help="Play this cut alone.")
@click.option("--jobs", type=click.IntRange(min=1), default=2, show_default=True, help="Number of processes.")
@click.option(
    "--age", type=float, help="Measure for so many s how old the oldest reading becomes that is not on the disk."
)
def main(cuts: int, seed: int, only: int | None, jobs: int, age: float | None) -> None:
    """Cut the power of a recorder at random moments, and count what is lost that was on the disk."""
    if age is not None:
        with tempfile.TemporaryDirectory(dir=".") as folder:
            ages = ages_s(age, jobs, Path(folder, "run.mcap"))
        half, most = np.quantile(ages, [0.5, 0.99])
        click.echo(
            f"the oldest reading not on the disk: {half:.2f} s (median), {most:.2f} (99 %), {ages.max():.2f} (worst)"
        )
        return
    if only is not None:
        click.echo(play(only, seed) or "nothing is lost, and nothing is invented")
        return
    began_s, wrong = time.monotonic(), list[tuple[int, str]]()
    parts = [range(k, min(k + 500, cuts)) for k in range(0, cuts, 500)]
    with ProcessPoolExecutor(jobs) as pool:
        for found in pool.map(_played, parts, [seed] * len(parts)):
            wrong += found
    for number, said in wrong[:20]:
        click.echo(f"cut {number}: {said}")
    click.echo(f"{len(wrong)} of {cuts} cuts lost or invented something ({time.monotonic() - began_s:.0f} s)")
    raise SystemExit(bool(wrong))


if __name__ == "__main__":
    with suppress(KeyboardInterrupt):
        main()
