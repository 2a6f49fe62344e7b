"""An oscillation of unknown frequency in the readings, slow or faster than a piece of a dwell; the test for a line."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.hidden_effects import BENCH
from helpers.long_runs import slow
from helpers.synthetic import plan_of
from scipy.signal import lfilter
from scipy.stats import binom

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench
from kf_calib.dwells.folding import detrended
from kf_calib.dwells.line_spectrum import SpectralLine, Spectrum, _leakage, _level, _Search, lines
from kf_calib.effects import checks, effect_named
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.dwell_columns import LinearisedDwells, stimulus_of
from kf_calib.estimation.engine_comparison import compare
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.score_test import Frame, delta_chi2, scan
from kf_calib.estimation.settings import Settings
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
        (0.15, 6.0, 5.0, 20),
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


@pytest.mark.parametrize("runs, low, high", [(3, 0.8, 1.0), *slow((300, 0.92, 0.98))])
def test_intervals_cover(runs: int, low: float, high: float) -> None:
    ratios = np.array([errors(calibrate(run(33.0, 1.0, seed=50 + k), WITH), 33.0, 1.0) for k in range(runs)])
    share = float(np.mean(np.abs(ratios) < 1.96))
    print(f"\nsinusoid: {(np.abs(ratios) < 1.96).mean(axis=0).round(3)}, std {np.std(ratios, axis=0).round(2)}", end="")
    assert low <= share <= high
    assert np.std(ratios) == pytest.approx(1.0, abs=0.25 if runs < 60 else 0.07)  # its standard error is 0.02


def test_engines_and_batch_agree() -> None:
    compared = compare(run(1.3, 2.0, dwells=6, dwell_s=4.0), WITH)
    assert compared.max_difference_sigma <= 1e-6


@pytest.mark.parametrize("scatter_mps2", [0.0, 2e-5])
@pytest.mark.parametrize("walk_mps2", [0.0, 1e-6])
def test_many_frequencies_are_tried_as_a_scan_would(scatter_mps2: float, walk_mps2: float) -> None:
    fitted = calibrate(run(0.1, 1.0, dwells=10), Settings(effects=("scale-drift",))).fit
    effects = [effect_named("sinusoid", BENCH).at(value) for value in np.linspace(0.01, 0.5, 20)]
    noise = replace(
        fitted.noise, scatter_mps2=np.full(3, scatter_mps2), scatter_stated=True, walk_mps2_per_sqrt_s=walk_mps2
    )
    expected = scan(fitted.linearised, noise, effects).statistics
    assert expected.max() > 10.0
    np.testing.assert_allclose(delta_chi2(fitted.linearised, noise, effects), expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("scatter_mps2", [0.0, 2e-5])
@pytest.mark.parametrize("walk_mps2", [0.0, 1e-6])
def test_a_periodogram_gives_what_each_frequency_alone_does(scatter_mps2: float, walk_mps2: float) -> None:
    """Interpolated between a few frequencies, beside two models, against every frequency worked out."""
    fitted = calibrate(run(0.1, 1.0, dwells=10), Settings(effects=("scale-drift",))).fit
    noise = replace(
        fitted.noise, scatter_mps2=np.full(3, scatter_mps2), scatter_stated=True, walk_mps2_per_sqrt_s=walk_mps2
    )
    values = np.linspace(0.01, 0.5, 400)
    frame = Frame(fitted.linearised, noise, [])
    twelve = LinearisedDwells(
        fitted.dwells, fitted.linearised.model - fitted.linearised.model.effects[0], fitted.linearised.state[:12]
    )
    for linearised in (fitted.linearised, twelve):
        effects = [effect_named("sinusoid", BENCH).at(value) for value in values[::7]]
        expected = scan(linearised, noise, effects).statistics
        assert expected.max() > 10.0
        found = frame.delta_chi2(linearised, effect_named("sinusoid", BENCH), values)[::7]
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)


def test_a_frame_answers_for_the_frequencies_it_is_asked() -> None:
    """As a first call with these frequencies does, whatever was asked before."""
    fitted = calibrate(run(0.1, 1.0, dwells=10)).fit
    effect, frames = effect_named("sinusoid", BENCH), [Frame(fitted.linearised, fitted.noise, []) for _ in range(2)]
    values_hz = np.linspace(0.01, 0.5, 100)
    expected = frames[0].delta_chi2(fitted.linearised, effect, values_hz[40:60])
    frames[1].delta_chi2(fitted.linearised, effect, values_hz[:20])
    assert np.array_equal(frames[1].delta_chi2(fitted.linearised, effect, values_hz[40:60]), expected)


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


def seen_in(
    rng: np.random.Generator, kind: str, sizes: dict[float, float], count: int = 600
) -> tuple[SpectralLine, ...]:
    """Lines in 20 dwells of ``count`` readings at 100 Hz with oscillations {frequency: amplitude} in all channels."""
    spectra, time_s = [], np.arange(count) / 100.0
    for _ in range(20):
        phases = rng.uniform(0.0, 2.0 * np.pi, len(sizes))
        waves = sum(a * np.sin(2 * np.pi * f * time_s + p) for (f, a), p in zip(sizes.items(), phases, strict=True))
        spectra.append(Spectrum.of(detrended(noise_of(rng, kind, count) + waves), time_s))
    return lines(spectra)


def noise_of(rng: np.random.Generator, kind: str, count: int) -> Floats:
    """White, or common to the channels, of unit variance; AR(1) of phi 0.9; density 1/f."""
    if kind == "common":
        return np.sqrt(0.9) * rng.normal(size=count) + np.sqrt(0.1) * rng.normal(size=(3, count))
    white = rng.normal(size=(3, 4 * count))
    if kind == "flicker":
        density = 1.0 / np.maximum(np.fft.rfftfreq(4 * count), 0.25 / count)
        white = np.fft.irfft(np.fft.rfft(white, axis=1) * np.sqrt(density), axis=1)
    return lfilter([1.0], [1.0, -0.9 if kind == "coloured" else 0.0], white, axis=1)[:, -count:]


@pytest.mark.parametrize("kind, count, runs", [
    ("white", 600, 30), ("common", 600, 30), ("coloured", 600, 30), ("flicker", 600, 30), ("coloured", 4000, 10),
    *slow(
        ("white", 600, 100), ("common", 600, 100), ("coloured", 600, 100), ("flicker", 600, 200),
        ("white", 200, 100), ("coloured", 4000, 40), ("flicker", 4000, 40),
    ),
])  # fmt: skip
def test_noise_alone_has_no_line(kind: str, count: int, runs: int) -> None:
    """At 1 %, and 1.5 % on flicker, whose rise is followed less well; the bound is passed once in 200 times."""
    rng, chance = np.random.default_rng(0), 0.015 if kind == "flicker" else 0.01
    assert sum(bool(seen_in(rng, kind, {}, count)) for _ in range(runs)) <= binom.ppf(0.995, runs, chance)


@pytest.mark.parametrize("size, near", [(0.5, 0.3), (2.0, 0.1)])
def test_a_line_is_found_with_its_size(size: float, near: float) -> None:
    """The power of 20 segments of a line 7 times above the noise scatters by 12 %."""
    (line,) = seen_in(np.random.default_rng(1), "coloured", {7.7: size})
    assert line.p_value < 1e-6 and line.frequency_hz == pytest.approx(7.7, abs=0.03)
    np.testing.assert_allclose(line.amplitude_mps2, size, rtol=near)


def test_lines_are_told_apart() -> None:
    """A strong one does not hide a weak one, nor has it others beside it."""
    found = seen_in(np.random.default_rng(2), "white", {5.0: 300.0, 12.3: 0.4, 44.0: 10.0})
    assert sorted(line.frequency_hz for line in found) == pytest.approx([5.0, 12.3, 44.0], abs=0.05)


def test_dwells_of_unequal_noise_have_no_line_if_they_count_by_their_weights() -> None:
    """At 1 %; the bound is passed once in 200 times. Without the weights, noise has lines."""
    rng, time_s, alarms = np.random.default_rng(4), np.arange(600) / 100.0, [0, 0]
    for _ in range(100):
        sizes = np.exp(rng.normal(size=20))
        spectra = [Spectrum.of(detrended(size * rng.normal(size=(3, 600))), time_s) for size in sizes]
        alarms[0] += bool(lines(spectra))
        alarms[1] += bool(lines(each.times(size**-2.0) for each, size in zip(spectra, sizes, strict=True)))
    assert alarms[1] <= binom.ppf(0.995, 100, 0.01) < alarms[0]


def test_a_line_leaks_at_most_what_is_allowed_for_it() -> None:
    """Power of a Hann window at so many bins from a line: the bound is reached between two bins."""
    count = 4096
    taper = np.sin(np.pi * (np.arange(count) + 0.5) / count) ** 2
    bins = np.arange(3.0, 40.0, 0.125)
    turning = np.exp(-2j * np.pi * np.outer(bins, np.arange(count)) / count)
    leaked = np.abs(turning @ taper) ** 2 / taper.sum() ** 2
    bound = _leakage(bins)
    assert np.all(leaked <= 1.001 * bound)
    np.testing.assert_allclose(leaked[4::8], bound[4::8], rtol=1e-3)
    assert np.isinf(_leakage(np.array([-2.9, 0.0, 2.9]))).all()
    np.testing.assert_array_equal(_leakage(-bins), bound)


@pytest.mark.parametrize("beside", [0.0, 0.2, 0.5, 0.8])
def test_a_line_between_bins_has_its_frequency_and_amplitude(beside: float) -> None:
    """Each accelerometer has its amplitude, of a line that is twenty times the noise or more."""
    rng, time_s = np.random.default_rng(5), np.arange(1024) / 100.0
    hz, sizes = (200.0 + beside) * 100.0 / 1024.0, np.array([[3.0], [2.0], [1.0]])
    spectra = [
        Spectrum.of(detrended(0.05 * rng.normal(size=(3, 1024)) + sizes * np.sin(2 * np.pi * hz * time_s + k)), time_s)
        for k in range(10)
    ]
    line = lines(spectra)[0]
    assert line.frequency_hz == pytest.approx(hz, abs=0.01 * 100.0 / 1024.0)
    np.testing.assert_allclose(line.amplitude_mps2, sizes[:, 0], rtol=0.01)


@pytest.mark.parametrize(("lag", "followed"), [(8, True), (9, False)])
def test_the_level_follows_an_autoregression_of_eight_readings_and_nothing_finer(lag: int, followed: bool) -> None:
    """The power of x_t = x_(t - lag) / 2 + e_t, which rises and falls ``lag`` times up to the sampling frequency."""
    power = 1.0 / np.abs(1.0 - 0.5 * np.exp(-2j * np.pi * lag * np.arange(385) / 768)) ** 2
    ratio = (_level(power, 20) / power)[3:-1]
    assert (ratio.max() < 1.01 * ratio.min()) == followed


def test_a_single_bin_is_as_rare_as_its_p_value_says() -> None:
    """In white noise of one segment and one channel: one bin in a thousand, to a third more or less."""
    rng, time_s, rare, bins = np.random.default_rng(9), np.arange(1024) / 100.0, 0, 0
    for _ in range(250):
        readings = rng.normal(size=(3, 1024)) * [[1.0], [0.0], [0.0]]
        (segments,) = Spectrum.of(detrended(readings), time_s).sums.values()
        search = _Search(segments, 1024, np.array([True, False, False]))
        bins += len(search.height) - 4
        rare += sum(search._chance(k) < 1e-3 for k in 3 + np.flatnonzero(search.height[3:-1] > 5.0))
    assert 0.7 < rare / bins / 1e-3 < 1.35


def test_spectra_add_up() -> None:
    """Of one channel that stands still and two dwells, together or one after the other."""
    rng, time_s = np.random.default_rng(3), np.arange(1500) / 100.0
    wave = np.array([[0.0], [0.3], [1.0]]) * np.sin(2 * np.pi * 20.0 * time_s)
    made = [np.diag([0.0, 1.0, 1.0]) @ rng.normal(size=(3, 1500)) + wave for _ in range(8)]
    parts = slice(700), slice(700, None)
    apart = [Spectrum.of(detrended(each[:, part]), time_s[part]) for each in made for part in parts]
    (line,) = lines(apart)
    (same,) = lines([sum(apart[1:], apart[0])])
    assert line.frequency_hz == same.frequency_hz and line.p_value == same.p_value
    assert line.channel == 2 and line.frequency_hz == pytest.approx(20.0, abs=0.05)
    np.testing.assert_allclose(line.amplitude_mps2, [0.0, 0.3, 1.0], atol=0.15)


def test_a_stated_scatter_goes_with_a_carrier() -> None:
    """Dwells folded on a carrier have nine nodes a piece; the slow part of the scatter has none of its envelopes."""
    result = calibrate(run(7.3, 1.0, dwells=16, bench=replace(BENCH, scatter_sigma_mps2=1e-5)), WITH)
    assert result.linearised.carrier_hz and np.abs(errors(result, 7.3, 1.0)).max() < 4.0
