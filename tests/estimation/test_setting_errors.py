"""Setting errors are rotations: the specific force turns and never becomes longer.

The truth is drawn by scipy's rotations: means of dwells that stand off their pose by a whole rotation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from helpers.long_runs import slow
from helpers.synthetic import NOMINAL, G, Run, sensitivities
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import binom, chi2

from kf_calib.bench.arrays import one_blas_thread
from kf_calib.bench.bench import Bench, axes_of
from kf_calib.bench.streams import Orientations
from kf_calib.dwells.folding import dwells_of_table
from kf_calib.estimation.attitude import _posterior_rotations
from kf_calib.estimation.calibration import calibrate, evaluate
from kf_calib.estimation.engine_comparison import compare
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.settings import Settings
from kf_calib.noise.terms import Scatter, SettingError

pytestmark = pytest.mark.usefixtures("unmeasured")

COUNT = 1000
DWELLS = 24


@dataclass
class Trial:
    """Mean readings (D, 3) at poses (D, gimbals), their true parameters and noise; the bench states the setting error
    or not."""

    seed: int
    setting_deg: float
    mean_sigma_mps2: float
    stated: bool = True
    axes: str = "yzx"

    def __post_init__(self) -> None:
        rng = np.random.default_rng([11, self.seed])
        self.bench = Bench(axes_of(self.axes), G, angle_sigma_deg=self.setting_deg if self.stated else None)
        self.truth = NOMINAL + rng.normal(size=12) * 1e-3
        self.rows, self.biases = sensitivities(self.truth)
        self.poses = rng.uniform(-np.pi, np.pi, (DWELLS, len(self.axes)))
        shown = Rotation.from_euler(self.axes.upper(), self.poses).inv().apply([0.0, G, 0.0])
        off = Rotation.from_rotvec(rng.normal(size=(DWELLS, 3)) * np.radians(self.setting_deg))
        noise = rng.normal(size=(DWELLS, 3)) * self.mean_sigma_mps2
        self.means = off.apply(shown) @ self.rows.T + self.biases + noise
        white = self.mean_sigma_mps2 * np.sqrt(COUNT)
        self.deviations = white * np.sqrt(rng.chisquare(COUNT - 3, (DWELLS, 3)) / (COUNT - 3))

    def evaluated(self) -> Calibration:
        count = len(self.means)
        table = Orientations(
            self.means, self.poses, 60.0 * np.arange(count), self.deviations, np.full(count, COUNT),
            np.full(count, np.nan),
        )  # fmt: skip
        with one_blas_thread():
            return evaluate(dwells_of_table(table, self.bench), self.bench, Settings())


@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize("axes", ["x", "yx"])
@pytest.mark.parametrize("runs", [5, *slow(40)])
def test_attitudes_do_not_tell_what_the_poses_leave_untold(axes: str, stated: bool, runs: int) -> None:
    """An axis that lies flat turns the force in a plane, and one that is upright not at all: the sensitivities to a
    force along x stay nominal, and all others are covered."""
    ratios = list[np.ndarray]()
    for seed in range(runs):
        trial = Trial(300 + seed, 0.05, 1e-5, stated, axes)
        result = trial.evaluated()
        estimate, nominal = result.estimate, result.model.nominal_state().reshape(3, 4)
        state, sigma = estimate.state.reshape(3, 4), np.sqrt(np.diag(estimate.covariance)).reshape(3, 4)
        assert estimate.undetermined.shape[1] == 3
        np.testing.assert_allclose(state[:, 0], nominal[:, 0], rtol=0, atol=1e-12)
        true = np.column_stack([trial.rows, trial.biases])
        ratios.append((state - true)[:, 1:] / sigma[:, 1:])
    z = np.array(ratios).reshape(len(ratios), 9)
    low, high = binom.interval(0.9999, z.size, 0.95)
    assert low <= np.sum(np.abs(z) < 1.96) <= high
    assert abs(np.sqrt(np.mean(z**2)) - 1.0) < 4.0 / np.sqrt(2.0 * z.size)


def turned_apart(state: np.ndarray, frame: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nine parameters in the frame of the sensors and the rotation vector (3,) from ``frame`` to it, as one array, and
    that frame. A common rotation of all axes is no difference of the angles between them, however large it is."""
    affine = state[:12].reshape(3, 4)
    x = affine[0, :3] / np.linalg.norm(affine[0, :3])
    y = affine[1, :3] - (affine[1, :3] @ x) * x
    y /= np.linalg.norm(y)
    axes = np.array([x, y, np.cross(x, y)])
    rows = affine[:, :3] @ axes.T
    turn = Rotation.from_matrix(axes @ frame.T).as_rotvec()
    return np.concatenate([rows[0, :1], rows[1, :2], rows[2], affine[:, 3], turn]), axes


def nees(result: Calibration, trial: Trial) -> float:
    """The normalised estimation error squared of the twelve, in the coordinates of ``turned_apart``."""
    state, true = result.estimate.state, np.column_stack([trial.rows, trial.biases]).ravel()
    _, frame = turned_apart(state, np.eye(3))
    jacobian, step = np.zeros((12, 12)), 1e-7
    for k in range(12):
        moved = step * np.eye(12)[k]
        jacobian[:, k] = (turned_apart(state + moved, frame)[0] - turned_apart(state - moved, frame)[0]) / (2.0 * step)
    covariance = jacobian @ result.estimate.covariance @ jacobian.T
    sigma = np.sqrt(np.diag(covariance))
    error = (turned_apart(true, frame)[0] - turned_apart(state, frame)[0]) / sigma
    return float(error @ np.linalg.solve(covariance / np.outer(sigma, sigma), error))


SIZES = [
    (setting_deg, mean_ug, stated) for setting_deg in (0.003, 0.05, 0.2, 1.0) for mean_ug in (0.1, 1.0, 100.0)
    for stated in (True, False)
]  # fmt: skip


@pytest.mark.parametrize(
    "setting_deg, mean_ug, stated, runs",
    [(0.05, 1.0, True, 10), (0.2, 0.1, False, 10), *slow(*((*size, 300) for size in SIZES))],
)
def test_sigmas_and_alarms_are_those_of_the_setting_error(
    setting_deg: float, mean_ug: float, stated: bool, runs: int
) -> None:
    """Each of the twelve is covered, the NEES is in its band, and one run in a hundred raises an alarm.

    Where the setting error is estimated, the misfit across the force is no evidence, and the alarms are those along it,
    or fewer.
    """
    ratios, squares, alarms = list[np.ndarray](), list[float](), 0
    for seed in range(runs):
        trial = Trial(seed, setting_deg, mean_ug * 1e-6 * G, stated)
        result = trial.evaluated()
        ratios.append((result.estimate.parameters - trial.truth) / result.estimate.sigma)
        squares.append(nees(result, trial))
        assert result.consistency.p_value is not None
        alarms += result.consistency.p_value < 0.01
    covered = (np.abs(ratios) < 1.96).mean(axis=0)
    low, high = chi2.ppf([0.001, 0.999], 12 * runs) / runs
    assert low < np.mean(squares) < high * (1.0 if stated else 1.03)  # an estimated size has an error of its own
    spread = np.sqrt(0.05 * 0.95 / runs)
    assert abs(covered.mean() - 0.95) < 2.0 * spread + 0.005 and np.abs(covered - 0.95).max() < 3.7 * spread + 0.005
    assert np.abs(np.mean(ratios, axis=0)).max() < 4.0 / np.sqrt(runs)
    assert alarms <= binom.ppf(0.999, runs, 0.013)


def test_equals_least_squares_over_the_parameters_and_all_rotations_at_once() -> None:
    """scipy's, with the three rotations of every dwell as unknowns beside the twelve; at 0.2 deg."""
    trial = Trial(3, 0.2, 1e-6 * G)
    result = trial.evaluated()
    sigma = result.noise.effective_sigma_mps2 / np.sqrt(COUNT)
    shown = Rotation.from_euler("YZX", trial.poses).inv().apply([0.0, G, 0.0])
    sigma_rad = np.radians(0.2)

    def whitened(unknown: np.ndarray) -> np.ndarray:
        affine, alpha = unknown[:12].reshape(3, 4), unknown[12:].reshape(-1, 3) * sigma_rad
        felt = Rotation.from_rotvec(alpha).apply(shown)
        left = (trial.means - felt @ affine[:, :3].T - affine[:, 3]) / sigma
        return np.concatenate([left.ravel(), unknown[12:]])

    start = np.append(result.linearised.model.nominal_state(), np.zeros(3 * DWELLS))
    found = least_squares(whitened, start, x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15, max_nfev=200)
    covariance = np.linalg.inv(found.jac.T @ found.jac)[:12, :12]
    estimated = result.estimate
    assert np.abs((estimated.state - found.x[:12]) / np.sqrt(np.diag(covariance))).max() < 0.01
    assert np.sqrt(np.diag(estimated.covariance)) == pytest.approx(np.sqrt(np.diag(covariance)), rel=2e-3)
    assert result.consistency.statistic == pytest.approx(2.0 * found.cost, rel=1e-3)


def test_a_small_setting_error_is_as_it_was_by_linear_rotations() -> None:
    """At 1 arcsec its square is nothing: dense least squares with f + alpha x f gives the same numbers."""
    trial = Trial(4, 1.0 / 3600.0, 1e-6 * G)
    result = trial.evaluated()
    sigma = result.noise.effective_sigma_mps2 / np.sqrt(COUNT)
    force = Rotation.from_euler("YZX", trial.poses).inv().apply([0.0, G, 0.0])
    rows = result.estimate.state.reshape(3, 4)[:, :3]
    information, right = np.zeros((12, 12)), np.zeros(12)
    for f, mean in zip(force, trial.means, strict=True):
        design = np.kron(np.eye(3), np.append(f, 1.0))
        across = G**2 * np.eye(3) - np.outer(f, f)
        covariance = np.diag(sigma**2) + np.radians(1.0 / 3600.0) ** 2 * rows @ across @ rows.T
        weighted = design.T @ np.linalg.inv(covariance)
        information, right = information + weighted @ design, right + weighted @ mean
    expected = np.linalg.solve(information, right)
    spread = np.sqrt(np.diag(np.linalg.inv(information)))
    assert np.abs((result.estimate.state - expected) / spread).max() < 0.02
    assert np.sqrt(np.diag(result.estimate.covariance)) == pytest.approx(spread, rel=1e-3)


@pytest.mark.parametrize("setting_deg", [0.05, 1.0])
def test_engines_agree_beside_setting_errors(setting_deg: float) -> None:
    compared = compare(Run(seed=2, dwells=14, count=60, setting_deg=setting_deg, white_mps2=1e-4))
    assert compared.max_difference_sigma < 1e-6
    assert max(way.max_relative_variance for way in compared.ways.values()) < 1e-6


def test_left_out_orientations_are_predicted_beside_a_setting_error() -> None:
    result = calibrate(Run(seed=5, dwells=24, count=100, setting_deg=0.2, white_mps2=1e-4))
    assert result.held_out is not None
    assert np.mean(result.held_out.statistics) == pytest.approx(3.0, abs=0.9)


@pytest.mark.parametrize("scatter_mps2", [0.0, 2e-4])
def test_the_likeliest_setting_error_is_that_of_normal_variates(scatter_mps2: float) -> None:
    """Rotations a N(0, s^2) turn readings by S (a x f), in noise and scatter R: a = s^2 C^T (s^2 C C^T + R)^-1 e, with
    C by turning forces a little. About the force the readings tell nothing."""
    fit = calibrate(Run(seed=3, dwells=12, count=100, setting_deg=2e-3)).fit
    noise = fit.noise.with_terms(SettingError(3e-5), Scatter(np.full(3, scatter_mps2)))
    means, state = fit.linearised.means, fit.state + 1e-5 * np.random.default_rng(1).normal(size=12)
    modes, variances = _posterior_rotations(means, noise, state, np.zeros((12, 3, 3)))
    sensitivity = state.reshape(3, 4)[:, :3]
    errors = means.readings - means.force_mps2 @ sensitivity.T - state.reshape(3, 4)[:, 3]
    for k, force in enumerate(means.force_mps2):
        turned = [Rotation.from_rotvec(1e-6 * axis).apply(force) - force for axis in np.eye(3)]
        columns = sensitivity @ np.array(turned).T / 1e-6
        noise_of_mean = np.diag(noise.effective_sigma_mps2**2 / means.counts[k] + scatter_mps2**2)
        gain = 9e-10 * columns.T @ np.linalg.inv(9e-10 * columns @ columns.T + noise_of_mean)
        assert modes[k] == pytest.approx(gain @ errors[k], abs=1e-3 * np.linalg.norm(modes[k]))
        covariance = 9e-10 * (np.eye(3) - gain @ columns)
        assert variances[k] == pytest.approx(np.trace(covariance) - 9e-10, rel=1e-3)
