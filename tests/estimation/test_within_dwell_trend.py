"""Trends within dwells: what noise, a walk and 1/f noise make of them, and what shows in them alone."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from helpers.hidden_effects import BENCH, noisy_source
from helpers.hidden_effects import noisy_run as run
from helpers.long_runs import slow
from helpers.synthetic import Run, plan_of
from scipy import stats

from kf_calib.bench.streams import Stream
from kf_calib.diagnosis.missing_effect import diagnose
from kf_calib.diagnosis.refits import Refits
from kf_calib.diagnosis.unknown_effect import WITHIN_DWELLS
from kf_calib.diagnosis.unknown_terms import RETURNING
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.within_dwell_trend import Trend, p_of_steady_oscillation, shapes, trend, variances
from kf_calib.online.sequential_test import SequentialTest
from kf_calib.sources.simulation.sensors import GRADES
from kf_calib.sources.simulation.simulator import Simulation
from kf_calib.views.console import plain
from kf_calib.views.diagnosis import diagnosis_object, diagnosis_report


def found_in(result: Calibration) -> Trend:
    found = trend(result.fit)
    assert found is not None
    return found


def test_variances_of_a_walk_and_of_flicker_are_those_of_closed_forms() -> None:
    """Of Legendre's polynomials: a walk's is (1 / (2k + 3) + 1 / (2k - 1)) / (4 (2k + 1)), that of 1/f noise
    (2k + 1) / (2k (k + 1))."""
    k = np.arange(1, 4)
    walk, flicker = variances(np.polynomial.legendre.legvander((2.0 * np.arange(1000) + 1.0) / 1000.0 - 1.0, 3))
    np.testing.assert_allclose(walk, (1.0 / (2 * k + 3) + 1.0 / (2 * k - 1)) / (4.0 * (2 * k + 1)), rtol=1e-2)
    np.testing.assert_allclose(flicker, (2 * k + 1) / (2.0 * k * (k + 1)), rtol=1e-2)


def test_a_walk_has_the_variance_on_the_shapes_that_is_expected() -> None:
    """Of 4000 random walks: 2 % of each."""
    values = shapes((2.0 * np.arange(600) + 1.0) / 600.0 - 1.0)
    frame = np.linalg.qr(values)[0][:, 1:] * np.sqrt(600.0)
    paths = np.cumsum(np.random.default_rng(0).standard_normal((4000, 600)), axis=1) / np.sqrt(600.0)
    np.testing.assert_allclose(np.var(paths @ frame / 600.0, axis=0), variances(values)[0], rtol=0.1)


def test_what_shakes_a_platform_as_it_leaves_is_no_trend() -> None:
    """Motors shake it for a third of a second before angles tell: with two and a half times the noise of a reading."""
    ratios = list[float]()
    for seed in range(5):
        source = Simulation(
            BENCH, GRADES["mems"].sensors(seed), GRADES["mems"].noise, plan_of(12, dwell_s=30.0, seed=seed),
            sample_hz=10.0, angle_hz=4.0, slew_rate_degps=5.0, seed=seed,
        )  # fmt: skip
        ratios.append(found_in(calibrate(source)).ratio)
    assert np.mean(ratios) < 1.12  # 1.3 on the polynomials themselves


@pytest.mark.parametrize("count", [8, *slow(200)])
def test_of_white_noise_the_p_value_is_uniform(count: int) -> None:
    plan = plan_of(12, dwell_s=6.0, seed=1)
    found = [found_in(run(seed=seed, plan=plan)) for seed in range(count)]
    assert stats.kstest([each.p_value for each in found], "uniform").pvalue > 0.01
    freedom = 3 * 12 * 3 * count
    assert stats.chi2.cdf(freedom * np.mean([each.ratio for each in found]), freedom) == pytest.approx(0.5, abs=0.495)


@pytest.mark.parametrize("noise", [{"ar1_phi": 0.9}, {"flicker_mps2": 2e-5}, {"scatter_mps2": 5e-5}], ids=str)
@pytest.mark.parametrize("seeds", [range(2), *slow(range(6))])
def test_coloured_noise_and_stated_scatter_make_no_trend(noise: dict[str, float], seeds: range) -> None:
    assert min(found_in(run(seed=seed, **noise)).p_value for seed in seeds) > 0.01


@pytest.mark.slow
def test_a_walk_in_the_model_is_expected_within_dwells_too() -> None:
    """Of a walk as strong as the noise of a dwell: without it in the model its slopes are no noise."""
    plan = plan_of(24, dwell_s=20.0, seed=3)
    for seed in range(1, 3):
        before = run("bias-walk=60sigma", seed=seed, plan=plan)
        assert found_in(before).p_value < 1e-6
        assert found_in(Refits().with_effects(before, ("bias-walk",))).p_value > 0.001


def test_what_dwells_hide_shows_within_them() -> None:
    """A period that falls below a dwell's length: no column follows it, and it is no line."""
    found = diagnose(noisy_source("chirp=25sigma;frequency=0.02;chirp=4e-4", seed=4, dwells=12))
    assert found.unknown and found.test.trend is not None and found.test.trend.p_value < 1e-6, found.verdict
    told = found.description
    assert told is not None and told.driver in (WITHIN_DWELLS, RETURNING) and told.formula == "bias-walk"
    dwell, channel = found.test.trend.most
    assert diagnosis_object(found)["trend"] == {
        "ratio": found.test.trend.ratio, "p_value": found.test.trend.p_value, "dwell": dwell, "channel": channel,
    }  # fmt: skip
    told = " ".join(plain(diagnosis_report(found, details=True)).split())
    assert f"most in dwell {dwell}, accelerometer {channel}" in told


def test_a_trend_is_told_where_it_is() -> None:
    """A ramp over one dwell of one accelerometer, 12 sigma of a mean from its middle to its end."""
    made = Run(seed=1, dwells=10, count=400, white_mps2=1e-4)
    made.bench = dataclasses.replace(made.bench, angle_sigma_deg=0.0, scatter_sigma_mps2=0.0)
    values = made.accel.values.copy()
    values[6 * 400 : 7 * 400, 1] += np.linspace(-1.0, 1.0, 400) * 12.0 * 1e-4 / np.sqrt(400.0)
    made.accel = Stream(made.accel.time_ns, values)
    found = found_in(calibrate(made))
    assert found.most == (7, 2)


def test_dwells_that_are_noisier_than_others_show_no_trend_by_it() -> None:
    """Every third dwell trembles eight times as much, and counts by that."""
    made = Run(seed=1, dwells=12, count=400, white_mps2=1e-4)
    made.bench = dataclasses.replace(made.bench, angle_sigma_deg=0.0, scatter_sigma_mps2=0.0)
    values = made.accel.values.copy()
    for dwell in range(0, 12, 3):
        part = slice(400 * dwell, 400 * (dwell + 1))
        values[part] += 8e-4 * np.random.default_rng(dwell).standard_normal(values[part].shape)
    made.accel = Stream(made.accel.time_ns, values)
    result = calibrate(made)
    assert np.ptp([dwell.weights for dwell in result.fit.dwells]) > 0.5
    assert 0.7 < found_in(result).ratio < 1.4


@pytest.mark.slow
def test_a_watch_sees_it_while_the_run_goes_on() -> None:
    """Dwell by dwell, as the diagnosis does in the end, but for noise found a quarter of the run earlier."""
    before = run("chirp=25sigma;frequency=0.02;chirp=2e-4", seed=4)
    watch = SequentialTest.over(before.fit.dwells[:4], before.bench, before.settings)
    for dwell in before.fit.dwells[4:]:
        watch = watch.after(dwell)
    assert watch.trend is not None and watch.alarmed is not None
    assert np.log(watch.trend.p_value) == pytest.approx(np.log(found_in(before).p_value), rel=0.1)


def test_nothing_is_judged_where_scatter_may_be_anything() -> None:
    """1/f noise that is not stated goes on within dwells."""
    before = run()
    bench = before.fit.noise.with_terms(dataclasses.replace(before.fit.noise.scatter, stated=False))
    assert trend(dataclasses.replace(before.fit, noise=bench)) is None


def swinging(amplitude_mps2: float, seed: int, only: int | None = None) -> Run:
    """A run whose second accelerometer swings with a period of 7 s, in all 12 dwells of 20 s or in one."""
    made = Run(seed=seed, dwells=12, count=400, white_mps2=1e-4, setting_deg=0.003)
    made.bench = dataclasses.replace(made.bench, scatter_sigma_mps2=0.0)
    values, elapsed_s = made.accel.values.copy(), made.accel.time_ns / 1e9
    part = slice(None) if only is None else slice(only * 400, (only + 1) * 400)
    values[part, 1] += amplitude_mps2 * np.sin(2.0 * np.pi * elapsed_s[part] / 7.0)
    made.accel = Stream(made.accel.time_ns, values)
    return made


@pytest.mark.slow
@pytest.mark.parametrize("count", [12, 100])
def test_an_oscillation_that_goes_on_in_all_dwells_is_steady(count: int) -> None:
    """The p-value of the dwell that differs most is uniform, however strong the oscillation is."""
    runs = [swinging(1e-4 * 5.0 ** (seed % 3), seed) for seed in range(count)]
    fits = [Refits(made).with_effects(calibrate(made), ("sinusoid",)).fit for made in runs]
    assert stats.kstest([p_of_steady_oscillation(fit) for fit in fits], "uniform").pvalue > 0.01


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, *slow(2, 3, 5)])
def test_what_swings_in_one_dwell_alone_is_no_oscillation_of_the_run(seed: int) -> None:
    """Creep and what goes on around a bench swing for a while; an effect of the sensor goes on."""
    found = diagnose(calibrate(swinging(1e-4, seed, only=seed)))
    assert found.likeliest is None or found.likeliest.dwells == (seed + 1,)
    assert "sinusoid" not in found.missing, found.verdict
