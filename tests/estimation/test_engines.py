"""Two engines, one result: filterpy sample by sample = block factor by factor = batch least squares."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from filterpy.kalman import SquareRootKalmanFilter
from helpers.synthetic import Run, sensitivities
from scipy.optimize import least_squares

from kf_calib.bench import paper_parameters
from kf_calib.bench.bench import Bench, axes_of
from kf_calib.dwells.folding import Folder
from kf_calib.dwells.table import DwellTable
from kf_calib.estimation import kalman_filterpy
from kf_calib.estimation.calibration import calibrate, evaluate, filterpy_estimate
from kf_calib.estimation.dwell_pass import Pass
from kf_calib.estimation.engine_comparison import compare
from kf_calib.estimation.kalman_filterpy import Samples
from kf_calib.estimation.settings import PRIORS, Settings
from kf_calib.noise.noise_model import Noise

pytestmark = pytest.mark.usefixtures("unmeasured")

CASES = {
    "paper grade": Run(seed=1, dwells=8, count=150),
    "four orientations": Run(seed=2, dwells=4, count=200),
    "mems grade": Run(seed=3, dwells=8, count=150, white_mps2=0.02, spread=(0.05, 0.05, 0.5)),
    "setting error": Run(seed=4, dwells=14, count=120, setting_deg=0.02),
    "coloured": Run(seed=5, dwells=8, count=200, phi=0.9),
    "scatter": Run(seed=6, dwells=8, count=150, scatter_mps2=1e-3),
    "shared noise": Run(seed=7, dwells=8, count=150, shared_mps2=1e-4, shaken_mps2=2e-4),
}


def distance(one, other) -> tuple[float, float]:
    """Largest difference in sigma, and of diag P relative."""
    difference = np.abs(one.parameters - other.parameters) / np.sqrt(np.diag(other.parameter_covariance))
    return float(difference.max()), float(np.abs(np.diag(one.covariance) / np.diag(other.covariance) - 1).max())


@pytest.mark.parametrize("name", CASES)
def test_three_ways_agree_to_rounding(name: str) -> None:
    compared = compare(CASES[name])
    for way in compared.ways.values():
        assert way.max_difference_sigma <= 1e-6
        assert way.max_relative_variance <= 1e-8


def test_three_ways_agree_on_what_orientations_about_one_axis_determine() -> None:
    """Two parameters of the twelve are not seen, and one sensor's sensitivity along the axis is not either."""
    poses = np.radians([[0.0, 0.0, angle] for angle in (0, 30, 70, 110, 200, 300)])
    compared = compare(Run(seed=1, count=60, poses=poses))
    assert compared.result.estimate.unseen.any() and not compared.result.estimate.unseen.all()
    for way in compared.ways.values():
        assert way.max_difference_sigma < 1e-6 and way.max_relative_variance < 1e-9


@pytest.mark.parametrize(
    ("name", "walk"), [("paper grade", 0.0), ("scatter", 0.0), ("setting error", 1e-5), ("shared noise", 1e-5)]
)
def test_plain_form_of_filterpy_agrees_to_its_own_rounding(name: str, walk: float) -> None:
    """With a stated prior; with a diffuse one (1e5 sigma) the plain form itself is off by 1e-4 sigma."""
    run = CASES[name]
    result = calibrate(run, Settings(prior=PRIORS["navigation"], walk_mps2_per_sqrt_s=walk))
    rooted = filterpy_estimate(run, result) if walk else result.estimate
    difference, variance = distance(filterpy_estimate(run, result, form="plain"), rooted)
    assert difference <= 1e-6 and variance <= 1e-6


@pytest.mark.parametrize("prior", ["navigation", "mems"])
def test_engines_agree_with_a_prior_and_a_walk(prior: str) -> None:
    """filterpy's biases step from reading to reading; the block engine keeps of a path what parabolas see of it."""
    run = CASES["setting error"]
    result = calibrate(run, Settings(prior=PRIORS[prior], walk_mps2_per_sqrt_s=1e-5))
    difference, variance = distance(filterpy_estimate(run, result), result.estimate)
    assert difference <= 2e-3 and variance <= 1e-3


def test_squares_of_filterpys_innovations_sum_to_the_misfit_of_batch_least_squares_and_prior() -> None:
    """In their covariance: sum nu^T S^-1 nu = sum |z - H x|^2 / sigma^2 + (x - x0)^T P0^-1 (x - x0)."""
    rng, sigma = np.random.default_rng(2), 0.3
    observation, readings = rng.normal(size=(20, 3, 4)), rng.normal(size=(20, 3))
    nominal, root = rng.normal(size=4), np.tril(rng.normal(size=(4, 4)))
    noise = Noise(np.full(3, sigma), np.ones(3))
    nuisances = np.zeros((20, 3, 0))
    samples = Samples(1, np.arange(20.0), observation, nuisances, readings, readings, sigma * np.eye(3))
    posterior = kalman_filterpy.estimate([samples], noise, nominal, root @ root.T, np.ones(4))
    rows = np.vstack([observation.reshape(-1, 4) / sigma, np.linalg.inv(root)])
    state, misfit, *_ = np.linalg.lstsq(rows, np.append(readings / sigma, np.linalg.solve(root, nominal)))
    assert posterior.state == pytest.approx(state, rel=1e-9)
    assert posterior.nis == pytest.approx(float(misfit[0]), rel=1e-9) and posterior.samples == 20


def test_a_walk_widens_and_a_prior_narrows() -> None:
    run = CASES["paper grade"]
    still, walking = calibrate(run), calibrate(run, Settings(walk_mps2_per_sqrt_s=1e-5))
    narrow = calibrate(run, Settings(prior=replace(PRIORS["mems"], bias_mps2=1e-6)))
    assert (walking.estimate.sigma > still.estimate.sigma).all()
    assert (narrow.estimate.sigma[3::4] < still.estimate.sigma[3::4]).all()


def test_mems_grade_equals_nonlinear_least_squares_on_the_papers_parameters() -> None:
    """scipy on theta, phi, K, b with rotation matrices for columns: 1e-6 relative."""
    run = CASES["mems grade"]
    result = calibrate(run)
    means = np.array([visit.dwell.means for visit in result.visits])
    counts = np.array([visit.dwell.count for visit in result.visits])
    weight = np.sqrt(counts)[:, None] / result.noise.effective_sigma_mps2

    def misfit(parameters: np.ndarray) -> np.ndarray:
        rows, biases = sensitivities(parameters)
        return ((means[:, 4:] - means[:, 1:4] @ rows.T - biases) * weight).ravel()

    found = least_squares(misfit, paper_parameters.nominal(), xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale="jac").x
    np.testing.assert_allclose(result.estimate.parameters, found, rtol=1e-6)


def test_inertial_platform_earth_rate_and_varying_columns() -> None:
    """Gravity that turns within a dwell: the block engine keeps all of the dwell's information."""
    run = Run(seed=7, dwells=6, count=100, rate_hz=0.05, gap_s=60.0)
    run.bench = Bench(axes_of("yzx"), 9.81, reference="inertial", latitude_deg=55.0)
    rows, biases = sensitivities(run.truth)
    elapsed_s = (run.accel.time_ns - run.accel.time_ns[0]) / 1e9
    poses = run.pose.values[np.searchsorted(run.pose.time_ns, run.accel.time_ns, side="right") - 1]
    noise = np.random.default_rng(0).normal(size=(len(elapsed_s), 3)) * 1e-4
    run.accel = replace(run.accel, values=run.bench.specific_force(elapsed_s, poses) @ rows.T + biases + noise)
    compared = compare(run)
    assert compared.max_difference_sigma <= 1e-6
    # gravity on a cone: 1, cosine and sine in each dwell
    forces = [visit.dwell.pieces.nodes.regressors for visit in compared.result.visits]
    assert sum(np.linalg.matrix_rank(each, tol=1e-9) for each in forces) == 3 * 6
    error = (compared.result.estimate.parameters - run.truth) / compared.result.estimate.sigma
    assert np.abs(error).max() < 4


def test_factors_merge_and_do_not_depend_on_batches() -> None:
    whole, chopped = Run(seed=8, dwells=6, count=6000), Run(seed=8, dwells=6, count=6000, batch=777)
    one, other = calibrate(whole), calibrate(chopped)
    np.testing.assert_array_equal(one.estimate.state, other.estimate.state)
    assert one.counts == other.counts
    parts = Pass(whole, Settings())
    left, right = Folder(), Folder()
    for rows in parts.rows():
        (left if rows.elapsed_s[0] % 20 < 10 else right).add(rows)
    by_number = {dwell.number: dwell for dwell in left.dwells}
    for dwell in right.dwells:
        known = by_number.get(dwell.number)
        by_number[dwell.number] = dwell if known is None else known.merge([dwell])
    merged = evaluate(DwellTable.of([by_number[k] for k in sorted(by_number)]), whole.bench, Settings())
    assert distance(merged.estimate, one.estimate)[0] < 1e-2  # the autocovariance sees other stretches
    np.testing.assert_allclose(merged.estimate.state, one.estimate.state, rtol=1e-12, atol=1e-14)


def test_trace_ends_on_the_estimate_and_shrinks() -> None:
    result = calibrate(CASES["paper grade"])
    trace = list(result.trace())
    np.testing.assert_allclose(trace[-1][2].state, result.estimate.state, rtol=1e-12, atol=1e-15)  # states up to 1
    determined = [estimate.sigma for _, _, estimate in trace if not estimate.unseen.any()]
    assert len(determined) > 8
    assert (np.diff(determined, axis=0) <= 1e-12).all()


def test_filterpy_takes_the_roots_that_are_set_past_its_setters() -> None:
    """The engine sets private attributes: a version of filterpy that names them otherwise would ignore them."""
    rng = np.random.default_rng(0)
    root, noise, walk = (np.tril(rng.normal(size=(n, n))) + 3 * np.eye(n) for n in (4, 3, 4))
    h, start, reading = rng.normal(size=(3, 4)), rng.normal(size=4), rng.normal(size=3)
    kf = SquareRootKalmanFilter(dim_x=4, dim_z=3)
    kf.x, kf.H = start.copy(), h
    kf._P1_2, kf._R1_2, kf._Q1_2 = root, noise, walk
    why = "filterpy no longer knows _P1_2, _R1_2 or _Q1_2: see kalman.py, and the cap in pyproject.toml"
    for known, square in ((kf.P, root), (kf.R, noise), (kf.Q, walk)):
        np.testing.assert_allclose(known, square @ square.T, err_msg=why)
    kf.predict()
    predicted = root @ root.T + walk @ walk.T
    np.testing.assert_allclose(kf.P, predicted, err_msg=why)
    kf.update(reading)
    gain = predicted @ h.T @ np.linalg.inv(h @ predicted @ h.T + noise @ noise.T)
    np.testing.assert_allclose(kf.x, start + gain @ (reading - h @ start), err_msg=why)
    np.testing.assert_allclose(kf.P, (np.eye(4) - gain @ h) @ predicted, atol=1e-12, err_msg=why)
