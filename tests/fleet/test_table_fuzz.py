"""Tables of fleets with anything in them changed: read, passed over or refused in a sentence, and no number is wrong.

What damage does to the bytes of Parquet is seen by its checksums; what somebody else writes has none that are wrong.
"""

import copy
import random
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from helpers.bounded import bounded
from helpers.damage import damaged
from helpers.fleet_overviews import BEGIN, rows_of
from helpers.long_runs import slow
from helpers.paths import ROOT
from helpers.run_factors import run_factor_of

import kf_calib
from kf_calib.errors import KfCalibError
from kf_calib.fleet.run_list import SCHEMA, Row, of_factor
from kf_calib.fleet.store import Store

RUNS = 12
NAME = "runs-00000000000000000001-1"
VALUES = [None, None, -1, 0, 1, 2**31 - 1, 0.5, -1e-300, 1e300, float("nan"), float("inf"), True, "", "x\n", "x" * 5000,
          [], [None], {}, datetime(1, 1, 1, tzinfo=UTC), datetime(9999, 12, 31, tzinfo=UTC)]  # fmt: skip


@cache
def rows() -> list[Row]:
    """Rows of six units that were measured twice each, as a fleet writes them."""
    empty, factors = dict.fromkeys(SCHEMA.names), [run_factor_of(k, date=_date(k)) for k in range(RUNS)]
    common = {"version": "1", "settings": "{}", "sha256": "0" * 64, "verdict": "consistent", "warnings": ["w"],
              "samples": 5, "dwells": 6, "orientations": 6, "model": [], "replay": "{}", "diagnosis": "{}"}  # fmt: skip
    return [
        empty | row | common | of_factor(factor) | {"evaluated": BEGIN + timedelta(seconds=k)}
        for k, (row, factor) in enumerate(zip(rows_of(RUNS // 2), factors, strict=True))
    ]


def _date(number: int) -> str:
    return (BEGIN + timedelta(weeks=number)).isoformat()


@cache
def plain(kind: str) -> bytes:
    """The table as the program writes it: a file of Parquet, or a small one of Arrow."""
    return written(rows(), kind)


def written(own: list[Row], kind: str) -> bytes:
    table, sink = pa.Table.from_pylist(own, SCHEMA), pa.BufferOutputStream()
    if kind == "parquet":
        pq.write_table(table, sink, compression="zstd", write_page_checksum=True)
    else:
        with pa.ipc.new_file(sink, SCHEMA) as file:
            file.write_table(table)
    return sink.getvalue().to_pybytes()


def bent(content: bytes, rng: random.Random) -> bytes:
    """A damaged file, at its end above all."""
    scraps = [byte * size for byte in (b"\x00", b"\xff", b"\x7f") for size in (1, 4, 40)]
    place = lambda n: rng.randrange(n) if rng.random() < 0.6 else n - 1 - rng.randrange(min(n, 9000))  # noqa: E731
    return damaged(content, rng, scraps, place)


def renamed(content: bytes) -> bytes:
    """The bytes of a file with a letter changed in the name of the program that wrote it: that harms nothing."""
    assert content.count(b"parquet-cpp") == 1
    return content.replace(b"parquet-cpp", b"parquet-cPp")


def rewritten(rng: random.Random) -> bytes:
    """A whole file with other values in some cells, as somebody else might write it."""
    while True:
        own = copy.deepcopy(rows())
        for _ in range(rng.choice([1, 1, 2, 5])):
            _replace(rng.choice(own), rng)
        try:
            return written(own, "parquet")
        except (pa.ArrowException, OverflowError, TypeError, ValueError):
            continue  # no column can hold such a value


def _replace(parent: Any, rng: random.Random) -> None:
    """Replace a value at any depth, or remove some of a list."""
    while True:
        keys = list(parent) if isinstance(parent, dict) else range(len(parent))
        key = rng.choice(["factor", *keys]) if "factor" in keys else rng.choice(keys)
        value = parent[key] = parent[key].tolist() if isinstance(parent[key], np.ndarray) else parent[key]
        if not (isinstance(value, dict | list) and value) or rng.random() < 0.3:
            break
        parent = value
    parent[key] = value[: rng.randrange(len(value))] if isinstance(value, list) and value else rng.choice(VALUES)


def used(folder: Path) -> dict[str, np.ndarray]:
    """Do all that a fleet does with its table; return the factors that it takes for whole."""
    fleet = kf_calib.open_fleet(folder)
    assert str(fleet) and fleet.rows().num_rows <= len(fleet) <= 2 * RUNS
    assert len(fleet.failures()) + fleet.parameters(["b1"]).num_rows <= 4 * RUNS
    factors = {factor.run: factor.factor for factor in fleet.factors()}
    fleet.overview()
    Store(folder).checked()
    Store(folder).compact()
    return factors


def case(content: bytes, kind: str, folder: Path) -> dict[str, np.ndarray] | None:
    """Use a table of these bytes, within limits; None where it is refused."""
    for file in (folder / "runs").glob("*"):
        file.unlink()
    (folder / "runs").mkdir(parents=True, exist_ok=True)
    (folder / "runs" / f"{NAME}.{kind}").write_bytes(content)
    with bounded():
        try:
            return used(folder)
        except KfCalibError as error:
            assert "\n" not in str(error) and len(str(error)) < 1500
    return None


@pytest.mark.parametrize("cases", [15, *slow(1000)])
def test_damaged_tables_are_refused_in_a_sentence_or_read_as_they_were(cases: int, tmp_path: Path) -> None:
    rng, whole, read = random.Random(1), {row["run"]: row["factor"]["upper"] for row in rows()}, 0
    for content in (renamed(plain("parquet")), *(bent(plain("parquet"), rng) for _ in range(cases))):
        factors = case(content, "parquet", tmp_path)
        for run, factor in (factors or {}).items():
            np.testing.assert_array_equal(factor[np.triu_indices(len(factor))], whole[run])
        read += factors is not None
    assert 0 < read < 0.5 * cases  # the first one, and some five in a hundred of the others, harm nothing


@pytest.mark.parametrize("cases", [8, *slow(1000)])
def test_tables_that_somebody_else_wrote_are_read_or_refused_in_a_sentence(cases: int, tmp_path: Path) -> None:
    rng, lengths = random.Random(2), list[int]()
    for _ in range(cases):
        factors = case(rewritten(rng), "parquet", tmp_path)
        lengths += [] if factors is None else [len(factors)]
    assert 0.5 * cases < len(lengths) and RUNS in lengths and RUNS - 1 in lengths


@pytest.mark.parametrize("cases", [8, *slow(1000)])
def test_damaged_small_files_are_refused_in_a_sentence_or_read(cases: int, tmp_path: Path) -> None:
    """In a process of its own: what Arrow does not expect there ends the process."""
    words = [sys.executable, "-W", "error", "-c", _SMALL_FILES, str(tmp_path), str(cases)]
    done = subprocess.run(words, cwd=ROOT / "tests", capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr
    assert 0 < int(done.stdout) < cases


_SMALL_FILES = """
import random, sys
from pathlib import Path
from fleet.test_table_fuzz import bent, case, plain
rng = random.Random(3)
print(sum(case(bent(plain("arrow"), rng), "arrow", Path(sys.argv[1])) is not None for _ in range(int(sys.argv[2]))))
"""
