#!/usr/bin/env python3
"""Compares kf_calib with what others fit: on a real recording, and on simulated benches whose truth is known.

- sphere: nine parameters such that |f| = g in each pose, by scipy: what imu_tk minimises, and the calibrations in
  ArduPilot and PX4 that need no angles;
- exact angles: linear least squares in which each pose is exactly as stated, as six-face calibrations such as imucal
  have it.

The truth of the simulated benches is made here, by rotations of scipy: 24 poses, setting errors, white noise of means.

usage: tools/compare_methods.py [--runs N] [--real FILE.csv --gravity M/S2]
Prints tables in Markdown, for docs/software.md.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import kf_calib
from kf_calib.bench.arrays import Floats

POSES = 24
GRAVITY = 9.81
SETTING_DEG = 0.05
MEAN_NOISE = 1e-4  # m/s^2
READINGS = 100
SCALES, BIASES = ("K1", "K2", "K3"), ("b1", "b2", "b3")


@dataclass(frozen=True)
class Truth:
    """sensitivity: rows K E; scale: their lengths."""

    sensitivity: Floats
    bias: Floats

    @property
    def scale(self) -> Floats:
        return np.linalg.norm(self.sensitivity, axis=1)


@dataclass(frozen=True)
class Means:
    """gimbal_rad: as stated; readings: mean of each pose, m/s^2."""

    gimbal_rad: Floats
    readings: Floats


def simulated(random: np.random.Generator) -> tuple[Truth, Means]:
    """A bench with axes y z x, each pose off by a rotation of its own."""
    truth = Truth(
        np.eye(3) * (1 + 1e-3 * random.normal(size=3)) + 3e-3 * random.normal(size=(3, 3)), random.normal(size=3) * 0.02
    )
    gimbal = random.uniform(-np.pi, np.pi, (POSES, 3))
    gimbal[:, 1] = np.arcsin(random.uniform(-1, 1, POSES))
    platform = Rotation.from_euler("YZX", gimbal) * Rotation.from_rotvec(
        np.radians(SETTING_DEG) * random.normal(size=(POSES, 3))
    )
    force = platform.inv().apply([0.0, GRAVITY, 0.0])
    readings = force @ truth.sensitivity.T + truth.bias + MEAN_NOISE * random.normal(size=(POSES, 3))
    return truth, Means(gimbal, readings)


def sphere(readings: Floats, gravity: float) -> tuple[Floats, Floats]:
    """Scale factors and biases such that |T^-1 (reading - b)| = g, T lower triangular."""
    lower = np.tril_indices(3)

    def misfit(parameters: Floats) -> Floats:
        triangle = np.zeros((3, 3))
        triangle[lower] = parameters[:6]
        return np.linalg.norm(np.linalg.solve(triangle, (readings - parameters[6:]).T), axis=0) - gravity

    start = np.concatenate([np.eye(3)[lower], (readings.max(0) + readings.min(0)) / 2])
    fit = least_squares(misfit, start, xtol=1e-14, ftol=1e-14, x_scale=[1.0] * 6 + [0.1] * 3).x
    triangle = np.zeros((3, 3))
    triangle[lower] = fit[:6]
    return np.linalg.norm(triangle, axis=1), fit[6:]


def exact_angles(means: Means) -> tuple[Floats, Floats]:
    """Scale factors and biases by linear least squares in which the angles have no error."""
    force = Rotation.from_euler("YZX", means.gimbal_rad).inv().apply([0.0, GRAVITY, 0.0])
    rows = np.column_stack([force, np.ones(len(force))])
    solution = np.linalg.lstsq(rows, means.readings, rcond=None)[0]
    return np.linalg.norm(solution[:3], axis=0), solution[3]


def by_kf_calib(means: Means) -> tuple[Floats, Floats, Floats, Floats]:
    """Scale factors, biases, and their sigmas, from a table of orientations."""
    outer, middle, inner = np.degrees(means.gimbal_rad).T
    ax, ay, az = means.readings.T
    sigma = np.full(POSES, MEAN_NOISE * np.sqrt(READINGS))
    columns = {
        "outer_deg": outer,
        "middle_deg": middle,
        "inner_deg": inner,
        "ax_mps2": ax,
        "ay_mps2": ay,
        "az_mps2": az,
        "sd_mps2": sigma,
    }
    bench = {"axes": "y z x", "gravity_mps2": str(GRAVITY), "angle_sigma_deg": str(SETTING_DEG)}
    parameters = kf_calib.calibrate(
        kf_calib.open_table(columns | {"count": np.full(POSES, READINGS)}, bench)
    ).parameters
    values, sigmas = (
        [np.array([getattr(parameters[name], what) for name in names]) for names in (SCALES, BIASES)]
        for what in ("value", "sigma")
    )
    return *values, *sigmas


def compare_simulated(runs: int) -> None:
    random = np.random.default_rng(2026)
    errors: dict[str, list[Floats]] = {"kf_calib": [], "sphere": [], "exact angles": []}
    inside, seconds = [], dict.fromkeys(errors, 0.0)
    for _ in range(runs):
        truth, means = simulated(random)
        began_s = time.process_time()
        scale, bias, scale_sigma, bias_sigma = by_kf_calib(means)
        seconds["kf_calib"] += time.process_time() - began_s
        error = np.concatenate([scale - truth.scale, bias - truth.bias])
        errors["kf_calib"].append(error)
        inside.append(np.abs(error) < 1.96 * np.concatenate([scale_sigma, bias_sigma]))
        for name, fit in (
            ("sphere", lambda m=means: sphere(m.readings, GRAVITY)),
            ("exact angles", lambda m=means: exact_angles(m)),
        ):
            began_s = time.process_time()
            errors[name].append(np.concatenate(fit()) - np.concatenate([truth.scale, truth.bias]))
            seconds[name] += time.process_time() - began_s
    print(
        f"{runs} simulated benches, {POSES} poses, setting error {SETTING_DEG} deg, noise of means {MEAN_NOISE} m/s²:\n"
    )
    print("| fit | rms error of K, ppm | of b, µg | 95 % intervals hold the truth | ms a run |\n|---|---|---|---|---|")
    for name, of_runs in errors.items():
        rms = np.sqrt(np.mean(np.square(of_runs), axis=0))
        held = f"{100 * np.mean(inside):.1f} %" if name == "kf_calib" else "has none"
        k_ppm, b_ug = 1e6 * np.sqrt(np.mean(rms[:3] ** 2)), 1e6 / GRAVITY * np.sqrt(np.mean(rms[3:] ** 2))
        print(f"| {name} | {k_ppm:.2f} | {b_ug:.2f} | {held} | {1e3 * seconds[name] / runs:.0f} |")


def compare_real(path: Path, gravity: float) -> None:
    began_s = time.process_time()
    recording = kf_calib.open_recording if path.suffix == ".mcap" else kf_calib.open_log
    run = kf_calib.calibrate(recording(path, {"gravity_mps2": str(gravity)}, angles=False))
    seconds = time.process_time() - began_s
    readings = np.array([visit.dwell.means[-3:] for visit in run.visits])
    scale, bias = sphere(readings, gravity)
    print(f"\n{path.name}, {len(readings)} poses, g = {gravity} m/s², {seconds:.1f} s:\n")
    print("| parameter | kf_calib | sphere |\n|---|---|---|")
    for name, other in zip((*SCALES, *BIASES), (*scale, *bias), strict=True):
        ours = run.parameters[name]
        print(f"| {name} | {ours.value:.6f} ± {ours.sigma:.6f} | {other:.6f} |")


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("--runs", type=int, default=200)
    asked.add_argument("--real", type=Path)
    asked.add_argument("--gravity", type=float, default=9.80665)
    options = asked.parse_args()
    compare_simulated(options.runs)
    if options.real:
        compare_real(options.real, options.gravity)


if __name__ == "__main__":
    main()
