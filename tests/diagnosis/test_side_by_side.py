"""Two evaluations side by side: differences of the parameters, their sigmas, and the test of all of them."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.paths import ROOT
from helpers.synthetic import Run
from scipy.stats import kstest

import kf_calib
from kf_calib.diagnosis.results import SideBySide, differences
from kf_calib.estimation.calibration import calibrate

HIDDEN = ROOT / "recordings" / "hidden.mcap"


def test_a_recording_beside_itself_differs_by_nothing() -> None:
    found = _diagnosed(kf_calib.calibrate(HIDDEN))
    pair = SideBySide(found, found, same_recording=False)
    assert pair.p_value == 1.0
    assert [each.value for each in pair.differences] == [0.0] * 12
    for each in pair.differences:
        assert each.sigma == pytest.approx(np.sqrt(2.0) * each.first.sigma)


def test_models_of_one_recording_are_told_apart_by_the_larger_sigma() -> None:
    plain = kf_calib.calibrate(HIDDEN)
    other = kf_calib.calibrate(HIDDEN, kf_calib.Settings(effects="hysteresis"))
    by_symbol = {each.symbol: each for each in differences(plain, other, same_recording=True)}
    assert set(by_symbol) == set(plain.parameters)  # what only one of the models has cannot be compared
    k1 = by_symbol["K1"]
    assert k1.value == other.parameters["K1"].value - plain.parameters["K1"].value
    assert k1.sigma == max(plain.parameters["K1"].sigma, other.parameters["K1"].sigma)
    assert k1.sigmas == k1.value / k1.sigma


def test_what_one_of_them_does_not_determine_has_no_difference() -> None:
    whole = kf_calib.calibrate(HIDDEN)
    unseen = replace(whole.parameters["b2"], value=None, sigma=None)
    other = SimpleNamespace(parameters={**whole.parameters, "b2": unseen})
    for two in ((whole, other), (other, whole)):
        without = [each for each in differences(*two, same_recording=False) if each.sigmas is None]
        assert [(each.symbol, each.value, each.sigma) for each in without] == [("b2", None, None)]


@pytest.mark.slow
@pytest.mark.parametrize("dwells", [10, 24])
def test_two_runs_of_the_same_sensors_differ_as_noise_does(dwells: int) -> None:
    runs = [calibrate(Run(seed=seed, dwells=dwells, count=80, spread=(0.0, 0.0, 0.0))) for seed in range(30)]
    assert len({tuple(run.estimate.parameters) for run in runs}) == 30
    pairs = [SideBySide(*map(_diagnosed, two), same_recording=False) for two in zip(runs[::2], runs[1::2], strict=True)]
    p_values = [pair.p_value for pair in pairs]
    assert kstest(p_values, "uniform").pvalue > 0.01
    ratios = [each.sigmas for pair in pairs for each in pair.differences]
    assert len(ratios) == 180 and np.std(ratios) == pytest.approx(1.0, abs=0.12)


def _diagnosed(run: kf_calib.Calibration) -> SimpleNamespace:
    """What a comparison of parameters reads of a diagnosis."""
    return SimpleNamespace(before=run)
