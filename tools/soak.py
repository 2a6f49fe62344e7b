#!/usr/bin/env python3
"""A simulated week by a fast clock: does memory stay flat, and is nothing lost?

    tools/soak.py live FOLDER [--hours 168] [--sample-hz 100]   # one dwell an hour, recorded and judged meanwhile
    tools/soak.py fleet FOLDER [--runs 10000] [--workers 2]     # links to a few tiny recordings

Each runs the command line in a process of its own, and looks at the memory of this and of those that it starts. In the
end every reading that was simulated has to be in the recording, and every run in the table of the fleet.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from kf_calib.sources.files.recording import Recording

COMMAND = [sys.executable, "-m", "kf_calib.cli"]
ANGLE_HZ, TINY = 1.0, 20  # of the platform in a week; different recordings in a fleet


def memory_mb(process: int) -> float:
    """Memory of a process and of all that it has started, MB, in which what they share counts once; 0 where it has
    ended."""
    try:
        children = " ".join(path.read_text() for path in Path(f"/proc/{process}/task").glob("*/children")).split()
        taken = Path(f"/proc/{process}/smaps_rollup").read_text()
    except OSError:
        return 0.0
    kib = next((int(line.split()[1]) for line in taken.splitlines() if line.startswith("Pss:")), 0)
    return 1024 * kib / 1e6 + sum(memory_mb(int(child)) for child in children)


def live(folder: Path, hours: int, sample_hz: float) -> dict[str, Any]:
    """A bench that visits an orientation an hour."""
    recording, began_s = folder / "week.mcap", time.monotonic()
    query = f"sample_hz={sample_hz:g}&angle_hz={ANGLE_HZ:g}&dwell_s=3590&orientations={hours}&seed=7&speed=inf"
    words = ["live", f"sim://?{query}", "--record", str(recording), "--json"]
    process = subprocess.Popen([*COMMAND, *words], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    assert process.stdout is not None
    memory, last = dict[int, float](), dict[str, Any]()
    for line in process.stdout:
        last = json.loads(line)
        memory[last["dwells"]] = memory_mb(process.pid) or memory[max(memory)]
    simulated = round(last["elapsed_s"] * sample_hz) + 1
    recorded = sum(len(batch.accel) for batch in Recording(recording))
    at = {dwells: round(memory[dwells], 1) for dwells in sorted(memory) if dwells % 24 == 0 or dwells == max(memory)}
    return {
        "hours": hours, "sample_hz": sample_hz, "code": process.wait(), "seconds": round(time.monotonic() - began_s),
        "memory_mb_after_dwells": at, "most_mb": round(max(memory.values()), 1),
        "simulated": simulated, "evaluated": last["samples"], "recorded": recorded,
        "nothing_lost": simulated == last["samples"] == recorded, "bytes": recording.stat().st_size,
        "consistent": last["consistent"],
    }  # fmt: skip


def fleet(folder: Path, runs: int, workers: int) -> dict[str, Any]:
    """Many tiny runs: some recordings under many names."""
    source, campaign = folder / "tiny", folder / "campaign"
    source.mkdir(parents=True)
    campaign.mkdir()
    for k in range(TINY):
        words = ["simulate", str(source / f"{k}.mcap"), "--orientations", "12", "--dwell-s", "2", "--sample-hz", "20"]
        subprocess.run([*COMMAND, *words, "--seed", str(k)], check=True, stdout=subprocess.DEVNULL)
    for number in range(runs):
        os.link(source / f"{number % TINY}.mcap", campaign / f"run{number:05}.mcap")
    began_s, series = time.monotonic(), list[float]()
    words = ["fleet", str(campaign), "-o", str(folder / "table"), "--workers", str(workers), "--json"]
    process = subprocess.Popen([*COMMAND, *words], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    with watched(process.pid, series):
        printed, _ = process.communicate()
    said = json.loads(printed.splitlines()[-1]) if printed.strip() else {}
    tenth = max(len(series) // 10, 1)
    return {
        "runs": runs, "workers": workers, "code": process.returncode, "seconds": round(time.monotonic() - began_s),
        "memory_mb_by_tenths": [round(max(series[k : k + tenth]), 1) for k in range(0, len(series), tenth)],
        "rows": said.get("runs"), "failed": said.get("failed"),
        "nothing_lost": said.get("runs") == runs and said.get("failed") == 0,
    }  # fmt: skip


@contextmanager
def watched(process: int, series: list[float]) -> Iterator[None]:
    """Append the memory of a process to a list every second."""
    over = threading.Event()

    def watch() -> None:
        while not over.wait(1.0):
            series.append(memory_mb(process))

    watching = threading.Thread(target=watch, daemon=True)
    watching.start()
    yield
    over.set()
    watching.join()


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    week, many = commands.add_parser("live"), commands.add_parser("fleet")
    week.add_argument("--hours", type=int, default=168)
    week.add_argument("--sample-hz", type=float, default=100.0)
    many.add_argument("--runs", type=int, default=10_000)
    many.add_argument("--workers", type=int, default=2)
    for one in (week, many):
        one.add_argument("folder", type=Path)
    chosen = parser.parse_args()
    if chosen.folder.exists():
        parser.error(f"{chosen.folder} is there already: give the name of a new folder.")
    chosen.folder.mkdir(parents=True)
    if chosen.command == "live":
        print(json.dumps(live(chosen.folder, chosen.hours, chosen.sample_hz), indent=1))
    else:
        print(json.dumps(fleet(chosen.folder, chosen.runs, chosen.workers), indent=1))


if __name__ == "__main__":
    main()
