"""One log and one table, written in every usual way: both are read, and alike."""

import gzip
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from kf_calib.bench.streams import Table
from kf_calib.errors import InputError
from kf_calib.sources.opening import opened
from kf_calib.sources.text.encoding import Cutter, TextFile, encoding_of
from kf_calib.sources.text.heading import TextHeading

UP = np.array([(0, 1, 0), (0, -1, 0), (1, 0, 0), (-1, 0, 0), (0, 0, 1), (0, 0, -1),
               (0.6, 0.8, 0), (0, 0.6, 0.8), (-0.8, 0, -0.6)])  # fmt: skip
MEANS = 9.81 * UP
TIMES = 60.0 * np.arange(len(UP))
ENGLISH = ("time_s", "ax_mps2", "ay_mps2", "az_mps2")
RUSSIAN = ("Время, с", "Ускорение X, м/с2", "Ускорение Y, м/с2", "Ускорение Z, м/с2")
GERMAN = ("Zeit [s]", "Beschleunigung x [m/s²]", "Beschleunigung y [m/s²]", "Beschleunigung z [m/s²]")
Rows = Sequence[Sequence[float]]


def log() -> Rows:
    """Three seconds of rest in each pose, and more than half a second of motion behind each."""
    rng = np.random.default_rng(1)
    forces = [rng.normal(mean, sigma, (count, 3)) for mean in MEANS for count, sigma in ((300, 1e-3), (60, 3.0))]
    return [(0.01 * k, *map(float, force)) for k, force in enumerate(np.concatenate(forces))]


def table() -> Rows:
    return [(float(t), *map(float, mean)) for t, mean in zip(TIMES, MEANS, strict=True)]


def text(rows: Rows, names: Sequence[str] = ENGLISH, between: str = ",", point: str = ".", before: str = "") -> str:
    lines = [between.join(f"{value:.5f}".replace(".", point) for value in row) for row in rows]
    return before + "\n".join([between.join(names), *lines, ""])


WAYS: dict[str, Callable[[Rows], bytes]] = {
    "UTF-8": lambda rows: text(rows).encode(),
    "a byte-order mark": lambda rows: text(rows).encode("utf-8-sig"),
    "UTF-16": lambda rows: text(rows).encode("utf-16"),
    "UTF-16 without a mark": lambda rows: text(rows).encode("utf-16-le"),
    "UTF-16, the other way round": lambda rows: text(rows).encode("utf-16-be"),
    "German in 1252": lambda rows: text(rows, GERMAN, ";", ",").encode("cp1252"),
    "Russian": lambda rows: text(rows, RUSSIAN, ";").encode(),
    "Russian in 1251": lambda rows: text(rows, RUSSIAN, ";").encode("cp1251"),
    "packed": lambda rows: gzip.compress(text(rows).encode()),
    "packed UTF-16": lambda rows: gzip.compress(text(rows).encode("utf-16")),
    "packed Russian in 1251": lambda rows: gzip.compress(text(rows, RUSSIAN, ";").encode("cp1251")),
    "a comment": lambda rows: text(rows, before="# my logger\n").encode(),
    "a comment of another kind": lambda rows: text(rows, before="% a, comment, with, commas\n").encode(),
    "names in a comment": lambda rows: text(rows, before="#").encode(),
    "names in a comment, blanks": lambda rows: text(rows, between=" ", before="# ").encode(),
    "titles": lambda rows: text(rows, before="Run 7\n2026-05-04\n").encode(),
    "sep": lambda rows: text(rows, between=";", before="sep=;\n").encode(),
    "units": lambda rows: text(rows, ("time", "ax", "ay", "az\ns,m/s^2,m/s^2,m/s^2")).encode(),
    "decimal comma": lambda rows: text(rows, between=";", point=",").encode(),
    "tabs": lambda rows: text(rows, between="\t").encode(),
    "pipes": lambda rows: text(rows, between="|").encode(),
    "blanks": lambda rows: text(rows, between=" ").encode(),
    "columns of blanks": lambda rows: text(rows, between="   ").encode(),
    "a delimiter at the end": lambda rows: text(rows).replace("\n", ",\n").encode(),
    "a delimiter at the end of the names alone": lambda rows: text(rows).replace("\n", ",\n", 1).encode(),
    "two at the end": lambda rows: text(rows, between=";", point=",").replace("\n", ";;\n").encode(),
    "quotes": lambda rows: text(rows, [f'"{name}"' for name in ENGLISH]).encode(),
    "decimal commas in quotes": lambda rows: "\n".join(
        f'"{line}"' for line in text(rows, between='","', point=",").splitlines()).encode(),
    "tabs and decimal commas": lambda rows: text(rows, between="\t", point=",").encode(),
    "blanks about commas": lambda rows: text(rows, between=" , ").encode(),
    "CR": lambda rows: text(rows).replace("\n", "\r").encode(),
    "CRLF": lambda rows: text(rows).replace("\n", "\r\n").encode(),
    "empty lines": lambda rows: text(rows).replace("\n", "\n\n").encode(),
    "typographic minus": lambda rows: text(rows).replace("-", "\u2212").encode(),
    "zeros at the end": lambda rows: text(rows).encode() + bytes(10),
}  # fmt: skip


@pytest.mark.parametrize("way", WAYS)
def test_a_log_and_a_table_are_read_however_they_are_written(way: str, tmp_path: Path) -> None:
    bench = {"gravity_mps2": "9.81"}
    for rows in (log(), table()):
        path = tmp_path / f"{len(rows)}.csv"
        path.write_bytes(WAYS[way](rows))
        source = opened(path, bench, angles=False)
        if isinstance(source, Table):
            values = source.orientations.mean_mps2
        else:
            values = np.concatenate([batch.accel.values for batch in source])
        assert isinstance(source, Table) == (len(rows) == len(UP))
        np.testing.assert_allclose(values, [row[1:] for row in rows], atol=1e-5)


@pytest.mark.parametrize("end", [b"\n", b"\r", b"\r\n"])
def test_lines_are_the_same_wherever_blocks_end(end: bytes) -> None:
    content = end.join([b"time_s,x", b"1,2", b"", "µ,4".encode(), b"5,6", b""])
    for size in range(1, len(content)):
        cutter, lines = Cutter(lambda *_: None), list[str]()
        for k in range(0, len(content), size):
            lines += cutter.push(content[k : k + size])
        assert [line for line in [*lines, *cutter.rest()] if line] == ["time_s,x", "1,2", "µ,4", "5,6"]


def test_a_letter_that_a_block_ends_in_is_no_other_encoding(tmp_path: Path) -> None:
    """Nor one that the first 64 KiB, which decide, cut in two."""
    content = "Größe µ".encode()
    assert {encoding_of(content[:k]) for k in range(len(content) + 1)} == {"utf-8"}
    path, long = tmp_path / "cut.txt", ("x" * ((1 << 16) - 1) + "é" + "\n") * 2
    path.write_text(long, encoding="utf-8")
    with TextFile(path) as file:
        assert b"".join(iter(lambda: file.read(1 << 14), b"")).decode() == long


@pytest.mark.parametrize(
    ("content", "encoding"),
    [(b"a", "utf-8"), ("ä b".encode("cp1252"), "cp1252"), ("привет".encode("cp1251"), "cp1251"),
     ("ab".encode("utf-16-le"), "utf-16-le")],
)  # fmt: skip
def test_the_encoding_is_told_by_the_beginning(content: bytes, encoding: str) -> None:
    assert encoding_of(content) == encoding


def test_zeros_amid_a_table_are_told(tmp_path: Path) -> None:
    path = tmp_path / "hole.csv"
    path.write_bytes(text(table()).encode().replace(b"\n120", b"\n" + bytes(64) + b"120"))
    with pytest.raises(InputError, match="is no text"):
        opened(path, {"gravity_mps2": "9.81"}, angles=False)


def test_a_table_that_is_packed_and_torn_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "table.csv.gz"
    path.write_bytes(gzip.compress(text(table()).encode())[:-12])
    with pytest.raises(InputError, match=r"its end cannot be unpacked .*: copy it anew\."):
        opened(path, {"gravity_mps2": "9.81"}, angles=False)


@pytest.mark.parametrize(("lines", "header"), [
    (["# t,ax,ay,az", "0,1,2,9.8"], ["t", "ax", "ay", "az"]),
    (["#", "# face,x,y,z", "+x,1.0,2,9.8"], ["face", "x", "y", "z"]),
    (["# made on 4 May, by me, with care, twice", "t,ax,ay,az", "0,1,2,9.8"], ["t", "ax", "ay", "az"]),
    (["# of 4 May", "0,1,2,9.8"], ["column 1", "column 2", "column 3", "column 4"]),
    (["0.1 0.2 9.8", "9.8 0.1 0.2"], ["column 1", "column 2", "column 3"]),
    (["2026-05-04 12:00:01.5,1,2,9.8"], ["column 1", "column 2", "column 3", "column 4"]),
    (["face,1,2,3", "+x,0.1,9.8,0"], ["face", "1", "2", "3"]),
    (["0,1,2", "0.1,9.8,0"], ["0", "1", "2"]),
])  # fmt: skip
def test_names_stand_in_the_first_line_or_in_the_comment_before_it(lines: list[str], header: list[str]) -> None:
    assert TextHeading.of(lines).header == header
