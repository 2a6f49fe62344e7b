"""Logs as other programs write them: with what stands beside the readings, without an option but gravity."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.foreign_logs import (
    COMMA_TABLES,
    FOREIGN_LOGS,
    RATE_HZ,
    SECONDS,
    UP,
    B,
    Columns,
    G,
    K,
    comma_table,
    constant,
    rates,
    readings,
    texts,
    three,
)
from helpers.long_runs import slow
from logs_page import COMMAND, PAGE, VERDICT, page

from kf_calib.bench.streams import Table
from kf_calib.errors import CountsError, InputError
from kf_calib.estimation.calibration import calibrate
from kf_calib.sources.file_kind import FileKind
from kf_calib.sources.opening import kind_of, opened
from kf_calib.sources.text.means import open_table
from kf_calib.sources.text.names import Meaning, meaning_of, meanings_of

GRAVITY = {"gravity_mps2": str(G)}
IN_BRIEF = "rostopic echo -p", "Klipper", "groups of HDF5", "a bag of ROS 1"


def written(path: Path, columns: Columns) -> Path:
    path.write_text(comma_table(columns))
    return path


def values(path: Path) -> np.ndarray:
    found = calibrate(opened(path, GRAVITY, angles=False)).parameters
    return np.array([found[name].value for name in ("K1", "K2", "K3", "b1", "b2", "b3", "nu1", "theta3", "phi3")])


@cache
def plain_values(folder: Path) -> np.ndarray:
    """Of a file in our own names."""
    columns = {"time_s": texts(SECONDS, "{:.2f}"), **three("a{}_mps2", readings())}
    return values(written(folder / "plain.csv", columns))


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    return plain_values(tmp_path_factory.getbasetemp())


@pytest.mark.parametrize("name", FOREIGN_LOGS)
def test_a_log_has_the_calibration_of_the_same_run_in_our_own_names(
    name: str, plain: np.ndarray, tmp_path: Path
) -> None:
    log = FOREIGN_LOGS[name]
    found = values(log.at(tmp_path))
    np.testing.assert_allclose(found, plain, rtol=0.0, atol=10.0 * log.digits)
    assert found[:3] == pytest.approx(K, abs=5e-4) and found[3:6] == pytest.approx(B, abs=5e-3)


@pytest.mark.parametrize("name", COMMA_TABLES)
def test_readings_and_times_are_those_of_the_file(name: str, tmp_path: Path) -> None:
    path = FOREIGN_LOGS[name].at(tmp_path)
    assert kind_of(path) is FileKind.SAMPLES
    batches = list(opened(path, GRAVITY, angles=False))
    np.testing.assert_allclose(np.concatenate([batch.accel.values for batch in batches]), readings(), atol=2e-9)
    times = np.concatenate([batch.accel.time_ns for batch in batches])
    np.testing.assert_allclose(np.diff(times), 1e9 / RATE_HZ, atol=1e3)  # of two stamps the even one


@pytest.mark.parametrize("name", [*IN_BRIEF, *slow(*(name for name in FOREIGN_LOGS if name not in IN_BRIEF))])
def test_the_command_of_the_page_gives_its_verdict(name: str, run: Any, tmp_path: Path) -> None:
    log = FOREIGN_LOGS[name]
    path = log.at(tmp_path)
    command = COMMAND.format(log.file)
    assert f"```sh\n{command}\n```" in PAGE.read_text(encoding="utf-8")
    code, out, err = run(*[path if word == log.file else word for word in command.split()[1:]])
    assert code == 0, err
    assert " ".join(VERDICT.split()) in " ".join(out.split())


@pytest.mark.parametrize("name", [*IN_BRIEF, *slow(*(name for name in FOREIGN_LOGS if name not in IN_BRIEF))])
def test_the_command_that_info_proposes_works(name: str, run: Any, tmp_path: Path) -> None:
    path = FOREIGN_LOGS[name].at(tmp_path)
    code, out, err = run(*run.proposed(path, "--gravity", G)[1])
    assert code == 0 and " ".join(VERDICT.split()) in " ".join(out.split()), err


def test_the_page_is_that_of_these_files() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(), "python tools/logs_page.py renews it"


COUNTED = {
    "Klipper": ({"#time": texts(SECONDS), **three("accel_{}", 1e3 * readings(), form="{:.0f}")},
                "--accel-scale 0.001"),
    "blackbox": ({"loopIteration": texts(range(len(SECONDS)), "{}"), " time (us)": texts(1e6 * SECONDS + 2e7, "{:.0f}"),
                  **constant("0", " axisP[0]", " axisP[1]", " axisP[2]"), **rates(" gyroADC[{}]", "012"),
                  **three(" accSmooth[{}]", 2048 * readings() / G, "012", "{:.0f}"),
                  **constant("IDLE", " failsafePhase (flags)"), **rates(" {}", ("roll", "pitch", "heading"))},
                 f"--accel-unit g --accel-scale {1 / 2048}"),
}  # fmt: skip


@pytest.mark.parametrize("name", COUNTED)
def test_the_usual_size_of_a_count_is_told_and_right(name: str, tmp_path: Path) -> None:
    columns, option = COUNTED[name]
    path = written(tmp_path / "log.csv", columns)
    with pytest.raises(CountsError, match=option) as told:
        opened(path, GRAVITY, angles=False).bench  # noqa: B018 (the bench is read by the asking)
    found = calibrate(opened(path, GRAVITY | told.value.keys, angles=False)).parameters
    assert [found[f"K{i}"].value for i in (1, 2, 3)] == pytest.approx(K, abs=5e-4)


@pytest.mark.parametrize(
    ("header", "ours"),
    [("q0,q1,q2,q3", "qw qx qy qz"), ("Quat_q0,Quat_q1,Quat_q2,Quat_q3", "qw qx qy qz"),
     ("QuatW,QuatX,QuatY,QuatZ", "qw qx qy qz"), ("quat_w,quat_x,quat_y,quat_z", "qw qx qy qz"),
     ("Quaternion.w,Quaternion.x,Quaternion.y,Quaternion.z", "qw qx qy qz"), ("s_ax,s_ay,w_RS_S_x", "sx sy "),
     ("orientation.x,orientation.y,orientation.z,orientation.w", "   "),
     ("q1,q2,q3", "angle angle angle"), ("a_x,a_y,a_z,s_x,s_y,s_z", "ax ay az sx sy sz"),
     ("ax,ay,az,mx,my,mz", "ax ay az   "), ("m1,m2,m3", "ax ay az"),
     ("accSmooth[0],accSmooth[1],accSmooth[2],debug[0]", "ax ay az "),
     ("timestamps,f_x,f_y,f_z", "time ax ay az"), ("angles_1,angles_2,angles_3", "angle angle angle")],
)  # fmt: skip
def test_names_are_understood_together(header: str, ours: str) -> None:
    assert " ".join(own.ours for own in meanings_of(header.split(","), {})) == ours


def test_joints_of_a_robot_are_gimbals_still() -> None:
    names = ("q1 [deg]", "q2 [deg]", "q3 [deg]", "axis 1", "Achse 2")
    assert {own.ours for own in meanings_of(names, {})} == {"angle"}
    assert meaning_of("axisP[1]").ours == ""


def test_what_is_stated_goes_before_what_is_guessed() -> None:
    names = ("acc1_x [g]", "acc2_x [g]", "Roll", "gyro_x")
    assert [own.ours for own in meanings_of(names, {})] == ["ax", "ax", "", ""]
    stated = meanings_of(names, {"acc2_x [g]": "ax", "Roll": "outer_deg"})
    assert stated[:3] == [Meaning("", "g"), Meaning("ax", "g"), Meaning("angle", "deg", 1)]


def test_two_accelerometers_are_a_choice_that_a_hint_makes_possible(tmp_path: Path) -> None:
    columns = {"time_s": texts(SECONDS), **three("acc1_{}", readings()), **three("acc2_{}", readings())}
    path = written(tmp_path / "log.csv", columns)
    with pytest.raises(InputError, match="say which it is, for example by --column 'acc1_x=ax'"):
        opened(path, {"gravity_mps2": "9.81"}, angles=False).bench  # noqa: B018 (the bench is read by the asking)


def test_a_table_of_nine_axes_is_of_the_accelerometer_alone(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    rows = [[G * x for x in up] + [0.1, 0.2, 0.3, 20.0, 3.0, 44.0] for up in UP[:3].tolist()]
    path.write_text("ax,ay,az,gx,gy,gz,mx,my,mz\n" + "\n".join(",".join(map(str, row)) for row in rows))
    source = opened(path, GRAVITY, angles=False)
    assert isinstance(source, Table)
    np.testing.assert_allclose(source.orientations.mean_mps2, G * UP[:3], atol=1e-9)


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
    words = ("replay", path, "--no-angles", "--gravity", G)
    said = "told apart by the column 'unit' (0, b): choose one, for example by --where 'unit=0'"
    assert said in run.refused(*words)
    for unit, bias in (("0", B[0]), ("b", B[0] + 0.1 * G)):
        found = run.parameters(*words, "--where", f"unit={unit}")
        assert found["K1"]["value"] == pytest.approx(K[0], abs=5e-4)
        assert found["b1"]["value"] == pytest.approx(bias, abs=5e-3)
    assert "write --where COLUMN=VALUE" in run.refused(*words, "--where", "unit")


def test_rows_of_a_table_are_chosen(tmp_path: Path) -> None:
    path, rows = tmp_path / "poses.csv", ["unit,ax (g),ay (g),az (g)"]
    for x, y, z in (K * UP + B / G).tolist():
        rows += [f"7,{x},{y},{z}", f"8,{x + 1},{y},{z}"]
    path.write_text("\n".join(rows))
    table = open_table(path, GRAVITY, where="unit=7", angles=False)
    np.testing.assert_allclose(table.orientations.mean_mps2, G * (K * UP) + B, rtol=1e-9)
    with pytest.raises(InputError, match="no row has '9' in column"):
        open_table(path, GRAVITY, where="unit=9", angles=False)
