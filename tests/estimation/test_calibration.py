"""The main job: real data by others, misfit, held-out error, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.hidden_effects import noisy_run
from helpers.synthetic import G, Run, sensitivities
from scipy.linalg import lstsq
from scipy.spatial.transform import Rotation

from kf_calib.bench.bench import Bench, axes_of
from kf_calib.bench.paper_parameters import BIASES
from kf_calib.bench.streams import Batch, Stream
from kf_calib.diagnosis.refits import Refits
from kf_calib.dwells.table import DwellTable
from kf_calib.errors import BlunderError, InputError, UnobservableError
from kf_calib.estimation import square_root_information, whitened_rows
from kf_calib.estimation.calibration import calibrate, evaluate
from kf_calib.estimation.cross_validation import orientations
from kf_calib.estimation.dwell_pass import Pass
from kf_calib.estimation.iterated_fit import fit
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.results import consistency
from kf_calib.estimation.settings import Settings
from kf_calib.noise.terms import RandomWalk, Scatter, SettingError
from kf_calib.sources.files.recording import Recording


def test_a_real_imu_placed_by_hand(ferraris: Path) -> None:
    """imucal's published scale factors; plain least squares' biases; the hand's angle errors in the sigmas."""
    result = calibrate(Recording(ferraris))
    values = {symbol: p.value for symbol, p in result.parameters.items()}
    np.testing.assert_allclose([values["K1"], values["K2"], values["K3"]], [0.99675, 1.00244, 1.02340], atol=2e-4)
    np.testing.assert_allclose([values["b1"], values["b2"], values["b3"]], [0.551, -0.620, 0.386], atol=5e-3)
    assert result.residual_rms_mps2 == pytest.approx(0.0131, abs=3e-4)
    assert len(result.visits) == 6
    sigmas = {symbol: p.sigma for symbol, p in result.parameters.items()}
    assert all(1e-3 < sigmas[f"K{i}"] < 5e-3 and 5e-3 < sigmas[f"b{i}"] < 0.05 for i in (1, 2, 3))
    assert sigmas["theta1"] > np.radians(0.3) / 2
    assert result.noise.setting.stated and result.consistency.consistent
    assert result.parameters["theta1"].nominal == 0.0
    assert any("too few to distinguish a setting error" in warning for warning in result.warnings)


def test_an_effect_that_is_missing_shows_as_misfit() -> None:
    run = Run(seed=1)
    assert calibrate(run).consistency.consistent
    run.accel.values[:, 0] += 3e-6 * run.accel.values[:, 0] ** 2
    result = calibrate(run)
    assert result.consistency.consistent is False
    assert result.held_out_rms_mps2 > 3 * result.held_out_floor_mps2
    assert any("an effect is missing" in warning for warning in result.warnings)


def test_misfit_beside_a_walk_and_a_stated_scatter_is_that_of_all_steps_solved_together() -> None:
    """The rows of what dwells have in common know nothing of steps within dwells, and count all the same."""
    before = noisy_run(seed=40, dwells=24, states={"scatter_sigma_mps2": 2.5e-6}, scatter_mps2=6e-6)
    fitted = Refits().with_effects(before, ("bias-walk",)).fit
    rows, count = fitted.misfit_rows, len(fitted.dwells)
    prior, dwells = np.vstack(rows[:-count]), rows[-count:]
    assert len(prior) and fitted.noise.walk.steps and prior.shape[1] == dwells[0].shape[1] - 3
    steps = fitted.steps.reshape(-1, 3)  # in the pause before each dwell, and within it
    joint = [np.hstack([np.zeros((len(prior), 3 * len(steps))), prior])]
    for k, own in enumerate(dwells):
        later = np.zeros((len(own), len(steps), 3))
        later[:, 2 * k + 2 :] = -own[:, 3:][:, None, BIASES]  # the state has the biases at the end of the run
        later[:, 2 * k + 1] = own[:, :3]
        joint.append(np.hstack([(later * np.sqrt(steps)).reshape(len(own), -1), own[:, 3:]]))
    joint.append(np.eye(3 * len(steps), joint[0].shape[1]))
    design = np.vstack(joint)
    columns = design[:, :-1] / np.linalg.norm(design[:, :-1], axis=0)
    left = design[:, -1] - columns @ lstsq(columns, design[:, -1])[0]
    found = consistency(fitted)
    each = 2 * 3  # of each channel a dwell shows its mean and its slope
    assert found.dof == len(design) - np.linalg.matrix_rank(columns) == each * count - 12
    assert found.statistic == pytest.approx(left @ left, rel=1e-6)


@pytest.mark.parametrize(("setting_deg", "stated", "charged"), [
    (0.0, False, 0), (0.01, False, 1), (0.0, True, 0), (0.01, True, 0),
])  # fmt: skip
def test_a_setting_error_that_is_estimated_takes_a_degree_of_freedom(
    setting_deg: float, stated: bool, charged: int
) -> None:
    """Of three means a dwell less twelve parameters; one that is stated, or estimated as none, takes none."""
    found = calibrate(Run(seed=0, dwells=24, stated=stated, setting_deg=setting_deg))
    assert (found.noise.setting_rad > 0.0) == bool(setting_deg)
    assert found.consistency.dof == 3 * 24 - 12 - charged


def test_where_nothing_is_left_to_judge_there_is_no_verdict() -> None:
    """Of twelve means and twelve parameters."""
    result = calibrate(Run(seed=2, dwells=4))
    found = result.consistency
    assert any("too few to test the model" in warning for warning in result.warnings)
    assert (found.dof, found.p_value, found.consistent, found.nis_per_dof) == (0, None, None, None)
    assert found.statistic == pytest.approx(0.0, abs=1e-6)


def test_what_a_run_does_not_determine_is_named() -> None:
    """Gravity up and down along one axis of the platform tells nothing of the others."""
    up_and_down = np.array([[0.0, 0.0, 0.0], [0.0, np.pi, 0.0]] * 4)
    found = calibrate(Run(seed=1, dwells=8, poses=up_and_down))
    unknown = {symbol for symbol, value in found.parameters.items() if value.sigma is None}
    assert set(found.undetermined) == unknown and 0 < len(unknown) < 12
    assert not calibrate(Run(seed=1)).undetermined


def test_held_out_equals_refits_without_the_orientation() -> None:
    run = Run(seed=2, dwells=8)
    result = calibrate(run)
    errors = []
    for left_out in range(8):
        kept = result.fit.dwells.take([k for k in range(8) if k != left_out])
        rest = evaluate(kept, replace(run.bench, angle_sigma_deg=0.0, scatter_sigma_mps2=0.0), Settings())
        means = result.visits[left_out].dwell.means
        state = rest.estimate.state.reshape(3, 4)
        errors.append(means[4:] - state[:, :3] @ means[1:4] - state[:, 3])
    assert result.held_out_rms_mps2 == pytest.approx(np.sqrt(np.mean(np.square(errors))), rel=0.01)


def test_repeated_poses_are_one_orientation() -> None:
    poses = np.random.default_rng(0).uniform(-3, 3, (5, 3))
    result = calibrate(Run(seed=3, poses=np.vstack([poses, poses])))
    groups = orientations(result.fit.dwells)
    assert groups == [[k, k + 5] for k in range(5)]


def test_one_orientation_names_what_cannot_be_seen() -> None:
    with pytest.raises(UnobservableError, match=r"theta1.*phi1.*K1.*b1.*nu1.*K3.*b3"):
        calibrate(Run(seed=4, poses=np.zeros((1, 3))))


def test_two_faces_name_the_unseen_and_give_the_rest() -> None:
    result = calibrate(Run(seed=5, poses=np.array([[0.0, 0, 0], [0, np.pi, 0]]), count=600))
    unseen = {symbol for symbol, p in result.parameters.items() if p.value is None}
    assert unseen == {"theta1", "phi1", "K1", "nu1", "nu2", "theta3", "phi3", "K3"}  # K sin(theta) is seen, not theta
    assert any(
        "do not determine theta1, phi1, K1, nu1, nu2, theta3, phi3, K3" in warning for warning in result.warnings
    )
    error = result.estimate.parameters - Run(seed=5, poses=np.zeros((1, 3))).truth
    assert result.consistency.consistent is None and abs(error[6]) < 5 * result.parameters["K2"].sigma


@pytest.mark.parametrize("unit, factor", [("g", 1 / 9.80665), ("mg", 1e3 / 9.80665)])
def test_readings_in_g_are_noticed(unit: str, factor: float) -> None:
    run = Run(seed=7, dwells=6)
    run.accel = replace(run.accel, values=run.accel.values * factor)
    with pytest.raises(InputError, match=f"gravity in {unit}, .*--accel-unit {unit}"):
        calibrate(run)


def test_counts_are_noticed() -> None:
    run = Run(seed=7, dwells=6)
    run.accel = replace(run.accel, values=np.round(run.accel.values * 1671.0))
    with pytest.raises(InputError, match="look like counts"):
        calibrate(run)


def test_wrong_axes_are_noticed() -> None:
    run = Run(seed=8)
    run.bench = replace(run.bench, axes=axes_of("xzy"))
    with pytest.raises(BlunderError, match="gimbal axes are, outer to inner, y z x"):
        calibrate(run)


def test_noise_free_readings_do_no_harm() -> None:
    run = Run(seed=9, white_mps2=0.0)
    result = calibrate(run)
    np.testing.assert_allclose(result.estimate.parameters, run.truth, atol=1e-12)
    assert result.consistency.consistent


def test_platform_that_never_rests_is_refused() -> None:
    time_ns = np.arange(0, 60_000_000_000, 50_000_000)
    angles = np.column_stack([time_ns * 1e-9] * 3)
    run = Run(seed=10, dwells=1)
    run.accel, run.pose = Stream(time_ns, np.full((len(time_ns), 3), G / 2)), Stream(time_ns, angles)
    with pytest.raises(InputError, match="no dwell was found"):
        calibrate(run)


def test_nothing_at_all_is_refused() -> None:
    class Empty:
        bench = Bench(axes_of("y"), G)
        warnings: tuple[str, ...] = ()
        fraction = 1.0

        def __iter__(self):
            return iter([Batch(Stream.empty(3), Stream.empty(1))])

    with pytest.raises(InputError, match="no accelerometer readings"):
        calibrate(Empty())


@pytest.mark.parametrize("reference", ["base", "inertial"])
def test_an_attitude_in_place_of_angles(reference: str) -> None:
    """A quaternion stream, base-fixed and inertially held."""
    run = Run(seed=12, dwells=12)
    run.bench = Bench((), G, reference=reference, latitude_deg=50.0)  # type: ignore[arg-type]
    elapsed_s = (run.accel.time_ns - run.accel.time_ns[0]) / 1e9
    dwell = np.arange(len(elapsed_s)) // run.count
    attitudes = Rotation.random(12, random_state=3).as_quat()[dwell]
    rows, biases = sensitivities(run.truth)
    noise = np.random.default_rng(1).normal(size=(len(elapsed_s), 3)) * 1e-4
    force = run.bench.specific_force(elapsed_s, attitudes)
    run.accel = replace(run.accel, values=force @ rows.T + biases + noise)
    run.pose = Stream(run.accel.time_ns, attitudes)
    result = calibrate(run)
    assert len(result.visits) == 12 and result.consistency.consistent
    assert np.abs((result.estimate.parameters - run.truth) / result.estimate.sigma).max() < 4


@pytest.mark.parametrize("seed", [20090, 20216, 20372])
def test_a_dwell_on_one_or_two_messages_of_a_noisy_encoder_is_left_out(seed: int) -> None:
    """Where noise breaks a dwell in two, the shorter part may have too few angles to know where it stands."""
    run = Run(seed=seed, dwells=24, count=200, encoder_deg=0.01)
    result = calibrate(run)
    assert all(visit.dwell.pose_sigma_rad > 0.0 for visit in result.visits)
    assert result.consistency.p_value is not None and result.consistency.p_value > 0.01
    exact = calibrate(Run(seed=seed, dwells=24, count=50))  # every dwell of an encoder without noise is used
    assert len(exact.visits) == 24


def assert_tells_the_same(rows: np.ndarray, others: np.ndarray) -> None:
    """Of the states, and of the readings through them."""
    left, right = rows[:, :-1].T @ rows, others[:, :-1].T @ others
    np.testing.assert_allclose(left, right, rtol=0, atol=1e-9 * np.abs(right).max())


def of_unequal_lengths(dwells: DwellTable) -> DwellTable:
    """The dwells, of two in three their first piece alone."""
    return DwellTable.of([next(dwells.prefixes(k))[0] if k % 3 else dwell for k, dwell in enumerate(dwells)])


def test_a_dwell_whose_columns_are_constant_tells_its_mean_alone() -> None:
    """Three rows have all that its readings tell of the states, of any number of pieces, weight and scatter."""
    dwells = Pass(Run(dwells=14, count=200, setting_deg=0.01, encoder_deg=0.0), Settings()).fold()
    dwells = of_unequal_lengths(dwells).weighted(np.repeat(1.0 + 0.1 * np.arange(14.0), 3).reshape(-1, 3))
    fitted = fit(dwells, Model.of(Run(dwells=1).bench, ("second-order",)))
    columns, state = fitted.linearised.columns, fitted.linearised.state
    for noise in (fitted.noise, fitted.noise.with_terms(Scatter(np.array([0.0, 1e-6, 1e-3])), SettingError(1e-3))):
        whole = whitened_rows.whiten(dwells, columns, noise, state, reduced=False)
        for all_rows, rows in zip(whole, whitened_rows.whiten(dwells, columns, noise, state), strict=True):
            assert len(rows) == 3 < len(all_rows)
            assert_tells_the_same(rows, all_rows)


def test_a_column_that_changes_from_piece_to_piece_tells_more_than_a_mean() -> None:
    """It is constant within each piece, and in most dwells altogether."""
    dwells = Pass(Run(dwells=14, count=200), Settings()).fold()
    fitted = fit(dwells, Model.of(Run(dwells=1).bench, ()))
    columns, state, noise = list(fitted.linearised.columns), fitted.linearised.state, fitted.noise
    columns[3] = columns[3] * (1.0 + np.arange(len(columns[3])))[:, None, None, None]
    assert len(dwells[3].pieces) > 1
    whole = whitened_rows.whiten(dwells, columns, noise, state, reduced=False)
    for all_rows, rows in zip(whole, whitened_rows.whiten(dwells, columns, noise, state), strict=True):
        assert_tells_the_same(rows, all_rows)


def test_dwells_whitened_together_are_those_whitened_alone() -> None:
    """Of any shape, beside each other in any order; a factor is solved alike in company, undetermined or not."""
    dwells = Pass(Run(dwells=14, count=200, setting_deg=0.01), Settings()).fold()
    dwells = of_unequal_lengths(dwells)
    assert len({len(dwell.pieces) for dwell in dwells}) > 1
    fitted = fit(dwells, Model.of(Run(dwells=1).bench, ("bias-drift",)))
    columns, state = fitted.linearised.columns, fitted.linearised.state
    for noise in (fitted.noise, fitted.noise.with_terms(Scatter(np.full(3, 1e-5)), RandomWalk(np.full(3, 1e-5)))):
        together = whitened_rows.whiten(dwells, columns, noise, state, reduced=False)
        for k, (own, rows) in enumerate(zip(columns, together, strict=True)):
            (alone,) = whitened_rows.whiten(dwells[k : k + 1], [own], noise, state, reduced=False)
            np.testing.assert_array_equal(rows, alone)
        few = whitened_rows.whiten(dwells, columns, noise, state)
        for whole, rows in zip(together, few, strict=True):
            assert len(rows) < len(whole)
            assert_tells_the_same(rows, whole)
    factors = [square_root_information.accumulate(fitted.rows()[:count])[:-1] for count in (1, 3, 14)]
    around = fitted.linearised.model.nominal_state()
    for factor, (state, covariance, lost) in zip(
        factors, square_root_information.solve_all(np.array(factors), around), strict=True
    ):
        assert lost.shape[1] == len(factor) - square_root_information.rank(factor)
        np.testing.assert_allclose(factor[:, :-1] @ lost, 0.0, atol=1e-6 * np.abs(factor).max())
        if not lost.size:
            np.testing.assert_allclose(factor[:, :-1] @ state, factor[:, -1], atol=1e-6 * np.abs(factor[:, -1]).max())
            sigma = np.sqrt(np.diag(covariance))
            np.testing.assert_allclose(factor[:, :-1].T @ factor[:, :-1] @ covariance, np.eye(len(sigma)), atol=1e-4)
