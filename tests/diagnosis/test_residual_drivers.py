"""What residuals go with: shares, predictions and their sigma, against computations of another way."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.hidden_effects import noisy_run, run
from helpers.known_runs import diagnosed
from helpers.synthetic import Run, plan_of
from scipy.stats import binom, f

from kf_calib.diagnosis.candidate_tests import overlap_matrix
from kf_calib.diagnosis.coefficient_sizes import QUIET, sensor_grade
from kf_calib.diagnosis.explanation import Explanation
from kf_calib.diagnosis.missing_effect import diagnose
from kf_calib.diagnosis.refits import Refits
from kf_calib.diagnosis.residual_drivers import (
    drivers_of,
    is_function_of,
    unexplained_mps2,
    walk_path,
)
from kf_calib.effects import effect_named, names
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.residual_table import mean_sigmas
from kf_calib.sources.simulation.injected import catalogue

PLAN = plan_of(16, dwell_s=8.0, seed=5)


def test_the_share_of_a_driver_is_that_of_least_squares_on_whitened_means() -> None:
    """Means of dwells over their sigma, regressed on the model and on the functions of the input: independent of the
    triangular factors. The readings of a dwell are as good as their mean, so the two differ by little."""
    result = run("second-order=15sigma")
    driver = next(each for each in drivers_of(result) if each.symbol == "a")
    means, sigmas = result.linearised.means, mean_sigmas(result)
    dwells = len(means.readings)
    rows = (means.design / sigmas[:, :, None]).reshape(3 * dwells, -1)
    columns = np.zeros((dwells, 3, 9))
    for i in range(3):
        a = driver.values[:, i]
        columns[:, i, 3 * i : 3 * i + 3] = np.stack([a**2, a**3, a**4], axis=1)
    columns = (columns / sigmas[:, :, None]).reshape(3 * dwells, 9)
    columns /= np.linalg.norm(columns, axis=0)
    residual = (result.residuals_mps2 / sigmas).ravel()

    def left(design: np.ndarray) -> float:
        scaled = design / np.linalg.norm(design, axis=0)
        return float(np.sum((residual - scaled @ np.linalg.lstsq(scaled, residual, rcond=1e-10)[0]) ** 2))

    fall = left(rows) - left(np.hstack([rows, columns]))
    assert driver.dof == 9
    assert driver.delta_chi2 == pytest.approx(fall, rel=1e-3)
    misfit = result.consistency
    before, after = misfit.statistic / misfit.dof, (misfit.statistic - fall) / (misfit.dof - 9)
    assert driver.share == pytest.approx(1.0 - (after - 1.0) / (before - 1.0), rel=2e-3)
    assert driver.p_value == pytest.approx(f.sf(fall / 9 / max(after, 1.0), 9, misfit.dof - 9), rel=0.1)


@pytest.mark.parametrize(("name", "symbol"), [
    ("hysteresis", "da"), ("thermal-bias", "T"), ("encoder-harmonic-1:z", "q2"), ("bias-drift", "t"),
])  # fmt: skip
def test_the_driver_of_the_hidden_effect_comes_first(name: str, symbol: str) -> None:
    first, *rest = drivers_of(run(f"{name}=15sigma"))
    assert first.symbol == symbol
    assert first.p_value < 1e-8 and first.share > 0.9
    assert all(each.share <= first.share for each in rest)


@pytest.mark.parametrize("seed", [3, 5])
def test_nothing_has_a_share_where_the_model_fits(seed: int) -> None:
    """Whether chi-squared is below its degrees of freedom, 30 of 36, or above, 45."""
    before = run(seed=seed)
    drivers = drivers_of(before)
    assert {"a", "p", "o", "da", "t", "T", "q1", "q2", "q3"} <= {each.symbol for each in drivers}
    assert all(each.share == 0.0 and each.p_value > 1e-3 for each in drivers)
    after = Refits().with_effects(before, ("second-order",))
    assert Explanation(("second-order",), before, after).share is None


def test_what_an_explanation_predicts_is_the_difference_of_the_predictions() -> None:
    best = diagnosed("second-order=15sigma").explanations[0]
    before, after = best.before.linearised, best.after.linearised
    predicted = [np.einsum("dip,p->di", each.means.design, state) for each, state in (
        (before, best.before.estimate.state), (after, best.after.estimate.state))]  # fmt: skip
    assert best.names == ("second-order",)
    explained = best.before.residuals_mps2 - best.unexplained_mps2
    assert explained == pytest.approx(predicted[1] - predicted[0], abs=1e-12)
    assert best.share is not None and best.share > 0.9 and best.fits
    (shape,) = best.shapes
    assert shape.symbol == "a" and shape.is_curve
    for driver in drivers_of(best.before):
        over = best.over(driver)
        assert is_function_of(over.component, driver.values, driver.unit) == over.is_curve
        assert over.is_curve == (driver.symbol == "a")


@pytest.mark.slow
def test_the_band_of_an_effect_covers_as_often_as_it_says() -> None:
    """Of runs of other noise: 1 sigma of the component, less its mean over the dwells, covers the truth in 68 % of the
    runs, accelerometer by accelerometer."""
    runs = 100
    inside, seen = 0, 0
    truth = 2e-6 / 9.80665  # 2 ug/g^2 in s^2/m
    offsets = list[float]()
    for seed in range(runs):
        before = noisy_run("second-order=2ug/g^2,2ug/g^2,2ug/g^2", seed=300 + seed, plan=PLAN)
        after = Refits().with_effects(before, ("second-order",))
        (shape,) = Explanation(("second-order",), before, after).shapes
        size, own = shape.component - shape.component.mean(axis=0), shape.component_sigma
        force = before.linearised.means.force_mps2
        for i in range(3):
            k = int(np.argmax(own[:, i]))
            squares = (force @ before.linearised.state[:12].reshape(3, 4)[i, :3]) ** 2
            error = size[k, i] - truth * (squares[k] - squares.mean())
            offsets.append(error / own[k, i])
            inside += abs(error) < own[k, i]
            seen += 1
    low, high = binom.ppf([0.001, 0.999], seen, 0.6827)
    assert low <= inside <= high, (inside, seen, np.std(offsets))
    assert abs(np.mean(offsets)) < 4.0 / np.sqrt(seen)


def test_the_path_of_a_walk_is_no_residual() -> None:
    """It is the best prediction from the residuals, of steps between the dwells that add up from each to the end."""
    before = noisy_run(dwells=16, walk_mps2_per_sqrt_s=3e-6, seed=4)
    after = Refits().with_effects(before, ("bias-walk",))
    assert after.noise.walk.steps
    ratios = unexplained_mps2(after) / mean_sigmas(before)
    assert np.sqrt(np.mean(unexplained_mps2(after) ** 2)) < 0.5 * before.residual_rms_mps2
    assert np.sqrt(np.mean(ratios**2)) < 1.5
    assert np.array_equal(unexplained_mps2(before), before.residuals_mps2)
    ends_s = after.linearised.means.ends_s
    steps_s, later = np.diff([*ends_s.mean(axis=1), ends_s[-1, 1]]), np.triu(np.ones((len(ends_s), len(ends_s))))
    covariance, sizes = later @ np.diag(steps_s) @ later.T, after.noise.walk_mps2_per_sqrt_s
    each = zip(sizes, walk_path(after).T, after.residuals_mps2.T, mean_sigmas(after).T, strict=True)
    for size, path, residual, sigma in each:
        walk = size**2 * covariance
        np.testing.assert_allclose(path, walk @ np.linalg.solve(walk + np.diag(sigma**2), residual), rtol=1e-6)


def test_overlaps_of_several_effects_are_those_of_pairs() -> None:
    diagnosis = diagnosed("second-order=15sigma")
    chosen = ["second-order", "scale-asymmetry", diagnosis.test.effects.walk, "latency"]
    overlaps = overlap_matrix(diagnosis.test, chosen)
    one, other = (diagnosis.test.effects.candidate(name) for name in chosen[:2])
    assert overlaps[0, 1] == pytest.approx(one.overlap(other)) and overlaps[0, 1] > 0.9
    assert overlaps[1, 0] == pytest.approx(overlaps[0, 1])
    assert overlaps[0, 0] == pytest.approx(1.0)
    assert np.all(overlaps[2, :3] == 1.0)  # a walk can take any path
    assert np.isnan(overlaps[3]).all()  # has no columns in dwells


@pytest.mark.slow
def test_an_effect_that_is_not_seen_has_a_reason() -> None:
    diagnosis = diagnosed("second-order=15sigma")
    reasons = {each.name: each.why for each in diagnosis.unseen}
    assert list(reasons)[: len(diagnosis.test.effects.unseen)] == diagnosis.test.effects.unseen
    assert "scale factor" in reasons["gravity-error"]
    assert "misalignment" in reasons["cross-talk"]
    assert reasons["encoder-harmonic-1:y"] == "adds nothing to a reading in these orientations"  # about the vertical
    assert "platform turns" in reasons["latency"]
    still = diagnose(calibrate(Run(seed=3, count=100)))
    assert "temperature" in {each.name: each.why for each in still.unseen}["thermal-bias"]


def test_the_grade_goes_by_the_noise_of_a_reading() -> None:
    """Run has white noise of 1e-4 m/s^2 at 20 Hz: a density of 2.2e-5 m/s^2/sqrt(Hz); the threshold is 1e-4."""
    assert sensor_grade(calibrate(Run(seed=1)).fit) == "navigation"
    assert sensor_grade(calibrate(Run(seed=1, white_mps2=0.9 * QUIET * np.sqrt(20.0))).fit) == "navigation"
    assert sensor_grade(calibrate(Run(seed=1, white_mps2=1.1 * QUIET * np.sqrt(20.0))).fit) == "mems"


def test_usual_sizes_are_those_of_the_simulator_where_the_unit_is_the_same() -> None:
    """The truth of the simulator and the catalogue share no code; what both say of navigation grade is the same."""
    bench, compared = run().bench, 0
    for name in names(bench):
        effect, kind = effect_named(name, bench), catalogue().get(name.partition(":")[0])
        usual = effect.typical.of("navigation")
        if usual is None or kind is None or name == "magnetic":  # there the product with the field is fitted
            continue
        assert np.allclose(usual, kind.typical("navigation"), rtol=1e-9), name
        compared += 1
    assert compared > 25


def test_where_nothing_is_missing_there_is_no_explanation() -> None:
    assert diagnosed().explanations == []
