"""The innovation gate takes single outliers and never a dwell."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.synthetic import Run

from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.settings import Settings


def test_nothing_is_rejected_from_clean_noise() -> None:
    assert calibrate(Run(seed=1, dwells=6, count=20_000)).counts.gated == 0


@pytest.mark.parametrize("share", [0.001, 0.02, 0.2])
def test_outliers_are_rejected_counted_and_harmless(share: float) -> None:
    clean, dirty = Run(seed=2), Run(seed=2)
    rng = np.random.default_rng(0)
    hit = rng.random(len(dirty.accel)) < share
    dirty.accel.values[hit] += rng.normal(size=(int(hit.sum()), 3)) * 0.5
    one, other = calibrate(clean), calibrate(dirty)
    place = np.arange(len(hit)) % 300  # within the dwell: a second settles, the last angle message of a dwell ends it
    evaluated = ((place >= 20) | (np.arange(len(hit)) < 300)) & (place < 288)
    assert other.counts.gated == pytest.approx((hit & evaluated).sum(), rel=0.03, abs=1)
    assert any("outlying readings" in warning for warning in other.warnings)
    shift = np.abs(other.estimate.parameters - one.estimate.parameters) / one.estimate.sigma
    assert shift.max() < 2.5
    spoiled = calibrate(dirty, Settings(gate_sigma=None))
    weights = np.array([dwell.weights for dwell in spoiled.fit.dwells])
    spoilt = hit.reshape(-1, 300)[:, 20:288].any(axis=1)
    if spoilt.all():
        assert np.median(spoiled.estimate.sigma / one.estimate.sigma) > 2
    else:  # dwells that were not hit keep their noise, and the others count less
        assert weights[spoilt].max() < 0.2 * weights[~spoilt].min()


def test_an_orientation_that_disagrees_is_kept_as_evidence() -> None:
    run = Run(seed=3)
    run.accel.values[3 * 300 : 4 * 300] += 0.01  # a hundred sigma, the whole fourth dwell
    result = calibrate(run)
    assert result.counts.gated == 0
    assert result.consistency.consistent is False


def test_varying_columns_are_fitted_before_judging() -> None:
    from kf_calib.dwells import rows

    rng = np.random.default_rng(4)
    turning = np.linspace(0, 0.2, 500)
    columns = np.column_stack([np.ones(500), np.sin(turning), np.cos(turning), np.zeros(500)])
    values = columns @ rng.normal(size=(4, 3)) * 10 + rng.normal(size=(500, 3)) * 1e-4
    values[77] += 0.01
    innovation = rows.innovations(columns, values, static=False)
    keep = rows.inliers(columns, values, innovation, False, 6.0)
    assert keep is not None and list(np.flatnonzero(~keep)) == [77]
