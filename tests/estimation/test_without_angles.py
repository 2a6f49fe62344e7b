"""Calibration from the size of gravity alone: nine parameters in the frame of the sensors."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest
from helpers.independent_bench import DWELL_S, IndependentBench, State
from helpers.long_runs import slow
from helpers.paths import RECORDINGS, SHARED
from helpers.recordings import ACCEL, read, write_officially
from helpers.synthetic import G, Run, sensitivities
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import binom, chi2, kstest

import kf_calib
from kf_calib.bench.bench import Bench
from kf_calib.bench.paper_parameters import SYMBOLS, parameters_of
from kf_calib.errors import InputError, UnobservableError
from kf_calib.estimation.calibration import evaluate
from kf_calib.estimation.dwell_pass import Pass
from kf_calib.estimation.engine_comparison import compare
from kf_calib.estimation.free_attitude import undetermined
from kf_calib.estimation.settings import Settings

pytestmark = pytest.mark.usefixtures("unmeasured")

NINE = [0, 3, 4, 5, 7, 8, 9, 10, 11]
"""The states that are left: s1x b1, s2x s2y b2, s3x s3y s3z b3."""
LEFT = [symbol for symbol in SYMBOLS if symbol not in ("theta1", "phi1", "nu2")]
FACES = np.array([[0, 0, 0], [0, 0, 180], [0, 90, 0], [0, -90, 0], [0, 0, 90], [0, 0, -90]])
PUBLISHED = {"K1": 0.996746, "K2": 1.002438, "K3": 1.023395}  # imucal's example session


def without_angles(run: Run) -> Run:
    """The run with its readings only."""
    run.bench = without(run.bench)
    run.pose = run.pose[:0]
    return run


def without(bench: Bench) -> Bench:
    return replace(bench, axes=(), angles=False, angle_sigma_deg=None, nominal={"theta1": 0.0, "theta3": 0.0})


def in_sensor_frame(rows: np.ndarray, biases: np.ndarray) -> np.ndarray:
    """The affine state (12,) turned so that accelerometer 1 is x and accelerometer 2 lies in the plane of x and y."""
    x = rows[0] / np.linalg.norm(rows[0])
    y = rows[1] - (rows[1] @ x) * x
    y /= np.linalg.norm(y)
    return np.column_stack([rows @ np.array([x, y, np.cross(x, y)]).T, biases]).ravel()


def hand_poses(seed: int, count: int) -> np.ndarray:
    """Gimbal angles of spread directions with a random start, as if turned by hand."""
    return Rotation.random(count, np.random.default_rng([7, seed])).as_euler("YZX")


@cache
def calibrated(seed: int, dwells: int = 16, white: float = 2e-2) -> tuple[kf_calib.Calibration, np.ndarray]:
    """A short run and its true state in the frame of the sensors."""
    spread = (1e-2, 2e-2, 0.1)
    run = without_angles(Run(seed, dwells, 100, white_mps2=white, spread=spread, poses=hand_poses(seed, dwells)))
    return kf_calib.calibrate(run), in_sensor_frame(*sensitivities(run.truth))


def test_equals_nonlinear_least_squares_on_the_size_of_f() -> None:
    result, truth = calibrated(3, white=1e-3)
    means = np.array([visit.dwell.means[4:] for visit in result.visits])
    counts = np.array([visit.dwell.count for visit in result.visits])
    inflated = result.noise.effective_sigma_mps2

    def whitened(nine: np.ndarray, scale: np.ndarray) -> np.ndarray:
        state = np.zeros(12)
        state[NINE] = nine
        affine = state.reshape(3, 4)
        force = np.linalg.solve(affine[:, :3], (means - affine[:, 3]).T).T
        return (np.linalg.norm(force, axis=1) - G) / scale

    state = result.estimate.state.reshape(3, 4)
    unit = np.array([visit.dwell.means[1:4] for visit in result.visits]) / G
    along = np.linalg.solve(state[:, :3].T, unit.T).T
    scale = np.sqrt(((along * inflated) ** 2).sum(axis=1) / counts)
    start = truth.copy()
    start[[0, 5, 10]], start[[3, 7, 11]] = 1.0, 0.0
    found = least_squares(lambda nine: whitened(nine, scale), start[NINE], xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert np.abs(result.estimate.state[NINE] - found.x).max() < 1e-6
    covariance = np.linalg.inv(found.jac.T @ found.jac)
    sigma = np.sqrt(np.diag(result.estimate.covariance)[NINE])
    assert np.allclose(sigma, np.sqrt(np.diag(covariance)), rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("runs", [30, 400])
def test_errors_are_those_that_sigmas_state(runs: int) -> None:
    """1 sigma covers 68 % of each, the normalised squared error of nine parameters is 9, p is uniform."""
    errors, squares, p_values = list[np.ndarray](), list[float](), list[float]()
    for seed in range(runs):
        result, truth = calibrated(seed)
        estimate = result.estimate
        assert not result.model.square
        error = estimate.state[NINE] - truth[NINE]
        covariance = estimate.covariance[np.ix_(NINE, NINE)]
        squares.append(float(error @ np.linalg.solve(covariance, error)))
        errors.append((estimate.parameters - parameters_of(truth))[keep()] / estimate.sigma[keep()])
        assert result.consistency.p_value is not None
        p_values.append(result.consistency.p_value)
    ratios = np.array(errors)
    assert binom.ppf(0.001, runs, 0.683) <= np.sum(np.abs(ratios) < 1.0, axis=0).min()
    assert np.mean(np.abs(ratios) < 1.96) == pytest.approx(0.95, abs=0.02 * max(30 / runs, 1.0) ** 0.5)
    low, high = chi2.ppf([0.005, 0.995], 9 * len(squares)) / len(squares)
    assert low < np.mean(squares) < high
    assert kstest(p_values, "uniform").pvalue > 0.01


def keep() -> list[int]:
    return [SYMBOLS.index(symbol) for symbol in LEFT]


def test_the_three_engines_agree_to_rounding() -> None:
    spread = (1e-2, 2e-2, 0.1)
    for dwells, poses in ((12, hand_poses(1, 12)), (6, np.radians(FACES))):
        run = without_angles(Run(5, dwells, 80, white_mps2=1e-2, spread=spread, poses=poses))
        compared = compare(run)
        assert compared.max_difference_sigma < 1e-6
        assert max(way.max_relative_variance for way in compared.ways.values()) < 1e-6


def test_agrees_with_the_calibration_by_angles_of_the_same_recording() -> None:
    path = RECORDINGS / "navigation_24.mcap"
    one, other = kf_calib.calibrate(path), kf_calib.calibrate(kf_calib.open_recording(path, angles=False))
    affine = one.estimate.state.reshape(3, 4)
    expected = parameters_of(in_sensor_frame(affine[:, :3], affine[:, 3]))[keep()]
    sigma = other.estimate.sigma[keep()]
    assert np.abs((other.estimate.parameters[keep()] - expected) / sigma).max() < 2.5
    assert other.parameters["theta1"].value is None and other.parameters["nu2"].sigma is None
    assert other.consistency.consistent


def test_the_size_of_f_in_poses_left_out_is_predicted_within_its_covariance() -> None:
    for seed in (1, 2, 3):
        result, _ = calibrated(seed)
        assert result.held_out is not None
        dwells = result.fit.dwells
        rest = evaluate(dwells[:4].beside(dwells[5:]), result.bench, Settings())
        affine = rest.estimate.state.reshape(3, 4)
        force = np.linalg.solve(affine[:, :3], dwells[4].means[4:] - affine[:, 3])
        assert result.held_out.errors_mps2[4, 0] == pytest.approx(np.linalg.norm(force) - G, rel=0.05, abs=1e-5)
        assert 0.1 < np.mean(result.held_out.statistics) < 3.0


def test_scatter_between_poses_is_found_and_enters_sigma() -> None:
    quiet, _ = calibrated(2, 30)
    run = without_angles(Run(2, 30, 100, white_mps2=2e-2, spread=(1e-2, 2e-2, 0.1), scatter_mps2=0.02,
                             poses=hand_poses(2, 30)))  # fmt: skip
    loud = kf_calib.calibrate(run)
    assert quiet.noise.scatter_mps2.max() == 0.0
    assert loud.noise.scatter_mps2[0] == pytest.approx(0.02, rel=0.4)
    assert (loud.estimate.sigma[keep()] > 3.0 * quiet.estimate.sigma[keep()]).all()
    assert loud.consistency.consistent is False


@pytest.mark.parametrize("runs", [4, *slow(15)])
def test_six_faces_tell_six_and_the_axes_are_taken_for_square(runs: int) -> None:
    spread = (1.5e-2, 2e-2, 0.1)
    ratios = list[np.ndarray]()
    for seed in range(runs):
        run = without_angles(Run(seed, 6, 100, white_mps2=1e-3, spread=spread, poses=np.radians(FACES)))
        result = kf_calib.calibrate(run)
        truth = parameters_of(in_sensor_frame(*sensitivities(run.truth)))
        six = [k for k, symbol in enumerate(SYMBOLS) if symbol[0] in "Kb"]
        assert result.model.square and result.consistency.dof == 0
        assert [p.value is None for p in result.parameters.values()] == [symbol[0] not in "Kb" for symbol in SYMBOLS]
        ratios.append(((result.estimate.parameters - truth) / result.estimate.sigma)[six])
    assert any("taken for square to 1 deg" in said for said in result.warnings)
    assert np.mean(np.abs(ratios) < 2.0) > 0.9  # misalignments of 1.2 deg between two axes


EDGES = np.array([[0, 0, 45], [0, 0, 135], [0, 0, -45], [0, 0, -135]])


def most_likely(means: np.ndarray, sigma: float, square_rad: float) -> tuple[np.ndarray, np.ndarray]:
    """The nine states and their sigmas by scipy: sizes of force, and the angles between axes to ``square_rad``."""

    def left(nine: np.ndarray) -> np.ndarray:
        affine = np.zeros(12)
        affine[NINE] = nine
        rows = affine.reshape(3, 4)
        force = np.linalg.solve(rows[:, :3], (means - rows[:, 3]).T).T
        sizes = np.linalg.norm(force, axis=1)
        spread = sigma * np.linalg.norm(np.linalg.solve(rows[:, :3].T, (force / sizes[:, None]).T), axis=0)
        angles = np.array([affine[4] / affine[5], affine[8] / affine[10], affine[9] / affine[10]])
        return np.append((sizes - G) / spread, angles / square_rad)

    start = np.zeros(12)
    start[[0, 5, 10]] = 1.0
    found = least_squares(left, start[NINE], x_scale="jac", xtol=1e-15, ftol=1e-15)
    return found.x, np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac)))


def test_angles_that_the_poses_tell_are_fitted_though_they_do_not_tell_all() -> None:
    """Six faces and four edges about one axis tell one of three angles: as scipy's posterior with 1 deg of each has it,
    and the run agrees. Both angles that are not told are off by a third of a degree."""
    p_values = list[float]()
    for seed in range(8):
        run = Run(seed, 10, 100, white_mps2=1e-2, spread=(6e-3, 2e-2, 0.1), poses=np.radians([*FACES, *EDGES]))
        result = kf_calib.calibrate(without_angles(run))
        state, spread = most_likely(result.linearised.means.readings, 1e-3, np.radians(1.0))
        sigma = np.sqrt(np.diag(result.estimate.covariance))[NINE]
        assert result.model.square == ("nu1", "phi3")
        assert sigma[6] == pytest.approx(spread[6], rel=0.1)  # s3y: the angle between axes 2 and 3
        told = [k for k in range(9) if k not in (2, 5)]
        assert np.abs(result.linearised.state[NINE] - state)[told] == pytest.approx(0.0, abs=0.3 * spread[told].max())
        assert result.consistency.p_value is not None
        p_values.append(result.consistency.p_value)
    assert min(p_values) > 1e-3 and max(p_values) > 0.3


@pytest.mark.skipif(not (SHARED / "ferraris_hand.mcap").exists(), reason="the recording of imucal is not there")
def test_six_magnitudes_of_a_hand_held_sensor_give_the_published_scale_factors() -> None:
    path = SHARED / "ferraris_hand.mcap"
    dwells = Pass(kf_calib.open_recording(path), Settings()).fold()  # the faces as they are marked in the recording
    marked = evaluate(dwells, without(kf_calib.open_recording(path).bench), Settings()).parameters
    found = kf_calib.calibrate(kf_calib.open_recording(path, angles=False)).parameters
    for symbol, published in PUBLISHED.items():
        assert marked[symbol].value == pytest.approx(published, abs=5e-5)
        assert found[symbol].value == pytest.approx(published, abs=1e-4)  # longer dwells, found in the readings
    for symbol, bias in zip(("b1", "b2", "b3"), (0.5511, -0.6197, 0.3856), strict=True):
        assert found[symbol].value == pytest.approx(bias, abs=0.02)


@pytest.mark.parametrize(("share", "poor"), [(0.17, []), (0.23, ["K2", "b3"])])
def test_what_is_known_to_a_fifth_is_determined(share: float, poor: list[str]) -> None:
    """A scale factor to a fifth of 1, a bias to a fifth of gravity."""
    variances = np.full((3, 4), 1e-6)
    variances[1, 1], variances[2, 3], variances[1, 0] = share**2, (share * 9.81) ** 2, 1e9
    assert undetermined(np.diag(variances.ravel())) == poor


def test_a_poor_set_of_poses_is_told_not_fitted() -> None:
    run = without_angles(Run(1, 5, 100, white_mps2=1e-3, poses=np.radians(FACES[:5])))
    with pytest.raises(
        UnobservableError,
        match=r"5 poses do not determine K3, b3: turn it so that the axis of accelerometer 3 points up",
    ):
        kf_calib.calibrate(run)
    level = without_angles(Run(1, 5, 100, white_mps2=1e-3, poses=np.radians([[0, 0, k] for k in range(5)])))
    with pytest.raises(UnobservableError, match="not determine K1, K2, K3, b1, b2: turn it so that"):
        kf_calib.calibrate(level)


def test_dwells_are_found_in_the_readings_and_motion_is_left_out() -> None:
    recording = kf_calib.open_recording(RECORDINGS / "navigation_24.mcap", angles=False)
    by_angles = Pass(kf_calib.open_recording(RECORDINGS / "navigation_24.mcap"), Settings()).fold()
    found = Pass(recording, Settings()).fold()
    assert len(found) == len(by_angles)
    for one, other in zip(found, by_angles, strict=True):
        assert other.start_s - 1.0 < one.start_s < other.end_s
        assert other.start_s < one.end_s < other.end_s + 0.5
        assert one.means[4:] == pytest.approx(other.means[4:], abs=2e-5)


def test_readings_that_never_rest_are_refused() -> None:
    run = without_angles(Run(1, 6, 100))
    shaken = 3.0 * np.sin(np.random.default_rng(1).normal(size=(len(run.accel), 1)).cumsum(axis=0))
    run.accel = replace(run.accel, values=run.accel.values + shaken)
    with pytest.raises(InputError, match="no dwell was found"):
        kf_calib.calibrate(run)


def test_a_recording_needs_no_angles_and_standard_gravity_is_used_where_none_is_stated(tmp_path: Path) -> None:
    source = kf_calib.open_recording(RECORDINGS / "navigation_24.mcap", angles=False)
    assert source.bench.gravity_mps2 != 9.80665 and not any("standard" in said for said in source.warnings)
    bare = write_officially(tmp_path / "bare.mcap", (ACCEL,), metadata={})
    with pytest.raises(InputError, match=r"or do without them \(--no-angles\)"):
        kf_calib.open_recording(bare)
    source = kf_calib.open_recording(bare, angles=False)
    assert source.bench.gravity_mps2 == 9.80665 and any("standard 9.80665" in said for said in source.warnings)
    assert np.array_equal(read(source).accel.values, ACCEL[3].values)
    stated = kf_calib.open_recording(bare, {"gravity_mps2": "9.8123"}, angles=False)
    assert stated.bench.gravity_mps2 == 9.8123 and not stated.warnings


@pytest.mark.parametrize(
    "creep_rad, seeds", [(1e-3, range(1, 13)), *slow((1e-3, range(21, 81)), (2e-2, range(21, 81)))]
)
def test_a_hand_that_creeps_within_dwells_is_no_misfit(creep_rad: float, seeds: range) -> None:
    """Turned about any axis in each dwell, by up to ten times what its readings show."""
    p_values = list[float]()
    for seed in seeds:
        turns = creep_rad * np.random.default_rng(seed).standard_normal((24, 3))
        run = IndependentBench(
            seed, base=partial(_crept, turns=turns), bench=Bench((), G, scatter_sigma_mps2=0.0, angles=False),
            white_mps2=2e-3,
        )  # fmt: skip
        p_value = kf_calib.calibrate(run).consistency.p_value
        assert p_value is not None
        p_values.append(p_value)
    assert kstest(p_values, "uniform").pvalue > 1e-3 and min(p_values) > 0.01 / len(p_values) / 10


def _crept(state: State, turns: np.ndarray) -> np.ndarray:
    """The rotation vectors (n, 3) by which a hand has turned since its arrival."""
    return (state.since_s / DWELL_S)[:, None] * turns[state.dwell]
