"""The Allan deviation against what is known of white noise, a drift and a walk in closed form."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.synthetic import Run

from kf_calib.bench.arrays import Floats
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.engine_comparison import compare
from kf_calib.noise.allan import LongestDwells, cluster_sizes, deviations, model_lines
from kf_calib.noise.noise_model import Noise
from kf_calib.noise.terms import RandomWalk, Scatter

SIZES = [1, 2, 5, 20, 100]


def test_white_noise_falls_with_the_root_of_the_cluster() -> None:
    series = list(np.random.default_rng(1).normal(0.0, 2e-4, (3, 60_000, 3)))
    found, clusters = deviations(series, SIZES)
    assert found == pytest.approx(2e-4 / np.sqrt(SIZES)[:, None] * np.ones(3), rel=0.05)
    assert clusters.tolist() == [3 * 60_000 // size for size in SIZES]


def test_a_drift_grows_with_the_cluster() -> None:
    """A ramp of c a reading gives c m / sqrt(2), exactly; a level gives nothing."""
    ramp = np.arange(500.0)[:, None] * [1e-6, -3e-6, 0.0] + 9.81
    assert deviations([ramp], SIZES)[0] == pytest.approx(np.outer(SIZES, [1e-6, 3e-6, 0.0]) / np.sqrt(2), abs=1e-12)


def test_a_walk_grows_with_the_root_of_the_cluster() -> None:
    """As q sqrt(tau / 3), which the noise model's line is."""
    intensity, period_s, sizes = 1e-5, 0.5, np.array([20, 50, 100])
    steps = np.random.default_rng(2).normal(0.0, intensity * np.sqrt(period_s), (200_000, 3)) * [1.0, 1.0, 0.5]
    found, _ = deviations([np.cumsum(steps, axis=0)], sizes.tolist())
    noise = Noise(np.full(3, 1e-4), np.ones(3), (RandomWalk(intensity * np.array([1.0, 1.0, 0.5])),))
    walk = model_lines(noise, sizes.astype(float), period_s * sizes, 12)[2]
    assert found == pytest.approx(walk, rel=0.08)


def test_clusters_reach_a_third_of_the_longest_dwell() -> None:
    assert cluster_sizes(2) == [1]
    sizes = cluster_sizes(3000)
    assert sizes[0] == 1 and 800 <= sizes[-1] <= 1000 and sizes == sorted(set(sizes))


@pytest.mark.slow
def test_the_readings_of_a_run_have_the_noise_that_was_put_in() -> None:
    run = Run(seed=3, dwells=8, count=600, white_mps2=3e-4)
    allan = compare(run).allan
    assert allan is not None and len(allan.dwells) == 5
    assert allan.tau_s[0] == pytest.approx(1.0 / run.rate_hz)
    assert allan.deviation_mps2[0] == pytest.approx(3e-4, rel=0.06)
    assert allan.white_mps2[0] == pytest.approx(3e-4, rel=0.06)
    assert (np.abs(allan.deviation_mps2 / allan.white_mps2 - 1.0) < 4.0 * allan.spread[:, None]).all()
    assert not allan.flicker_mps2.any() and not allan.walk_mps2.any()


@pytest.mark.slow
def test_the_spread_is_that_of_white_noise_drawn_anew() -> None:
    """Of 400 draws of three channels: to a third, as neighbouring differences share a cluster."""
    result = calibrate(Run(seed=3, dwells=6, count=400))
    dwells, rng = LongestDwells(result.fit.dwells, result.noise), np.random.default_rng(6)
    drawn = list[Floats]()
    for _ in range(400):
        dwells.kept = {
            number: [SimpleNamespace(elapsed_s=np.arange(400) / 20.0, residual_mps2=rng.normal(size=(400, 3)))]
            for number in dwells.kept
        }
        drawn.append(dwells.allan_deviation().deviation_mps2)
    ratios = np.std(np.log(drawn), axis=(0, 2)) / dwells.allan_deviation().spread
    assert 0.8 < ratios[:6].min() and ratios[:6].max() < 1.35


def test_the_longest_dwell_is_used_whatever_its_length(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("kf_calib.noise.allan.MOST_KEPT", 10)
    result = calibrate(Run(dwells=6, count=100))
    longest = max(result.fit.dwells, key=lambda dwell: dwell.count)
    assert list(LongestDwells(result.fit.dwells, result.noise).kept) == [longest.number]


def test_scatter_from_dwell_to_dwell_stands_for_flicker_whose_floor_is_that_of_ieee_952() -> None:
    """1/f noise of density h / f scatters the means of n dwells by h ln n, and its Allan deviation is h 2 ln 2."""
    noise = Noise(np.ones(3), np.ones(3), (Scatter(np.array([1e-5, 2e-5, 0.0])),))
    floor = model_lines(noise, np.array([1.0]), np.array([1.0]), 20)[1]
    np.testing.assert_allclose(floor**2, noise.scatter_mps2**2 / np.log(20.0) * 2.0 * np.log(2.0), rtol=1e-12)
