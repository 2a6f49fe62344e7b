"""Broken tables: each is refused in one sentence that names the place and says what to write."""

from pathlib import Path
from typing import Any

import pytest

import kf_calib
from kf_calib.errors import InputError, KfCalibError

HEADER = "time [s],outer [deg],inner [deg],ax [g],ay [g],az [g],sd [mg],count"
LINES = ["0,0,0,0.003,1.001,-0.002,0.5,900", "60,90,0,1.002,0.002,0.001,0.5,900",
         "120,180,0,-0.001,-0.999,0.004,0.5,900", "180,270,0,-0.998,0.001,0.002,0.5,900",
         "240,0,90,0.002,0.004,-1.003,0.5,900", "300,0,270,-0.001,0.001,0.997,0.5,900"]  # fmt: skip
PLAIN = "\n".join([HEADER, *LINES]) + "\n"
BENCH = {"axes": "z x", "gravity_mps2": "9.81"}


def cell(line: int, column: int, text: str) -> str:
    """The plain table with another text in one cell; lines are counted from 1, columns from 0."""
    rows = [row.split(",") for row in PLAIN.splitlines()]
    rows[line][column] = text
    return "\n".join(",".join(row) for row in rows)


def without(*columns: int) -> str:
    rows = [row.split(",") for row in PLAIN.splitlines()]
    return "\n".join(",".join(own for k, own in enumerate(row) if k not in columns) for row in rows)


SAMPLES = "\n".join(["time [s],outer [deg],inner [deg],ax [g],ay [g],az [g]",
                     *(f"{k / 100},0,0,0,1,0" for k in range(100))])  # fmt: skip
FACES = "face,ax [g],ay [g],az [g]\n+x,1,0,0\nsideways,-1,0,0\n"
QUATERNIONS = "qx,qy,qz,qw,ax [g],ay [g],az [g]\n0,0,0,1,0,1,0\n0,0,1,1,1,0,0\n"
GERMAN = PLAIN.replace(",", ";").replace(".", ",")
BROKEN: dict[str, tuple[str | bytes, dict[str, Any], str]] = {
    "a word in a reading": (cell(2, 3, "n/a"), {}, "row 3, column 'ax [g]' is 'n/a': write a reading such as 9.80665"),
    "an empty reading": (cell(2, 3, ""), {}, "row 3, column 'ax [g]' is empty: write a reading such as 9.80665"),
    "two points": (cell(3, 4, "0.9.99"), {}, "row 4, column 'ay [g]' is '0.9.99'"),
    "an error of Excel": (cell(4, 5, "#DIV/0!"), {}, "row 5, column 'az [g]' is '#DIV/0!'"),
    "infinite": (cell(1, 3, "inf"), {}, "row 2, column 'ax [g]' is 'inf'"),
    "not a number": (cell(1, 3, "nan"), {}, "row 2, column 'ax [g]' is 'nan'"),
    "a word for an angle": (cell(2, 1, "left"), {}, "row 3, column 'outer [deg]' is 'left': write an angle such as"),
    "a unit in the cell": (cell(2, 1, "90 deg"), {}, "row 3, column 'outer [deg]' is '90 deg'"),
    "a negative deviation": (cell(3, 6, "-0.5"), {}, "row 4, column 'sd [mg]' is '-0.5': a standard deviation is not "),
    "no deviation in a row": (cell(3, 6, ""), {}, "row 4, column 'sd [mg]' is empty: write a standard deviation"),
    "half a reading": (cell(1, 7, "2.5"), {}, "row 2, column 'count' is '2.5': write how many readings were averaged"),
    "no readings": (cell(1, 7, "0"), {}, "row 2, column 'count' is '0': write how many readings were averaged"),
    "time goes back": (cell(3, 0, "30"), {}, "row 4, column 'time [s]' is '30': the row before is not earlier: sort"),
    "time stands": (cell(3, 0, "60"), {}, "row 4, column 'time [s]' is '60': the row before is not earlier: sort"),
    "no stamp": (cell(2, 0, "noon"), {}, "row 3, column 'time [s]' is 'noon': write a time such as"),
    "the 31st of February": (cell(1, 0, "31.02.2026").replace("time [s]", "Datum"), {},
                             "column 'Datum' is '31.02.2026'"),
    "both decimal signs": (GERMAN.replace("-0,998", "-0.99"), {}, "column 'ax [g]' is '-0.99': write a reading such "
                           "as 9,80665"),
    "thousands astray": (GERMAN.replace("900", "9.00,5"), {}, "column 'count' is '9.00,5'"),
    "a cell too many": (PLAIN.replace("0.004,0.5,900", "0.004,0.5,900,7"), {},
                        "row 4 has 9 cells where the header has 8"),
    "no readings at all": (without(3, 4, 5), {}, "recognised as the mean reading of accelerometer x and y and z among"),
    "one reading missing": (without(4), {}, "mean reading of accelerometer y among"),
    "no angles": (without(1, 2), {}, "no column was recognised as gimbal angles, attitude or face"),
    "an angle missing": (without(2), {}, "has 1 column of angles ('outer [deg]') where --axes names 2 gimbals"),
    "two columns for one": (PLAIN.replace("sd [mg]", "acc x [g]"), {}, "columns 'ax [g]', 'acc x [g]' are all "
                            "taken for ax: say which it is, for example by --column 'ax [g]=ax'"),
    "a face nobody knows": (FACES, {}, "row 3, column 'side' is 'sideways': write the axis that points up"),
    "half a quaternion": (QUATERNIONS, {}, "row 3, column 'qx, qy, qz, qw' is '0, 0, 1, 1': its length is 1.41"),
    "samples": (SAMPLES, {}, "its 100 rows are samples, 0.01 s apart, and no table with a row a dwell"),
    "an empty file": ("", {}, "has no table: write a header and a row for each orientation"),
    "a header alone": (HEADER, {}, "has a header and no rows"),
    "zeros": (b"\0\1\2\3" * 100, {}, "is no text (it has bytes of zero)"),
    "no Excel file": (b"PK\x03\x04garbage", {}, "is no Excel file that can be read"),
    "a column that is not there": (PLAIN, {"columns": {"acc": "ax"}},
                                   "has no column 'acc' (--column), it has 'time [s]'"),
    "a name nobody knows": (PLAIN, {"columns": {"count": "foo"}}, "--column count=foo: 'foo' is not known: use ax_g"),
    "another unit": (PLAIN, {"accel_unit": "mg"}, "column 'ax [g]' is in g by its name, and --accel-unit is mg"),
    "a g of its own": (PLAIN, {"g_unit": "1"}, "--g-unit is '1': give m/s^2 from 9 to 10"),
    "no gravity": (PLAIN, {"overrides": {"axes": "z x"}}, "neither gravity nor latitude is stated"),
    "no axes": (PLAIN, {"overrides": {"gravity_mps2": "9.81"}}, "the gimbal axes are not stated"),
}  # fmt: skip


@pytest.mark.parametrize("what", BROKEN)
def test_a_broken_table_is_one_sentence(what: str, tmp_path: Path) -> None:
    content, options, expected = BROKEN[what]
    if what == "no Excel file":
        pytest.importorskip("openpyxl", reason="openpyxl is not there")
    path = tmp_path / "table.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.replace("face,", "side,").encode())
    with pytest.raises(InputError) as caught:
        kf_calib.open_table(path, **{"overrides": BENCH, **options})
    said = str(caught.value)
    assert expected in said
    assert "\n" not in said and said.endswith(".") and len(said) < 600


def test_the_plain_table_is_sound(tmp_path: Path) -> None:
    (tmp_path / "table.csv").write_text(PLAIN)
    assert len(kf_calib.calibrate(kf_calib.open_table(tmp_path / "table.csv", BENCH)).visits) == 6


@pytest.mark.parametrize("suffix", [".xls", ".ods"])
def test_old_spreadsheets_are_to_be_saved_again(suffix: str, tmp_path: Path) -> None:
    (tmp_path / f"table{suffix}").write_bytes(b"\xd0\xcf\x11\xe0")
    with pytest.raises(InputError, match=r"save it as \.xlsx or \.csv"):
        kf_calib.open_table(tmp_path / f"table{suffix}", BENCH)


def test_excel_without_its_package_says_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "table.xlsx").write_bytes(b"PK\x03\x04")
    monkeypatch.setattr("kf_calib.errors.find_spec", lambda _: None)
    with pytest.raises(KfCalibError, match=r"needs openpyxl, which is not installed: pip install 'kf_calib\[tables\]'"):
        kf_calib.open_table(tmp_path / "table.xlsx", BENCH)


def test_what_is_no_table_at_all_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="has no names of columns"):
        kf_calib.open_table([[1, 2], [3, 4]], BENCH)
    with pytest.raises(InputError, match="cannot be read"):
        kf_calib.open_table(tmp_path / "absent.csv", BENCH)
