"""Speed and memory of a replay, against decoding alone, in one run.

usage: .venv/bin/python tools/bench.py [--samples 1000000] [--scan-memory] [--large] [--json]

Decoding is this package's reader, with nothing done with the samples. Each figure is the median of several runs, the
ways taken in turn; tools/bench_peers.py compares with other programs. ``--large`` adds the peak memory of a ten times
longer recording. Start-up is a whole process, ``kf-calib replay --json`` of four minutes at 100 Hz. A growth exponent:
of time in readings, those of one dwell; 1 is linear. The scan: decoding, folding, fitting the twelve, and projecting
70 further columns off them, those of all visible effects of the catalogue and of formulas.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np


def make_recording(path: Path, samples: int, rate_hz: float = 1000.0, dwells: int = 24) -> None:
    """A simulated run with angles at a tenth of the rate."""
    from kf_calib.bench.bench import Bench, axes_of
    from kf_calib.sources.files.recorder import Recorder
    from kf_calib.sources.simulation.sensors import GRADES
    from kf_calib.sources.simulation.simulator import Simulation
    from kf_calib.sources.simulation.visit_plans import spread_plan

    grade = GRADES["navigation"]
    bench = Bench(axes_of("yzx"), 9.81, angle_sigma_deg=0.0)
    plan = spread_plan(dwells, dwell_s=samples / rate_hz / dwells, seed=1)
    run = Simulation(
        bench, grade.sensors(1), grade.noise, plan,
        sample_hz=rate_hz, angle_hz=rate_hz / 10, slew_rate_degps=720.0, seed=1,
    )  # fmt: skip
    with Recorder(path, bench, flush_s=5.0) as recorder:
        for batch in run:
            recorder.write(batch)


def decode(path: Path) -> int:
    from kf_calib.sources.files.recording import Recording

    return sum(len(batch.accel) for batch in Recording(path))


def replay(path: Path) -> int:
    from kf_calib.estimation.calibration import calibrate
    from kf_calib.sources.files.recording import Recording

    return calibrate(Recording(path)).counts.read


def fold(path: Path) -> int:
    from kf_calib.estimation.dwell_pass import Pass
    from kf_calib.estimation.settings import Settings
    from kf_calib.sources.files.recording import Recording

    passed = Pass(Recording(path), Settings())
    passed.fold()
    return passed.counts.read


def candidates(dwells: Any, bench: Any, columns: int = 70) -> list[Any]:
    """Effects of the catalogue that have a column the twelve do not explain, and formulas up to so many columns."""
    from kf_calib.effects import effect_named, names

    effects = [effect_named(name, bench) for name in names(bench)]
    effects = [effect for effect in effects if effect.coefficients and scanned(dwells, bench, [effect])[0].dof]
    letters = [f"f{a}*f{b}*{more}" for more in ("T", "t", "fx", "fy") for a in "xyz" for b in "xyz" if a <= b]
    formulas = (effect_named(f"f{k:02} = {text}", bench) for k, text in enumerate(letters))
    while sum(len(effect.coefficients) for effect in effects) < columns:
        effects.append(next(formulas))
    return effects


def scanned(dwells: Any, bench: Any, effects: list[Any]) -> Sequence[Any]:
    from kf_calib.estimation.iterated_fit import fit
    from kf_calib.estimation.measurement_model import Model
    from kf_calib.estimation.score_test import scan

    fitted = fit(dwells, Model(bench))
    return scan(fitted.linearised, fitted.noise, effects).candidates


def fold_and_scan(path: Path) -> tuple[int, int]:
    """Readings, and columns beside the twelve."""
    from threadpoolctl import threadpool_limits

    from kf_calib.estimation.dwell_pass import Pass
    from kf_calib.estimation.settings import Settings
    from kf_calib.sources.files.recording import Recording

    passed = Pass(Recording(path), Settings())
    with threadpool_limits(1, user_api="blas"):
        dwells = passed.fold()
        if path not in _candidates:
            _candidates[path] = candidates(dwells, passed.source.bench)
        scanned(dwells, passed.source.bench, _candidates[path])
    return passed.counts.read, sum(len(effect.coefficients) for effect in _candidates[path])


_candidates: dict[Path, list[Any]] = {}


def seconds(run: Callable[[], int]) -> tuple[float, int]:
    begin = time.perf_counter()
    count = run()
    return time.perf_counter() - begin, count


def peak_rss_mb() -> float:
    """Largest resident memory of this process, MB. What rusage says on Linux begins with that of the parent."""
    if sys.platform == "linux":
        (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) / 1024
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def peak_mb(path: Path, way: str = "replay") -> float:
    """Largest resident memory of a process of its own that goes ``way`` (a function of this file), MB."""
    code = (
        f"import pathlib, sys; sys.path.insert(0, {str(Path(__file__).resolve().parent)!r}); import bench; "
        f"bench.{way}(pathlib.Path(sys.argv[1])); print(bench.peak_rss_mb())"
    )
    return float(
        subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True).stdout
    )


def import_s() -> float:
    """Wall time of importing the package in a fresh interpreter, less that of the interpreter."""

    def started(code: str) -> float:
        return statistics.median(
            seconds(lambda: subprocess.run([sys.executable, "-c", code], check=True).returncode)[0] for _ in range(7)
        )

    return started("import kf_calib") - started("pass")


def start_up_s(path: Path) -> float:
    """Wall time of ``kf-calib replay --json`` as a user has it: a process of its own, bytecode written before."""
    env = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    command = [sys.executable, "-m", "kf_calib.cli", "replay", str(path), "--json"]

    def run() -> int:
        return subprocess.run(command, env=env, stdout=subprocess.DEVNULL, check=True).returncode

    run()
    return statistics.median(seconds(run)[0] for _ in range(7))


def growth_exponent(recordings: Sequence[Path], runs: int) -> float:
    """Of the time to fold, from one of two recordings to the other."""
    short, long = recordings
    fold(short)
    times = [(seconds(lambda: fold(short))[0], seconds(lambda: fold(long))[0]) for _ in range(runs)]
    less, more = np.median(times, axis=0)
    return math.log(more / less) / math.log(fold(long) / fold(short))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--samples", type=int, default=1_000_000)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--scan-memory", action="store_true", help="peak memory of a scan of three times the readings")
    parser.add_argument("--large", action="store_true")
    parser.add_argument("--json", action="store_true")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        making_s, _ = seconds(lambda: make_recording(path, chosen.samples) or 0)
        short, single = Path(folder) / "short.mcap", [Path(folder) / f"one_dwell_{k}.mcap" for k in (1, 4)]
        make_recording(short, 24_000, rate_hz=100.0)
        for k, each in zip((1, 4), single, strict=True):
            make_recording(each, k * chosen.samples // 2, dwells=1)
        replay(path)  # imports and the disk cache are not what is compared
        _, columns = fold_and_scan(path)
        times: dict[str, list[float]] = {"decode": [], "replay": [], "scan": []}
        for _ in range(chosen.runs):
            times["decode"].append(seconds(lambda: decode(path))[0])
            wall_s, samples = seconds(lambda: replay(path))
            times["replay"].append(wall_s)
            times["scan"].append(seconds(lambda: fold_and_scan(path)[0])[0])
        median = {name: statistics.median(values) for name, values in times.items()}
        figures = {
            "samples": samples,
            "file_mb": path.stat().st_size / 1e6,
            "simulate_and_record_s": making_s,
            "decode_s": median["decode"],
            "replay_s": median["replay"],
            "replay_over_decode": statistics.median(np.divide(times["replay"], times["decode"]).tolist()),
            "scan_columns": 12 + columns,
            "scan_s": median["scan"],
            "scan_over_replay": statistics.median(np.divide(times["scan"], times["replay"]).tolist()),
            "import_s": import_s(),
            "start_up_s": start_up_s(short),
            "one_dwell_growth_exponent": growth_exponent(single, chosen.runs),
            "replay_peak_mb": peak_mb(path),
            "scan_peak_mb": peak_mb(path, "fold_and_scan"),
        }
        if chosen.scan_memory:
            longer = Path(folder) / "longer.mcap"
            make_recording(longer, 3 * chosen.samples)
            figures["scan_peak_mb_of_three_times"] = peak_mb(longer, "fold_and_scan")
        if chosen.large:
            long = Path(folder) / "long.mcap"
            make_recording(long, 10 * chosen.samples)
            figures["replay_peak_mb_of_ten_times"] = peak_mb(long)
    if chosen.json:
        print(json.dumps(figures))
        return
    for name, value in figures.items():
        print(f"{name:28} {value:12.4g}")


if __name__ == "__main__":
    main()
