#!/usr/bin/env python3
"""kf_calib beside other programs that can do the same job or a part of it: time, memory, parameters, intervals.

usage: .venv/bin/python tools/bench_peers.py [--readings N] [--rounds N] [--runs N] [--peers-python PYTHON]
                                             [--real FILE --gravity M/S2] [--json]

Prints tables in Markdown, for docs/software.md, of
1. one recording of N readings in 24 poses, whose truth is known: processor time and peak memory of a process of its own
   for each program, all in turn, several rounds, and how far its parameters are from the truth and from kf_calib's;
2. many short runs, on a bench whose angles are exact and on one with setting errors: how often the intervals of 95 %
   hold the truth, and the error of scale factors and biases;
3. with --real, a recording of a real sensor without angles.

The truth is made here, by rotations of scipy, and shares nothing with kf_calib. Programs that are not installed are
left out, with the reason and the command that installs them; PYTHON is an interpreter that has those which this one
lacks. kf_calib and the textbook way read an MCAP file; all others get arrays, and so are spared the reading of it.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from bench import peak_rss_mb
from numpy.typing import NDArray

if TYPE_CHECKING:
    from kf_calib import Calibration

Floats = NDArray[np.float64]

POSES = 24
FACES_RAD = np.pi / 2 * np.array([[0, 1, 0], [0, -1, 0], [0, 0, 0], [0, 0, 2], [0, 0, -1], [0, 0, 1]])
"""Gimbal angles with +x, -x, +y, -y, +z and -z up: the first six poses of each run."""
GRAVITY = 9.81
SETTING_DEG = 0.05
NOISE = 1e-3  # m/s^2, of a reading
SHORT = 100  # readings a pose, of a short run
RATE_HZ, ANGLES_HZ = 1000, 100
SCALES, BIASES = ("K1", "K2", "K3"), ("b1", "b2", "b3")
AXES = [f"s{i}{k}" for i in "123" for k in "xyz"]
NORMAL = 1.96


@dataclass(frozen=True)
class Run:
    """gimbal_rad (p, 3) as stated; readings (p, n, 3), m/s^2; sensitivity: rows K E of the truth; setting_deg: size of
    the setting errors."""

    gimbal_rad: Floats
    readings: Floats
    sensitivity: Floats
    bias: Floats
    setting_deg: float

    @property
    def truth(self) -> dict[str, float]:
        return named(self.sensitivity, self.bias)

    @property
    def force(self) -> Floats:
        """Specific force in the platform at the stated angles (p, 3)."""
        return force_at(self.gimbal_rad)


@dataclass(frozen=True)
class Estimate:
    """values: of named parameters. sigmas: their standard deviations; halves: half the lengths of the intervals of
    95 %; both empty where a program states none."""

    values: dict[str, float]
    sigmas: dict[str, float]
    halves: dict[str, float]


@dataclass(frozen=True)
class Peer:
    """modules: what has to be there; packages: what pip installs. gets: what of a run. fit_file: from an MCAP file,
    of a program that reads one."""

    name: str
    modules: tuple[str, ...]
    packages: tuple[str, ...]
    gets: str
    fit: Callable[[Run], Estimate]
    fit_file: Callable[[Path], Estimate] | None = None


def force_at(gimbal_rad: Floats) -> Floats:
    """On a bench with axes y z x, whose outer axis is vertical."""
    from scipy.spatial.transform import Rotation  # here: others do not pay for it

    return Rotation.from_euler("YZX", gimbal_rad).inv().apply([0.0, GRAVITY, 0.0])


def simulated(random: np.random.Generator, readings: int, setting_deg: float) -> Run:
    """24 poses, of which six are faces, each turned off by a rotation of its own."""
    from scipy.spatial.transform import Rotation

    sensitivity = np.eye(3) * (1 + 1e-3 * random.normal(size=3)) + 3e-3 * random.normal(size=(3, 3))
    bias = random.normal(size=3) * 0.02
    gimbal = random.uniform(-np.pi, np.pi, (POSES, 3))
    gimbal[:, 1] = np.arcsin(random.uniform(-1, 1, POSES))
    gimbal[: len(FACES_RAD)] = FACES_RAD
    errors = Rotation.from_rotvec(np.radians(setting_deg) * random.normal(size=(POSES, 3)))
    force = errors.inv().apply(force_at(gimbal))
    noise = NOISE * random.normal(size=(POSES, readings, 3))
    return Run(gimbal, (force @ sensitivity.T + bias)[:, None] + noise, sensitivity, bias, setting_deg)


def named(sensitivity: Floats, bias: Floats) -> dict[str, float]:
    scale = np.linalg.norm(sensitivity, axis=1)
    names = (*SCALES, *BIASES, *AXES)
    return dict(zip(names, map(float, (*scale, *bias, *sensitivity.ravel())), strict=True))


def of_rows(states: Floats, covariance: Floats) -> Estimate:
    """From a row of sensitivity and a bias of each accelerometer (3, 4), and the covariance of each row (3, 4, 4)."""
    sensitivity = states[:, :3]
    axes = sensitivity / np.linalg.norm(sensitivity, axis=1)[:, None]
    scale = np.sqrt(np.einsum("ij,ijk,ik->i", axes, covariance[:, :3, :3], axes))
    sigmas = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    of_names = dict(
        zip((*SCALES, *BIASES, *AXES), map(float, (*scale, *sigmas[:, 3], *sigmas[:, :3].ravel())), strict=True)
    )
    return Estimate(
        named(sensitivity, states[:, 3]), of_names, {name: NORMAL * sigma for name, sigma in of_names.items()}
    )


def by_kf_calib(run: Run) -> Estimate:
    """From a table of mean readings."""
    import kf_calib

    return of_calibration(kf_calib.calibrate(kf_calib.open_table(*table_of(run))))


def file_by_kf_calib(file: Path) -> Estimate:
    import kf_calib

    return of_calibration(kf_calib.calibrate(file))


def of_calibration(result: Calibration) -> Estimate:
    blocks = result.estimate.covariance[:12, :12].reshape(3, 4, 3, 4)
    estimate = of_rows(result.estimate.state[:12].reshape(3, 4), np.array([blocks[i, :, i] for i in range(3)]))
    parameters = [result.parameters[name] for name in (*SCALES, *BIASES)]
    halves = {each.symbol: (result.interval(each)[1] or 0.0) - (each.value or 0.0) for each in parameters}
    return Estimate(estimate.values, estimate.sigmas, estimate.halves | halves)


def table_of(run: Run) -> tuple[dict[str, Any], dict[str, Any]]:
    """The means of a run and the bench, as ``kf_calib.open_table`` has them."""
    degrees = zip(("outer_deg", "middle_deg", "inner_deg"), np.degrees(run.gimbal_rad).T, strict=True)
    means = zip(("ax_mps2", "ay_mps2", "az_mps2"), run.readings.mean(axis=1).T, strict=True)
    count = np.full(POSES, run.readings.shape[1])
    columns = {**dict(degrees), **dict(means), "sd_mps2": np.full(POSES, NOISE), "count": count}
    return columns, {"axes": "y z x", "gravity_mps2": GRAVITY, "angle_sigma_deg": run.setting_deg}


def textbook(rows: Iterable[tuple[Floats, Floats]]) -> Estimate:
    """From force and reading, one by one: updates of filterpy's filter of twelve states; the noise is the truth's."""
    from filterpy.kalman import KalmanFilter

    kf = KalmanFilter(dim_x=12, dim_z=3)
    kf.x, kf.P, kf.R = np.zeros(12), np.eye(12), np.eye(3) * NOISE**2
    for force, reading in rows:
        observation = np.zeros((3, 12))
        for i in range(3):
            observation[i, 4 * i : 4 * i + 3], observation[i, 4 * i + 3] = force, 1.0
        kf.H = observation
        kf.update(reading)
    blocks = kf.P.reshape(3, 4, 3, 4)
    return of_rows(kf.x.reshape(3, 4), np.array([blocks[i, :, i] for i in range(3)]))


def of_arrays(run: Run) -> Iterator[tuple[Floats, Floats]]:
    for force, readings in zip(run.force, run.readings, strict=True):
        for reading in readings:
            yield force, reading


def of_messages(file: Path) -> Iterator[tuple[Floats, Floats]]:
    """Force and reading of each message while the platform stands: between two messages with equal angles."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    angles, force, waiting = np.full(3, np.nan), np.zeros(3), list[Floats]()
    with file.open("rb") as stream:
        for _, channel, _, message in make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            if channel.topic == "/accelerometer":
                reading = message.linear_acceleration
                waiting.append(np.array([reading.x, reading.y, reading.z]))
            elif channel.topic == "/platform/angles":
                stated = np.array(message.position)
                if np.array_equal(stated, angles):
                    yield from ((force, reading) for reading in waiting)
                else:
                    angles, force = stated, force_at(stated)
                waiting = []


def by_statsmodels(run: Run) -> Estimate:
    """Recursive least squares of each accelerometer; the noise is estimated."""
    from statsmodels.regression.recursive_ls import RecursiveLS

    count = run.readings.shape[1]
    rows = np.repeat(np.column_stack([run.force, np.ones(POSES)]), count, axis=0)
    fits = [RecursiveLS(run.readings[:, :, i].ravel(), rows).filter() for i in range(3)]
    return of_rows(np.array([fit.params for fit in fits]), np.array([fit.cov_params() for fit in fits]))


def by_simdkalman(run: Run) -> Estimate:
    """One update for each reading, of three filters of four states side by side, with the noise of the truth."""
    from simdkalman.primitives import update

    state, covariance, noise = np.zeros((3, 4, 1)), np.tile(np.eye(4), (3, 1, 1)), np.full((3, 1, 1), NOISE**2)
    for force, reading in of_arrays(run):
        observation = np.tile([*force, 1.0], (3, 1, 1))
        state, covariance = update(state, covariance, observation, noise, reading[:, None, None])
    return of_rows(state[:, :, 0], covariance)


def by_imucal(run: Run) -> Estimate:
    """Ferraris' calibration of the six faces; turns, for the gyroscopes, are made up."""
    from imucal import FerrarisCalibration, FerrarisSignalRegions

    regions = [f"{kind}_{axis}_{side}" for kind in ("acc", "gyr") for axis in "xyz" for side in "pa"]
    turns = [f"{kind}_{axis}_rot" for kind in ("acc", "gyr") for axis in "xyz"]
    still = np.zeros((2, 3))
    turned = dict(zip(turns, [still] * 3 + [np.tile(axis, (2, 1)) for axis in np.eye(3)], strict=True))
    signals = dict(zip(regions, [*run.readings[: len(FACES_RAD)], *[still] * 6], strict=True)) | turned
    found = FerrarisCalibration(grav=GRAVITY).compute(FerrarisSignalRegions(**signals), RATE_HZ, "m/s^2", "deg/s")
    return Estimate(named(found.K_a @ found.R_a, found.b_a), {}, {})


def by_size_of_force(run: Run) -> Estimate:
    """imu_tk's: the nine parameters with the least sum of (g^2 - |T^-1 (mean - b)|^2)^2, T lower triangular."""
    return Estimate(sphere(run.readings.mean(axis=1), GRAVITY), {}, {})


def sphere(means: Floats, gravity: float) -> dict[str, float]:
    from scipy.optimize import least_squares

    lower = np.tril_indices(3)

    def triangle(parameters: Floats) -> Floats:
        matrix = np.zeros((3, 3))
        matrix[lower] = parameters[:6]
        return matrix

    def misfit(parameters: Floats) -> Floats:
        force = np.linalg.solve(triangle(parameters), (means - parameters[6:]).T)
        return gravity**2 - (force**2).sum(axis=0)

    start = np.concatenate([np.eye(3)[lower], (means.max(0) + means.min(0)) / 2])
    fit = least_squares(misfit, start, xtol=1e-14, ftol=1e-14, x_scale=[1.0] * 6 + [0.1] * 3).x
    scale = np.linalg.norm(triangle(fit), axis=1)
    return dict(zip((*SCALES, *BIASES), map(float, (*scale, *fit[6:])), strict=True))


OURS = "kf_calib"
PEERS = {
    peer.name: peer
    for peer in (
        Peer(OURS, ("kf_calib",), ("kf_calib",), "the MCAP file", by_kf_calib, file_by_kf_calib),
        Peer(
            "mcap-ros2-support and filterpy", ("mcap_ros2", "filterpy"), ("mcap-ros2-support", "filterpy"),
            "the MCAP file", lambda run: textbook(of_arrays(run)), lambda file: textbook(of_messages(file)),
        ),
        Peer("simdkalman", ("simdkalman",), ("simdkalman",), "readings in an array", by_simdkalman),
        Peer("statsmodels, RecursiveLS", ("statsmodels",), ("statsmodels",), "readings in an array", by_statsmodels),
        Peer("imucal", ("imucal",), ("imucal",), "readings of six faces in an array", by_imucal),
        Peer("imu_tk's sum of squares, by scipy", ("scipy",), ("scipy",), "readings in an array", by_size_of_force),
    )
}  # fmt: skip


def save(runs: list[Run], path: Path) -> None:
    columns: dict[str, Any] = {
        name: np.array([getattr(run, name) for run in runs]) for name in Run.__dataclass_fields__
    }
    np.savez(path, **columns)


def loaded(path: Path) -> Iterator[Run]:
    with np.load(path) as columns:
        arrays = {name: columns[name] for name in Run.__dataclass_fields__}
    for k, setting_deg in enumerate(arrays.pop("setting_deg")):
        yield Run(**{name: values[k] for name, values in arrays.items()}, setting_deg=float(setting_deg))


def record(run: Run, path: Path) -> None:
    """The run as kf_calib records it, the platform turning for half a second before each pose but the first."""
    from kf_calib.bench.bench import Bench, axes_of
    from kf_calib.bench.streams import Batch, Stream
    from kf_calib.sources.files.recorder import Recorder

    step_ns, count = 10**9 // RATE_HZ, run.readings.shape[1]
    turn = np.arange(1, RATE_HZ // 2)[:, None] / (RATE_HZ // 2)
    begin_ns, every = 1_700_000_000 * 10**9, RATE_HZ // ANGLES_HZ
    with Recorder(path, Bench(axes_of("yzx"), GRAVITY, angle_sigma_deg=0.0), flush_s=5.0) as recorder:
        for k, pose in enumerate(run.gimbal_rad):
            before = run.gimbal_rad[max(k - 1, 0)]
            moving = before + turn[: len(turn) * min(k, 1)] * (pose - before)
            gimbal = np.concatenate([moving, np.tile(pose, (count, 1))])
            readings = np.concatenate([force_at(moving) @ run.sensitivity.T + run.bias, run.readings[k]])
            times = begin_ns + step_ns * np.arange(len(gimbal))
            recorder.write(Batch(Stream(times, readings), Stream(times[::every], gimbal[::every])))
            begin_ns = int(times[-1]) + step_ns


def child(name: str, data: Path) -> None:
    """Prints what a program finds in a file or in each of the runs that were saved."""
    peer = PEERS[name]
    if data.suffix == ".mcap":
        assert peer.fit_file is not None
        estimates = [peer.fit_file(data)]
    else:
        estimates = [peer.fit(run) for run in loaded(data)]
    print(json.dumps([peak_rss_mb(), *map(asdict, estimates)]))


@dataclass(frozen=True)
class Process:
    """Processor time and peak memory of a whole process, and what it found."""

    processor_s: float
    peak_mb: float
    estimates: list[Estimate]


def run_child(python: str, name: str, data: Path) -> Process:
    command = [python, str(Path(__file__).resolve()), "--peer", name, "--data", str(data)]
    environment = os.environ | dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    started = subprocess.Popen(command, stdout=subprocess.PIPE, env=environment)
    assert started.stdout is not None
    printed = started.stdout.read()
    _, status, used = os.wait4(started.pid, 0)
    started.returncode = os.waitstatus_to_exitcode(status)
    if started.returncode:
        raise SystemExit(f"{name} ended with {started.returncode}: {' '.join(command)}")
    peak_mb, *estimates = json.loads(printed)
    return Process(used.ru_utime + used.ru_stime, peak_mb, [Estimate(**each) for each in estimates])


def interpreters(peers_python: str | None) -> tuple[dict[str, tuple[str, str]], list[str]]:
    """The interpreter of each program that is installed and its versions; a sentence for each that is not."""
    usable, absent = dict[str, tuple[str, str]](), list[str]()
    for peer in PEERS.values():
        for python in (sys.executable, *([peers_python] if peers_python else [])):
            code = f"import {', '.join(peer.modules)}; from importlib.metadata import version; "
            code += f"print(*map(version, {peer.packages}))"
            asked = subprocess.run([python, "-c", code], capture_output=True, text=True)
            if asked.returncode == 0:
                usable[peer.name] = python, asked.stdout.strip().replace(" ", ", ")
                break
        else:
            absent.append(f"{peer.name} is left out: it is not installed (pip install {' '.join(peer.packages)}).")
    return usable, absent


def far(values: dict[str, float], others: dict[str, float], sigmas: dict[str, float]) -> float:
    """The largest difference of parameters that both have, in sigmas."""
    return max(abs(values[name] - others[name]) / sigmas[name] for name in values if name in others)


def compare_long(usable: dict[str, tuple[str, str]], readings: int, rounds: int, folder: Path) -> list[dict[str, Any]]:
    run = simulated(np.random.default_rng(2026), readings // POSES, 0.0)
    data, file = folder / "long.npz", folder / "long.mcap"
    save([run], data)
    record(run, file)
    processes: dict[str, list[Process]] = {name: [] for name in usable}
    for _ in range(rounds):
        for name, (python, _) in usable.items():
            processes[name].append(run_child(python, name, data if PEERS[name].fit_file is None else file))
    ours = processes[OURS]
    rows = list[dict[str, Any]]()
    for name, of_rounds in processes.items():
        values, mine = of_rounds[0].estimates[0].values, ours[0].estimates[0]
        ratios = [one.processor_s / other.processor_s for one, other in zip(of_rounds, ours, strict=True)]
        rows.append({
            "name": name, "version": usable[name][1], "gets": PEERS[name].gets,
            "processor_s": statistics.median(one.processor_s for one in of_rounds),
            "times_ours": statistics.median(ratios), "peak_mb": statistics.median(one.peak_mb for one in of_rounds),
            "parameters": 12 if AXES[0] in values else 6,
            "from_truth_sigma": far(values, run.truth, mine.sigmas),
            "from_ours_sigma": far(values, mine.values, mine.sigmas),
            "intervals": bool(of_rounds[0].estimates[0].halves),
        })  # fmt: skip
    return rows


def compare_short(
    usable: dict[str, tuple[str, str]], runs: int, setting_deg: float, folder: Path
) -> list[dict[str, Any]]:
    random, data = np.random.default_rng(7), folder / "short.npz"
    truths = [simulated(random, SHORT, setting_deg) for _ in range(runs)]
    save(truths, data)
    rows = list[dict[str, Any]]()
    for name, (python, _) in usable.items():
        process = run_child(python, name, data)
        pairs = list(zip(process.estimates, truths, strict=True))
        errors = np.array([[one.values[p] - run.truth[p] for p in (*SCALES, *BIASES)] for one, run in pairs])
        held = [
            abs(one.values[p] - run.truth[p]) < one.halves[p]
            for one, run in pairs
            for p in (*SCALES, *BIASES)
            if one.halves
        ]
        rows.append({
            "name": name, "held": float(np.mean(held)) if held else None, "ms_a_run": 1e3 * process.processor_s / runs,
            "scale_ppm": 1e6 * float(np.sqrt(np.mean(errors[:, :3] ** 2))),
            "bias_ug": 1e6 / GRAVITY * float(np.sqrt(np.mean(errors[:, 3:] ** 2))),
        })  # fmt: skip
    return rows


def compare_real(path: Path, gravity: float) -> str:
    import kf_calib

    opened = kf_calib.open_recording if path.suffix == ".mcap" else kf_calib.open_log
    run = kf_calib.calibrate(opened(path, {"gravity_mps2": gravity}, angles=False))
    means = np.array([visit.dwell.means[-3:] for visit in run.visits])
    others = sphere(means, gravity)
    lines = (
        f"| {name} | {run.parameters[name].value:.6f} ± {run.parameters[name].sigma:.6f} | {others[name]:.6f} |"
        for name in (*SCALES, *BIASES)
    )
    return markdown(
        f"{path.name}, {len(means)} poses, g = {gravity} m/s²", "parameter|kf_calib|imu_tk's sum, by scipy", lines
    )


def markdown(caption: str, heads: str, lines: Iterable[str]) -> str:
    columns = heads.split("|")
    return "\n".join([f"\n{caption}:\n", f"| {' | '.join(columns)} |", "|---" * len(columns) + "|", *lines])


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("--readings", type=int, default=300_000)
    asked.add_argument("--rounds", type=int, default=3)
    asked.add_argument("--runs", type=int, default=100)
    asked.add_argument("--peers-python", metavar="PYTHON")
    asked.add_argument("--real", type=Path)
    asked.add_argument("--gravity", type=float, default=9.80665)
    asked.add_argument("--json", action="store_true")
    for hidden in ("--peer", "--data"):
        asked.add_argument(hidden, help=argparse.SUPPRESS)
    options = asked.parse_args()
    if options.peer:
        return child(options.peer, Path(options.data))
    usable, absent = interpreters(options.peers_python)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        long = compare_long(usable, options.readings, options.rounds, folder)
        short = {each: compare_short(usable, options.runs, each, folder) for each in (0.0, SETTING_DEG)}
    if options.json:
        return print(json.dumps({"long": long, "short": short, "absent": absent}))
    print(markdown(
        f"{options.readings} readings in {POSES} poses, exact angles; medians of {options.rounds} rounds",
        "program|version|reads|processor time, s|times ours|peak MB|parameters|furthest from the truth, σ|from ours, σ|"
        "intervals",
        (
            f"| {row['name']} | {row['version']} | {row['gets']} | {row['processor_s']:.2f} | "
            f"{row['times_ours']:.2g} | {row['peak_mb']:.0f} | {row['parameters']} | {row['from_truth_sigma']:.2g} | "
            f"{row['from_ours_sigma']:.2g} | {'yes' if row['intervals'] else 'no'} |"
            for row in long
        ),
    ))  # fmt: skip
    print(markdown(
        f"{options.runs} runs of {POSES} poses with {SHORT} readings each; first with exact angles, then with setting "
        f"errors of {SETTING_DEG}°",
        "program|rms error of K, ppm|of b, µg|intervals of 95 % that hold the truth|K, ppm|b, µg|intervals|ms a run",
        (
            "| " + " | ".join([
                exact["name"], *(f"{row[key]:.3g}" if key != "held" else share(row[key]) for row in (exact, setting)
                for key in ("scale_ppm", "bias_ug", "held")), f"{setting['ms_a_run']:.0f}",
            ]) + " |"
            for exact, setting in zip(*short.values(), strict=True)
        ),
    ))  # fmt: skip
    if options.real:
        print(compare_real(options.real, options.gravity))
    print("", *absent, sep="\n")


def share(of_runs: float | None) -> str:
    return "has none" if of_runs is None else f"{100 * of_runs:.1f} %"


if __name__ == "__main__":
    main()
