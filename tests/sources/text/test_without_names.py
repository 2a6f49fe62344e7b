"""Files that name no column, or each cell, and tables that hold of each axis its own reading alone."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

G = 9.80665
DIRECTIONS = np.array([(0, 0, 1), (0, 0, -1), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0.6, 0.8, 0),
                       (-0.6, 0.8, 0), (0, 0.6, 0.8), (0, 0.6, -0.8), (0.8, 0, 0.6), (0.8, 0, -0.6)])  # fmt: skip
FACES = ("+Z", "-Z", "+X", "-X", "+Y", "-Y")
K, BIAS = np.array([1.01, 0.99, 1.005]), np.array([0.02, -0.015, 0.03])


def found(run: Any, path: Path, *options: Any) -> dict[str, float]:
    """The parameters by the command that ``info`` proposes."""
    command = run.proposed(path, "--gravity", G, *options)[1]
    return {symbol: each["value"] for symbol, each in run.parameters(*command).items()}


def check(parameters: dict[str, float]) -> None:
    assert [parameters[f"K{k}"] for k in (1, 2, 3)] == pytest.approx(K.tolist(), abs=1e-3)
    assert [parameters[f"b{k}"] for k in (1, 2, 3)] == pytest.approx((G * BIAS).tolist(), abs=0.01)


@pytest.mark.parametrize("between", [" ", "\t", ",", ";"])
def test_a_bare_matrix_is_a_table_of_poses(between: str, run: Any, tmp_path: Path) -> None:
    path = tmp_path / "bare.txt"
    rng = np.random.default_rng(1)
    rows = DIRECTIONS * K + BIAS + rng.normal(0, 1e-5, DIRECTIONS.shape)
    path.write_text("\n".join(between.join(f"{cell:.6f}" for cell in row) for row in rows))
    check(found(run, path, "--scatter-sigma", 0.001))


@pytest.mark.parametrize("beside", [0, 3])
def test_a_bare_log_is_told_by_its_numbers(beside: int, run: Any, tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    forces = np.repeat(G * (DIRECTIONS * K + BIAS), 200, axis=0)
    forces += rng.normal(0, 1e-3, forces.shape)
    rows = np.column_stack([0.02 * np.arange(len(forces)), forces, rng.normal(0, 0.01, (len(forces), beside))])
    path = tmp_path / "bare.csv"
    path.write_text("\n".join(",".join(f"{cell:.6f}" for cell in row) for row in rows))
    check(found(run, path))
    _, out, err = run("replay", path, "--gravity", G, "--no-angles")
    assert "columns without names are told by their numbers" in out + err


def test_labelled_lines_of_a_serial_port_are_a_table_with_their_faces(run: Any, tmp_path: Path) -> None:
    path = tmp_path / "serial.txt"
    rows = G * (DIRECTIONS[:6] * K + BIAS)
    path.write_text("".join(f"{face}:\nAcceleration X: {x:.4f}, Y: {y:.4f}, Z: {z:.4f} m/s^2\n"
                            for face, (x, y, z) in zip(FACES, rows, strict=True)))  # fmt: skip
    check(found(run, path))


@pytest.mark.parametrize("between", ["; ", " ", "\t", " | "])
def test_labelled_lines_are_a_log_with_a_rate(between: str, run: Any, tmp_path: Path) -> None:
    """Lines of something else among them are passed over, as of the gyroscope and the thermometer."""
    rng = np.random.default_rng(2)
    forces = np.repeat(DIRECTIONS * K + BIAS, 200, axis=0)
    forces += rng.normal(0, 1e-4, forces.shape)
    path = tmp_path / "serial.log.csv"
    other = between.join(["Rotation X: 0.03", "Y: -0.01", "Z: 0.00 rad/s"]) + "\nTemperature: 25.3 degC\n\n"
    rows = (between.join([f"aX = {x:.6f} g", f"aY = {y:.6f} g", f"aZ = {z:.6f} g"]) for x, y, z in forces)
    path.write_text("".join(f"{row}\n{other}" for row in rows))
    check(found(run, path, "--rate", 50))


def test_a_copy_of_labelled_lines_keeps_its_labels(run: Any, tmp_path: Path) -> None:
    rows = G * (DIRECTIONS * K + BIAS)
    path, copy = tmp_path / "serial.txt", tmp_path / "copy.txt"
    path.write_text("".join(f"X: {x:.4f}, Y: {y:.4f}, Z: {z:.4f} m/s^2\n" for x, y, z in rows))
    saved = tmp_path / "cal.json"
    options = ("--gravity", G, "--no-angles", "--scatter-sigma", 0.001)
    assert run("replay", path, *options, "--save", saved)[0] == 0
    code, _, err = run("apply", saved, path, "-o", copy)
    assert code == 0, err
    lines = copy.read_text().splitlines()
    assert len(lines) == len(rows) and all(line.startswith("X: ") and line.endswith(" m/s^2") for line in lines)
    values = np.array([[float(part.split(":")[1].split()[0]) for part in line.split(",")] for line in lines])
    np.testing.assert_allclose(np.linalg.norm(values, axis=1), G, atol=0.01)


OWN = {
    "blank": "face,x,y,z\n+z,,,276\n+y,,258,\n-x,-250,,\n-y,,-259,\n+x,264,,\n-z,,,-230\n",
    "dashes": "face,x,y,z\n+z,-,-,276\n+y,-,258,-\n-x,-250,-,-\n-y,-,-259,-\n+x,264,-,-\n-z,-,-,-230\n",
    "extremes": "axis,+1g,-1g\nX,264,-250\nY,258,-259\nZ,276,-230\n",
}


@pytest.mark.parametrize("how", OWN)
def test_readings_of_own_axes_alone_have_no_freedom(how: str, run: Any, tmp_path: Path) -> None:
    path = tmp_path / "own.csv"
    path.write_text(OWN[how])
    err = run.refused("replay", path, "--gravity", G, "--accel-unit", "g", "--accel-scale", 1 / 256)
    assert "six numbers for six unknowns, K1 = 1.0039, K2 = 1.0098, K3 = 0.9883, and b1 = 7, b2 = -0.5, b3 = 23" in err
    assert "no degree of freedom" in err
