"""The residuals of a run as a table, and results in notebooks."""

from __future__ import annotations

import importlib
import subprocess
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from helpers.known_runs import hidden_improved
from helpers.paths import ROOT

import kf_calib
from kf_calib import errors
from kf_calib.views import html

FACES = ROOT / "recordings" / "mems_faces.mcap"


@pytest.fixture(scope="module")
def run() -> kf_calib.Calibration:
    return kf_calib.calibrate(FACES)


@pytest.fixture(scope="module")
def improved() -> kf_calib.Improvement:
    """Of a run whose residuals fail until the effect that is hidden in it is in the model."""
    return hidden_improved()


def test_a_row_for_each_dwell_and_accelerometer(run: kf_calib.Calibration) -> None:
    table = run.residuals()
    assert len(table) == 3 * len(run.visits)
    np.testing.assert_array_equal(table["residual_mps2"].reshape(-1, 3), run.residuals_mps2)
    np.testing.assert_array_equal(table["dwell"][::3], [visit.dwell.number for visit in run.visits])
    np.testing.assert_array_equal(table["accelerometer"][:6], [1, 2, 3, 1, 2, 3])
    np.testing.assert_allclose(table["ratio"], table["residual_mps2"] / table["sigma_mps2"])


@pytest.mark.parametrize("kind", ["pandas", "polars"])
def test_a_package_that_is_not_installed_is_a_sentence(
    run: kf_calib.Calibration, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(errors, "find_spec", lambda name: None)
    with pytest.raises(kf_calib.KfCalibError, match=f"^a {kind} table needs {kind}.*: pip install {kind}.$"):
        run.residuals(kind)


@pytest.mark.parametrize("kind", ["pandas", "polars"])
def test_a_dataframe_is_made_of_named_columns(
    run: kf_calib.Calibration, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a package that stands in for the real one, which is not among those that development needs."""
    made = ModuleType(kind)
    made.DataFrame = dict
    made.__spec__ = importlib.machinery.ModuleSpec(kind, None)
    monkeypatch.setitem(sys.modules, kind, made)
    table, own = run.residuals(kind), run.residuals()
    assert tuple(table) == own.dtype.names
    np.testing.assert_array_equal(table["ratio"], own["ratio"])


def test_another_kind_is_refused(run: kf_calib.Calibration) -> None:
    with pytest.raises(kf_calib.InputError, match="use numpy, pandas or polars"):
        run.residuals("excel")


def test_notebooks_show_results_as_tables(
    run: kf_calib.Calibration, improved: kf_calib.Improvement, monkeypatch: pytest.MonkeyPatch
) -> None:
    for result, says in ((run, "Parameters (1σ)"), (improved.start, "Missing: hysteresis"), (improved, "Rms error")):
        shown = result._repr_html_()
        assert shown.count("<table>") >= 1 and says in shown and "<script" not in shown
    monkeypatch.setattr(html, "find_spec", lambda name: None)
    assert run._repr_html_() is None  # a notebook then shows the text


def test_a_diagnosis_of_a_run_that_agrees_says_so_in_a_notebook(run: kf_calib.Calibration) -> None:
    assert "no effect is missing" in kf_calib.diagnose(run)._repr_html_()


def test_parameters_are_a_dictionary_and_rows(run: kf_calib.Calibration, monkeypatch: pytest.MonkeyPatch) -> None:
    """pandas makes rows of an array of objects, polars of a stream that it has made of dictionaries itself."""
    own = run.parameters
    assert list(own) == list(own.keys()) == [each.symbol for each in own.values()] and "K1" in own and len(own) == 12
    assert dict(own) == {**own} == dict(own.items()) and own == run.parameters and own.get("x") is None
    assert repr(own).splitlines()[2] == f"K1 = {own['K1'].value:.9g} ± {own['K1'].sigma:.2g}"
    assert np.asarray(own).tolist() == list(own.values())
    made = ModuleType("polars")
    made.DataFrame = lambda rows: SimpleNamespace(__arrow_c_stream__=lambda schema: rows)
    made.__spec__ = importlib.machinery.ModuleSpec("polars", None)
    monkeypatch.setitem(sys.modules, "polars", made)
    assert [row["value"] for row in own.__arrow_c_stream__()] == [each.value for each in own.values()]


@pytest.mark.parametrize("kind", ["pandas", "polars"])
def test_a_dataframe_of_parameters(run: kf_calib.Calibration, kind: str) -> None:
    frame = pytest.importorskip(kind).DataFrame(run.parameters)
    assert list(frame["symbol"]) == list(run.parameters)
    assert list(frame["sigma"]) == [each.sigma for each in run.parameters.values()]


@pytest.mark.slow
def test_a_run_is_printed_alike_whatever_was_imported(run: kf_calib.Calibration) -> None:
    program = "from kf_calib.estimation.calibration import calibrate; import sys; print(calibrate(sys.argv[1]))"
    words = [sys.executable, "-c", program, FACES]
    printed = subprocess.run(words, capture_output=True, text=True, check=True, timeout=120).stdout
    assert printed.splitlines() == str(run).splitlines() and "Parameters (1σ)" in printed


def test_effects_may_be_stated_alone() -> None:
    settings = kf_calib.Settings(gate_sigma=5.0)
    found = kf_calib.calibrate(FACES, settings, effects="second-order")
    assert found.settings.effects == ("second-order",) and found.settings.gate_sigma == 5.0
    assert (
        found.parameters
        == kf_calib.calibrate(FACES, kf_calib.Settings(gate_sigma=5.0, effects=["second-order"])).parameters
    )


def test_a_table_and_the_explanations_print_themselves(improved: kf_calib.Improvement) -> None:
    table = kf_calib.open_table(ROOT / "recordings" / "twelve_poses.csv", {"axes": "y z x", "gravity_mps2": "9.8123"})
    assert repr(table).endswith("twelve_poses.csv: 12 orientations, raw readings in mg, channels in the order of the "
                                "accelerometers>")  # fmt: skip
    found = improved.start.table
    assert found is not None and repr(found).splitlines()[0] == f" {found.first.probability:.2%} hysteresis"
