"""A factor of information whose other states are held at zero, against the normal equations."""

from __future__ import annotations

import numpy as np
import pytest

from kf_calib.estimation import square_root_information


@pytest.mark.parametrize("kept", [[0], [2, 0], [1, 3, 4]])
def test_restricting_a_factor_leaves_out_rows_and_columns_of_the_normal_equations(kept: list[int]) -> None:
    rows = np.random.default_rng(1).normal(size=(9, 6))
    restricted = square_root_information.restrict(np.linalg.qr(rows)[1][:5], kept)
    assert restricted.shape == (len(kept), len(kept) + 1)
    whole = rows[:, [*kept, 5]]
    np.testing.assert_allclose(restricted[:, :-1].T @ restricted, whole[:, :-1].T @ whole, rtol=1e-10, atol=1e-12)
