"""An oscillation of unknown frequency in the readings, slow or faster than a piece of a dwell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.hidden_effects import BENCH
from helpers.long_runs import slow
from helpers.synthetic import plan_of

from kf_calib.bench.bench import Bench
from kf_calib.effects import checks, effect_named
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.dwell_columns import LinearisedDwells, stimulus_of
from kf_calib.estimation.engine_comparison import compare
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.score_test import delta_chi2, periodogram, scan
from kf_calib.estimation.settings import Settings
from kf_calib.noise.terms import RandomWalk, Scatter
from kf_calib.sources.simulation.injected import parse
from kf_calib.sources.simulation.sensors import GRADES, TrueNoise
from kf_calib.sources.simulation.simulator import Simulation

pytestmark = pytest.mark.usefixtures("unmeasured")

SIGMA = 5e-5
SHARES = (1.0, -0.6, 0.8)
WITH = Settings(effects=("sinusoid",))


def run(
    frequency_hz: float, size_sigma: float, dwell_s: float = 6.0, seed: int = 5, dwells: int = 30, bench: Bench = BENCH
) -> Simulation:
    sizes = ",".join(str(size_sigma * SIGMA * share) for share in SHARES)
    return Simulation(
        bench, GRADES["navigation"].sensors(seed), TrueNoise(white_mps2=SIGMA),
        plan_of(dwells, dwell_s=dwell_s, seed=4), sample_hz=100.0, slew_rate_degps=90.0, seed=seed,
        hidden=parse([f"sinusoid={sizes};frequency={frequency_hz}"], BENCH.axes, seed=seed),
    )  # fmt: skip


def errors(result: Calibration, frequency_hz: float, size_sigma: float) -> list[float]:
    """Of the frequency and the six amplitudes, in their sigmas; the simulator's phase is 0.7 rad."""
    turned = np.concatenate([share * np.array([np.cos(0.7), np.sin(0.7)]) for share in SHARES]) * size_sigma * SIGMA
    expected = [*turned, frequency_hz]
    symbols = [*(c.symbol for c in effect_named("sinusoid", BENCH).coefficients), "fSin"]
    found = [result.parameters[symbol] for symbol in symbols]
    return [(p.value - truth) / p.sigma for p, truth in zip(found, expected, strict=True)]


@pytest.mark.parametrize(
    "frequency_hz, dwell_s, size_sigma, dwells",
    [
        (1.3, 6.0, 1.0, 20),
        (33.0, 6.0, 1.0, 20),
        *slow(
            *(
                (*case, size_sigma, 30)
                for case in [(0.15, 6.0), (0.15, 40.0), (1.3, 6.0), (33.0, 6.0), (33.0, 40.0), (0.02, 40.0)]
                for size_sigma in (1.0, 5.0)
            )
        ),
    ],
)
def test_frequency_and_amplitudes_are_found(
    frequency_hz: float, dwell_s: float, size_sigma: float, dwells: int
) -> None:
    result = calibrate(run(frequency_hz, size_sigma, dwell_s, dwells=dwells), WITH)
    assert np.abs(errors(result, frequency_hz, size_sigma)).max() < 4.0
    np.testing.assert_allclose(result.noise.effective_sigma_mps2, SIGMA, rtol=0.02)  # 0.7 % is its standard error


@pytest.mark.slow
def test_intervals_cover() -> None:
    runs, low, high = 300, 0.92, 0.98
    ratios = np.array([errors(calibrate(run(33.0, 1.0, seed=50 + k), WITH), 33.0, 1.0) for k in range(runs)])
    share = float(np.mean(np.abs(ratios) < 1.96))
    print(f"\nsinusoid: {(np.abs(ratios) < 1.96).mean(axis=0).round(3)}, std {np.std(ratios, axis=0).round(2)}", end="")
    assert low <= share <= high
    assert np.std(ratios) == pytest.approx(1.0, abs=0.07)  # its standard error is 0.02


def test_engines_and_batch_agree() -> None:
    compared = compare(run(1.3, 2.0, dwells=6, dwell_s=4.0), WITH)
    assert compared.max_difference_sigma <= 1e-6


@pytest.mark.parametrize("scatter_mps2", [0.0, 2e-5])
@pytest.mark.parametrize("walk_mps2", [0.0, 1e-6])
def test_many_frequencies_are_tried_as_a_scan_would(scatter_mps2: float, walk_mps2: float) -> None:
    fitted = calibrate(run(0.1, 1.0, dwells=10), Settings(effects=("scale-drift",))).fit
    effects = [effect_named("sinusoid", BENCH).at(value) for value in np.linspace(0.01, 0.5, 20)]
    walk = RandomWalk(walk_mps2 * np.array([1.0, 0.5, 2.0]))
    noise = fitted.noise.with_terms(Scatter(np.full(3, scatter_mps2), stated=True), walk)
    expected = scan(fitted.linearised, noise, effects).statistics
    assert expected.max() > 10.0
    np.testing.assert_allclose(delta_chi2(fitted.linearised, noise, effects), expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("scatter_mps2", [0.0, 2e-5])
@pytest.mark.parametrize("walk_mps2", [0.0, 1e-6])
def test_a_periodogram_gives_what_each_frequency_alone_does(scatter_mps2: float, walk_mps2: float) -> None:
    """Interpolated between a few frequencies, beside two models, against every frequency worked out."""
    fitted = calibrate(run(0.1, 1.0, dwells=10), Settings(effects=("scale-drift",))).fit
    walk = RandomWalk(walk_mps2 * np.array([1.0, 0.5, 2.0]))
    noise = fitted.noise.with_terms(Scatter(np.full(3, scatter_mps2), stated=True), walk)
    values = np.linspace(0.01, 0.5, 400)
    twelve = LinearisedDwells(
        fitted.dwells, fitted.linearised.model - fitted.linearised.model.effects[0], fitted.linearised.state[:12]
    )
    for linearised in (fitted.linearised, twelve):
        effects = [effect_named("sinusoid", BENCH).at(value) for value in values[::7]]
        expected = scan(linearised, noise, effects).statistics
        assert expected.max() > 10.0
        found = periodogram(linearised, noise, effect_named("sinusoid", BENCH), values)[::7]
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)


def test_columns_are_the_nearest_parabolas() -> None:
    """One and a half cycles in the longest piece, against least squares on dense instants."""
    result, effect = calibrate(run(0.1, 0.0, dwells=6)), effect_named("sinusoid", BENCH).at(0.5)
    at = stimulus_of(result.fit.dwells, BENCH, result.linearised.state)
    own = effect.columns(at)[:, 0, :2].reshape(-1, 3, 2)
    u = np.linspace(-1.0, 1.0, 20_001)
    for nodes, times in zip(own, at.elapsed_s.reshape(-1, 3), strict=True):
        phase = np.pi * np.interp(u, [-1.0, 0.0, 1.0], times)
        nearest = np.polynomial.legendre.legfit(u, np.column_stack([np.sin(phase), np.cos(phase)]), 2)
        np.testing.assert_allclose(nodes, np.polynomial.legendre.legval([-1.0, 0.0, 1.0], nearest).T, atol=2e-3)


def test_columns_pass_the_checks() -> None:
    assert checks.check_effect(effect_named("sinusoid", BENCH)) == ()


def test_a_stated_scatter_goes_with_a_carrier() -> None:
    """Dwells folded on a carrier have nine nodes a piece; the slow part of the scatter has none of its envelopes."""
    result = calibrate(run(7.3, 1.0, dwells=16, bench=replace(BENCH, scatter_sigma_mps2=1e-5)), WITH)
    assert result.linearised.carrier_hz and np.abs(errors(result, 7.3, 1.0)).max() < 4.0
