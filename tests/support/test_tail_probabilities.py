"""The chance of an F ratio, against a finite sum in 60 digits, and against scipy's."""

import math
from decimal import Decimal, localcontext

import numpy as np
import pytest
from scipy.special import chdtrc, fdtrc

from kf_calib.support.tail_probabilities import chi_squared_tail, f_tail, sidak


@pytest.mark.parametrize("freedom", [1, 2, 7, 60, 1000])
def test_chi_squared_is_scipys(freedom: int) -> None:
    for value in freedom * np.array([0.1, 0.9, 1.0, 1.3, 2.0]):
        assert chi_squared_tail(freedom, value) == pytest.approx(float(chdtrc(freedom, value)), rel=1e-12)


@pytest.mark.parametrize("freedom", [1.0, 2.0, 3.0, 7.5, 60.0, 1101.0, 12000.0])
@pytest.mark.parametrize("noise_freedom", [1.0, 2.5, 30.0, 4728.0, 1e6, 1e9])
def test_it_is_scipys_as_far_as_that_goes(freedom: float, noise_freedom: float) -> None:
    ratios = np.concatenate([np.geomspace(1e-3, 1e3, 61), 1.0 + np.linspace(-0.1, 0.1, 21)])
    for ratio in ratios.tolist():
        expected = float(fdtrc(freedom, noise_freedom, ratio))
        if expected > 1e-290:  # below, it runs out of exponents
            assert f_tail(freedom, noise_freedom, ratio) == pytest.approx(expected, rel=1e-6), ratio


@pytest.mark.parametrize("freedom", [2, 60, 1100])
@pytest.mark.parametrize("noise_freedom", [1.0, 4728.0, 1e6, 1e9])
@pytest.mark.parametrize("ratio", [0.03, 0.9, 1.0, 1.26, 3.0])
def test_it_has_12_digits_where_a_finite_sum_tells(freedom: int, noise_freedom: float, ratio: float) -> None:
    """Of an even number of degrees of freedom: x^a times the first terms of (1 - y)^-a."""
    with localcontext(prec=60):
        a = Decimal(noise_freedom) / 2
        x = a / (a + freedom // 2 * Decimal(ratio))
        total, term = Decimal(0), Decimal(1)
        for j in range(freedom // 2):
            total, term = total + term, term * (a + j) / (j + 1) * (1 - x)
        expected = float(total * (a * x.ln()).exp())
    assert f_tail(freedom, noise_freedom, ratio) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("freedom", [1, 3, 60, 5000])
def test_a_variance_that_is_known_makes_it_chi_squared(freedom: int) -> None:
    for ratio in (0.2, 0.97, 1.0, 1.03, 2.0, 5.0):
        if (expected := float(chdtrc(freedom, ratio * freedom))) > 1e-290:
            assert f_tail(freedom, 1e18, ratio) == pytest.approx(expected, rel=1e-9), ratio


def test_its_ends() -> None:
    assert f_tail(3.0, 5.0, 0.0) == f_tail(3.0, 5.0, -1.0) == f_tail(60.0, 4728.0, 1e-300) == 1.0
    assert f_tail(3.0, 5.0, math.inf) == f_tail(60.0, 4728.0, 1e300) == f_tail(1e4, 1e9, 1e3) == 0.0
    assert math.isnan(f_tail(3.0, 5.0, math.nan))


@pytest.mark.parametrize("tests", [1, 3, 40, 10**6])
@pytest.mark.parametrize("p_value", [1e-300, 1e-20, 1e-7, 0.01, 0.6, 1.0])
def test_the_smallest_of_many_p_values(p_value: float, tests: int) -> None:
    with localcontext(prec=400):
        expected = float(1 - (1 - Decimal(p_value)) ** tests)
    assert sidak(p_value, tests) == pytest.approx(expected, rel=1e-13)
