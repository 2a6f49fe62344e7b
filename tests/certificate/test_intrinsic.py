"""The nine parameters that no choice of a frame changes, their covariance, and a check of the budget by drawing."""

import math

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from kf_calib.bench import paper_parameters
from kf_calib.certificate.budget import COVERAGE, Budget, Contribution, ellipsoid_factor
from kf_calib.certificate.intrinsic import intrinsic
from kf_calib.certificate.monte_carlo import monte_carlo

RNG = np.random.default_rng(5)
TWELVE = paper_parameters.nominal() + RNG.normal(0.0, 2e-3, 12)
ROOT = RNG.normal(0.0, 1e-5, (12, 12))
COVARIANCE = ROOT @ ROOT.T


def turned(parameters: np.ndarray, rotation: Rotation) -> np.ndarray:
    state = paper_parameters.state_of(parameters).reshape(3, 4).copy()
    state[:, :3] = rotation.apply(state[:, :3])
    return paper_parameters.parameters_of(state.ravel())


def test_a_turn_of_the_frame_changes_none() -> None:
    other = turned(TWELVE, Rotation.from_rotvec([0.01, -0.02, 0.005]))
    np.testing.assert_allclose(intrinsic(other, COVARIANCE).values, intrinsic(TWELVE, COVARIANCE).values, atol=1e-14)
    assert np.abs(other - TWELVE).max() > 5e-3


def test_the_covariance_is_that_of_draws_through_the_formulas() -> None:
    drawn = np.random.default_rng(6).multivariate_normal(TWELVE, COVARIANCE, 200_000)
    state = np.array([paper_parameters.state_of(own) for own in drawn]).reshape(-1, 3, 4)
    axes = state[:, :, :3] / np.linalg.norm(state[:, :, :3], axis=2)[:, :, None]
    angles = [np.arccos(np.sum(axes[:, i] * axes[:, j], axis=1)) for i, j in ((0, 1), (0, 2), (1, 2))]
    nine = np.column_stack([np.linalg.norm(state[:, :, :3], axis=2), *angles, state[:, :, 3]])
    told = intrinsic(TWELVE, COVARIANCE)
    np.testing.assert_allclose(nine.mean(axis=0), told.values, atol=1e-6)
    sigma = np.sqrt(np.diag(told.covariance))
    np.testing.assert_allclose(np.cov(nine.T) / np.outer(sigma, sigma),
                               told.covariance / np.outer(sigma, sigma), atol=0.012)  # fmt: skip


def test_what_turns_the_block_is_in_no_angle_between_its_axes() -> None:
    """A tilt of 1 arcsec about each axis, as the covariance that it gives the twelve."""
    tilt = math.radians(1.0 / 3600.0)
    moved = [(turned(TWELVE, Rotation.from_rotvec(step)) - turned(TWELVE, Rotation.from_rotvec(-step))) / 2.0
             for step in tilt * np.eye(3)]  # fmt: skip
    covariance = sum((np.outer(own, own) for own in moved), np.zeros((12, 12)))
    told = intrinsic(TWELVE, covariance)
    assert np.sqrt(np.diag(covariance)).max() > 0.9 * tilt
    assert np.sqrt(np.abs(np.diag(told.covariance))).max() < 1e-6 * tilt


@pytest.mark.parametrize("count", [1, 9, 12])
def test_an_ellipsoid_holds_what_it_says(count: int) -> None:
    normal = np.random.default_rng(7).standard_normal((200_000, count))
    within = (np.linalg.norm(normal, axis=1) <= ellipsoid_factor(count, math.inf)).mean()
    assert within == pytest.approx(COVERAGE, abs=0.002)
    sizes = np.sqrt(9.0 / np.random.default_rng(8).chisquare(9.0, 200_000))
    within = (np.linalg.norm(normal * sizes[:, None], axis=1) <= ellipsoid_factor(count, 9.0)).mean()
    assert within == pytest.approx(COVERAGE, abs=0.002)


def line(standard: float, distribution: str, dof: float = math.inf, dwells: int = 0) -> Contribution:
    """One that moves all of the twelve alike: in common, or anew in each of so many dwells."""
    changes = np.full((12, max(dwells, 1)), 1.0 / math.sqrt(max(dwells, 1)))
    return Contribution("e", "", "B", standard, "", distribution, dof, None, standard**2 * np.ones((12, 12)), changes)


@pytest.mark.parametrize(
    ("contribution", "half_width"),
    [
        (line(2.0, "normal"), 2.0 * stats.norm.ppf(0.5 + COVERAGE / 2)),
        (line(2.0, "rectangular"), 2.0 * math.sqrt(3.0) * COVERAGE),
        (line(2.0, "triangular"), 2.0 * math.sqrt(6.0) * (1.0 - math.sqrt(1.0 - COVERAGE))),
        (line(2.0, "arcsine"), 2.0 * math.sqrt(2.0) * math.sin(0.5 * math.pi * COVERAGE)),
        (line(2.0, "normal", 5.0), 2.0 * stats.t.ppf(0.5 + COVERAGE / 2, 5.0)),
        (line(2.0, "rectangular", dwells=50), 4.0),  # a sum of many is normal
    ],
)
def test_one_contribution_has_the_interval_of_its_distribution(contribution: Contribution, half_width: float) -> None:
    check = monte_carlo(Budget((contribution,)), 200_000)
    np.testing.assert_allclose(check.expanded, half_width, rtol=0.006)


def test_the_filter_and_a_normal_error_confirm_the_budget_and_one_rectangle_does_not() -> None:
    filter_line = Contribution("u_A", "", "A", None, "", "normal", math.inf, None, COVARIANCE)
    sigma = np.sqrt(np.diag(COVARIANCE))
    assert all(monte_carlo(Budget((filter_line,)), 1_000_000).agrees)
    budget = Budget((filter_line, line(20.0 * sigma.max(), "rectangular")))
    check = monte_carlo(budget, 100_000)
    assert not any(check.agrees) and (check.expanded < budget.expanded).all()
