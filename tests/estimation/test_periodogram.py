"""Parts of the periodogram, against dense matrices and the functions that it interpolates."""

from __future__ import annotations

import numpy as np
import pytest

from kf_calib.bench.paper_parameters import BIASES
from kf_calib.estimation.periodogram import _basis_and_rest, _Path, _points


@pytest.mark.parametrize(("longest_s", "count"), [(6.0, 400), (60.0, 2000)])
def test_waves_within_a_dwell_are_interpolated_between_a_few_frequencies(longest_s: float, count: int) -> None:
    """Products of two of them too, which pass through twice the phase."""
    values_hz = np.linspace(0.3, 1.8, count)
    points_hz, shares = _points(values_hz, longest_s)
    assert len(points_hz) < count // 3 and 0.3 < points_hz.min() and points_hz.max() < 1.8
    for apart_s in longest_s * np.array([-0.5, 0.1, 0.5, 0.9]):
        waves = np.exp(2j * np.pi * apart_s * points_hz)
        np.testing.assert_allclose(shares @ waves, np.exp(2j * np.pi * apart_s * values_hz), atol=1e-9)


def test_few_frequencies_are_computed_themselves() -> None:
    values_hz = np.linspace(0.3, 1.8, 20)
    points_hz, shares = _points(values_hz, 10.0)
    np.testing.assert_array_equal(points_hz, values_hz)
    np.testing.assert_array_equal(shares, np.eye(20))


def test_what_a_walk_explains_is_that_of_its_covariance() -> None:
    """x - C (C^T C + Q^-1)^-1 C^T x = (1 + C Q C^T)^-1 x, with Q the covariance of sums of independent steps."""
    rng, dwells, height = np.random.default_rng(6), 5, 4
    rows, steps = rng.normal(size=(dwells * height, 3 + 13)), rng.uniform(0.2, 2.0, size=(dwells, 2, 3))
    ends = list(range(0, dwells * height + 1, height))
    path, expected = _Path(rows, ends, steps), np.eye(len(rows))
    for axis in range(3):
        bias, inside = rows[:, 3 + BIASES[axis]], rows[:, axis]
        effect = np.zeros((len(rows), dwells, 2))  # of the step in the pause before each dwell, and of that within it
        for k in range(dwells):
            for d in range(k, dwells):
                part = slice(ends[d], ends[d + 1])
                effect[part, k, 0] = bias[part] if k else 0.0
                effect[part, k, 1] = bias[part] + (inside[part] if d == k else 0.0)
        flat = effect.reshape(len(rows), -1)
        expected += flat * steps[:, :, axis].ravel() @ flat.T
    columns = rng.normal(size=(len(rows), 3))
    freed = np.linalg.solve(expected, columns)
    np.testing.assert_allclose(path.freed(columns), freed, rtol=1e-9, atol=1e-12)
    whitened = path.whitened(path.products(columns))
    np.testing.assert_allclose(whitened.T @ whitened, columns.T @ (columns - freed), rtol=1e-9, atol=1e-12)


def test_columns_beside_others_leave_what_least_squares_leave() -> None:
    """In rows of unlike sizes, with a column that the others have already."""
    rng = np.random.default_rng(7)
    rows, readings = rng.normal(size=(30, 6)) * 10.0 ** np.arange(-3, 3), rng.normal(size=30)
    rows[:, 4] = rows[:, 0] - 2e-3 * rows[:, 3]
    both = np.column_stack([rows, readings])
    basis, rest = _basis_and_rest(both, both)
    left = readings - rows @ np.linalg.lstsq(rows, readings, rcond=1e-13)[0]
    np.testing.assert_allclose(rest, left, atol=1e-9)
    np.testing.assert_allclose(basis.T @ basis, np.eye(5), atol=1e-9)
