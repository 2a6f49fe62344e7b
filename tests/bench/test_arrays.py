"""Choices that do not depend on how a processor rounds."""

import numpy as np

from kf_calib.bench.arrays import first_least, sign


def test_of_equal_numbers_the_first_is_the_least_whatever_rounding_says() -> None:
    values = np.array([3.0, 1.0 + 1e-15, 2.0, 1.0, 1.0 + 1e-6])
    assert first_least(values) == 1 and first_least(values, tie=0.0) == 3
    assert first_least(1e6 * values) == 1 and first_least(-values) == 0
    assert first_least(np.array([0.0, -np.inf, 1.0])) == 1 and first_least(np.array([np.inf, np.inf])) == 0


def test_zero_has_no_sign_and_neither_has_what_rounding_leaves_of_it() -> None:
    assert sign(np.array([2.0, -0.1, 0.0, 1e-17, -1e-12])).tolist() == [1.0, -1.0, 0.0, 0.0, 0.0]
    assert sign(np.array([2.0, -0.1]), 0.5).tolist() == [1.0, 0.0]
