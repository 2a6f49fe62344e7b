"""Time and memory of a diagnosis against the number of dwells, each a process of its own as a user has it.

usage: .venv/bin/python tools/bench_dwells.py [--dwells 24,96,384] [--runs 3] [--json]

The recordings are simulated: 5 s an orientation, a hidden second-order effect of 15 sigma, one of them without stated
noise and with an effect that is in no catalogue. ``improve`` is of the smallest. Times are the least of several runs,
beside that of decoding the same file; the growth exponent is that of seconds against dwells, from one size to the next.
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
from dataclasses import dataclass
from pathlib import Path

_ENVIRONMENT = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
RUN = ("--dwell-s", "5", "--sample-hz", "20", "--angle-hz", "5")


@dataclass(frozen=True)
class Cost:
    """Wall time, s, and largest resident memory, MB, of one process."""

    seconds: float
    peak_mb: float


def recording(folder: Path, dwells: int, *options: str) -> Path:
    path = folder / f"{dwells}{'_'.join(options[:1])}.mcap"
    command = ["simulate", str(path), "--orientations", str(dwells), *RUN, "--seed", str(dwells), *options]
    subprocess.run([sys.executable, "-m", "kf_calib.cli", *command], check=True, stdout=subprocess.DEVNULL)
    return path


def cost(command: list[str], runs: int) -> Cost:
    """The least of several runs."""
    found = list[Cost]()
    for _ in range(runs):
        begin = time.perf_counter()
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, env=_ENVIRONMENT)
        _, status, used = os.wait4(process.pid, 0)
        if status:
            raise SystemExit(f"{' '.join(command)} ended with {status}")
        found.append(Cost(time.perf_counter() - begin, used.ru_maxrss / (1e6 if sys.platform == "darwin" else 1024)))
    return min(found, key=lambda each: each.seconds)


def told(command: str, path: Path, runs: int) -> Cost:
    return cost([sys.executable, "-m", "kf_calib.cli", command, str(path), "--json"], runs)


def decoding_s(path: Path) -> float:
    """Of decoding alone, without the start of a process."""
    from kf_calib.sources.files.recording import Recording

    times = list[float]()
    for _ in range(3):
        begin = time.perf_counter()
        for _ in Recording(path):
            pass
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


def after_reading_s(path: Path) -> float:
    """What follows the reading of a recording: the fit, the filter, its judgement."""
    from kf_calib.estimation.calibration import evaluate
    from kf_calib.estimation.dwell_pass import Pass
    from kf_calib.estimation.settings import Settings
    from kf_calib.sources.files.recording import Recording

    passed = Pass(Recording(path), Settings())
    dwells = passed.fold()
    begin = time.perf_counter()
    evaluate(dwells, passed.source.bench, passed.settings)
    return time.perf_counter() - begin


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--dwells", default="24,96,384")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--json", action="store_true")
    chosen = parser.parse_args()
    sizes, figures = [int(each) for each in chosen.dwells.split(",")], dict[str, float]()
    with tempfile.TemporaryDirectory() as name:
        folder, last = Path(name), 0.0
        for k, dwells in enumerate(sizes):
            path = recording(folder, dwells, "--hide", "second-order=15sigma")
            own, decoded = told("diagnose", path, chosen.runs), decoding_s(path)
            figures[f"diagnose_{dwells}_s"], figures[f"diagnose_{dwells}_peak_mb"] = own.seconds, own.peak_mb
            figures[f"diagnose_{dwells}_over_decode"] = own.seconds / decoded
            if k:
                figures[f"growth_exponent_to_{dwells}"] = math.log(own.seconds / last) / math.log(dwells / sizes[k - 1])
            else:
                figures[f"improve_{dwells}_over_diagnose"] = told("improve", path, chosen.runs).seconds / own.seconds
            last = own.seconds
        unknown = recording(folder, sizes[0], "--unstated", "--hide", "random-unknown=15sigma")
        figures[f"diagnose_unknown_unstated_{sizes[0]}_s"] = told("diagnose", unknown, chosen.runs).seconds
        thousand = recording(folder, 1000, "--hide", "second-order=15sigma")
        figures["after_reading_1000_s"] = after_reading_s(thousand)
        figures["replay_1000_s"] = told("replay", thousand, chosen.runs).seconds
    if chosen.json:
        print(json.dumps(figures))
        return
    for key, value in figures.items():
        print(f"{key:36} {value:10.4g}")


if __name__ == "__main__":
    main()
