"""The reduced factor of one run holds all that linear models can ask of it."""

from pathlib import Path

import numpy as np
import pytest
from helpers.hidden_effects import noisy_run

import kf_calib
from kf_calib.bench.paper_parameters import STATES
from kf_calib.dwells.qr import triangle
from kf_calib.estimation import square_root_information
from kf_calib.fleet.run_factor import run_factor

ROOT = Path(__file__).resolve().parents[2]


def test_an_effect_that_is_added_by_the_factor_is_that_of_a_refit() -> None:
    path = ROOT / "recordings" / "hidden.mcap"
    before, after = kf_calib.calibrate(path), kf_calib.calibrate(path, kf_calib.Settings(effects="hysteresis"))
    found = run_factor(before.fit)
    columns = [*found.model, *found.effects["hysteresis"]]
    around = np.concatenate([found.nominal, np.zeros(3)])
    state, covariance, lost = square_root_information.solve(found.of(columns)[:-1], around)
    assert found.model == STATES and not lost.size
    sigma = np.sqrt(np.diag(after.estimate.covariance))
    np.testing.assert_allclose(state / sigma, after.estimate.state / sigma, rtol=0, atol=2e-2)  # small rotations move
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), sigma, rtol=1e-3)
    alone = square_root_information.solve(found.of(found.model)[:-1], found.nominal)[0]
    np.testing.assert_allclose(alone / sigma[:12], before.estimate.state / sigma[:12], rtol=0, atol=1e-6)


def test_the_factors_of_two_runs_are_that_of_both_together() -> None:
    """Twice the same run: the same estimate, sigma smaller by the root of two, and what nothing explains adds up."""
    found = run_factor(kf_calib.calibrate(ROOT / "recordings" / "mems_faces.mcap").fit)
    both = triangle(np.vstack([found.of(found.model)] * 2))
    one, two = (square_root_information.solve(factor[:-1], found.nominal) for factor in (found.of(found.model), both))
    np.testing.assert_allclose(two[0], one[0], rtol=1e-9)
    np.testing.assert_allclose(np.diag(two[1]), np.diag(one[1]) / 2.0, rtol=1e-9)
    np.testing.assert_allclose(abs(both[-1, -1]), np.sqrt(2.0) * abs(found.of(found.model)[-1, -1]), rtol=1e-9)


def test_without_angles_nine_states_are_left_and_no_effects() -> None:
    source = kf_calib.open_recording(ROOT / "recordings" / "mems_faces.mcap", angles=False)
    result = kf_calib.calibrate(source)
    found = run_factor(result.fit)
    assert len(found.columns) == found.width == 12 - len(result.model.fixed)
    assert not found.effects and np.isfinite(found.factor).all()


@pytest.mark.parametrize(
    ("noise", "states", "estimated"),
    [
        ({"scatter_mps2": 3e-4, "setting_sigma_deg": 2e-4}, {}, False),
        ({"scatter_mps2": 3e-4}, {"scatter_sigma_mps2": None}, True),
        ({"setting_sigma_deg": 2e-3}, {"angle_sigma_deg": None}, True),
    ],
)
def test_noise_estimated_from_the_misfit_is_told_from_noise_that_was_stated(
    noise: dict[str, float], states: dict[str, float | None], estimated: bool
) -> None:
    assert run_factor(noisy_run(states=states, seed=3, **noise).fit).noise_estimated == estimated
