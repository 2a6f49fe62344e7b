"""A run judged dwell by dwell: as a scan from the start would, and with one chance of a false alarm for all looks."""

import numpy as np
import pytest
from helpers.hidden_effects import run
from helpers.synthetic import Run

from kf_calib.diagnosis.candidate_tests import candidates
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.dwell_columns import LinearisedDwells
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.score_test import scan
from kf_calib.online.sequential_test import RecursiveTest, SequentialTest


def quiet(seed: int, **kwargs: float) -> Calibration:
    return calibrate(Run(seed=seed, dwells=16, count=100, **kwargs))


def watched(result: Calibration) -> SequentialTest:
    dwells = result.fit.dwells
    sequential = SequentialTest.over(dwells[:6], result.bench)
    for dwell in dwells[6:]:
        sequential = sequential.after(dwell)
    return sequential


def test_a_running_scan_is_that_from_the_start() -> None:
    result = quiet(1)
    effects = [each for each in candidates(result.model) if each.unknown is None]
    dwells, noise = result.fit.dwells, result.noise.for_goodness_of_fit
    recursive = RecursiveTest.over(dwells[:8], result.model, noise, result.linearised.state, effects)
    for dwell in dwells[8:]:
        recursive = recursive.after(dwell)
    expected = scan(result.linearised, noise, effects)
    np.testing.assert_allclose(recursive.scan.statistics, expected.statistics, rtol=1e-6, atol=1e-7)
    statistic, dof = recursive.misfit
    assert dof == result.consistency.dof or dof > result.consistency.dof  # columns within dwells add rows
    own = [sum(c.dof for c in each.candidates) for each in (recursive.scan, expected)]
    assert own[0] == own[1] and statistic == pytest.approx(float(dof), abs=6.0 * np.sqrt(2.0 * dof))


@pytest.mark.slow
def test_noise_raises_no_alarm_however_often_it_is_looked_at() -> None:
    """11 looks at each of 12 runs: at 1 % a run two alarms have a chance of 0.6 %; of 2 runs, one has 2 %."""
    runs = 12
    found = [watched(quiet(900 + k)) for k in range(runs)]
    assert all(each.looks == 11 for each in found)
    assert sum(each.alarmed is not None for each in found) <= runs // 12


def test_a_missing_effect_raises_the_alarm_before_the_end() -> None:
    sequential = watched(run("second-order=20sigma"))
    assert sequential.alarmed is not None and sequential.alarmed < 24
    assert sequential.suspects[0] in {"second-order", "scale-asymmetry"}


def test_a_dwell_more_has_the_columns_that_the_whole_run_gives_it() -> None:
    """Its own temperatures alone would not do: their rate and what lags behind them come from before."""
    result = run()
    dwells, model = result.fit.dwells, result.model
    for effect in candidates(model):
        model = model if str(effect) in model.parts else model + effect
    state = np.concatenate([result.linearised.state[:12], np.zeros(model.count - 12)])
    more, whole = (
        LinearisedDwells(dwells[:-1], model, state).followed_by(dwells[-1:]),
        LinearisedDwells(dwells, model, state),
    )
    lagged = model.parts["thermal-lag"]
    assert np.abs(whole.columns[-1][..., lagged]).max() > 0.1
    np.testing.assert_array_equal(more.columns[-1], whole.columns[-1])
    assert more.means.readings.shape == whole.means.readings.shape
