"""A calibration from elsewhere of a unit among the runs: which files are taken, and what is said of the others."""

import json
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from helpers.paths import ROOT

import kf_calib
from kf_calib.errors import InputError
from kf_calib.fleet.run_factor import ReferenceUnit
from kf_calib.fleet.store import Store


@pytest.fixture(scope="module")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    recording = ROOT / "recordings" / "navigation_24.mcap"
    path = tmp_path_factory.mktemp("reference") / "cal.json"
    kf_calib.save_calibration(kf_calib.calibrate(recording), path, recording)
    return json.loads(path.read_text())


def without_serial(content: dict[str, Any]) -> None:
    content["provenance"]["bench"].pop("block_serial", None)


def without_scale(content: dict[str, Any]) -> None:
    content["provenance"]["bench"]["block_serial"] = "A"
    content["parameters"][2] |= {"value": None, "sigma": None}
    content["state"]["undetermined"] = ["K1"]


def without_format(content: dict[str, Any]) -> None:
    del content["format"]


@pytest.mark.parametrize(("change", "says"), [
    (without_serial, "does not say of which unit it is"), (without_scale, "does not determine all three scale factors"),
    (without_format, "is no calibration"), (None, "cannot be read (No such file or directory)"),
])  # fmt: skip
def test_a_file_that_is_no_reference_is_refused_before_the_work(
    calibration: dict[str, Any], run: Any, tmp_path: Path, change: Callable[[dict[str, Any]], None] | None, says: str
) -> None:
    path, content = tmp_path / "cal.json", json.loads(json.dumps(calibration))
    if change is not None:
        change(content)
        path.write_text(json.dumps(content))
    err = run.refused("fleet", tmp_path, "-o", tmp_path / "fleet", "--reference-unit", path)
    assert says in err and str(path) in err
    assert not (tmp_path / "fleet").exists()


def test_scale_factors_from_one_of_the_runs_are_no_reference(tmp_path: Path) -> None:
    store = Store(tmp_path)
    with store.taken():
        store.append([{"run": "/lab/a.mcap", "sha256": "abc", "evaluated": datetime(2026, 1, 1, tzinfo=UTC)}])
    own = ReferenceUnit("A", (1.0, 1.0, 1.0), (1e-6, 1e-6, 1e-6), "abc")
    with pytest.raises(InputError, match=r"are from /lab/a\.mcap, one of these runs"):
        kf_calib.open_fleet(tmp_path).pooled(reference_unit=own)
