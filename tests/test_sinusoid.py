"""An oscillation of unknown frequency in the readings, slow or faster than a piece of a dwell; the test for a line."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter
from test_effects import BENCH

from kf_calib.calibration import Calibration, Settings, calibrate
from kf_calib.comparison import compare
from kf_calib.effects import checks, effect_named
from kf_calib.sources.hidden import parse
from kf_calib.sources.noise_sources import Noise
from kf_calib.sources.plans import spread_plan
from kf_calib.sources.sensors import GRADES
from kf_calib.sources.simulator import Simulation
from kf_calib.spectrum import Line, Spectrum

SIGMA = 5e-5
SHARES = (1.0, -0.6, 0.8)
WITH = Settings(effects=("sinusoid",))


def run(frequency_hz: float, size_sigma: float, dwell_s: float = 6.0, seed: int = 5, dwells: int = 30) -> Simulation:
    sizes = ",".join(str(size_sigma * SIGMA * share) for share in SHARES)
    return Simulation(
        BENCH, GRADES["navigation"].sensors(seed), Noise(white_mps2=SIGMA),
        spread_plan(dwells, dwell_s=dwell_s, seed=4), sample_hz=100.0, slew_rate_degps=90.0, seed=seed,
        hidden=parse([f"sinusoid={sizes};frequency={frequency_hz}"], BENCH.axes, seed=seed),
    )  # fmt: skip


def errors(result: Calibration, frequency_hz: float, size_sigma: float) -> list[float]:
    """Of the frequency and the six amplitudes, in their sigmas; the simulator's phase is 0.7 rad."""
    turned = np.concatenate([share * np.array([np.cos(0.7), np.sin(0.7)]) for share in SHARES]) * size_sigma * SIGMA
    expected = [*turned, frequency_hz]
    symbols = [*(c.symbol for c in effect_named("sinusoid", BENCH).coefficients), "fSin"]
    found = [result.parameters[symbol] for symbol in symbols]
    return [(p.value - truth) / p.sigma for p, truth in zip(found, expected, strict=True)]


@pytest.mark.parametrize("size_sigma", [1.0, 5.0])
@pytest.mark.parametrize(
    "frequency_hz, dwell_s", [(0.15, 6.0), (0.15, 40.0), (1.3, 6.0), (33.0, 6.0), (33.0, 40.0), (0.02, 40.0)]
)
def test_frequency_and_amplitudes_are_found(frequency_hz: float, dwell_s: float, size_sigma: float) -> None:
    result = calibrate(run(frequency_hz, size_sigma, dwell_s), WITH)
    assert np.abs(errors(result, frequency_hz, size_sigma)).max() < 4.0
    np.testing.assert_allclose(result.noise.effective_sigma_mps2, SIGMA, rtol=0.05)


def test_intervals_cover() -> None:
    ratios = [errors(calibrate(run(33.0, 1.0, seed=50 + k), WITH), 33.0, 1.0) for k in range(20)]
    assert 0.88 <= np.mean(np.abs(ratios) < 1.96) <= 1.0
    assert np.std(ratios) == pytest.approx(1.0, abs=0.2)


def test_engines_and_batch_agree() -> None:
    compared = compare(run(1.3, 2.0, dwells=16), WITH)
    assert compared.max_difference_sigma <= 1e-6


def test_columns_pass_the_checks() -> None:
    assert checks.check(effect_named("sinusoid", BENCH)) == ()


def line_of(rng: np.random.Generator, phi: float, size: float = 0.0) -> Line:
    spectrum, time_s = Spectrum(), np.arange(600) / 100.0
    for _ in range(20):
        noise = lfilter([1.0], [1.0, -phi], rng.normal(size=(3, 800)), axis=1)[:, 200:]
        phase = rng.uniform(0.0, 2.0 * np.pi)
        spectrum.add(noise + size * np.sin(2.0 * np.pi * 7.7 * time_s + phase), time_s)
    line = spectrum.line()
    assert line is not None
    return line


@pytest.mark.parametrize("phi, runs, allowed", [(0.0, 200, 6), (0.9, 100, 4)])
def test_noise_alone_has_no_line(phi: float, runs: int, allowed: int) -> None:
    """At 1 %: two or one are expected, and the bound is passed once in 200 times."""
    rng = np.random.default_rng(0)
    assert sum(line_of(rng, phi).p_value < 0.01 for _ in range(runs)) <= allowed


def test_a_line_is_found_with_its_size() -> None:
    line = line_of(np.random.default_rng(1), 0.9, 2.0)
    assert line.p_value < 1e-6 and line.frequency_hz == pytest.approx(7.7, abs=0.03)
    np.testing.assert_allclose(line.amplitude_mps2, 2.0, rtol=0.1)
