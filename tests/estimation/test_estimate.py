"""What an estimate says of its parameters: which are determined, and by how much their covariance is enlarged."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.thresholds import begins_at

from kf_calib.estimation.estimate import Estimate, Parameter, correlation, enlarged


def test_a_parameter_is_not_determined_from_ten_degrees_a_fifth_or_two_metres_per_second_squared_on() -> None:
    """Of a unit triad, in which sigmas of sensitivities are those of angles and of scale factors."""
    state = np.eye(3, 4).ravel()

    def unseen(parameter: int, sigma: float) -> bool:
        return bool(Estimate(state, sigma**2 * np.eye(12), np.zeros((12, 0))).unseen[parameter])

    for parameter, least in ((4, np.radians(10.0)), (6, 0.2), (7, 2.0)):
        assert begins_at(lambda sigma, k=parameter: unseen(k, sigma), 1e-3, 10.0) == pytest.approx(least)


def test_a_parameter_in_words() -> None:
    cases = (1.0, 0.25, "m/s^2"), (1.0, 0.25, "1"), (None, 0.25, "1"), (1.0, None, "1")
    told = [str(Parameter("b1", value, sigma, unit, 0.0, "", 1.0)) for value, sigma, unit in cases]
    assert told == ["b1 = 1 ± 0.25 m/s^2", "b1 = 1 ± 0.25", "b1 is not determined", "b1 is not determined"]


def test_considered_parameters_enlarge_the_covariance_by_p_b_p() -> None:
    """Of one covariance or several; B of low rank, of states of very unlike sizes, one of which has none of it."""
    rng, sizes = np.random.default_rng(4), 10.0 ** np.array([-8.0, 3.0, 0.0, -2.0])
    roots = rng.normal(size=(5, 4, 4)) * sizes[:, None]
    covariances, changes = roots @ np.swapaxes(roots, 1, 2), rng.normal(size=(4, 2)) / sizes[:, None]
    changes[2] = 0.0
    extra = changes @ changes.T
    expected = covariances + covariances @ extra @ covariances
    np.testing.assert_allclose(enlarged(covariances, extra), expected, rtol=1e-9)
    np.testing.assert_allclose(enlarged(covariances[0], extra), expected[0], rtol=1e-9)
    assert enlarged(covariances, np.zeros((4, 4))) is covariances


def test_coefficients_in_combinations_that_are_not_determined_have_no_sigma() -> None:
    """Two coefficients of four cannot be told apart; neither they nor any of the twelve are of another."""
    lost = np.zeros((16, 1))
    lost[[13, 15], 0] = 3.0, -1e-5
    found = Estimate(np.append(np.eye(3, 4), np.zeros(4)), 0.01 * np.eye(16), lost)
    assert np.isnan(found.effect_sigma).tolist() == [False, True, False, True] and not found.unseen.any()
    assert found.effect_sigma[[0, 2]] == pytest.approx(0.1)
    assert found.determined.tolist() == [k not in (13, 15) for k in range(16)]
    assert np.isnan(correlation(found)[[13, 15]]).all()
    seen = [k for k in range(16) if k not in (13, 15)]
    assert correlation(found)[np.ix_(seen, seen)] == pytest.approx(np.eye(14), abs=1e-12)
