"""Least squares over all dwells so far against the filter: equal to rounding, and not where a prior is stated."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.paths import ROOT

from kf_calib.estimation.batch_by_dwell import batch_differences
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.prior import PRIORS
from kf_calib.estimation.settings import Settings
from kf_calib.sources.files.recording import Recording


@pytest.mark.parametrize("effects", [(), ("hysteresis",)])
def test_they_agree_after_every_dwell(effects: tuple[str, ...]) -> None:
    result = calibrate(Recording(ROOT / "recordings" / "hidden.mcap"), Settings(effects=effects))
    apart = batch_differences(result)
    assert apart.shape == (24, 12 + len(result.model.coefficients))
    unknown = [bool(visit.estimate.undetermined.size) for visit in result.visits]
    assert unknown[0] and not unknown[-1]
    np.testing.assert_array_equal(np.isnan(apart).all(axis=1), unknown)
    assert 0.0 < np.nanmax(np.abs(apart)) < 1e-6


def test_a_prior_moves_the_filter_and_less_with_every_dwell() -> None:
    result = calibrate(Recording(ROOT / "recordings" / "mems_faces.mcap"), Settings(prior=PRIORS["mems"]))
    apart = np.abs(batch_differences(result)).max(axis=1)
    assert 1e-6 < apart[-1] < 10.0
