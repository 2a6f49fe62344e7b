"""What poses without angles tell, against derivatives of the size of the force by differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.synthetic import G, Run
from scipy.optimize import approx_fprime
from scipy.spatial.transform import Rotation

from kf_calib.bench.arrays import Floats
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.free_attitude import DIRECTIONS, covariance_of, most_informative, row_of
from kf_calib.estimation.results import Calibration
from kf_calib.noise.terms import Scatter

FREE = [0, 3, 4, 5, 7, 8, 9, 10, 11]
"""The states that are not fixed by the frame: s1x b1, s2x s2y b2, s3x s3y s3z b3."""


@pytest.fixture(scope="module")
def result() -> Calibration:
    """Of ten poses in a hand."""
    poses = Rotation.random(10, np.random.default_rng(3)).as_euler("YZX")
    run = Run(3, 10, 100, white_mps2=2e-2, spread=(1e-2, 2e-2, 0.1), poses=poses)
    run.bench = replace(run.bench, axes=(), angles=False, angle_sigma_deg=None, nominal={"theta1": 0.0, "theta3": 0.0})
    run.pose = run.pose[:0]
    return calibrate(run)


def size(readings: Floats, state: Floats) -> float:
    """|f| = |S^-1 (z - b)|."""
    affine = state.reshape(3, 4)
    return float(np.linalg.norm(np.linalg.solve(affine[:, :3], readings - affine[:, 3])))


def test_the_covariance_is_that_of_normal_equations_of_sizes(result: Calibration) -> None:
    """Of means with noise within dwells and scatter between them, unlike in the three accelerometers, beside weak
    knowledge: 100 % of scale factors, 10 m/s^2 of biases, and one degree between the axes."""
    noise = replace(result.noise, sigma_mps2=np.array([0.02, 0.04, 0.01]), inflation=np.array([1.0, 2.0, 4.0]))
    noise = noise.with_terms(Scatter(np.array([1e-3, 4e-3, 2e-3])))
    state, angle = result.linearised.state, np.radians(1.0)
    weak = np.array([1.0, 10.0, angle, 1.0, 10.0, angle, angle, 1.0, 10.0])
    information = np.diag(weak**-2.0)
    for dwell in result.fit.dwells:
        readings = dwell.means[4:]
        by_state = approx_fprime(state, lambda x, z=readings: size(z, x), 1e-7)[FREE]
        by_readings = approx_fprime(readings, lambda z: size(z, state), 1e-6)
        of_mean = noise.scatter_mps2**2 + noise.sigma_mps2**2 * noise.inflation / dwell.count
        information += np.outer(by_state, by_state) / float(by_readings**2 @ of_mean)
    covariance = covariance_of(result.linearised, noise, angle)
    np.testing.assert_allclose(covariance[np.ix_(FREE, FREE)], np.linalg.inv(information), rtol=0.02, atol=1e-9)
    fixed = [k for k in range(12) if k not in FREE]
    assert not covariance[fixed].any() and not covariance[:, fixed].any()


@pytest.mark.parametrize("up", ["+x", "-z", "+x -y", "-x +y +z"])
def test_the_row_of_a_pose_is_the_derivative_of_its_size(result: Calibration, up: str) -> None:
    state = result.linearised.state
    affine = state.reshape(3, 4)
    readings = affine[:, :3] @ (G * DIRECTIONS[up]) + affine[:, 3]
    row, weights = row_of(up, state, G)
    np.testing.assert_allclose(row, -approx_fprime(state, lambda x: size(readings, x), 1e-7), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(weights, approx_fprime(readings, lambda z: size(z, state), 1e-6), rtol=1e-5, atol=1e-6)


def test_the_next_pose_is_that_of_which_the_size_is_known_worst(result: Calibration) -> None:
    """To a tenth of its variance, so that a face is preferred to a corner that is hardly less known."""
    state = result.linearised.state
    for seed in range(20):
        covariance = np.zeros((12, 12))
        root = np.random.default_rng(seed).normal(size=(9, 9))
        covariance[np.ix_(FREE, FREE)] = root @ root.T
        spread = {up: float(row_of(up, state, G)[0] @ covariance @ row_of(up, state, G)[0]) for up in DIRECTIONS}
        best = most_informative(covariance, state, G)
        assert 1.1 * spread[best] >= max(spread.values())
        fewer = [up for up in DIRECTIONS if len(up) < len(best)]
        assert all(spread[up] < spread[best] for up in fewer)
