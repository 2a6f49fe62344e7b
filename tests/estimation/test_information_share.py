"""The shares of information: by hand for a bias, in total for a run, and where nothing is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.paths import ROOT

from kf_calib.bench.arrays import Floats
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.filter_history import prior_estimate, shares_of
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.settings import PRIORS, Settings
from kf_calib.sources.files.recording import Recording

RECORDING = ROOT / "recordings" / "navigation_24.mcap"


def information_shares(result: Calibration) -> Floats:
    """Shares (D, 12) of the dwells of a run."""
    estimates = [prior_estimate(result), *(visit.estimate for visit in result.visits)]
    return shares_of(np.array([estimate.sigma for estimate in estimates]))


@pytest.fixture(scope="module")
def results() -> dict[str, Calibration]:
    return {name: calibrate(Recording(RECORDING), Settings(prior=PRIORS[name])) for name in ("diffuse", "navigation")}


def test_all_dwells_and_the_prior_together_bring_everything(results: dict[str, Calibration]) -> None:
    np.testing.assert_allclose(information_shares(results["diffuse"]).sum(axis=0), 1.0)
    own = results["navigation"]
    known = (own.estimate.sigma / prior_estimate(own).sigma) ** 2
    assert (known > 0.0).all()
    np.testing.assert_allclose(information_shares(own).sum(axis=0) + known, 1.0)


def test_each_dwell_brings_what_it_took_from_the_variance(results: dict[str, Calibration]) -> None:
    own = results["diffuse"]
    shares = information_shares(own)
    assert shares.shape == (24, 12)
    assert (shares > -1e-9).all()
    before, after = (own.visits[k].estimate.sigma for k in (11, 12))
    np.testing.assert_allclose(shares[12], (after**-2 - before**-2) * own.estimate.sigma**2, rtol=1e-9)
    unseen = [visit.estimate.unseen for visit in own.visits]
    assert unseen[0].all()
    for share, hidden in zip(shares, unseen, strict=True):
        assert (share[hidden] == 0.0).all()


def test_what_is_not_determined_has_no_share(results: dict[str, Calibration]) -> None:
    few = replace(results["diffuse"], visits=results["diffuse"].visits[:3])
    assert few.visits[-1].estimate.unseen.all()
    assert np.isnan(information_shares(few)).all()


def test_a_parameter_that_the_last_dwell_determines_has_all_of_it_from_there() -> None:
    """And one that was known exactly, or that nothing tells, has no shares."""
    unknown = np.nan
    sigmas = np.array([[unknown, 2.0, 0.0, unknown], [unknown, 1.0, 0.0, unknown], [0.5, 0.5, 0.0, unknown]])
    shares = shares_of(sigmas)
    np.testing.assert_allclose(shares[:, 0], [0.0, 1.0])
    np.testing.assert_allclose(shares[:, 1], [0.1875, 0.75])
    assert np.isnan(shares[:, 2:]).all()
