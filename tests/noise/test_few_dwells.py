"""Scatter that nobody stated is in every sigma, however few dwells there are to see it: errors over sigmas are those of
Student's t, whose degrees of freedom are what the dwells leave."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.independent_bench import BENCH, IndependentBench
from helpers.long_runs import slow
from helpers.paths import REAL
from scipy.stats import kstest, t

from kf_calib import open_log
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.settings import Settings

UNSTATED = replace(BENCH, angle_sigma_deg=None, scatter_sigma_mps2=None)
SCATTER_MPS2 = 2e-3


def scattering(seed: int, dwells: int) -> IndependentBench:
    offsets = np.random.default_rng([5, seed]).normal(0.0, SCATTER_MPS2, (dwells, 3))
    return IndependentBench(seed, dwells, bench=UNSTATED, bias=lambda state: offsets[state.dwell])


@pytest.mark.parametrize("dwells, runs", [(5, 30), *slow((5, 200), (6, 200))])
def test_errors_over_sigmas_are_students(dwells: int, runs: int) -> None:
    errors = list[float]()
    for seed in range(runs):
        run = scattering(seed, dwells)
        result = calibrate(run)
        assert result.noise.scatter_mps2.any(), seed
        errors.append((result.parameters["b2"].value - run.biases_mps2[1]) / result.parameters["b2"].sigma)
    assert kstest(errors, t(3 * dwells - 12).cdf).pvalue > 0.01


def test_without_scatter_none_is_estimated() -> None:
    quiet = [calibrate(IndependentBench(seed, 5, bench=UNSTATED)) for seed in range(12)]
    assert sum(result.noise.scatter_mps2.any() for result in quiet) <= 1


def test_how_uncertain_the_sigmas_are_is_said() -> None:
    result = calibrate(scattering(1, 5))
    (said,) = [warning for warning in result.warnings if "their whole misfit" in warning]
    assert ", itself uncertain by 41 % with 3 degrees of freedom) enters every sigma" in said
    assert not any("it is taken as zero" in warning for warning in result.warnings)
    stated = replace(scattering(1, 5), bench=replace(UNSTATED, scatter_sigma_mps2=SCATTER_MPS2))
    assert any("(angle_sigma_deg): it is taken as zero" in warning for warning in calibrate(stated).warnings)


@pytest.mark.slow
@pytest.mark.skipif(not REAL.is_dir(), reason="the recordings of others are not there")
def test_a_dozen_poses_of_a_real_sensor_agree_with_all_others_within_their_sigmas() -> None:
    """Within 1.96 sigma are 86 % by Student's t of 3 degrees of freedom, and 63 % were where scatter was left out."""
    source = open_log(REAL / "xsens_mti.csv.gz", {"gravity_mps2": "9.80665"}, angles=False)
    rng = np.random.default_rng(0)
    numbers, ratios = [dwell.number for dwell in calibrate(source).fit.dwells], list[float]()
    for _ in range(25):
        twelve = set(rng.choice(numbers, 12, replace=False).tolist())
        some = calibrate(source, Settings(left_out=tuple(k for k in numbers if k not in twelve)))
        others = calibrate(source, Settings(left_out=tuple(twelve)))
        for symbol in ("K1", "b1", "K2", "b2", "K3", "b3"):
            one, other = some.parameters[symbol], others.parameters[symbol]
            ratios.append(abs(one.value - other.value) / np.hypot(one.sigma, other.sigma))
    assert np.mean(np.array(ratios) < 1.96) > 0.75
