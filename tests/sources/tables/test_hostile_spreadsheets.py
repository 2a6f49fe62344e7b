"""Excel files that no program writes: nothing is lost in silence, and none takes long, fills the memory or crashes."""

import io
import random
import re
import warnings
import zipfile
from collections.abc import Callable
from contextlib import closing
from datetime import datetime, time, timedelta
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import openpyxl
import pytest
from helpers.bounded import bounded
from helpers.damage import damaged
from helpers.long_runs import slow
from helpers.paths import ROOT

import kf_calib
from kf_calib.bench.streams import Table
from kf_calib.errors import InputError, KfCalibError
from kf_calib.sources.file_kind import FileKind
from kf_calib.sources.opening import kind_of
from kf_calib.sources.text.names import meaning_of
from kf_calib.sources.text.spreadsheet import sheets_of

HEADER = ["time [s]", "outer [deg]", "inner [deg]", "ax [g]", "ay [g]", "az [g]"]
ROWS = [[0, 0, 0, 0.003, 1.001, -0.002], [60, 90, 0, 1.002, 0.002, 0.001], [120, 180, 0, -0.001, -0.999, 0.004],
        [180, 270, 0, -0.998, 0.001, 0.002], [240, 0, 90, 0.002, 0.004, -1.003],
        [300, 0, 270, -0.001, 0.001, 0.997]]  # fmt: skip
SHEET, STYLES = "xl/worksheets/sheet1.xml", "xl/styles.xml"
Change = Callable[[bytes], bytes]


@cache
def plain() -> bytes:
    book, file = openpyxl.Workbook(), io.BytesIO()
    for row in [HEADER, *ROWS]:
        book.active.append(row)
    book.save(file)
    return file.getvalue()


def changed(part: str, change: Change) -> bytes:
    """The plain file with one of its parts changed."""
    made = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(plain())) as old, zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            content = old.read(name)
            after = change(content) if name == part else content
            assert name != part or after != content
            new.writestr(name, after)
    return made.getvalue()


def put(old: bytes, new: bytes) -> Change:
    return lambda content: content.replace(old, new)


def at_the_end(rows: bytes) -> Change:
    return put(b"</sheetData>", rows + b"</sheetData>")


def table_of(content: bytes, path: Path) -> Table:
    path.write_bytes(content)
    return kf_calib.open_table(path, {"axes": "z x", "gravity_mps2": "9.81"})


@pytest.mark.parametrize("stated", [b"A1:D6", b"A1", b"A1:XFD1048576", b"B3:C4"])
def test_what_a_file_says_of_its_size_is_not_believed(stated: bytes, tmp_path: Path) -> None:
    with bounded():
        table = table_of(changed(SHEET, put(b'ref="A1:F7"', b'ref="' + stated + b'"')), tmp_path / "t.xlsx")
    angles_deg = np.degrees([dwell.pose for dwell in table.orientations])
    np.testing.assert_allclose(angles_deg, [row[1:3] for row in ROWS])


def test_an_empty_cell_in_the_last_row_and_column_is_passed_over(tmp_path: Path) -> None:
    with bounded():
        table = table_of(changed(SHEET, at_the_end(b'<row r="1048576"><c r="XFD1048576"/></row>')), tmp_path / "t.xlsx")
    assert len(table.orientations) == len(ROWS)


def test_a_hidden_sheet_is_not_read(tmp_path: Path) -> None:
    book, path = openpyxl.Workbook(), tmp_path / "t.xlsx"
    for row in [HEADER, *ROWS[:4]]:
        book.active.append(row)
    book.active.sheet_state = "hidden"
    shown = book.create_sheet("measured")
    for row in [HEADER, *ROWS]:
        shown.append(row)
    book.active = 1
    book.save(path)
    table = table_of(path.read_bytes(), path)
    assert len(table.orientations) == len(ROWS) and any(
        "'Sheet' was not read, as it is hidden" in w for w in table.warnings
    )
    shown.delete_rows(1, 99)
    book.save(path)
    with pytest.raises(InputError, match="all sheets that can be seen \\('Sheet' is hidden\\) are empty"):
        table_of(path.read_bytes(), path)


HOSTILE: dict[str, tuple[Callable[[], bytes], str]] = {
    "a row beyond the last": (lambda: changed(SHEET, at_the_end(b'<row r="2000000000"><c r="A2000000000"/></row>')),
                              "more cells than any table"),
    "wide empty rows": (lambda: changed(SHEET, at_the_end(b"".join(b'<row r="%d"><c r="XFD%d"/></row>' % (k, k)
                                                                   for k in range(100, 5000)))), "more cells than any"),
    "rows out of order": (lambda: changed(SHEET, put(b'r="7"', b'r="2"')), "rows that are out of order"),
    "a gigabyte of spaces": (lambda: changed(SHEET, at_the_end(b" " * 65_000_000)), "unpacks to more than any table"),
    "millions of cells": (lambda: changed(SHEET, at_the_end(b"<row>" + b"<c/>" * 700_000 + b"</row>")),
                          "more cells than any table"),
    "entities": (lambda: changed(SHEET, lambda xml: b'<!DOCTYPE x [<!ENTITY a "1">]>' + xml), "declares entities"),
    "a number format without end": (
        lambda: changed(STYLES, put(b"<cellXfs", b'<numFmts><numFmt numFmtId="170" formatCode="' + b"[" * 200_000
                                    + b'"/></numFmts><cellXfs')), "a number format longer than Excel allows"),
    "200 kB of spaces in a cell": (
        lambda: changed(SHEET, at_the_end(b'<row r="8"><c r="A8" t="str"><v>1' + b" " * 200_000 + b"x</v></c></row>")),
        "row 8, column 'time [s]' is '1  "),
    "broken XML": (lambda: changed(SHEET, put(b"</sheetData>", b"")), "is no Excel file that can be read"),
    "a half file": (lambda: plain()[: len(plain()) // 2], "is no Excel file that can be read"),
}  # fmt: skip


@pytest.mark.parametrize("kind", HOSTILE)
def test_what_no_program_writes_is_refused_in_a_sentence(kind: str, tmp_path: Path) -> None:
    make, says = HOSTILE[kind]
    content = make()
    with bounded(), pytest.raises(InputError) as error:
        table_of(content, tmp_path / "t.xlsx")
    assert says in str(error.value) and "\n" not in str(error.value) and str(error.value).endswith((".", "]"))


@pytest.mark.parametrize("cell", ["1" + " " * 200_000 + "x", "(" * 200_000, "a" + " (" * 100_000, "+" * 200_000])
def test_a_long_cell_of_text_takes_no_time(cell: str, tmp_path: Path) -> None:
    text = "\n".join(",".join(map(str, row)) for row in [[*HEADER, "note"], *([*row, 0] for row in ROWS)])
    for number, broken in enumerate([text.replace("60,90", f"{cell},90"), text.replace("note", cell)]):
        path = tmp_path / f"{number}.csv"
        path.write_text(broken)
        with bounded(seconds=5.0):
            try:
                kf_calib.open_table(path, {"axes": "z x", "gravity_mps2": "9.81"})
            except InputError as error:
                assert len(str(error)) < 1500


@pytest.mark.parametrize("name", ["(" * 100_000, "a" + " " * 100_000 + "[g", "x" * 100_000, "a," * 50_000])
def test_a_log_with_a_long_name_takes_no_time(name: str, tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    rows = "".join(f"{k / 100},0,9.81,0,0,1\n" for k in range(2000))
    path.write_text(f'time_s,ax_mps2,ay_mps2,az_mps2,outer_deg,"{name}"\n{rows}')
    with bounded(seconds=5.0):
        assert kind_of(path) in FileKind
        assert meaning_of(name).ours == ""


@pytest.mark.slow
def test_a_table_of_a_wide_header_and_many_rows_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text(",".join(f"c{k}" for k in range(200_000)) + "\n" + "1\n" * 1_000_000)
    with bounded(), pytest.raises(InputError, match="has 200000 columns and 1000000 rows, more than any table"):
        kf_calib.open_table(path, {})


SCRAPS = [b"-", b"9" * 9, b"<", b">", b'"', b"&x;", b"\0", b"e99", b"1E400"]


def mutated(rng: random.Random) -> bytes:
    """The plain file, or one of its parts, damaged."""
    if rng.random() < 0.3:
        return damaged(plain(), rng, SCRAPS)
    with zipfile.ZipFile(io.BytesIO(plain())) as archive:
        part = rng.choice([SHEET, SHEET, "xl/sharedStrings.xml", STYLES, *archive.namelist()])
    return changed(part, lambda content: damaged(content, rng, SCRAPS) + b" ")


@pytest.mark.parametrize("cases", [50, *slow(2000)])
def test_mutated_files_are_read_or_refused_in_a_sentence(cases: int, tmp_path: Path) -> None:
    rng, read = random.Random(7), 0
    for _ in range(cases):
        content = mutated(rng)
        with bounded(seconds=20.0):
            try:
                table_of(content, tmp_path / "t.xlsx")
                read += 1
            except KfCalibError as error:
                assert "\n" not in str(error) and len(str(error)) < 1500
    assert 0.1 * cases < read < 0.9 * cases


def test_a_hidden_row_is_not_read(tmp_path: Path) -> None:
    """Nor is one that a filter hides; the warning names the rows of the sheet."""
    book = openpyxl.Workbook()
    book.active.append(["face", "ax [g]", "ay [g]", "az [g]"])
    for face, *reading in (("+x", 1, 0, 0), ("-x", -1, 0, 0), ("+y", 9, 9, 9), ("-y", 0, -1, 0), ("+z", 8, 8, 8)):
        book.active.append([face, *reading])
    for row in (4, 6, 9):  # the last is empty
        book.active.row_dimensions[row].hidden = True
    book.save(tmp_path / "table.xlsx")
    table = kf_calib.open_table(tmp_path / "table.xlsx", {"gravity_mps2": "9.80665"})
    assert [row.mean_mps2.tolist() for row in table.orientations] == [[9.80665, 0, 0], [-9.80665, 0, 0],
                                                                      [0, -9.80665, 0]]  # fmt: skip
    assert any("rows 4, 6 were not read, as hidden rows are no data" in said for said in table.warnings)


@pytest.mark.parametrize("merged, says", [
    (b"A9:XFD1048576", "has more merged cells than any table of orientations"),
    (b"D2:F3", "cell E2 is merged with others, so no reading can be written there"),
])  # fmt: skip
def test_merged_cells_end_no_copy(merged: bytes, says: str, run: Any, tmp_path: Path) -> None:
    """A table is read as it is; its copy with corrected readings would make every one of the cells."""
    calibration, path, out = tmp_path / "cal.json", tmp_path / "t.xlsx", tmp_path / "out.xlsx"
    merges = b'<mergeCells><mergeCell ref="' + merged + b'"/></mergeCells>'
    content = changed(SHEET, put(b"</sheetData>", b"</sheetData>" + merges))
    assert len(table_of(content, path).orientations) == len(ROWS)
    kf_calib.save_calibration(kf_calib.calibrate(ROOT / "recordings" / "mems_faces.mcap"), calibration)
    with bounded():
        err = run.refused("apply", calibration, path, "-o", out, "--axes", "z x", "--gravity", "9.81", "--unchecked")
    assert says in err and not out.exists()


def test_cells_are_what_openpyxl_makes_of_them(tmp_path: Path) -> None:
    """Shared texts and texts of a cell alone, dates, durations, formulas, empty cells and numbers of all kinds, with
    prefixes of names and without, and where neither rows nor cells say their places."""
    book, texts, path = openpyxl.Workbook(), ["face", "+x"], tmp_path / "t.xlsx"
    dates = [datetime(2026, 5, 4, 9, 30), datetime(1900, 2, 1), time(13, 45), timedelta(hours=30, minutes=5), 45000.25]
    for k, date in enumerate(dates):
        book.active.append([texts[k % 2], date, -1.5e-7 * k, 1234567890123456, 0, None, 9.80665])
    book.active.append(["+x & more", True])
    book.active.append([None, None, 1e300])
    book.active["H3"].font = openpyxl.styles.Font(bold=True)  # a cell with a style and no value
    book.active["B2"].value = 1e10  # no date of Excel
    file = io.BytesIO()
    book.save(file)
    with zipfile.ZipFile(file) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    alone = b'<c r="E1" t="inlineStr"><is><r><t>in two </t></r><r><t>fonts</t></r></is></c>'
    sheet = parts[SHEET].replace(b'<c r="E1" t="n"><v>0</v></c>', alone)
    sheet = sheet.replace(b"<v>0</v>", b'<f ca="1">SUM(A1:A2)</f><v>0</v>').replace(b"<v>9.80665<", b"<v>-0<", 1)
    prefixed = re.sub(rb"<(/?)(\w+)(?=[ />])", rb"<\1x:\2", sheet).replace(b"xmlns=", b"xmlns:x=")
    for changed_sheet in (sheet, prefixed, re.sub(rb' r="\w+"', b"", sheet)):
        with zipfile.ZipFile(path, "w") as archive:
            for name, content in parts.items():
                archive.writestr(name, changed_sheet if name == SHEET else content)
        told = openpyxl.load_workbook(path, read_only=True, data_only=True)
        with closing(told), warnings.catch_warnings(action="ignore"):  # of the date that is none
            rows = list(told.active.iter_rows(values_only=True))
        lines = [[None] * len(rows[0]) for _ in rows]
        for number, row in sheets_of(path)[0].lines:
            lines[number - 1][: len(row)] = row
        assert alone not in changed_sheet or lines[0][4] == "in two fonts"
        assert [[_plain(value) for value in row] for row in lines] == [[_plain(value) for value in row] for row in rows]


def _plain(value: Any) -> Any:
    return float(value) if type(value) is int else value
