"""The paper's parameters in closed form against finite differences."""

from collections.abc import Callable

import numpy as np
import pytest
from helpers.synthetic import NOMINAL, sensitivities
from scipy.spatial.transform import Rotation

from kf_calib.bench import paper_parameters
from kf_calib.errors import BenchError

RNG = np.random.default_rng(3)


def test_nominal_is_the_papers_and_can_be_overridden() -> None:
    np.testing.assert_array_equal(paper_parameters.nominal(), NOMINAL)
    assert paper_parameters.nominal({"theta1": 0.0})[0] == 0.0
    with pytest.raises(BenchError, match="theta2"):
        paper_parameters.nominal({"theta2": 0.0})


@pytest.mark.parametrize("size", [1e-4, 0.05, 0.3])
def test_state_is_the_turned_axes(size: float) -> None:
    truth = NOMINAL + RNG.normal(size=12) * size
    rows, biases = sensitivities(truth)
    np.testing.assert_allclose(
        paper_parameters.state_of(truth).reshape(3, 4), np.column_stack([rows, biases]), atol=1e-14
    )
    np.testing.assert_allclose(paper_parameters.parameters_of(paper_parameters.state_of(truth)), truth, atol=1e-13)


def slopes(function: Callable[[np.ndarray], np.ndarray], at: np.ndarray) -> np.ndarray:
    """Of a function of twelve numbers, by differences."""
    step = 1e-6
    return np.column_stack([(function(at + step * e) - function(at - step * e)) / (2 * step) for e in np.eye(12)])


@pytest.mark.parametrize("size", [0.0, 0.05, 0.3])
def test_both_jacobians_by_finite_differences(size: float) -> None:
    truth = NOMINAL + RNG.normal(size=12) * size
    state = paper_parameters.state_of(truth)
    forward, back = slopes(paper_parameters.state_of, truth), slopes(paper_parameters.parameters_of, state)
    np.testing.assert_allclose(paper_parameters.sensitivity_jacobian(truth), forward, atol=1e-9)
    np.testing.assert_allclose(paper_parameters.jacobian(state), back, atol=1e-9)


def test_parameters_and_state_are_one_to_one_whatever_way_the_axes_point() -> None:
    """An accelerometer 2 that points down has a negative K2; no sign is lost, and the Jacobian is the derivative."""
    rng = np.random.default_rng(0)
    for _ in range(200):
        state = rng.standard_normal(12)
        np.testing.assert_allclose(paper_parameters.state_of(paper_parameters.parameters_of(state)), state, atol=1e-12)
        assert (paper_parameters.parameters_of(state)[6] < 0) == (state[5] < 0)
        differences = slopes(paper_parameters.parameters_of, state)
        np.testing.assert_allclose(paper_parameters.jacobian(state), differences, rtol=1e-4, atol=1e-4)


def test_a_turn_of_the_frame_is_found_and_undone() -> None:
    """Against scipy's rotations: turning the frame changes angles alone, and comparing in one frame leaves nothing."""
    rng = np.random.default_rng(2)
    parameters = paper_parameters.nominal() + rng.normal(0.0, 1e-3, 12)
    state = paper_parameters.state_of(parameters)
    turn = np.array([5e-5, -2e-5, 3e-5])
    moved = state.reshape(3, 4).copy()
    moved[:, :3] = Rotation.from_rotvec(-turn).apply(moved[:, :3])
    found = paper_parameters.frame_turn(moved.ravel(), state)
    np.testing.assert_allclose(found, -turn, rtol=1e-3)
    back = paper_parameters.parameters_of(paper_parameters.turned(moved.ravel(), found))
    np.testing.assert_allclose(back, parameters, atol=1e-8)
    other = paper_parameters.parameters_of(moved.ravel())
    assert abs(other - parameters)[[0, 1, 4, 5, 8, 9]].max() > 1e-5
    np.testing.assert_allclose(other[[2, 3, 6, 7, 10, 11]], parameters[[2, 3, 6, 7, 10, 11]], rtol=1e-12)
