"""One log and one table in every way of writing that people bring: both readers take each."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from kf_calib.errors import InputError
from kf_calib.sources.opening import opened
from kf_calib.sources.text.encoding import TextFile, encoding_of, unpacked

UP = [(0, 1, 0), (0, -1, 0), (1, 0, 0), (-1, 0, 0), (0, 0, 1), (0, 0, -1), (0.6, 0.8, 0), (0, 0.6, -0.8), (0.8, 0, 0.6)]
ENGLISH = ["time_s", "ax_mps2", "ay_mps2", "az_mps2"]
RUSSIAN = ["Время, с", "Ускорение X, м/с2", "Ускорение Y, м/с2", "Ускорение Z, м/с2"]
GERMAN = ["Zeit [s]", "Beschleunigung x [m/s²]", "Beschleunigung y [m/s²]", "Beschleunigung z [m/s²]"]
Rows = list[tuple[float, ...]]


def table() -> Rows:
    return [(60.0 * k, *(9.81 * np.array(up)).tolist()) for k, up in enumerate(UP)]


def log() -> Rows:
    rng, readings = np.random.default_rng(0), list[np.ndarray]()
    for up in UP:
        force = 9.81 * np.array(up)
        readings += [force + rng.normal(0.0, 1e-3, (300, 3)), force + rng.normal(0.0, 3.0, (60, 3))]
    return [(0.01 * k, *reading) for k, reading in enumerate(np.concatenate(readings).tolist())]


def text(rows: Rows, head: list[str] = ENGLISH, cell: str = ",", decimal: str = ".", above: str = "") -> str:
    lines = [cell.join(head), *(cell.join(f"{value:.5f}".replace(".", decimal) for value in row) for row in rows)]
    return above + "\n".join(lines) + "\n"


WAYS: dict[str, Callable[[Rows], bytes]] = {
    "utf-8": lambda rows: text(rows).encode(),
    "mark": lambda rows: text(rows).encode("utf-8-sig"),
    "utf-16": lambda rows: text(rows).encode("utf-16"),
    "utf-16-le without a mark": lambda rows: text(rows).encode("utf-16-le"),
    "utf-16-be without a mark": lambda rows: text(rows).encode("utf-16-be"),
    "cp1251": lambda rows: text(rows, RUSSIAN, ";").encode("cp1251"),
    "cp1252": lambda rows: text(rows, GERMAN, ";", ",").encode("cp1252"),
    "gzip": lambda rows: gzip.compress(text(rows).encode()),
    "gzip of cp1251": lambda rows: gzip.compress(text(rows, RUSSIAN, ";").encode("cp1251")),
    "CR": lambda rows: text(rows).replace("\n", "\r").encode(),
    "CR LF": lambda rows: text(rows).replace("\n", "\r\n").encode(),
    "zeros at the end": lambda rows: text(rows).encode() + b"\0" * 1000,
    "minus sign": lambda rows: text(rows).replace("-", "\u2212").encode(),
    "title": lambda rows: text(rows, above="Run 7\n2026-05-04\n").encode(),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(("rows", "readings"), [(table, len(UP)), (log, 360 * len(UP))])
def test_a_table_and_a_log_are_read_in_each_way(
    way: str, rows: Callable[[], Rows], readings: int, tmp_path: Path
) -> None:
    path = tmp_path / "written.csv"
    path.write_bytes(WAYS[way](rows()))
    source = opened(path, {"gravity_mps2": "9.81"}, angles=False)
    if rows is table:
        assert type(source).__name__ == "Table" and len(source.orientations) == readings  # type: ignore[attr-defined]
        return
    found = np.concatenate([batch.accel.values for batch in source])
    np.testing.assert_allclose(found, np.array(log())[:, 1:], atol=1e-5)


def test_a_long_log_with_one_letter_late_is_utf_8(tmp_path: Path) -> None:
    """The first 64 KiB decide, and a character that they cut in two is none of another encoding."""
    path = tmp_path / "cut.txt"
    content = ("x" * ((1 << 16) - 1) + "é" + "\n") * 2
    path.write_text(content, encoding="utf-8")
    with TextFile(path) as file:
        assert b"".join(iter(lambda: file.read(1 << 14), b"")).decode() == content


def test_zeros_amid_a_table_are_told(tmp_path: Path) -> None:
    path = tmp_path / "hole.csv"
    path.write_bytes(text(table()).encode().replace(b"\n120", b"\n" + b"\0" * 64 + b"120"))
    with pytest.raises(InputError, match="is no text"):
        opened(path, {"gravity_mps2": "9.81"}, angles=False)


@pytest.mark.parametrize(
    ("content", "encoding"),
    [(b"", "utf-8"), (b"a", "utf-8"), ("ä".encode(), "utf-8"), ("ä b".encode("cp1252"), "cp1252"),
     ("привет".encode("cp1251"), "cp1251"), ("ab".encode("utf-16-le"), "utf-16-le")],
)  # fmt: skip
def test_the_encoding_is_told_by_the_beginning(content: bytes, encoding: str) -> None:
    assert encoding_of(content) == encoding


def test_a_packed_file_without_its_end_is_told(tmp_path: Path) -> None:
    path = tmp_path / "cut.csv.gz"
    path.write_bytes(gzip.compress(text(table()).encode())[:-20])
    with pytest.raises(InputError, match=r"its end cannot be unpacked .*: copy it anew"):
        unpacked(path)
