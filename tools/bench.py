"""Speed and memory of a replay, as ratios against named peers in one run.

usage: .venv/bin/python tools/bench.py [--samples 1000000] [--large] [--json]

Peers: decoding alone (this package's reader, nothing done with the samples), and the textbook way: the official mcap
reader with mcap-ros2-support's decoder and one update of filterpy's KalmanFilter a sample (timed on the first
``--peer-samples`` and scaled: it is linear). Each figure is the median of several runs, the ways taken in turn.
``--large`` adds the peak memory of a ten times longer recording.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np


def make_recording(path: Path, samples: int) -> None:
    """A simulated run of 24 dwells with angles at a tenth of the rate."""
    from kf_calib.bench import Bench, axes_of
    from kf_calib.sources.plans import spread_plan
    from kf_calib.sources.recorder import Recorder
    from kf_calib.sources.sensors import GRADES
    from kf_calib.sources.simulator import Simulation

    grade, rate_hz = GRADES["navigation"], 1000.0
    bench = Bench(axes_of("yzx"), 9.81, angle_sigma_deg=0.0)
    plan = spread_plan(24, dwell_s=samples / rate_hz / 24, seed=1)
    run = Simulation(
        bench, grade.sensors(1), grade.noise, plan,
        sample_hz=rate_hz, angle_hz=rate_hz / 10, slew_rate_degps=720.0, seed=1,
    )  # fmt: skip
    with Recorder(path, bench, flush_s=5.0) as recorder:
        for batch in run:
            recorder.write(batch)


def decode(path: Path) -> int:
    from kf_calib.sources.recording import Recording

    return sum(len(batch.accel) for batch in Recording(path))


def replay(path: Path) -> int:
    from kf_calib.calibration import calibrate
    from kf_calib.sources.recording import Recording

    return calibrate(Recording(path)).tally.read


def textbook(path: Path, samples: int) -> int:
    """Official reader and decoder, filterpy's update with the affine model; angles are taken as last decoded."""
    from filterpy.kalman import KalmanFilter
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    from kf_calib.bench import Bench, axes_of

    bench, force, done = Bench(axes_of("yzx"), 9.81), np.zeros(3), 0
    kf = KalmanFilter(dim_x=12, dim_z=3)
    kf.x, kf.P, kf.R = np.zeros(12), np.eye(12), np.eye(3) * 5e-5**2
    observation = np.zeros((3, 12))
    with path.open("rb") as file:
        for _, channel, _, message in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            if channel.topic == "/platform/angles":
                force = bench.specific_force(np.zeros(1), np.array([message.position]))[0]
            elif channel.topic == "/accelerometer":
                for i in range(3):
                    observation[i, 4 * i : 4 * i + 3], observation[i, 4 * i + 3] = force, 1.0
                kf.H = observation
                reading = message.linear_acceleration
                kf.update(np.array([reading.x, reading.y, reading.z]))
                done += 1
                if done == samples:
                    break
    return done


def seconds(run: Callable[[], int]) -> tuple[float, int]:
    begin = time.perf_counter()
    count = run()
    return time.perf_counter() - begin, count


def peak_mb(path: Path) -> float:
    """Largest resident memory of a process of its own that replays the recording, MB."""
    code = (
        "import resource, sys; from kf_calib.calibration import calibrate; "
        "from kf_calib.sources.recording import Recording; calibrate(Recording(sys.argv[1])); "
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1e6 if sys.platform == 'darwin' else 1024))"
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


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--samples", type=int, default=1_000_000)
    parser.add_argument("--peer-samples", type=int, default=30_000)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--large", action="store_true")
    parser.add_argument("--json", action="store_true")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        making_s, _ = seconds(lambda: make_recording(path, chosen.samples) or 0)
        replay(path)  # imports and the disk cache are not what is compared
        times: dict[str, list[float]] = {"decode": [], "replay": [], "textbook": []}
        for _ in range(chosen.runs):
            times["decode"].append(seconds(lambda: decode(path))[0])
            wall_s, samples = seconds(lambda: replay(path))
            times["replay"].append(wall_s)
            wall_s, done = seconds(lambda: textbook(path, chosen.peer_samples))
            times["textbook"].append(wall_s * samples / done)
        median = {name: statistics.median(values) for name, values in times.items()}
        figures = {
            "samples": samples,
            "file_mb": path.stat().st_size / 1e6,
            "simulate_and_record_s": making_s,
            "decode_s": median["decode"],
            "replay_s": median["replay"],
            "textbook_s_scaled": median["textbook"],
            "replay_over_decode": statistics.median(np.divide(times["replay"], times["decode"]).tolist()),
            "textbook_over_replay": statistics.median(np.divide(times["textbook"], times["replay"]).tolist()),
            "import_s": import_s(),
            "replay_peak_mb": peak_mb(path),
        }
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
