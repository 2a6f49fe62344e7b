"""Logs as other programs write them: with what stands beside the readings, without an option but gravity."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kf_calib.errors import CountsError, InputError
from kf_calib.estimation.calibration import calibrate
from kf_calib.sources.opening import FileKind, kind_of, opened
from kf_calib.sources.tables.opening import open_table
from kf_calib.sources.text.names import meanings_of

G = 9.80665
K, B = np.array([1.01, 0.99, 1.005]), np.array([0.2, -0.15, 0.3])
UP = np.array([*np.eye(3), *-np.eye(3), [0.6, 0.8, 0], [0, 0.6, -0.8], [-0.8, 0, 0.6], [0.6, -0.8, 0], [0, 0.6, 0.8],
               [0.8, 0, 0.6]])  # fmt: skip
GYRO, MAG, ATTITUDE = ["0.01", "-0.02", "0.005"], ["20.1", "-3.2", "44.0"], ["0", "0", "0", "1"]
STILL, TURNING = 300, 60


@cache
def readings() -> np.ndarray:
    rng, parts = np.random.default_rng(3), list[np.ndarray]()
    for up in UP:
        force = K * G * up / np.linalg.norm(up) + B
        parts += [force + rng.normal(0.0, 0.02, (STILL, 3)), force + rng.normal(0.0, 3.0, (TURNING, 3))]
    return np.concatenate(parts)


def written(
    path: Path, header: str, cells: Sequence[str], unit_mps2: float = 1.0, time: float = 1.0, digits: int = 5
) -> Path:
    """Write a log: cells of a row in which {t} is the time and {x} {y} {z} are the readings, in this unit."""
    lines = [header]
    for k, (x, y, z) in enumerate((readings() / unit_mps2).tolist()):
        at = 1_700_000_000 * time + 0.01 * time * k if time > 1.0 else 0.01 * k
        row, time_text = ",".join(cells), f"{at:.6f}" if time == 1.0 else str(round(at))
        xyz = [f"{value:.{digits}f}" for value in (x, y, z)]
        lines.append(row.format(t=time_text, x=xyz[0], y=xyz[1], z=xyz[2]))
    path.write_text("\n".join(lines) + "\n")
    return path


XYZ = ["{x}", "{y}", "{z}"]
LAYOUTS = {
    "Kalibr": ("timestamp,omega_x,omega_y,omega_z,alpha_x,alpha_y,alpha_z", ["{t}", *GYRO, *XYZ], 1.0, 1e9),
    "EuRoC": (
        "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
        "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]", ["{t}", *GYRO, *XYZ], 1.0, 1e9,
    ),
    "EuRoC without units": (
        "timestamp,w_RS_S_x,w_RS_S_y,w_RS_S_z,a_RS_S_x,a_RS_S_y,a_RS_S_z", ["{t}", *GYRO, *XYZ], 1.0, 1e9,
    ),
    "rostopic echo -p": (
        "%time,field.header.seq,field.header.stamp,field.orientation.x,field.orientation.y,field.orientation.z,"
        "field.orientation.w,field.orientation_covariance0,field.angular_velocity.x,field.angular_velocity.y,"
        "field.angular_velocity.z,field.linear_acceleration.x,field.linear_acceleration.y,"
        "field.linear_acceleration.z,field.linear_acceleration_covariance0,field.linear_acceleration_covariance1",
        ["{t}", "7", "{t}", *ATTITUDE, "-1.0", *GYRO, *XYZ, "0.0", "0.1"], 1.0, 1e9,
    ),
    "bagpy": (
        "Time,header.seq,orientation.x,orientation.y,orientation.z,orientation.w,angular_velocity.x,angular_velocity.y,"
        "angular_velocity.z,linear_acceleration.x,linear_acceleration.y,linear_acceleration.z",
        ["{t}", "7", *ATTITUDE, *GYRO, *XYZ], 1.0, 1.0,
    ),
    "nine axes": ("time_s,ax,ay,az,gx,gy,gz,mx,my,mz", ["{t}", *XYZ, *GYRO, *MAG], 1.0, 1.0),
    "MPU-6050": ("millis,AcX,AcY,AcZ,Tmp,GyX,GyY,GyZ", ["{t}", *XYZ, "25.3", *GYRO], G, 1e3),
    "true beside": ("time_s,x_true (g),y_true (g),z_true (g),x_mean (g),y_mean (g),z_mean (g)",
                    ["{t}", "0", "0", "1", *XYZ], G, 1.0),
    "two stamps": ("time_arrival,time_device,ax (g),ay (g),az (g)", ["5", "{t}", *XYZ], G, 1.0),
}  # fmt: skip


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_log_is_read_without_an_option(layout: str, tmp_path: Path) -> None:
    path = written(tmp_path / "log.csv", *LAYOUTS[layout])
    assert kind_of(path) is FileKind.SAMPLES
    result = calibrate(opened(path, {"gravity_mps2": str(G)}, angles=False))
    found = result.parameters
    assert [found[f"K{i}"].value for i in (1, 2, 3)] == pytest.approx(K, abs=5e-4)
    assert [found[f"b{i}"].value for i in (1, 2, 3)] == pytest.approx(B, abs=5e-3)


@pytest.mark.parametrize(
    ("header", "cells", "unit_mps2", "option"),
    [("#time,accel_x,accel_y,accel_z", ["{t}", *XYZ], 1e-3, "--accel-scale 0.001"),
     ("loopIteration, time (us), gyroADC[0], gyroADC[1], gyroADC[2], accSmooth[0], accSmooth[1], accSmooth[2]",
      ["0", "{t}", *GYRO, *XYZ], G / 2048, f"--accel-unit g --accel-scale {1 / 2048}")],
)  # fmt: skip
def test_the_usual_size_of_a_count_is_told_and_right(
    header: str, cells: list[str], unit_mps2: float, option: str, tmp_path: Path
) -> None:
    path = written(tmp_path / "log.csv", header, cells, unit_mps2, 1e6 if "us" in header else 1.0, digits=0)
    keys = {"gravity_mps2": str(G)}
    with pytest.raises(CountsError, match=option) as told:
        opened(path, keys, angles=False).bench  # noqa: B018
    found = calibrate(opened(path, keys | told.value.keys, angles=False)).parameters
    assert [found[f"K{i}"].value for i in (1, 2, 3)] == pytest.approx(K, abs=5e-4)


@pytest.mark.parametrize(
    ("header", "ours"),
    [("q0,q1,q2,q3", "qw qx qy qz"), ("Quat_q0,Quat_q1,Quat_q2,Quat_q3", "qw qx qy qz"),
     ("QuatW,QuatX,QuatY,QuatZ", "qw qx qy qz"), ("s_ax,s_ay,w_RS_S_x", "sx sy "),
     ("orientation.x,orientation.y,orientation.z,orientation.w", "   "),
     ("q1,q2,q3", "angle angle angle"), ("a_x,a_y,a_z,s_x,s_y,s_z", "ax ay az sx sy sz"),
     ("ax,ay,az,mx,my,mz", "ax ay az   "), ("m1,m2,m3", "ax ay az"),
     ("accSmooth[0],accSmooth[1],accSmooth[2],debug[0]", "ax ay az ")],
)  # fmt: skip
def test_names_are_understood_together(header: str, ours: str) -> None:
    assert " ".join(own.ours for own in meanings_of(header.split(","), {})) == ours


def two_units(path: Path) -> Path:
    """Rows of two sensors in turns, told apart by a column; the second has another bias."""
    lines = ["time_s,unit,ax (g),ay (g),az (g)"]
    for k, (x, y, z) in enumerate((readings() / G).tolist()):
        lines += [
            f"{0.01 * k:.4f},0,{x:.5f},{y:.5f},{z:.5f}",
            f"{0.01 * k + 0.003:.4f},b,{x + 0.1:.5f},{y:.5f},{z:.5f}",
        ]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_one_of_several_sensors_is_chosen(tmp_path: Path, run: Any) -> None:
    path = two_units(tmp_path / "two.csv")
    code, _, err = run("replay", path, "--no-angles", "--gravity", G)
    assert code == 2 and "told apart by the column 'unit' (0, b): choose one, for example by --where 'unit=0'" in err
    for unit, bias in (("0", B[0]), ("b", B[0] + 0.1 * G)):
        code, out, err = run("replay", path, "--no-angles", "--gravity", G, "--where", f"unit={unit}", "--json")
        assert code == 0, err
        found = {each["symbol"]: each["value"] for each in json.loads(out)["parameters"]}
        assert found["K1"] == pytest.approx(K[0], abs=5e-4) and found["b1"] == pytest.approx(bias, abs=5e-3)
    code, _, err = run("replay", path, "--no-angles", "--gravity", G, "--where", "unit")
    assert code == 2 and "write --where COLUMN=VALUE" in err


def test_rows_of_a_table_are_chosen(tmp_path: Path) -> None:
    path, rows = tmp_path / "poses.csv", ["unit,ax (g),ay (g),az (g)"]
    for x, y, z in (K * UP + B / G).tolist():
        rows += [f"7,{x},{y},{z}", f"8,{x + 1},{y},{z}"]
    path.write_text("\n".join(rows))
    table = open_table(path, {"gravity_mps2": str(G)}, where="unit=7", angles=False)
    np.testing.assert_allclose(table.orientations.mean_mps2, G * (K * UP) + B, rtol=1e-9)
    with pytest.raises(InputError, match="no row has '9' in column"):
        open_table(path, {"gravity_mps2": str(G)}, where="unit=9", angles=False)
