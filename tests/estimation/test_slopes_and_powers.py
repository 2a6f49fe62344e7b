"""How effects bend the readings, against closed forms; what size of an effect shows, against scipy's distributions."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.paths import ROOT
from scipy import stats

from kf_calib.effects import effect_named
from kf_calib.estimation.attitude import bendings_of
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.observability import smallest_size
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.score_test import scan
from kf_calib.estimation.settings import Settings


@pytest.fixture(scope="module")
def run() -> Calibration:
    return calibrate(ROOT / "recordings" / "hidden.mcap", Settings(effects=("second-order",)))


def test_a_second_order_term_bends_readings_by_twice_its_coefficient_times_the_acceleration(run: Calibration) -> None:
    state = run.estimate.state.copy()
    state[12:] = 3e-4, -2e-4, 5e-4  # of the square of the acceleration along each input axis
    linearised = run.fit.linearised
    sensitivity = state[:12].reshape(3, 4)[:, :3]
    axes = sensitivity / np.linalg.norm(sensitivity, axis=1, keepdims=True)
    along = linearised.means.force_mps2 @ axes.T  # (D, 3)
    wanted = 2.0 * (state[12:] * along)[:, :, None] * axes
    np.testing.assert_allclose(bendings_of(linearised, state), wanted, atol=0.01 * np.abs(wanted).max())


@pytest.mark.parametrize("name", ["third-order", "bias-drift"])
@pytest.mark.parametrize("chance", [1e-4, 0.01])
def test_an_effect_of_the_smallest_size_is_found_in_nine_of_ten_runs(
    run: Calibration, name: str, chance: float
) -> None:
    (candidate,) = scan(run.fit.linearised, run.noise, [effect_named(name, run.bench)]).candidates
    smallest = smallest_size(candidate, chance)
    assert smallest is not None
    coefficient, size = smallest
    column = [str(each.symbol) for each in candidate.effect.coefficients].index(coefficient.symbol)
    noncentrality = (size * np.linalg.norm(candidate.columns[:, column])) ** 2
    threshold = stats.chi2.isf(chance, candidate.dof)
    assert stats.ncx2.sf(threshold, candidate.dof, noncentrality) == pytest.approx(0.9, abs=1e-6)
