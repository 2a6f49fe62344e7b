"""Tables of orientations: the same numbers as the recording they are made of, however they are written."""

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.known_runs import hidden_diagnosed
from helpers.paths import ROOT

import kf_calib
from kf_calib.bench.streams import Orientation, Table
from kf_calib.dwells.folding import dwells_of_table
from kf_calib.errors import InputError
from kf_calib.estimation.calibration import filterpy_estimate
from kf_calib.sources.text.names import face_of, meaning_of

pytestmark = pytest.mark.usefixtures("unmeasured")

BENCH = {"axes": "y z x", "gravity_mps2": "9.8123"}
TWELVE = ROOT / "recordings" / "twelve_poses.csv"
FACES = {"+x": (1, 0, 0), "-x": (-1, 0, 0), "+y": (0, 1, 0), "-y": (0, -1, 0), "+z": (0, 0, 1), "-z": (0, 0, -1)}
G = 9.80665


def table_of(result: kf_calib.Calibration) -> Table:
    """What would be written down of a run: of each dwell mean, standard deviation, count, angles and temperature."""
    rows = [
        Orientation(
            dwell.means[4:], dwell.pose, 0.5 * (dwell.start_s + dwell.end_s), result.noise.effective_sigma_mps2,
            dwell.count, float(dwell.pieces.nodes.temperature_c[0]),
        )
        for dwell in result.fit.dwells
    ]  # fmt: skip
    return Table("table", result.bench, rows)


@pytest.mark.parametrize("name", ["navigation_24", "mems_faces", "hidden"])
def test_a_run_and_its_table_give_the_same_parameters_and_sigmas(name: str) -> None:
    run = kf_calib.calibrate(ROOT / "recordings" / f"{name}.mcap")
    written = kf_calib.calibrate(table_of(run))
    for symbol, expected in run.parameters.items():
        found = written.parameters[symbol]
        assert expected.value is not None and found.value is not None
        assert found.value == pytest.approx(expected.value, rel=1e-9, abs=1e-12)
        assert found.sigma == pytest.approx(expected.sigma, rel=1e-9)


@pytest.mark.slow
@pytest.mark.usefixtures("unmeasured")
@pytest.mark.parametrize("recording", ["mems_faces", "navigation_24"])
def test_the_engines_agree_on_a_table(recording: str) -> None:
    table = table_of(kf_calib.calibrate(ROOT / "recordings" / f"{recording}.mcap"))
    compared = kf_calib.compare(table)
    assert compared.max_difference_sigma < 1e-6
    assert compared.allan is None
    run = kf_calib.calibrate(table)
    np.testing.assert_allclose(filterpy_estimate(table, run).parameters, run.estimate.parameters, atol=1e-9)


def six_faces(matrix: np.ndarray, bias: np.ndarray, gravity_mps2: float) -> dict[str, list[Any]]:
    means = np.array([matrix @ np.array(face) * gravity_mps2 + bias for face in FACES.values()])
    return {"face": list(FACES), "ax_mps2": means[:, 0], "ay_mps2": means[:, 1], "az_mps2": means[:, 2]}  # type: ignore[dict-item]


def test_six_faces_give_the_closed_form() -> None:
    """K is half the difference of up and down over g, a bias is the mean over all faces."""
    matrix = np.array([[1.001, 0.002, -0.003], [0.0, 0.998, 0.004], [0.001, 0.0, 1.003]])
    noise = np.random.default_rng(4).normal(0.0, 1e-4, (6, 3))
    columns = six_faces(matrix, np.array([0.03, -0.02, 0.01]), 9.81)
    for k, name in enumerate(("ax_mps2", "ay_mps2", "az_mps2")):
        columns[name] = columns[name] + noise[:, k]
    run = kf_calib.calibrate(kf_calib.open_table(columns, {"gravity_mps2": "9.81"}))
    means = np.column_stack([columns[name] for name in ("ax_mps2", "ay_mps2", "az_mps2")])
    for k in range(3):
        sensitivity = (means[0::2, k] - means[1::2, k]) / 2.0 / 9.81
        assert run.parameters[f"K{k + 1}"].value == pytest.approx(np.linalg.norm(sensitivity), rel=1e-9)
        assert run.parameters[f"b{k + 1}"].value == pytest.approx(means[:, k].mean(), rel=1e-9)
    assert run.consistency.p_value is None and run.consistency.dof == 6
    assert any("no standard deviation and number of readings" in warning for warning in run.warnings)


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_a_face_is_the_axis_that_points_up_whatever_the_bench_calls_up(up: str) -> None:
    table = kf_calib.open_table(six_faces(np.eye(3), np.zeros(3), 9.81), {"gravity_mps2": "9.81", "up": up})
    pose = np.array([row.pose for row in table.orientations])
    np.testing.assert_allclose(table.bench.specific_force(np.zeros(6), pose), 9.81 * np.array(list(FACES.values())),
                               atol=1e-12)  # fmt: skip


def test_a_german_spreadsheet_is_understood_without_a_word() -> None:
    table = kf_calib.open_table(TWELVE, BENCH)
    first, last = table.orientations[0], table.orientations[-1]
    assert first.count == 1200 and len(table.orientations) == 12
    assert last.elapsed_s == 22 * 60.0
    np.testing.assert_allclose(np.degrees(last.pose), [0, 315, 225])
    assert first.temperature_c == 24.6
    assert table.orientations[1].mean_mps2[0] == pytest.approx(1.003 * G, abs=1e-3)
    (said,) = table.warnings
    assert "1 g = 9.80665 m/s^2" in said and "not used: 'Bemerkung'" in said
    assert kf_calib.calibrate(table).consistency.consistent


def test_a_spreadsheet_of_russian_windows_is_read(tmp_path: Path) -> None:
    header = HEADER.replace("outer", "Наружный").replace("ax", "Среднее X").replace("sd", "СКО")
    (tmp_path / "ru.csv").write_text("\n".join([header, *LINES]), encoding="cp1251")
    (tmp_path / "plain.csv").write_text(PLAIN)
    one, other = (kf_calib.open_table(tmp_path / name, BENCH).orientations for name in ("plain.csv", "ru.csv"))
    assert [each.mean_mps2.tolist() for each in one] == [each.mean_mps2.tolist() for each in other]
    np.testing.assert_array_equal([each.sigma_mps2 for each in one], [each.sigma_mps2 for each in other])


def test_local_gravity_as_the_unit_changes_scale_and_bias_alike() -> None:
    standard, local = (
        kf_calib.calibrate(kf_calib.open_table(TWELVE, BENCH, g_unit=unit)) for unit in ("9.80665", "local")
    )
    for symbol in ("K1", "K2", "b3"):
        one, other = standard.parameters[symbol].value, local.parameters[symbol].value
        assert one is not None and other == pytest.approx(one * 9.8123 / G, rel=1e-9)


HEADER = "outer [deg],middle [deg],inner [deg],ax [g],ay [g],az [g],sd [mg],count"
LINES = ["0,0,0,0.003,1.001,-0.002,0.5,900", "0,90,0,1.002,0.002,0.001,0.5,900", "0,180,0,-0.001,-0.999,0.004,0.5,900",
         "0,270,0,-0.998,0.001,0.002,0.5,900", "0,0,90,0.002,0.004,-1.003,0.5,900",
         "0,0,270,-0.001,0.001,0.997,0.5,900"]  # fmt: skip
PLAIN = "\n".join([HEADER, *LINES]) + "\n"
WRITTEN = {
    "a title and blank lines": "Block 0417\n\n" + PLAIN.replace("\n", "\n\n"),
    "a line of units": PLAIN.replace(" [deg]", "").replace(" [g]", "").replace(" [mg]", "").replace(
        "count\n", "count\ndeg,deg,deg,g,g,g,mg,-\n"),
    "other names": PLAIN.replace(HEADER,
                                 "outer_deg,middle_deg,inner_deg,Acc1 (g),Acc2 (g),Acc3 (g),Stabw. [mg],Anzahl"),
    "names in Russian": PLAIN.replace(HEADER, "наружный [град],средний [град],внутренний [град],Среднее X [g],"
                                      "Среднее Y [g],Среднее Z [g],СКО [мg],Число"),
    "other order": "\n".join(",".join(line.split(",")[::-1]) for line in PLAIN.splitlines()),
    "angles of which one is in another unit": PLAIN.replace("inner [deg]", "inner [mrad]").replace(
        ",90,0.002,", f",{500 * np.pi!r},0.002,").replace(",270,-0.001,0.001", f",{1500 * np.pi!r},-0.001,0.001"),
    "no unit at all": PLAIN.replace(" [deg]", "").replace(" [g]", ""),
}  # fmt: skip


@pytest.mark.parametrize("how", WRITTEN)
def test_the_same_table_written_in_another_way_is_the_same(how: str, tmp_path: Path) -> None:
    """tests/sources/text/test_ways_of_writing.py has encodings, delimiters and decimal signs."""
    (tmp_path / "plain.csv").write_text(PLAIN)
    (tmp_path / "other.csv").write_text(WRITTEN[how], newline="")
    one, other = (kf_calib.open_table(tmp_path / name, BENCH).orientations for name in ("plain.csv", "other.csv"))
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(a.mean_mps2, b.mean_mps2, rtol=1e-12)
        np.testing.assert_allclose(a.pose, b.pose)
        assert a.sigma_mps2 is not None and b.sigma_mps2 is not None
        np.testing.assert_allclose(a.sigma_mps2, b.sigma_mps2, rtol=1e-12)
        assert a.count == b.count == 900


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("2026-05-04T13:45:00+02:00", "2026-05-04T11:47:00Z"),
        ("2026-05-04 13:45", "2026-05-04 13:47"),
        ("04.05.2026 13:45:00", "04.05.2026 13:47:00"),
        ("04.05.26 13:45 MESZ", "04.05.26 13:47 MESZ"),
        ("5/4/2026 1:45 PM", "5/4/2026 1:47 PM"),
        ("4.5.2026, 13:45:00,5", "4.5.2026, 13:47:00,5"),
        ("0.0", "120"),
    ],
)
def test_stamps_of_many_kinds_are_two_minutes_apart(first: str, second: str) -> None:
    columns = six_faces(np.eye(3), np.zeros(3), 9.81)
    two = {name: list(values)[:2] for name, values in columns.items()} | {"Zeit": [first, second]}
    rows = kf_calib.open_table(two, {"gravity_mps2": "9.81"}).orientations
    assert [row.elapsed_s for row in rows] == [0.0, 120.0]


@pytest.mark.parametrize(("unit", "size"), [("g", 1.0 / G), ("mg", 1e3 / G), ("mps2", 1.0)])
def test_units_are_told_by_the_numbers_where_no_name_tells_them(unit: str, size: float) -> None:
    columns = six_faces(np.eye(3), np.zeros(3), 9.81)
    bare = {"face": columns["face"]} | {name[:2]: np.array(columns[name]) * size for name in list(columns)[1:]}
    table = kf_calib.open_table(bare, {"gravity_mps2": "9.81"})
    np.testing.assert_allclose(table.orientations[0].mean_mps2, [9.81, 0, 0], atol=1e-9)
    assert "by their size" in table.warnings[-1]


def test_counts_need_the_size_of_one() -> None:
    columns = six_faces(np.eye(3), np.zeros(3), 9.81)
    counts = {"face": columns["face"]} | {f"{n[:2]}_counts": np.array(columns[n]) / 5e-4 for n in list(columns)[1:]}
    with pytest.raises(InputError, match="--accel-scale"):
        kf_calib.calibrate(kf_calib.open_table(counts, {"gravity_mps2": "9.81"}))
    run = kf_calib.calibrate(kf_calib.open_table(counts, {"gravity_mps2": "9.81"}, accel_scale=5e-4))
    assert run.parameters["K1"].value == pytest.approx(1.0)


def test_a_structured_array_and_a_data_frame_are_tables() -> None:
    columns = six_faces(np.eye(3), np.zeros(3), 9.81)
    kinds = [("face", "U2"), ("ax_mps2", float), ("ay_mps2", float), ("az_mps2", float)]
    array = np.array(list(zip(*columns.values(), strict=True)), dtype=kinds)
    tables = [columns, array]
    pandas = pytest.importorskip("pandas", reason="pandas is not there") if _has("pandas") else None
    tables += [pandas.DataFrame(columns)] if pandas else []
    for table in tables:
        rows = kf_calib.open_table(table, {"gravity_mps2": "9.81"}).orientations
        np.testing.assert_allclose([row.mean_mps2[0] for row in rows], [9.81, -9.81, 0, 0, 0, 0], atol=1e-12)


def _has(package: str) -> bool:
    from importlib.util import find_spec

    return find_spec(package) is not None


def excel(path: Path, rows: list[list[Any]], title: str = "Messung") -> Path:
    openpyxl = pytest.importorskip("openpyxl", reason="openpyxl is not there")
    book = openpyxl.Workbook()
    book.active.title = title
    for row in rows:
        book.active.append(row)
    book.save(path)
    return path


def test_an_excel_file_is_the_same_table(tmp_path: Path) -> None:
    rows: list[list[Any]] = [HEADER.split(","), *([float(cell) for cell in line.split(",")] for line in LINES)]
    (tmp_path / "plain.csv").write_text(PLAIN)
    path = excel(tmp_path / "table.xlsx", [["Block 0417"], [], *rows])
    one, other = (kf_calib.open_table(each, BENCH).orientations for each in (tmp_path / "plain.csv", path))
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a.mean_mps2, b.mean_mps2)
        assert a.count == b.count


def test_a_column_can_be_settled_by_the_user(tmp_path: Path) -> None:
    (tmp_path / "table.csv").write_text(
        PLAIN.replace("ax [g]", "foo").replace("ay [g]", "bar").replace("az [g]", "ay [g]")
    )
    with pytest.raises(InputError, match="accelerometer x and z"):
        kf_calib.open_table(tmp_path / "table.csv", BENCH)
    names = {"foo": "ax_g", "bar": "ay_g", "ay [g]": "az_g"}
    rows = kf_calib.open_table(tmp_path / "table.csv", BENCH, columns=names).orientations
    np.testing.assert_allclose(rows[0].mean_mps2, G * np.array([0.003, 1.001, -0.002]))


def test_few_readings_have_the_sigma_of_their_mean() -> None:
    """Of 4 readings a dwell as of 400 with a tenfold standard deviation."""
    table = kf_calib.open_table(TWELVE, BENCH)
    many = Table("many", table.bench, [replace(row, count=400) for row in table.orientations])
    tenth = [replace(row, count=4, sigma_mps2=np.asarray(row.sigma_mps2) / 10.0) for row in table.orientations]
    one, other = kf_calib.calibrate(many), kf_calib.calibrate(Table("few", table.bench, tenth))
    for symbol, expected in one.parameters.items():
        assert other.parameters[symbol].sigma == pytest.approx(expected.sigma, rel=1e-9)


@pytest.mark.slow
def test_a_missing_effect_is_found_in_a_table() -> None:
    expected = hidden_diagnosed()
    found = kf_calib.diagnose(table_of(expected.before))
    assert found.verdict.split(":")[0].split("(")[0] == expected.verdict.split(":")[0].split("(")[0]


@pytest.mark.slow
def test_rows_equally_apart_are_searched_for_oscillations_too() -> None:
    """At some frequencies the sine is zero in all of them."""
    table = kf_calib.open_table(TWELVE, BENCH)
    some = [row for k, row in enumerate(table.orientations) if k % 6]
    assert kf_calib.diagnose(kf_calib.calibrate(Table("some", table.bench, some))).test.consistent


def test_what_needs_readings_says_so() -> None:
    table = kf_calib.open_table(TWELVE, BENCH)
    with pytest.raises(InputError, match="vibration-rectification needs the readings themselves"):
        kf_calib.calibrate(table, kf_calib.Settings(effects="vibration-rectification"))
    with pytest.raises(InputError, match="needs the readings themselves"):
        next(iter(table))


def test_noise_that_nothing_shows_is_refused() -> None:
    columns = six_faces(np.eye(3), np.zeros(3), 9.81)
    five = {name: list(values)[:5] for name, values in columns.items()}
    with pytest.raises(InputError, match="too few to estimate the noise"):
        kf_calib.calibrate(kf_calib.open_table(five, {"gravity_mps2": "9.81"}))
    stated = {"gravity_mps2": "9.81", "scatter_sigma_mps2": "0.001"}
    assert kf_calib.calibrate(kf_calib.open_table(five, stated)).parameters["K1"].sigma == pytest.approx(7e-5, rel=0.2)


@pytest.mark.parametrize(
    ("name", "ours", "unit"),
    [
        ("ax", "ax", ""), ("acc_y_g", "ay", "g"), ("Acc1 (g)", "ax", "g"), ("AccZ_mps2", "az", "m/s2"),
        ("accel_x_m/s^2", "ax", "m/s2"), ("fx in g", "ax", "g"), ("3", "az", ""), ("ax std", "sx", ""),
        ("Std. Dev. X", "sx", ""), ("Stabw. y [mg]", "sy", "mg"),
        ("Standardabweichung z [mg]", "sz", "mg"), ("Mittelwert x", "ax", ""), ("СКО X, мg", "sx", "mg"),
        ("Стандартное отклонение у [мg]", "sy", "mg"), ("Среднее X [м/с²]", "ax", "m/s2"),
        ("Среднее квадратическое отклонение Z", "sz", ""), ("Ускорение Х, мg", "ax", "mg"),
        ("Показания акселерометра 2", "ay", ""), ("Температура, °С", "temperature", "c"), ("Время, с", "time", "s"),
        ("Число измерений", "count", ""), ("Угол наружной рамки, град", "angle", "deg"), ("Положение", "face", ""),
        ("Примечание", "", ""), ("Длительность, с", "", "s"), ("sd_g", "sd", "g"), ("N readings", "count", ""),
        ("T (°C)", "temperature", "c"), ("t [s]", "time", "s"), ("Datum", "time", ""), ("x_deg", "angle", "deg"),
        ("Winkel außen [°]", "angle", "deg"), ("acc_z_raw", "az", "count"), ("Lage", "face", ""), ("note", "", ""),
        ("gyro x", "", ""), ("dwell [s]", "", "s"),
    ],
)  # fmt: skip
def test_names_of_columns_are_understood(name: str, ours: str, unit: str) -> None:
    assert meaning_of(name)[:2] == (ours, unit)


@pytest.mark.parametrize(
    ("text", "face"),
    [("+x", (0, 1)), ("X", (0, 1)), ("−z", (2, -1)), ("y down", (1, -1)), ("z-", (2, -1)), ("2", None),
     ("+2", (1, 1)),
     ("up", None), ("xx", None), ("", None)],
)  # fmt: skip
def test_faces_are_read(text: str, face: tuple[int, int] | None) -> None:
    assert face_of(text) == face


def test_rows_are_read_and_folded_in_a_time_that_grows_with_their_number(tmp_path: Path) -> None:
    def lasting_s(count: int) -> float:
        rows = (f"{60 * k},{k % 360},{7 * k % 360},0.0{k % 10}1,1.001,-0.5,0.5,900" for k in range(count))
        header = "time [s],outer [deg],inner [deg],ax [g],ay [g],az [g],sd [mg],count"
        (tmp_path / "long.csv").write_text("\n".join([header, *rows]))
        begin = time.process_time()
        table = kf_calib.open_table(tmp_path / "long.csv", {"axes": "z x", "gravity_mps2": "9.81"})
        assert len(dwells_of_table(table.orientations, table.bench)) == count
        return time.process_time() - begin

    lasting_s(500)
    assert lasting_s(8000) < 8.0 * lasting_s(2000)  # four times as many
