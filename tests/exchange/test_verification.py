"""An old calibration is said not to hold no more often than agreed, and what has moved is named."""

from collections import Counter
from functools import cache

import numpy as np
import pytest
from helpers.calibrations import BENCH, simulated, warming_up, with_result
from helpers.long_runs import slow
from helpers.paths import ROOT
from scipy import optimize, spatial, stats

import kf_calib
from kf_calib.bench.bench import Bench
from kf_calib.errors import UnobservableError
from kf_calib.exchange import calibration_file, verification
from kf_calib.exchange.calibration_file import SavedCalibration
from kf_calib.exchange.verification import Verification, verify
from kf_calib.noise.noise_model import mean_covariances
from kf_calib.sources.simulation.physics import Ambient
from kf_calib.support.tail_probabilities import chi_squared_tail


@cache
def saved(seed: int) -> SavedCalibration:
    if seed == 0:
        return calibration_file.saved(kf_calib.calibrate(simulated(0)))
    return with_result(saved(0), kf_calib.calibrate(simulated(seed)))


def verified(seed: int, count: int = 9, **moved: float) -> Verification:
    return verify(saved(seed), saved(seed).model(), simulated(10_000 + seed, count, moved=moved))


@pytest.mark.parametrize(("count", "runs"), [(3, 8), (8, 8), *slow((3, 25), (8, 50), (3, 200), (8, 200))])
def test_p_values_are_uniform_where_nothing_has_moved(count: int, runs: int) -> None:
    found = [verified(seed, count) for seed in range(runs)]
    joint = [chi_squared_tail(each.dof, each.statistic) for each in found]
    assert stats.kstest(joint, "uniform").pvalue > 0.01
    scores = [move.difference / move.sigma for each in found for move in each.moves]
    assert len(scores) == (0 if count == 3 else 12 * runs)
    if scores:
        assert abs(float(np.std(scores)) - 1.0) < 0.05 * max(50 / runs, 1.0) ** 0.5
    false_alarms = sum(not each.holds for each in found)
    assert false_alarms <= stats.binom.ppf(0.999, runs, verification.MOVED_LEVEL)


def test_the_misfit_is_that_of_the_new_run_by_itself_and_that_of_the_two_states_together() -> None:
    """Least squares with the old state as prior, taken apart: both terms from the two calibrations alone."""
    found, new = verified(3), kf_calib.calibrate(simulated(10_003))
    between = new.estimate.state - np.array(saved(3).state.values)
    both = np.array(saved(3).state.covariance) + new.estimate.covariance
    expected = new.consistency.statistic + between @ np.linalg.solve(both, between)
    assert found.statistic == pytest.approx(expected, rel=1e-6) and found.dof == new.consistency.dof + 12 == 27
    residuals = new.linearised.means.readings - new.linearised.means.design @ np.array(saved(3).state.values)
    assert found.residual_rms_mps2 == pytest.approx(np.linalg.norm(residuals) / residuals.size**0.5, rel=1e-6)


def test_the_p_value_of_a_move_is_two_sided_and_counts_how_many_are_compared() -> None:
    found, new = verified(3, K2=3e-6), kf_calib.calibrate(simulated(10_003, moved={"K2": 3e-6}))
    old = {each.symbol: each for each in saved(3).parameters}
    for move in found.moves:
        own = new.parameters[move.symbol]
        assert (move.old, move.new) == (old[move.symbol].value, pytest.approx(own.value, rel=1e-9))
        assert move.difference == move.new - move.old
        assert move.sigma == pytest.approx((old[move.symbol].sigma ** 2 + own.sigma**2) ** 0.5, rel=1e-6)
        alone = 2.0 * stats.norm.sf(abs(move.difference) / move.sigma)
        assert move.p_value == pytest.approx(1.0 - (1.0 - alone) ** 12, rel=1e-9)
    p_values = [move.p_value for move in found.moves]
    assert len(p_values) == 12 and p_values == sorted(p_values)
    assert found.p_value == pytest.approx(2.0 * min(p_values[0], stats.chi2.sf(found.statistic, found.dof)), rel=1e-9)


def test_a_hundredth_is_the_level_for_the_whole_and_half_of_it_for_what_has_moved() -> None:
    found = [verified(15, K2=size) for size in (3.0e-6, 3.1e-6)]
    p_values = [each.p_value for each in found]
    assert any(0.005 < p < 0.01 for p in p_values) and any(0.01 < p < 0.02 for p in p_values)
    assert [each.holds for each in found] == [p >= 0.01 for p in p_values]
    clearest = [each.moves[0].p_value for each in found]
    assert any(0.0025 < p < 0.005 for p in clearest) and any(0.005 < p < 0.01 for p in clearest)
    assert [bool(each.moved) for each in found] == [p < 0.005 for p in clearest]


def test_the_worst_error_is_the_greatest_over_all_directions_by_an_optimizer() -> None:
    """And its sigma is propagated from S f + b of the old and the new state in closed form."""
    found, new = verified(3, K2=8e-6), kf_calib.calibrate(simulated(10_003, moved={"K2": 8e-6}))
    states = np.array(saved(3).state.values), new.estimate.state
    (old, old_bias), (now, bias) = ((own.reshape(3, 4)[:, :3], own.reshape(3, 4)[:, 3]) for own in states)

    def error(direction: np.ndarray) -> np.ndarray:
        force = BENCH.gravity_mps2 * direction / np.linalg.norm(direction)
        return np.linalg.solve(old, now @ force + bias - old_bias) - force

    tries = [optimize.minimize(lambda x: -np.linalg.norm(error(x)), start, tol=1e-12)
             for start in np.vstack([np.eye(3), -np.eye(3)])]  # fmt: skip
    best = min(tries, key=lambda each: each.fun)
    assert found.worst_mps2 == pytest.approx(-best.fun, rel=1e-3)
    force = BENCH.gravity_mps2 * best.x / np.linalg.norm(best.x)
    along = np.linalg.solve(old.T, error(best.x) / -best.fun)
    gradient = np.kron(along, np.append(force, 1.0))
    variance = gradient @ (np.array(saved(3).state.covariance) + new.estimate.covariance) @ gradient
    assert found.worst_sigma_mps2 == pytest.approx(variance**0.5, rel=0.02)


def test_directions_cover_the_sphere_evenly() -> None:
    points = verification._sphere(4000)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1.0, rtol=1e-12)
    np.testing.assert_allclose(points.mean(axis=0), 0.0, atol=1e-3)
    np.testing.assert_allclose(points.T @ points / 4000, np.eye(3) / 3.0, atol=1e-3)
    anywhere = np.random.default_rng(0).normal(size=(2000, 3))
    nearest = spatial.KDTree(points).query(anywhere / np.linalg.norm(anywhere, axis=1)[:, None])[0]
    assert nearest.max() < 1.3 * np.sqrt(4.0 * np.pi / 4000)  # of the side of a square of one point's share


@pytest.mark.parametrize(("low_c", "high_c", "told"), [(24.5, 30.0, False), (26.5, 30.0, True), (20.0, 24.5, False),
                                                       (20.0, 23.5, True)])  # fmt: skip
def test_a_temperature_more_than_a_degree_beyond_that_of_the_calibration_is_told(
    low_c: float, high_c: float, told: bool
) -> None:
    """The new run is at 25 °C."""
    limits = {"temperature_min_c": low_c, "temperature_max_c": high_c}
    own = saved(0).model_copy(update={"conditions": saved(0).conditions.model_copy(update=limits)})
    found = verify(own, own.model(), simulated(1, 3, ambient=Ambient(25.0, sigma_c=0.0)))
    assert any("a difference may be the temperature's" in said for said in found.warnings) == told


@pytest.mark.slow
def test_the_parameter_that_moved_is_found_and_named() -> None:
    found = [verified(seed, K2=8e-6) for seed in range(15)]
    assert sum(not each.holds for each in found) >= 14
    named = Counter(each.moved[0].symbol for each in found if each.moved)
    assert named["K2"] >= 14 and sum(named.values()) == named["K2"]
    worst = np.array([(each.worst_mps2, each.worst_sigma_mps2) for each in found])
    assert np.all(np.abs(worst[:, 0] - 8e-6 * BENCH.gravity_mps2) < 5.0 * worst[:, 1])


def test_three_orientations_see_a_bias_that_moved_though_they_name_nothing() -> None:
    found = [verified(seed, 3, b1=1e-4) for seed in range(10)]
    assert all(not each.holds and each.new is None and not each.moves for each in found)


def test_gravity_block_and_the_very_same_recording_are_told() -> None:
    path = ROOT / "recordings" / "navigation_24.mcap"
    recording = kf_calib.open_recording(path)
    own = calibration_file.of_source(kf_calib.calibrate(path), recording)
    assert "this is the recording that it was calibrated from" in verify(own, own.model(), recording).warnings[0]
    other = Bench.from_metadata({**recording.bench.to_metadata(), "gravity_mps2": "9.8124", "block_serial": "B2"})
    again = kf_calib.open_recording(path, other.to_metadata())
    marked = own.provenance.model_copy(update={"bench": {**own.provenance.bench, "block_serial": "B1"}})
    found = verify(own.model_copy(update={"provenance": marked}), own.model(bench=other), again)
    told = " ".join(found.warnings)
    assert "gravity is stated" in told and "the block is B2, the calibration is of B1" in told
    ratio = other.gravity_mps2 / recording.bench.gravity_mps2
    assert not found.holds and {"K1", "K2", "K3"} <= {move.symbol for move in found.moved}
    k2 = next(move for move in found.moves if move.symbol == "K2")
    assert k2.new / k2.old == pytest.approx(1.0 / ratio, abs=1e-6)


def test_effects_of_the_run_are_not_compared() -> None:
    settings = kf_calib.Settings(effects=("warm-up", "second-order"))
    own = calibration_file.saved(kf_calib.calibrate(warming_up(0, 14), settings))
    found = verify(own, own.model(), warming_up(77, 14))
    assert found.free == ("warm-up",) and found.holds
    assert {move.symbol for move in found.moves} >= {"K1", "K2_1"}
    assert not {move.symbol for move in found.moves} & {"B1", "B2", "B3", "tauWarm"}
    assert found.dof == 3 * 14 - 4


def test_the_misfit_beside_effects_of_the_run_has_none_of_the_old_ones() -> None:
    """Normal equations of the new means, with the information of the old state without its coefficients of drift."""
    settings = kf_calib.Settings(effects=("bias-drift", "second-order"))
    own, new = (kf_calib.calibrate(simulated(seed, 14), settings) for seed in (0, 77))
    old = calibration_file.saved(own)
    found = verify(old, old.model(), simulated(77, 14))
    kept = [k for k, symbol in enumerate(old.state.symbols) if not symbol.startswith("beta")]
    assert found.free == ("bias-drift",) and len(kept) == 15 and found.dof == 3 * 14 - 3
    means, before = new.linearised.means, np.array(old.state.values)
    weights = np.linalg.inv(mean_covariances(new.noise, means, before))
    known = np.zeros((18, 18))
    known[np.ix_(kept, kept)] = np.linalg.inv(np.array(old.state.covariance)[np.ix_(kept, kept)])
    left = means.readings - means.design @ before
    information = known + np.einsum("dip,dij,djq->pq", means.design, weights, means.design)
    score = np.einsum("dip,dij,dj->p", means.design, weights, left)
    expected = np.einsum("di,dij,dj->", left, weights, left) - score @ np.linalg.solve(information, score)
    assert found.statistic == pytest.approx(expected, rel=1e-4)


def test_a_calibration_that_determined_too_little_predicts_nothing() -> None:
    settings = kf_calib.Settings(effects="thermal-bias")  # the temperature does not vary
    own = calibration_file.saved(kf_calib.calibrate(simulated(0), settings))
    assert own.state.undetermined
    with pytest.raises(UnobservableError, match=r"did not determine .*: verify one that did"):
        verification.refuse_incomplete(own)
