"""The noise model against noise of known kind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.long_runs import slow
from helpers.restricted import restricted_log_likelihood
from helpers.synthetic import Run, plan_of
from scipy.optimize import minimize
from scipy.signal import lfilter

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench, axes_of
from kf_calib.dwells.folding import detrended
from kf_calib.dwells.pieces import Pieces
from kf_calib.dwells.rows import Nodes
from kf_calib.dwells.sufficient_statistics import Autocovariance, Dwell
from kf_calib.dwells.table import DwellTable
from kf_calib.estimation.calibration import calibrate
from kf_calib.noise import within_dwells
from kf_calib.noise.terms import Scatter, WavesOverRun
from kf_calib.sources.simulation.sensors import GRADES
from kf_calib.sources.simulation.sensors import TrueNoise as SimulatedNoise
from kf_calib.sources.simulation.simulator import Simulation


def test_autocovariance_is_the_sum_of_lagged_products() -> None:
    """Of what a parabola leaves: a drift within the block is no noise."""
    noise, time = np.random.default_rng(0).normal(size=(3, 500)), np.arange(500.0)
    got = Autocovariance.of(detrended(noise + 3.0 * time - 0.01 * time**2))
    values = np.array([row - np.polyval(np.polyfit(time, row, 2), time) for row in noise])
    for lag in (0, 1, 7, 64):
        np.testing.assert_allclose(got.products[lag], np.sum(values[:, : 500 - lag] * values[:, lag:], axis=1))
    assert got.pairs[64] == 436


def test_white_noise_is_not_inflated() -> None:
    inflations = [calibrate(Run(seed=seed, dwells=6)).noise.inflation for seed in range(10)]
    assert np.mean(np.array(inflations) == 1.0) > 0.9


@pytest.mark.parametrize("phi", [0.5, 0.9, 0.97])
def test_ar1_inflation_is_that_of_the_mean(phi: float) -> None:
    """kappa = (1 + phi) / (1 - phi)."""
    result = calibrate(Run(seed=1, dwells=24, count=2000, rate_hz=100.0, phi=phi))
    np.testing.assert_allclose(result.noise.inflation, (1 + phi) / (1 - phi), rtol=0.25)
    np.testing.assert_allclose(result.noise.sigma_mps2, 1e-4, rtol=0.1)


@pytest.mark.parametrize(("phi", "count"), [(0.0, 100), (0.5, 300)])
def test_a_parabola_takes_three_independent_readings_of_a_dwell(phi: float, count: int) -> None:
    """Of pieces of 40 and of 125 readings, of which it takes much: sigma is right to three standard errors."""
    dwells = calibrate(Run(seed=4, dwells=300, count=count, phi=phi)).fit.dwells
    assert within_dwells.within_dwells(dwells).sigma_mps2.mean() == pytest.approx(1e-4, rel=0.012)


@pytest.mark.slow
def test_a_walk_of_known_intensity_is_no_noise_of_a_reading() -> None:
    """Beside white noise of 1e-4 m/s^2, one of 1e-4 m/s^2/s^(1/2) over dwells of 20 seconds."""
    run, walk = Run(seed=1, dwells=80, count=400), 1e-4
    steps = np.random.default_rng(2).normal(size=run.accel.values.shape) * walk / np.sqrt(run.rate_hz)
    run.accel.values[:] += np.cumsum(steps.reshape(80, 400, 3), axis=1).reshape(-1, 3)
    dwells = calibrate(run).fit.dwells
    known = within_dwells.within_dwells(dwells, walk)
    assert known.sigma_mps2 == pytest.approx(1e-4, rel=0.06)
    assert within_dwells.within_dwells(dwells).sigma_mps2.mean() > 1.07e-4


@pytest.mark.parametrize("phi", [0.0, 0.5])
def test_channels_of_short_blocks_have_one_correlation_and_variances_of_their_size(phi: float) -> None:
    """Of 1000 blocks of 60 readings of AR(1) noise, less a parabola; a channel that stands still is left out."""
    sigmas, rng, total = np.array([1e-4, 3e-4, 0.0]), np.random.default_rng(8), Autocovariance()
    for _ in range(1000):
        white = rng.normal(size=(3, 160)) * np.sqrt(1.0 - phi**2)
        total += Autocovariance.of(detrended(sigmas[:, None] * lfilter([1.0], [1.0, -phi], white, axis=1)[:, 100:]))
    kappa, variances = within_dwells._alike(total)
    assert kappa[:2] == pytest.approx((1.0 + phi) / (1.0 - phi), rel=0.1) and kappa[2] == 1.0
    assert np.sqrt(variances) == pytest.approx(sigmas, rel=0.05)


def test_ar2_resonance_is_followed_too() -> None:
    """A noise with a spectral line averages down faster than white noise: kappa = var(e) / (var(x) (1 - a1 - a2)^2)."""
    run = Run(seed=2, dwells=12, count=2000, rate_hz=100.0, white_mps2=0.0)
    a = [1.0, -2 * 0.95 * np.cos(1.0), 0.95**2]
    run.accel.values[:] += 1e-4 * lfilter(
        [1.0], a, np.random.default_rng(0).normal(size=run.accel.values.shape), axis=0
    )
    response = lfilter([1.0], a, np.eye(1, 4000)[0])
    np.testing.assert_allclose(calibrate(run).noise.inflation, response.sum() ** 2 / np.sum(response**2), rtol=0.15)


@pytest.mark.parametrize("theta", [-0.6, -0.9])
def test_noise_that_averages_down_faster_than_white_noise_is_judged_by_what_it_leaves(theta: float) -> None:
    """Readings e_t + theta e_(t-1), whose means have (1 + theta)^2 / (1 + theta^2) of the variance of white noise."""
    ratios = list[float]()
    for seed in range(24):
        run = Run(seed=seed, dwells=24, count=600, white_mps2=0.0)
        moved = np.random.default_rng(seed).normal(size=run.accel.values.shape)
        run.accel.values[:] += 1e-4 * lfilter([1.0, theta], [1.0], moved, axis=0)
        judged = calibrate(run).consistency
        assert judged.dof == 60
        ratios.append(judged.statistic / judged.dof)
    # The mean of 24 chi-squared of 60 degrees of freedom is within 3 sigma of them; kappa is known to some per cent.
    assert np.mean(ratios) == pytest.approx(1.0, abs=3.0 * np.sqrt(2.0 / 60 / 24) + 0.25)


def test_one_channel_that_is_correlated_leaves_the_others_as_they_are() -> None:
    """AR(0.95) in channel 1 of dwells too short to tell it well: 2 and 3 are white."""
    run = Run(seed=5, dwells=24, count=240, white_mps2=0.0)
    white = np.random.default_rng(5).normal(size=run.accel.values.shape)
    run.accel.values[:] += 1e-4 * white * [0.0, 1.0, 1.0]
    slow = lfilter([1.0], [1.0, -0.95], white[:, 0])
    run.accel.values[:, 0] += 1e-4 * slow
    kappa = calibrate(run).noise.inflation
    assert kappa[1:] == pytest.approx(1.0, abs=0.1)
    assert 25.0 < kappa[0] < 80.0  # 39 is right


@pytest.mark.slow
def test_setting_error_and_scatter_are_told_apart_and_sized() -> None:
    runs, off = 12, 0.1
    settings, scatters, mistaken = [], [], 0
    for seed in range(runs):
        setting = calibrate(Run(seed=seed, dwells=30, setting_deg=0.01, stated=False)).noise
        mistaken += bool(setting.scatter_mps2.any())
        settings.append(np.degrees(setting.setting_rad))
        scatter = calibrate(Run(seed=seed, dwells=30, scatter_mps2=5e-4)).noise
        mistaken += scatter.setting_rad > 0 and not scatter.setting.stated
        scatters.append(scatter.scatter_mps2)
    assert mistaken <= runs // 5  # of twice as many, at the 1 % point each
    assert np.sqrt(np.mean(np.square(settings))) == pytest.approx(0.01, rel=off)
    assert np.sqrt(np.mean(np.square(scatters))) == pytest.approx(5e-4, rel=1.2 * off)


def test_what_is_stated_is_not_estimated() -> None:
    noise = calibrate(Run(seed=3, setting_deg=0.01)).noise
    assert noise.setting.stated and noise.setting_rad == pytest.approx(np.radians(0.01))


@pytest.mark.parametrize("kind", [{"setting_deg": 0.01}, {"scatter_mps2": 5e-4}])
@pytest.mark.parametrize("seed", [0, *slow(1, 2, 3)])
def test_no_other_size_of_the_dwell_parts_is_likelier(seed: int, kind: dict[str, float]) -> None:
    """By the likelihood alone, without the derivative that the search goes by."""
    result = calibrate(Run(seed=seed, dwells=30, stated=False, **kind))
    noise, means, state = result.noise, result.linearised.means, result.linearised.state

    def likelihood(setting: float, scatter: float) -> float:
        other = noise.with_terms(
            replace(noise.setting, size_rad=noise.setting_rad * setting), Scatter(noise.scatter_mps2 * scatter)
        )
        return restricted_log_likelihood(other.weights, means, state)

    others = [likelihood(*pair) for x in (0.5, 0.9, 0.98, 1.02, 1.1, 2.0) for pair in ((x, 1.0), (1.0, x))]
    assert noise.setting_rad + noise.scatter_mps2.max() > 0
    assert max(others) <= likelihood(1.0, 1.0) + 1e-6


@pytest.mark.parametrize("runs", [4, *slow(40)])
def test_dwells_too_short_for_their_noise_raise_no_alarm_and_are_told(runs: int) -> None:
    """Forty readings, correlated over ten: their parabola takes all that would tell how slow they are."""
    low = 0
    for seed in range(runs):
        bench = Bench(axes_of("yzx"), 9.81, angle_sigma_deg=0.0, scatter_sigma_mps2=0.0)
        source = Simulation(
            bench, GRADES["mems"].sensors(seed), SimulatedNoise(white_mps2=0.02, ar1_phi=0.9),
            plan_of(16, dwell_s=10.0, seed=seed), sample_hz=4.0, angle_hz=4.0, slew_rate_degps=90.0, seed=seed,
        )  # fmt: skip
        result = calibrate(source)
        assert result.consistency.p_value is not None
        low += result.consistency.p_value < 0.05
        assert "too short to tell" in " ".join(result.warnings)
    assert low <= runs / 20  # one in five would be were each channel's correlation taken as it is found


def piece_of(start_s: float, span_s: float, count: int, residual: Floats | float = 0.0, width: int = 3) -> Pieces:
    """A piece of readings that leave ``residual`` (3,) about their parabola, in one row of its triangle."""
    triangle = np.eye(width + 3)
    triangle[width:, width:] = 0.0
    triangle[width, width:] = residual
    at_s = start_s + span_s * np.array([0.0, 0.5, 1.0])
    nodes, counts = Nodes(at_s, at_s, np.ones((3, 3)), np.zeros((3, 1)), np.full(3, np.nan)), np.array([count])
    return Pieces(triangle[None], nodes, counts, counts)


def test_noise_along_the_force_has_the_likeliest_sizes_of_gamma_sums() -> None:
    """Sums of squares along directions m, of variance m^2 . v and n - 3 kappa degrees of freedom, against scipy."""
    rng = np.random.default_rng(5)
    along = np.repeat(np.eye(3), 5, axis=0) + 0.3 * rng.normal(size=(15, 3))
    counts, kappa = rng.integers(50, 90, (15, 4)), np.array([1.0, 2.0, 1.5])
    truth, freedom = np.array([0.5, 1.0, 2.0]) ** 2, (counts - 3.0 * kappa.mean()).sum(axis=1)
    squares = along**2 @ truth * rng.chisquare(freedom)
    residuals = along * np.sqrt(squares / np.sum(along**2, axis=1) ** 2)[:, None]  # whose part along m has that square
    dwells = [
        Dwell(k + 1, Pieces.joined([piece_of(60.0 * k, 60.0, count, own / 2.0) for count in counts[k].tolist()]))
        for k, own in enumerate(residuals)
    ]

    def cost(logs: np.ndarray) -> float:
        expected = along**2 @ np.exp(logs)
        return float(np.sum(freedom * np.log(expected) + squares / expected))

    best = minimize(cost, np.zeros(3), method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-10, "maxiter": 9999})
    sigma = within_dwells._sigma_along(DwellTable.of(dwells), along, kappa)
    np.testing.assert_allclose(sigma**2, np.exp(best.x), rtol=1e-3)


def test_slow_waves_are_independent_of_each_other_and_their_sizes_fall_with_the_root_of_their_number() -> None:
    """Mean products of waves over dwells at equal distances are one or zero; h / k is the variance of wave k."""
    count = 40
    dwells = [Dwell(k + 1, piece_of(10.0 * k, 10.0, 9, width=4)) for k in range(count)]
    columns = WavesOverRun(np.array([2.0, 0.0, 3.0])).columns(DwellTable.of(dwells), np.zeros(12))
    sigma = np.concatenate([2.0 / np.sqrt(np.arange(1, 7)), 3.0 / np.sqrt(np.arange(1, 7))])
    waves = columns / sigma  # (dwells, nodes, channels, waves)
    assert not waves[:, 3].any() and not waves[:, :, 1].any()
    first, third = waves[:, 0, 0, :6], waves[:, 1, 2, 6:]
    np.testing.assert_allclose(first, third)
    np.testing.assert_allclose(first.T @ first / count, np.eye(6), atol=1e-12)
