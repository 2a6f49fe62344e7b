"""From which sizes on a calibration is remarked on."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.synthetic import G, Run
from helpers.thresholds import begins_at

from kf_calib.bench.bench import Bench, axes_of
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.remarks import beyond_stated, misfit_remark, remarks_on
from kf_calib.estimation.results import Calibration, Consistency
from kf_calib.noise.noise_model import Noise
from kf_calib.noise.terms import SettingError

UNTESTED = Consistency(0.0, 0, None, None)


@pytest.fixture(scope="module")
def result() -> Calibration:
    """Of 12 dwells of 300 readings, of which the margins after arrivals take 20."""
    return calibrate(Run(seed=4, dwells=12))


def remarks(result: Calibration, **changes: Any) -> str:
    """What is remarked on where some things of a calibration are others."""
    own = dict(linearised=result.linearised, noise=result.noise, estimate=result.estimate,
               judged=result.consistency, residuals=result.residuals_mps2)  # fmt: skip
    return "\n".join(remarks_on(**(own | changes)))


def test_noise_is_told_to_be_correlated_where_its_variance_is_inflated_by_half(result: Calibration) -> None:
    """In any accelerometer; and dwells to be too short where they have fewer readings than four times the inflation."""

    def told(kappa: float) -> str:
        return remarks(result, noise=replace(result.noise, inflation=np.array([1.0, kappa, 1.0])))

    assert begins_at(lambda kappa: "inflating its variance by 1," in told(kappa), 1.1, 9.0) == pytest.approx(1.5)
    readings = float(np.median([dwell.count for dwell in result.fit.dwells]))
    assert begins_at(lambda kappa: "too short to tell" in told(kappa), 2.0, 200.0) == pytest.approx(readings / 4.0)


def test_a_misfit_of_three_hundredths_of_gravity_is_one_of_the_set_up() -> None:
    bench, noise = Bench(axes_of("yzx"), G), Noise(np.full(3, 1e-4), np.ones(3))
    signs = np.array([[1.0, -1.0, 1.0], [-1.0, 1.0, -1.0]])
    size = begins_at(lambda rms: misfit_remark(UNTESTED, rms * signs, bench, noise), 1e-3, 10.0)
    assert size == pytest.approx(0.03 * G)
    said = misfit_remark(Consistency(90.0, 30, 1e-6, False), 0.01 * signs, bench, noise)
    assert said.endswith("noise from dwell to dwell, which was not stated (angle_sigma_deg and scatter_sigma_mps2).")


def test_poses_are_told_to_be_uncertain_from_a_tenth_more_than_stated() -> None:
    bench, noise = Bench(axes_of("yzx"), G, angle_sigma_deg=0.02), Noise(np.full(3, 1e-4), np.ones(3))
    size = begins_at(lambda deg: beyond_stated(noise.with_terms(SettingError(np.radians(deg))), bench), 0.01, 1.0)
    assert size == pytest.approx(0.022)
    assert not beyond_stated(noise.with_terms(SettingError(1.0)), replace(bench, angle_sigma_deg=None))


def test_scale_factors_of_the_result_are_compared_with_those_of_the_bench(result: Calibration) -> None:
    """All three a thousandth too large; not where one of them is not determined."""
    state = result.model.nominal_state().copy()
    state[:12].reshape(3, 4)[:, :3] *= 1.001
    larger = replace(result.estimate, state=state)
    assert "off by the same +1000 ppm" in remarks(result, estimate=larger)
    covariance = result.estimate.covariance.copy()
    covariance[9, 9] = covariance[10, 10] = covariance[8, 8] = 1.0
    assert "off by the same" not in remarks(result, estimate=replace(larger, covariance=covariance))


def test_few_dwells_are_told_in_grammar(result: Calibration) -> None:
    assert "12 dwells are too few to test" in remarks(result, judged=UNTESTED)
    assert "too few" not in remarks(result)
    assert "no standard deviation" in remarks(result, judged=Consistency(20.0, 24, None, None))
