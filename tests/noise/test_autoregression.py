"""The correlation of noise from blocks that a parabola was taken out of."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.long_runs import slow
from scipy.linalg import toeplitz
from scipy.signal import lfilter

from kf_calib.noise.noise_of_readings import expected_products, unbiased


@pytest.mark.parametrize("count, phi", [(30, 0.9), (80, 0.5), (200, 0.99), (81, -0.4)])
def test_expected_products_are_those_of_the_projected_covariance(count: int, phi: float) -> None:
    gamma = phi ** np.arange(count)
    curve = np.linalg.qr(np.vander(np.linspace(-1, 1, count), 3))[0]
    rest = np.eye(count) - curve @ curve.T
    dense = rest @ toeplitz(gamma) @ rest
    assert expected_products(gamma, 7) == pytest.approx([np.trace(dense, lag) for lag in range(8)], abs=1e-10)


@pytest.mark.parametrize(
    "size, phi, blocks", [(80, 0.9, 36), (80, 0.5, 24), *slow((100, 0.9, 36), (400, 0.9, 24), (1000, 0.97, 24))]
)
def test_inflation_is_found_from_blocks_that_are_short_for_it(size: int, phi: float, blocks: int) -> None:
    """In the median of 40 runs within a tenth, and within a factor of two in each: blocks of 4 kappa and more."""
    found = []
    for seed in range(40):
        noise = lfilter([1.0], [1.0, -phi], np.random.default_rng(seed).normal(size=(blocks, size + 400)), axis=1)[
            :, 400:
        ]
        curve = np.linalg.qr(np.vander(np.linspace(-1, 1, size), 3))[0]
        left = noise - (noise @ curve) @ curve.T
        raw = np.array(
            [np.mean((left[:, : size - lag] * left[:, lag:]).sum(axis=1)) / (size - lag) for lag in range(21)]
        )
        model, variance = unbiased(raw, blocks * size, size)
        found.append((model.inflation * (1 - phi) / (1 + phi), variance * (1 - phi**2)))
    ratios = np.array(found)
    assert np.median(ratios, axis=0) == pytest.approx([1.0, 1.0], abs=0.1)
    assert ratios.min() > 0.5 and ratios.max() < 2.0
