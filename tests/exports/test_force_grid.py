"""Means over the grid on which the error of an export is judged, against means in closed form."""

import numpy as np
import pytest
from scipy.integrate import quad

from kf_calib.exports.target import force_grid

G = 9.81


def test_its_shares_are_one_together_and_all_directions_count_alike() -> None:
    """Mean of f is none, of f_i f_j it is g²/3 where i = j, of f_i⁴ it is g⁴/5."""
    grid = force_grid(G, 10.0, 40.0)
    assert grid.weight.sum() == pytest.approx(1.0)
    assert (grid.weight > 0.0).all()
    np.testing.assert_allclose(np.linalg.norm(grid.force_mps2, axis=1), G)
    np.testing.assert_allclose(grid.weight @ grid.force_mps2, 0.0, atol=1e-9)
    second = np.einsum("n,ni,nj->ij", grid.weight, grid.force_mps2, grid.force_mps2)
    np.testing.assert_allclose(second, G**2 / 3.0 * np.eye(3), atol=1e-5 * G**2)
    np.testing.assert_allclose(grid.weight @ grid.force_mps2**4, G**4 / 5.0, rtol=1e-4)


@pytest.mark.parametrize("power", range(8))
def test_all_temperatures_count_alike_up_to_the_seventh_power(power: int) -> None:
    low, high = -15.0, 40.0
    grid = force_grid(G, low, high)
    mean = quad(lambda t: t**power, low, high)[0] / (high - low)
    assert grid.weight @ grid.temperature_c**power == pytest.approx(mean, rel=1e-9)
    assert (grid.temperature_c.min(), grid.temperature_c.max()) == (grid.low_c, grid.high_c) == (low, high)


def test_a_temperature_that_is_not_known_is_that_of_reference() -> None:
    grid = force_grid(G, None, None)
    assert set(grid.temperature_c.tolist()) == {grid.low_c} == {grid.high_c}
