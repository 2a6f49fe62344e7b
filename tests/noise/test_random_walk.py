"""A walk of the biases against dense covariance matrices, and against a truth that walks from reading to reading."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.long_runs import slow
from helpers.restricted import restricted_log_likelihood
from helpers.synthetic import Run
from scipy.stats import binom, chi2, multivariate_normal

from kf_calib.bench.arrays import Floats
from kf_calib.bench.streams import Stream
from kf_calib.dwells.pieces import walk_path_of
from kf_calib.estimation import square_root_information
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.cross_validation import held_out
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.settings import Settings
from kf_calib.noise import random_walk
from kf_calib.noise.noise_model import mean_covariances, steps
from kf_calib.noise.terms import RandomWalk, SettingError

Q = 1e-5


def walking(seed: int, intensity: float | Floats = Q, **options: object) -> Run:
    """A run whose biases walk from reading to reading, through the pauses as well; ``biases`` are those at its end."""
    made = Run(seed=seed, white_mps2=5e-5, **options)  # type: ignore[arg-type]
    rng, time_ns = np.random.default_rng([seed, 1]), made.accel.time_ns
    deltas = np.diff(time_ns * 1e-9, prepend=time_ns[0] * 1e-9)
    path = np.cumsum(rng.normal(size=(len(time_ns), 3)) * np.sqrt(deltas)[:, None], axis=0) * intensity
    made.accel = Stream(time_ns, made.accel.values + path)
    made.truth[3::4] += path[-1]
    return made


def fitted(run: Run) -> Calibration:
    return calibrate(run, Settings(effects=("bias-walk",)))


def covariance_at(times_s: Floats) -> Floats:
    """Of a walk with q = 1 that is zero at the first of the times."""
    since = times_s - times_s[0]
    return np.minimum(since[:, None], since[None, :])


def test_a_path_has_the_covariance_of_its_readings() -> None:
    """Rows of parabolas over uneven pieces with a gap between two, from the covariance of all readings."""
    parts = [np.arange(11) * 0.1, 1.1 + np.arange(7) * 0.1, 4.0 + np.arange(25) * 0.1]
    times, onto, triangles = np.concatenate(parts), [], []
    for part in parts:
        u = (part - part.mean()) / np.ptp(part) * 2.0
        orthogonal, upper = np.linalg.qr(np.column_stack([np.ones_like(u), u, u * u]))
        onto.append(orthogonal.T)
        triangles.append(upper)
    path = walk_path_of(
        np.array([part[0] for part in parts]), np.array([part[-1] for part in parts]), [11, 7, 25], np.array(triangles)
    )
    full, project, first = covariance_at(times), np.zeros((9, len(times))), 0
    for k, own in enumerate(onto):
        project[3 * k : 3 * k + 3, first : first + own.shape[1]] = own
        first += own.shape[1]
    span = times[-1] - times[0]
    mean = project @ (full[:, -1] / span)  # what W is, given its end
    given = project @ (full - np.outer(full[:, -1], full[:, -1]) / span) @ project.T
    np.testing.assert_allclose((path.modes * path.variances) @ path.modes.T, given, atol=1e-12)
    np.testing.assert_allclose(path.step, mean - project @ np.ones(len(times)), atol=1e-12)
    left = [np.trace(full[a:b, a:b]) for a, b in ((0, 11), (11, 18), (18, 43))]
    inside = [
        np.trace(own @ full[a:b, a:b] @ own.T) for own, (a, b) in zip(onto, ((0, 11), (11, 18), (18, 43)), strict=True)
    ]
    np.testing.assert_allclose(path.about_parabola, np.array(left) - inside, rtol=1e-9)


def test_the_likelihood_is_that_of_a_dense_covariance() -> None:
    """Against scipy's density of the residuals of the dwell means, the coefficients integrated out."""
    result = fitted(walking(3, dwells=9, setting_deg=1e-4))
    means, state = result.linearised.means, result.linearised.state
    times = []
    for begin, end in means.ends_s:
        times.append(begin + (end - begin) * (np.arange(500) + 0.5) / 500)
    instants, kernel = np.concatenate(times), np.zeros((9, 9))
    for i in range(9):
        for j in range(9):
            apart = np.abs(times[i][:, None] - times[j][None, :])
            kernel[i, j] = (instants[-1] - 0.5 * apart).mean()
    design = means.design.reshape(27, -1)
    rest = np.linalg.svd(design / np.linalg.norm(design, axis=0))[0][:, design.shape[1] :]
    values = []
    for q in (0.3 * Q, Q, 3.0 * Q):
        noise = result.noise.without(RandomWalk)
        full = q**2 * np.kron(kernel, np.diag([1.0, 4.0, 0.25]))
        for k, own in enumerate(mean_covariances(noise, means, state)):
            full[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += own
        expected = multivariate_normal(cov=rest.T @ full @ rest).logpdf(rest.T @ means.readings.ravel())
        found = restricted_log_likelihood(noise.with_terms(RandomWalk(q * np.array([1.0, 2.0, 0.5]))), means, state)
        values.append((expected, found))
    differences = np.diff(np.array(values), axis=0)
    np.testing.assert_allclose(differences[:, 0], differences[:, 1], atol=2e-3)


@pytest.mark.parametrize("setting_deg", [0.01, 1.0, 100.0])
def test_the_likelihood_of_a_walk_is_there_however_large_a_setting_error_is_tried_beside_it(setting_deg: float) -> None:
    """No rotation changes a reading along the force: there the covariance is that of the noise, or of rounding."""
    result = calibrate(Run(seed=3, dwells=24, count=60, white_mps2=1e-6))
    noise = result.noise.with_terms(SettingError(np.radians(setting_deg)), RandomWalk(np.full(3, 1e-9)))
    assert np.isfinite(restricted_log_likelihood(noise, result.linearised.means, result.linearised.state))


def test_leaving_an_orientation_out_equals_a_fit_without_it() -> None:
    """The two filters that meet at the dwell left out, against the covariance of all means and generalised least
    squares; one orientation is visited twice. In dwells as short as here a path shows in the means alone."""
    poses = np.random.default_rng(2).uniform(-np.pi, np.pi, (12, 3))
    poses[9] = poses[4]
    result = fitted(walking(4, dwells=12, poses=poses, count=80, gap_s=100.0))
    left_out = held_out(result.fit)
    assert left_out is not None
    found, floor = left_out.rms_mps2, left_out.floor_mps2
    expected, floor_expected = by_conditioning(result)
    assert found == pytest.approx(expected, rel=0.02) and floor == pytest.approx(floor_expected, rel=0.02)


def by_conditioning(result: Calibration) -> tuple[float, float]:
    """Rms held-out error and its expectation from the dense covariance of the dwell means."""
    means, count, full = result.linearised.means, len(result.visits), dense(result)
    design, readings = means.design.reshape(3 * count, -1), means.readings.ravel()
    errors, expected = [], []
    for group in ([0], [1], [2], [3], [4, 9], [5], [6], [7], [8], [10], [11]):
        out = np.concatenate([np.arange(3 * k, 3 * k + 3) for k in group])
        kept = np.setdiff1d(np.arange(3 * count), out)
        weight = np.linalg.inv(full[np.ix_(kept, kept)])
        spread = np.linalg.inv(design[kept].T @ weight @ design[kept])
        state = spread @ design[kept].T @ weight @ readings[kept]
        gain = full[np.ix_(out, kept)] @ weight
        tilt = design[out] - gain @ design[kept]
        own = full[np.ix_(out, out)] - gain @ full[np.ix_(kept, out)] + tilt @ spread @ tilt.T
        errors.append((readings[out] - design[out] @ state - gain @ (readings[kept] - design[kept] @ state)) ** 2)
        expected.append(np.diag(own))
    return float(np.sqrt(np.mean(np.concatenate(errors)))), float(np.sqrt(np.mean(np.concatenate(expected))))


def dense(result: Calibration) -> Floats:
    """Covariance (3 D, 3 D) of the dwells' mean readings about the model, by the moments of a Brownian path."""
    means, noise = result.linearised.means, result.noise
    starts, ends = means.ends_s.T
    middle = 0.5 * (starts + ends) - starts[0]
    kernel = np.minimum(middle[:, None], middle[None, :])
    np.fill_diagonal(kernel, starts - starts[0] + (ends - starts) / 3.0)
    full = np.kron(kernel, np.diag(noise.walk_mps2_per_sqrt_s**2))
    for k, own in enumerate(mean_covariances(noise, means, result.linearised.state)):
        full[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += own
    return full


@pytest.mark.parametrize("runs", [3, *slow(100)])
def test_sigmas_of_a_walk_and_of_the_twelve_beside_it_are_honest(runs: int) -> None:
    """95 % intervals, the NEES of the twelve (biases at the end of the run), the run's own misfit."""
    ratios, nees, misfit = [], 0.0, 0
    for seed in range(runs):
        run = walking(seed)
        result = fitted(run)
        found = result.parameters["qb"]
        assert found.value is not None and found.sigma is not None
        ratios.append((found.value - Q) / found.sigma)
        error = result.estimate.parameters - run.truth
        nees += float(error @ np.linalg.solve(result.estimate.parameter_covariance, error))
        misfit += result.consistency.consistent is False
    low, high = chi2.ppf([0.005, 0.995], runs)
    assert np.mean(np.abs(ratios) < 1.96) >= 0.85 and abs(np.mean(ratios)) < 3.0 / np.sqrt(runs)
    assert low < np.sum(np.square(ratios)) < high
    low, high = chi2.ppf([5e-4, 1.0 - 5e-4], 12 * runs)
    assert low < nees < 1.15 * high  # the intensity is estimated, too
    assert misfit <= max(1, 0.05 * runs)


@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize(("dwells", "runs"), [(12, 8), *slow((8, 60), (12, 60), (24, 60))])
def test_intervals_hold_where_biases_walk_by_another_amount_each(dwells: int, runs: int, stated: bool) -> None:
    """One walks and two stand; those that stand are known as if nothing walked, though nobody said which it is."""
    inside, one, others = list[bool](), list[float](), list[float]()
    for seed in range(runs):
        run = walking(seed, Q * np.array([1.0, 0.0, 0.0]), dwells=dwells, stated=stated)
        result = fitted(run)
        ends = [result.interval(each) for each in [*result.parameters.values()][:12]]
        inside += [low <= truth <= high for (low, high), truth in zip(ends, run.truth, strict=True)]
        lengths = [ends[k][1] - ends[k][0] for k in (3, 7, 11)]
        one.append(lengths[0])
        others += lengths[1:]
    low, high = binom.ppf([1e-4, 1.0 - 1e-4], 4 * runs, 0.95)  # of three accelerometers at most one is independent
    assert low / (4 * runs) <= np.mean(inside) <= min(high / (4 * runs), 0.99)
    assert np.median(others) < 0.3 * np.median(one)


def test_no_walk_is_seen_where_there_is_none() -> None:
    results = [fitted(walking(seed, 0.0)) for seed in range(100, 105)]
    unseen = [result.parameters["qb"].value is None for result in results]
    assert sum(unseen) >= 1  # half the time the likelihood is highest at zero
    for result in results:
        value = result.parameters["qb"]
        assert value.value is None or value.value < 4.0 * value.sigma


@pytest.mark.slow
def test_a_walk_in_the_model_lets_the_held_out_error_fall() -> None:
    run = walking(7, 3.0 * Q)
    bare, result = calibrate(run), fitted(run)
    assert result.held_out_rms_mps2 < 0.6 * bare.held_out_rms_mps2
    assert 0.75 < result.held_out_rms_mps2 / result.held_out_floor_mps2 < 1.3


def test_going_back_in_time_is_going_forward_on_reversed_dwells() -> None:
    """The factor of the biases before the first dwell, from all dwells, is what a filter over all finds for them."""
    result = fitted(walking(5, dwells=8))
    fit = result.fit
    rows, variances = fit.rows(), steps(fit.dwells, fit.noise)
    factor = np.zeros((12, 13))
    for own, variance in zip(rows[::-1], variances[::-1], strict=True):
        factor = random_walk.recede(factor, variance, own)
    forward = square_root_information.accumulate(rows, variances)[:-1]
    gains = [k for k in range(12) if k % 4 != 3]
    one, other = (square_root_information.solve(each, np.zeros(12)) for each in (factor, forward))
    sigma = np.sqrt(np.diag(other[1]))[gains]
    np.testing.assert_allclose(one[0][gains] / sigma, other[0][gains] / sigma, rtol=0, atol=1e-6)
    covariances = (each[1][np.ix_(gains, gains)] / np.outer(sigma, sigma) for each in (one, other))
    np.testing.assert_allclose(*covariances, rtol=0, atol=1e-6)


def test_rows_whitened_for_a_walk_have_the_gram_matrix_of_dense_noise() -> None:
    """W' W = X' (1 + J V J')^-1 X with J from every step of the biases to every row; one pause lasts no time."""
    rng, dwells, count, width = np.random.default_rng(7), 5, 6, 14
    rows = [rng.normal(size=(count, 3 + width)) for _ in range(dwells)]
    spans = np.array([(0.5, 0.3), (0.7, 0.2), (0.0, 0.4), (1.1, 0.6), (0.2, 0.1)])  # in the pause before, within
    variances = spans[:, :, None] * [1.0, 0.3, 2.0]
    later = np.zeros((dwells * count, 3 * 2 * dwells))
    for d, of_dwell in enumerate(rows):
        of_steps = later[d * count : (d + 1) * count].reshape(count, dwells, 2, 3)
        of_steps[:, : d + 1] += of_dwell[:, 3:][:, [3, 7, 11]][:, None, None]
        of_steps[:, 0, 0] = 0.0  # the path begins with the first dwell
        of_steps[:, d, 1] += of_dwell[:, :3]
    columns = np.concatenate(rows)[:, 3:]
    dense = np.eye(len(columns)) + later @ np.diag(variances.ravel()) @ later.T
    above = rng.normal(size=(4, width))
    whitened = random_walk.whiten_walk([above, *rows], variances)
    expected = columns.T @ np.linalg.solve(dense, columns) + above.T @ above
    np.testing.assert_allclose(whitened.T @ whitened, expected, rtol=1e-10, atol=1e-10)
