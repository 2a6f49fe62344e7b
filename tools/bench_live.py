"""Figures of live acquisition, against the bench emulator: CPU, latency, loss, memory, kills and faults.

    tools/bench_live.py            all of them, about five minutes
    tools/bench_live.py --quick    shorter runs, about one minute
    tools/bench_live.py --only memory --json

The source under test runs in a process of its own, the emulator in another.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from bench_emulator import Emulator, Tcp

from kf_calib.bench.streams import Batch
from kf_calib.dwells.folding import Folder
from kf_calib.estimation.dwell_pass import Pass
from kf_calib.estimation.settings import Settings
from kf_calib.online.evaluation import targets
from kf_calib.online.session import Session
from kf_calib.online.status import judge_so_far
from kf_calib.sources.files.recording import Recording
from kf_calib.sources.live import LiveSource, frames, open_live
from kf_calib.sources.live.feed import Link
from kf_calib.sources.live.streamed import StreamedFeed
from kf_calib.sources.simulation.options import options_from_query, simulation
from kf_calib.views.live.objects import line

HERE = Path(__file__).resolve().parent
KEYS = {"axes": "y z x", "gravity_mps2": "9.81"}


def resident_mb() -> float:
    """Resident memory of this process now."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


# -- the process under test --


@dataclass
class Timed:
    """A live source that notes when its consumer asks for more: by then it is through with the last batch.

    late_ms: of each reading, its stamp being wall time; ``cpu_share``: of a core, of the whole process meanwhile.
    """

    source: LiveSource
    late_ms: list[float] = field(default_factory=list[float])
    marks: list[tuple[float, float]] = field(default_factory=list[tuple[float, float]])

    def __getattr__(self, name: str) -> Any:
        return getattr(self.source, name)

    def __iter__(self) -> Iterator[Batch]:
        self._mark()
        for batch in self.source:
            yield batch
            self.late_ms += ((time.time_ns() - batch.accel.time_ns) / 1e6).tolist()
        self._mark()

    def _mark(self) -> None:
        used = resource.getrusage(resource.RUSAGE_SELF)
        self.marks.append((time.monotonic(), used.ru_utime + used.ru_stime))

    @property
    def cpu_share(self) -> float:
        (began_s, before_s), (ended_s, after_s) = self.marks
        return (after_s - before_s) / (ended_s - began_s)


def evaluate(url: str, out: Path) -> dict[str, Any]:
    """The same with a session that evaluates it: late is when the estimate has taken a reading in."""
    return acquire(url, out, lambda source: Session(source, every=False).run())


def acquire(url: str, out: Path, consume: Callable[[Timed], object] = list) -> dict[str, Any]:
    """Reads a source to its end, recording it; what it took, and how late each reading was (stamps are wall time)."""
    with open_live(url, KEYS, out) as live:
        _ = live.bench
        print(json.dumps({"ready": True}), flush=True)
        source = Timed(live)
        consume(source)
    status, samples = live.status, len(source.late_ms)
    settled = np.array(source.late_ms[samples // 20 :])
    return {
        "samples": samples,
        "cpu_share": source.cpu_share,
        "late_ms": np.percentile(settled, [50, 99, 100]).round(2).tolist(),
        "missing": status.missing,
        "refused": status.refused,
        "dropped": status.dropped,
        "recorded": status.recorded,
    }


class Endless(Link):
    """The same frames over and over, as fast as they are taken."""

    reopens = False
    patient = True

    def __init__(self, samples: int) -> None:
        block = [frames.sample(frames.ACCEL, i, 10**18 + i * 100_000, (i * 1e-4, 9.8, -0.25)) for i in range(10_000)]
        block += [frames.sample(frames.ANGLES, i, 10**18 + i * 10_000_000, (0.1, 0.2, 0.3)) for i in range(100)]
        self._block, self._left = b"".join(block), samples // 10_000

    def open(self) -> None: ...

    def read(self) -> bytes:
        if not self._left:
            raise EOFError
        self._left -= 1
        return self._block

    def close(self) -> None: ...


def gorge(samples: int, out: Path) -> dict[str, Any]:
    """Resident memory while so many readings pass through a source that records them."""
    feed = StreamedFeed("endless", Endless(samples), KEYS, {}, "", 1.0, float("inf"))
    done, marks, began_s = 0, list[float](), time.monotonic()
    with LiveSource(feed, out) as source:
        for batch in source:
            done += len(batch.accel)
            if done >= (len(marks) + 1) * samples / 10:
                marks.append(round(resident_mb(), 1))
    return {"samples": done, "resident_mb": marks, "samples_per_s": done / (time.monotonic() - began_s)}


def random_bytes(size: int, out: Path) -> dict[str, Any]:
    """Resident memory, and what is told, while so many random bytes come after a good beginning."""
    url, noise = out, np.random.default_rng(0).bytes(1 << 20)

    class Noise(Link):
        reopens, patient = False, True
        pieces: Iterator[bytes] = iter(())

        def open(self) -> None:
            good = b"time_ns,ax_g,ay_g,az_g,a_deg,b_deg,c_deg\n1,0,1,0,0,0,0\n"
            self.pieces = iter([good, *[noise] * (size >> 20), b"\n" + good[-16:]])

        def read(self) -> bytes:
            piece = next(self.pieces, None)
            if piece is None:
                raise EOFError
            return piece

        def close(self) -> None: ...

    began_s, before = time.monotonic(), resident_mb()
    with LiveSource(StreamedFeed("noise", Noise(), KEYS, {}, "", 1.0, float("inf")), url) as source:
        kept = sum(len(batch.accel) for batch in source)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024 - before
    return {
        "mb": size / 1e6, "kept": kept, "refused": source.status.refused, "grown_mb": round(grown, 1),
        "seconds": time.monotonic() - began_s,
    }  # fmt: skip


# -- measurements --


def emulator(*options: str) -> tuple[subprocess.Popen[str], str]:
    child = subprocess.Popen(
        [sys.executable, str(HERE / "bench_emulator.py"), *options], stdout=subprocess.PIPE, text=True
    )
    assert child.stdout is not None
    return child, child.stdout.readline().strip()


def child(*arguments: object) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, __file__, "--child", *map(str, arguments)], stdout=subprocess.PIPE, text=True
    )


def answer(process: subprocess.Popen[str]) -> dict[str, Any]:
    out, _ = process.communicate(timeout=1200)
    if process.returncode:
        raise SystemExit(process.returncode)  # it has said why
    return json.loads(out.splitlines()[-1])


def steady(form: str, rate_hz: float, seconds: float, folder: Path, role: str = "acquire") -> dict[str, Any]:
    """A run without faults in real time: what was sent must be there to the last reading."""
    dwell_s = seconds / 8
    bench, url = emulator(
        "--format", form, "--wall", "--sim",
        f"sample_hz={rate_hz:g}&angle_hz=100&dwell_s={dwell_s:g}&orientations=8&slew_degps=inf",
    )  # fmt: skip
    with bench:
        try:
            found = answer(child(role, f"{url}?give_up=0.5", folder / f"{role}_{form}{rate_hz:g}.mcap"))
        except BaseException:
            bench.kill()  # it would wait for ever
            raise
        sent = json.loads((bench.stdout.read() if bench.stdout else "").splitlines()[-1])
    return {
        "rate_hz": rate_hz,
        "format": form,
        "sent": sent["readings"],
        **found,
        "lost": sent["readings"] - found["samples"],
    }


def kills(count: int, folder: Path) -> dict[str, Any]:
    """kill -9 at random moments of a run at 1 kHz: seconds of readings that are not in the file."""
    lost_s, chance = list[float](), random.Random(0)
    for k in range(count):
        run = simulation(options_from_query("sample_hz=1000&dwell_s=30&orientations=2"), {}, 2048)
        bench = Emulator(run, Tcp(), "frames", wall=True, keep=True)
        thread = bench.in_background()
        out = folder / f"killed{k}.mcap"
        with child("acquire", bench.url, out) as process:
            assert process.stdout is not None
            process.stdout.readline()
            time.sleep(chance.uniform(0.3, 2.5))
            process.kill()
            killed_ns = time.time_ns()
        bench.stopping = True
        thread.join()
        stamps = np.concatenate([batch.accel.time_ns for batch in Recording(out)])
        sent = np.array(bench.ledger.stamps_ns)
        assert np.array_equal(stamps, sent[: len(stamps)]), "nothing but the end is missing"
        lost_s.append((killed_ns - int(stamps[-1])) / 1e9)
    return {"kills": count, "lost_s": [round(x, 3) for x in sorted(lost_s)[:: max(count - 1, 1)]]}


def faults(count: int, form: str, folder: Path) -> dict[str, Any]:
    """So many random faults: every reading that was not sent whole is counted as missing, and no other."""
    query = "sample_hz=1000&angle_hz=100&dwell_s=600&orientations=8&slew_degps=inf"
    kinds = ("drop", "garbage", "damage", "stall", "burst", "disconnect")
    bench = Emulator(
        simulation(options_from_query(query), {}, 2048), Tcp(), form, speed=5.0, faults=kinds, every=200.0, seed=1,
        keep=True, most_faults=count, outage_s=0.1,
    )  # fmt: skip
    thread = bench.in_background()
    out = folder / f"faults_{form}.mcap"

    def end() -> None:
        while sum(bench.ledger.faults.values()) < count:
            time.sleep(0.05)
        time.sleep(0.5)
        bench.stopping = True

    threading.Thread(target=end, daemon=True).start()
    with open_live(f"{bench.url}?give_up=1", KEYS, out) as source:
        got = np.concatenate([batch.accel.time_ns for batch in source])
    thread.join()
    ledger, status = bench.ledger, source.status
    replayed = np.concatenate([batch.accel.time_ns for batch in Recording(out)])
    return {
        "format": form,
        "faults": sum(ledger.faults.values()),
        "readings": ledger.readings,
        "not_sent": ledger.readings - ledger.sent,
        "sent_and_not_got": len(np.setdiff1d(ledger.stamps_ns, got)),
        "got_and_not_sent": len(np.setdiff1d(got, ledger.stamps_ns)),
        "missing": status.missing,
        "refused": status.refused,
        "reconnects": status.reconnects,
        "replay_is_same": bool(np.array_equal(replayed, got)),
    }


def judging(hidden: str, count: int) -> dict[str, Any]:
    """Milliseconds of a core that judging a dwell takes, and saying it in a line, at the 24th and the last of so many:
    the mean over eight dwells there, looks at all candidates among them, and the median."""
    query = f"sample_hz=50&angle_hz=10&dwell_s=10&orientations={count}&seed=5{hidden}"
    passed = Pass(simulation(options_from_query(query), {}, 4096), Settings())
    dwells, before, taken = passed.fold(), None, dict[int, float]()
    near = range(count - 8, count + 1)
    for number in sorted({*range(1, 25), *near}):
        folder = Folder()
        folder.dwells = dwells[:number]
        began_s = time.process_time()
        before = judge_so_far(replace(passed, folder=folder), targets({}), before)
        _ = line(before)
        taken[number] = 1e3 * (time.process_time() - began_s)
    out = dict[str, Any]()
    for last in (24, count):
        own = [taken[number] for number in range(last - 7, last + 1)]
        out[f"at_{last}_ms"] = {"mean": round(float(np.mean(own)), 1), "median": round(float(np.median(own)), 1)}
    return out


def measurements(quick: bool, folder: Path) -> dict[str, Callable[[], dict[str, Any]]]:
    millions = 500_000 if quick else 5_000_000
    return {
        "json_1khz": lambda: steady("json", 1000.0, 8.0 if quick else 30.0, folder),
        "frames_1khz": lambda: steady("frames", 1000.0, 8.0 if quick else 30.0, folder),
        "evaluated_1khz": lambda: steady("json", 1000.0, 16.0 if quick else 60.0, folder, "evaluate"),
        "frames_10khz": lambda: steady("frames", 10_000.0, 8.0 if quick else 60.0, folder),
        "judging": lambda: judging("", 100 if quick else 400),
        "judging_alarmed": lambda: judging("&hide=second-order=20sigma", 48 if quick else 100),
        "memory": lambda: answer(child("gorge", millions, folder / "memory.mcap")),
        "random_bytes": lambda: answer(child("random_bytes", (10 if quick else 100) << 20, folder / "noise.mcap")),
        "kills": lambda: kills(3 if quick else 30, folder),
        "faults_frames": lambda: faults(100 if quick else 1000, "frames", folder),
        "faults_json": lambda: faults(100 if quick else 1000, "json", folder),
    }


CHILDREN: dict[str, Callable[[str, Path], dict[str, Any]]] = {
    "acquire": acquire,
    "evaluate": evaluate,
    "gorge": lambda count, out: gorge(int(count), out),
    "random_bytes": lambda size, out: random_bytes(int(size), out),
}


def main() -> None:
    if sys.argv[1:2] == ["--child"]:
        print(json.dumps(CHILDREN[sys.argv[2]](sys.argv[3], Path(sys.argv[4]))), flush=True)
        return
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--only", action="append", default=[], help="name of a measurement; repeatable")
    parser.add_argument("--json", action="store_true")
    chosen = parser.parse_args()
    figures: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, measure in measurements(chosen.quick, Path(folder)).items():
            if chosen.only and name not in chosen.only:
                continue
            figures[name] = measure()
            if not chosen.json:
                print(f"{name:14}", "  ".join(f"{key} {value}" for key, value in figures[name].items()), flush=True)
    if chosen.json:
        print(json.dumps(figures))


if __name__ == "__main__":
    main()
