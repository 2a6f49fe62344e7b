"""The residuals of a run as a table, and results in notebooks."""

from __future__ import annotations

import importlib
import sys
from types import ModuleType

import numpy as np
import pytest
from helpers.paths import ROOT

import kf_calib
from kf_calib.support import extras
from kf_calib.views import notebook

FACES = ROOT / "recordings" / "mems_faces.mcap"


@pytest.fixture(scope="module")
def run() -> kf_calib.Calibration:
    return kf_calib.calibrate(FACES)


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
    monkeypatch.setattr(extras, "find_spec", lambda name: None)
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


def test_notebooks_show_results_as_tables(run: kf_calib.Calibration, monkeypatch: pytest.MonkeyPatch) -> None:
    improved = kf_calib.improve(run)
    for result, says in ((run, "Parameters (1σ)"), (improved.start, "Smallest coefficient"), (improved, "Rms error")):
        shown = result._repr_html_()
        assert shown.count("<table>") >= 1 and says in shown and "<script" not in shown
    monkeypatch.setattr(notebook, "find_spec", lambda name: None)
    assert run._repr_html_() is None  # a notebook then shows the text
