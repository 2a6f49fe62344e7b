"""Directions of rows whose attitude is not known."""

from __future__ import annotations

import numpy as np

from kf_calib.dwells.rows import _direction


def test_a_direction_is_the_unit_vector_and_that_of_nothing_is_none() -> None:
    np.testing.assert_allclose(_direction(np.array([3.0, -4.0, 12.0])), np.array([3.0, -4.0, 12.0]) / 13.0)
    np.testing.assert_array_equal(_direction(np.zeros(3)), np.zeros(3))
