"""``info`` on logs and tables in any layout, unit and encoding: the command that it proposes works, and is right."""

import gzip
import itertools
import random
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

G = 9.80665
K, B = np.array([1.01, 0.99, 1.005]), np.array([0.2, -0.15, 0.3])
CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3))) / 3**0.5
EDGES = np.array([up for up in itertools.product((-1.0, 0.0, 1.0), repeat=3) if np.abs(up).sum() == 2]) / 2**0.5
UP = np.array([*np.eye(3), *-np.eye(3), *CORNERS, *EDGES])
STILL, TURNING = 250, 50


class Layout(NamedTuple):
    """Names of the columns; {} stands for the readings x y z, {t} for the time, other cells are written as they are."""

    names: str
    cells: str
    is_log: bool = True


LAYOUTS = {
    "plain": Layout("time_s;ax{u};ay{u};az{u}", "{t};{x};{y};{z}"),
    "EuRoC": Layout("#timestamp [ns];w_RS_S_x [rad s^-1];w_RS_S_y [rad s^-1];w_RS_S_z [rad s^-1];a_RS_S_x{u};"
                    "a_RS_S_y{u};a_RS_S_z{u}", "{n};0;1;-1;{x};{y};{z}"),
    "rostopic": Layout("%time;field.header.stamp;field.orientation.x;field.orientation.y;field.orientation.z;"
                       "field.orientation.w;field.angular_velocity.x;field.angular_velocity.y;field.angular_velocity.z;"
                       "field.linear_acceleration.x{u};field.linear_acceleration.y{u};field.linear_acceleration.z{u};"
                       "field.linear_acceleration_covariance0", "{n};{n};0;0;0;1;2;1;0;{x};{y};{z};0"),
    "nine axes": Layout("millis;AcX{u};AcY{u};AcZ{u};GyX;GyY;GyZ;MagX;MagY;MagZ;Tmp",
                        "{m};{x};{y};{z};1;0;3;40;-12;7;21"),
    "German": Layout("Zeit [s];Beschleunigung x{u};Beschleunigung y{u};Beschleunigung z{u};Temperatur [°C]",
                     "{t};{x};{y};{z};21"),
    "Russian": Layout("Время, с;Ускорение X{u};Ускорение Y{u};Ускорение Z{u}", "{t};{x};{y};{z}"),
    "no names": Layout("", "{t};{x};{y};{z}"),
    "table": Layout("Nr.;x{u};y{u};z{u}", "{k};{x};{y};{z}", is_log=False),
    "table of means": Layout("Pose;ax_mean{u};ay_mean{u};az_mean{u};Temp [°C]", "{k};{x};{y};{z};21", is_log=False),
}  # fmt: skip
UNITS = {"": 1.0, " [m/s^2]": 1.0, " [g]": G, " (mg)": 1e-3 * G, " raw": G / 16384}
"""As they stand behind a name, and their sizes; the last, of counts, is in no name."""
ENCODINGS = ("utf-8", "utf-8-sig", "utf-16", "utf-16-le", "cp1251", "cp1252")
WRITING = (",.", ";,", "\t.", ";.")
ENDS = ("\n", "\r\n", "\r")
WAYS = tuple(itertools.product(LAYOUTS, UNITS, ENCODINGS, WRITING, ENDS, (False, True)))


def ways(count: int) -> Sequence[tuple[str, str, str, str, str, bool]]:
    """Some of all, but for letters that the encoding has not."""
    lacking = {"Russian": {"cp1252"}, "German": {"cp1251"}}
    possible = [way for way in WAYS if way[2] not in lacking.get(way[0], set())]
    return random.Random(5).sample(possible, count)


@cache
def readings(is_log: bool) -> np.ndarray:
    rng, force = np.random.default_rng(3), K * G * UP + B
    if not is_log:
        return force + rng.normal(0.0, 0.002, force.shape)
    return np.concatenate([
        np.concatenate([own + rng.normal(0.0, 0.02, (STILL, 3)), own + rng.normal(0.0, 3.0, (TURNING, 3))])
        for own in force
    ])  # fmt: skip


def write(path: Path, layout: Layout, unit: str, encoding: str, writing: str, end: str) -> None:
    is_counted = unit == " raw"
    digits, said = (0, "") if is_counted else (7, unit)
    delimiter, point = writing
    lines = [layout.names.replace("{u}", said)] if layout.names else []
    for k, xyz in enumerate((readings(layout.is_log) / UNITS[unit]).tolist()):
        x, y, z = (f"{value:.{digits}f}" for value in xyz)
        at_ns = 1_700_000_000_000_000_000 + 10_000_000 * k
        lines.append(layout.cells.format(t=f"{0.01 * k:.3f}", n=at_ns, m=10 * k, k=k + 1, x=x, y=y, z=z))
    names, rows = (lines[:1], lines[1:]) if layout.names else ([], lines)
    quoted = [";".join(f'"{name}"' if delimiter in name else name for name in names[0].split(";"))] if names else []
    text = end.join([*quoted, *(row.replace(".", point) for row in rows), ""]).replace(";", delimiter)
    path.write_bytes(text.encode(encoding))


@pytest.mark.parametrize("way", [
    *ways(24), *(pytest.param(way, marks=pytest.mark.slow) for way in ways(224)[24:]),
], ids=lambda way: "-".join(map(str, way)).encode("unicode_escape").decode())  # fmt: skip
def test_the_command_that_info_proposes_gives_the_calibration(
    way: tuple[str, str, str, str, str, bool], run: Any, tmp_path: Path
) -> None:
    name, unit, encoding, writing, end, is_packed = way
    layout, path = LAYOUTS[name], tmp_path / "file.csv"
    write(path, layout, unit, encoding, writing, end)
    if is_packed:
        path = tmp_path / "file.csv.gz"
        path.write_bytes(gzip.compress((tmp_path / "file.csv").read_bytes()))
    said, words = run.proposed(path, "--gravity", G)
    found = run.parameters(*words)
    loose = 10.0 if not layout.is_log else 1.0
    assert [found[f"K{i}"]["value"] for i in (1, 2, 3)] == pytest.approx(K, abs=1e-3 * loose), said
    assert [found[f"b{i}"]["value"] for i in (1, 2, 3)] == pytest.approx(B, abs=1e-2 * loose), said
