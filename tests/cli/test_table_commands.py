"""Tables of orientations on the command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers.paths import ROOT

TWELVE = ROOT / "recordings" / "twelve_poses.csv"
OPTIONS = (TWELVE, "--axes", "y z x", "--gravity", "9.8123")
FACES = "face,A,B,C\n+x,1,0,0\n-x,-1,0,0.001\n+y,0,1.002,0\n-y,0,-1,0.001\n+z,0.001,0,1\n-z,0,0.001,-1\n"


@pytest.mark.parametrize("command", [("replay",), ("diagnose",), ("improve",), ("compare",)])
def test_a_table_goes_where_a_recording_goes(command: tuple[str, ...], run) -> None:
    code, out, err = run(*command, *OPTIONS, "--json")
    assert (code, err) == (0, "")
    assert (
        sum("1 g = 9.80665 m/s^2" in warning for warning in json.loads(out).get("warnings", ["1 g = 9.80665 m/s^2"]))
        == 1
    )


def test_a_plan_goes_on_from_a_table(run) -> None:
    code, out, err = run("plan", "--recording", *OPTIONS, "--json")
    assert (code, err) == (0, "") and json.loads(out)["gimbal_deg"]


def test_columns_and_g_are_settled_by_options(run, tmp_path: Path) -> None:
    path = tmp_path / "faces.csv"
    path.write_text(FACES)
    columns = ("--column", "A=ay_g", "--column", "B=ax_g", "--column", "C=az_g")
    code, out, _ = run("replay", path, "--gravity", "9.81", "--g-unit", "local", "--json", *columns)
    assert code == 2 and out == ""  # x and y exchanged are no calibration of this bench
    columns = ("--column", "A=ax_g", "--column", "B=ay_g", "--column", "C=az_g")
    code, out, _ = run("replay", path, "--gravity", "9.81", "--g-unit", "local", "--json", *columns)
    assert code == 0
    found = json.loads(out)
    (value,) = [each["value"] for each in found["parameters"] if each["symbol"] == "K1"]
    assert value == pytest.approx(1.0, abs=1e-5)
    assert found["consistency"]["p_value"] is None
    assert any("1 g = 9.81 m/s^2" in warning for warning in found["warnings"])


def test_samples_are_to_be_recorded_first(run, tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    rows = "".join(f"{k / 100},0,0,0,0,1,0\n" for k in range(200))
    path.write_text(f"time_s,outer_deg,middle_deg,inner_deg,ax_g,ay_g,az_g\n{rows}")
    code, out, err = run("replay", path, "--axes", "y z x", "--gravity", "9.81")
    assert (code, out) == (2, "") and "are samples, 0.01 s apart" in err and "kf-calib record run.mcap" in err


def test_a_recording_has_no_columns(run) -> None:
    code, _, err = run("replay", ROOT / "recordings" / "hidden.mcap", "--column", "a=ax_g")
    assert code == 2 and "is no table (.csv, .xlsx)" in err
