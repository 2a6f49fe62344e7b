"""Columns of dwells: when readings count as vibrating."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from kf_calib.estimation.dwell_columns import _varying


@pytest.mark.parametrize(("sigmas", "vibrates"), [(0.0, False), (3.0, False), (4.7, True)])
def test_readings_vibrate_where_their_variances_differ_by_four_sigma(sigmas: float, vibrates: bool) -> None:
    """A variance from n readings has the sigma v (2 / n)^(1/2); in one channel they lie so far above or below."""
    counts = np.full(40, 200.0)
    variances = np.full((40, 3, 3), 2.0)
    sides = np.tile([1.0, -1.0], 20)[:, None]
    variances[:, :, 1] *= 1.0 + sides * sigmas * np.sqrt(2.0 / 200.0)
    folded: Any = SimpleNamespace(shaking=(variances, counts))
    found = _varying(folded)
    expected = np.broadcast_to(variances if vibrates else 2.0, (40, 3, 3))
    np.testing.assert_allclose(found[..., 1], expected[..., 1])
    np.testing.assert_allclose(found[..., ::2], 2.0)
