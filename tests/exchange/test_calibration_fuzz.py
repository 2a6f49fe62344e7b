"""Calibration files with anything in them changed: refused in a sentence, or used as the file it was made from is.

Whatever a mutation changes, no number that is printed may differ from the one that is applied.
"""

import copy
import csv
import json
import math
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.bounded import bounded
from helpers.calibrations import simulated
from helpers.long_runs import slow

import kf_calib
from kf_calib.certificate.budget import certificate
from kf_calib.certificate.statement import Statement
from kf_calib.errors import KfCalibError
from kf_calib.exchange import calibration_file
from kf_calib.exports import TARGETS, exported

VALUES = [None, True, -1, 0, 1, 2**70, -0.0, 1e-300, 1e300, 0.5, "", "x", "\n#", "=1", "fx*T", "second-order", [], {},
          [0.0]]  # fmt: skip


@pytest.fixture(scope="module")
def plain() -> dict[str, Any]:
    settings = kf_calib.Settings(effects=("second-order", "warm-up", "mine = fx*fy"))
    return calibration_file.saved(kf_calib.calibrate(simulated(0, 14), settings), "run.mcap").model_dump(mode="json")


def places(content: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths to all that is in the content."""
    items = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    return [place for key, value in items for place in [(*path, key), *places(value, (*path, key))]]


def changed(content: dict[str, Any], rng: random.Random) -> Any:
    """Some values replaced, scaled, removed, doubled or exchanged, numbers outside the covariance above all."""
    made = copy.deepcopy(content)
    for _ in range(rng.choice([1, 1, 1, 2, 4])):
        every = places(made)
        few = [place for place in every if "covariance" not in place and "not_seen" not in place]
        *way, key = rng.choice(few if rng.random() < 0.9 else every)
        parent: Any = made
        for step in way:
            parent = parent[step]
        value, kind = parent[key], rng.randrange(5)
        if kind == 0 and isinstance(value, float):
            parent[key] = value * rng.choice([-1.0, 0.0, 1.0 + 1e-6, 2.0, 1e9, -1e-9])
        elif kind == 1:
            del parent[key]
        elif kind == 2 and isinstance(value, list):
            value.extend(copy.deepcopy(value[: rng.choice([1, 3])]))
        elif kind == 3 and isinstance(parent, list):
            other = rng.randrange(len(parent))
            parent[key], parent[other] = parent[other], parent[key]
        else:
            parent[key] = rng.choice(VALUES)
    return made


def used(path: Path) -> None:
    """All that commands do with a file, and that what they say of it agrees."""
    saved = kf_calib.open_calibration(path)
    model, correction = saved.model(path), saved.correction(path)
    with np.errstate(all="ignore"):
        correction.corrected(np.array([[0.1, 9.8, -0.1], [5.0, 5.0, 7.0]]), 25.0)
        for to in TARGETS:
            text = exported(saved, correction, to, lossy=True).text()
            assert "\r" not in text.removesuffix("\r\n") and not any(
                line[:1] in "=@" for line in text.splitlines() if line
            )
    table = {row[0]: row[1:] for row in csv.reader(exported(saved, correction, "csv").text().splitlines()[1:])}
    applied = np.linalg.inv([[float(table[f"C{i}{j}"][0]) for j in (1, 2, 3)] for i in (1, 2, 3)])
    assert [float(table[f"K{i}"][0]) for i in (1, 2, 3)] == pytest.approx(np.linalg.norm(applied, axis=1), rel=1e-6)
    for part in model.coefficients:
        value, k = table[part.symbol][0], saved.state.symbols.index(part.symbol)
        if value and part.symbol not in ("tauWarm",):
            assert float(value) == pytest.approx(saved.state.values[k], rel=1e-8)
            assert float(table[part.symbol][1]) == pytest.approx(math.sqrt(saved.state.covariance[k][k]), rel=1e-5)
    made = certificate(saved, model, Statement())
    assert all(each.standard is None or each.standard > 0.0 for each in made.results)


@pytest.mark.parametrize("cases", [20, *slow(2000)])
def test_changed_files_are_refused_in_a_sentence_or_agree_with_themselves(
    plain: dict[str, Any], cases: int, tmp_path: Path
) -> None:
    rng, path, accepted = random.Random(3), tmp_path / "cal.json", 0
    for _ in range(cases):
        text = json.dumps(changed(plain, rng))
        if rng.random() < 0.1:
            at = rng.randrange(len(text))
            text = text[:at] + rng.choice(["", "9", "-", '"', "{", "\\u0000", "1e999", "NaN"]) + text[at + 1 :]
        path.write_text(text)
        with bounded(seconds=10.0):
            try:
                used(path)
                accepted += 1
            except KfCalibError as error:
                assert "\n" not in str(error) and len(str(error)) < 1500
    assert 0.02 * cases < accepted < 0.6 * cases
