"""The search for a weak oscillation of one phase in all dwells: honest in noise of every kind, and nearly as sharp as a
fit would be that knows the frequency."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.long_runs import slow
from scipy.signal import lfilter
from scipy.stats import binom

from kf_calib.bench.arrays import Floats
from kf_calib.dwells.coherent_tone import Cells, Trace, _levels, _share_beside_parabola, band_hz, tone

RATE_HZ, DWELL_S = 6.0, 58.0


def noise_of(rng: np.random.Generator, kind: str, count: int) -> Floats:
    """(n, 3): white, or nearly common to the channels; AR(1) of phi 0.9; white and 1/f, 1/f alone; a walk in white."""
    white = rng.normal(size=(4 * count, 3))
    match kind:
        case "common":
            return np.sqrt(0.1) * white[:count] + np.sqrt(0.9) * rng.normal(size=(count, 1))
        case "coloured":
            return lfilter([1.0], [1.0, -0.9], white, axis=0)[-count:]
        case "flicker" | "white and flicker":
            density = 1.0 / np.maximum(np.fft.rfftfreq(len(white)), 0.25 / count)
            slow = np.fft.irfft(np.fft.rfft(white, axis=0) * np.sqrt(density)[:, None], axis=0)[:count]
            return slow if kind == "flicker" else 0.1 * slow + rng.normal(size=(count, 3))
        case "walk":
            return white[:count] + 0.02 * np.cumsum(rng.normal(size=(count, 3)), axis=0)
    return white[:count]


def traces(
    rng: np.random.Generator,
    kind: str = "white",
    size: float = 0.0,
    frequency_hz: float = 0.15,
    steady: bool = True,
    rate_hz: float = RATE_HZ,
    dwells: int = 24,
) -> list[Trace]:
    """Of dwells at different levels, with pauses in between and an oscillation in all channels."""
    out, begin, cells = list[Trace](), 0, None
    for _ in range(dwells):
        at_s = (begin + np.arange(round(DWELL_S * rate_hz))) / rate_hz
        phase = 0.7 if steady else rng.uniform(0.0, 2.0 * np.pi)
        wave = size * np.sin(2.0 * np.pi * frequency_hz * at_s + phase)
        cells = cells or Cells.of(at_s)
        assert cells is not None
        readings = noise_of(rng, kind, len(at_s)) + wave[:, None] + 9.8 * rng.normal(size=3)
        out.append(Trace.of(readings, at_s, cells))
        begin += len(at_s) + int(rng.integers(20, 100))
    return out


def amplitude_of(sigmas: float, dwells: int = 24) -> float:
    """Of an oscillation that raises chi-squared by the square of ``sigmas`` in white noise of unit variance."""
    return sigmas * np.sqrt(2.0 / (3.0 * dwells * round(DWELL_S * RATE_HZ)))


@pytest.mark.parametrize("kind", ["white", "common", "coloured", "flicker", "white and flicker", "walk"])
@pytest.mark.parametrize("runs", [6, *slow(40)])
def test_noise_alone_has_no_tone(kind: str, runs: int) -> None:
    """At 5 %; the bound is passed once in 200 times."""
    rng = np.random.default_rng(0)
    found = sum(tone(traces(rng, kind), 0.05) is not None for _ in range(runs))
    assert found <= binom.ppf(0.995, runs, 0.05)


@pytest.mark.slow
def test_readings_that_come_often_are_averaged_without_a_beat() -> None:
    """What is slow shows nowhere else, whatever the rate."""
    rng, runs = np.random.default_rng(1), 20
    found = sum(tone(traces(rng, "flicker", rate_hz=47.0), 0.05) is not None for _ in range(runs))
    assert found <= binom.ppf(0.995, runs, 0.05)


@pytest.mark.slow
@pytest.mark.parametrize("sigmas, least", [(8.0, 0.6), (10.0, 0.95)])
def test_a_weak_oscillation_is_found(sigmas: float, least: float) -> None:
    """From two cycles a dwell to two a second, at the level of a diagnosis."""
    rng, found = np.random.default_rng(2), 0
    low, high = band_hz(traces(rng))
    assert low == pytest.approx(1.5 / DWELL_S, rel=0.02) and high == pytest.approx(0.375 * RATE_HZ)
    for _ in range(40):
        frequency_hz = rng.uniform(1.5 * low, high)
        line = tone(traces(rng, size=amplitude_of(sigmas), frequency_hz=frequency_hz), 1e-3)
        found += line is not None and abs(line.frequency_hz - frequency_hz) < 1e-3
    assert found >= 40 * least


@pytest.mark.parametrize("sigmas", [30.0, 3e3])
def test_its_frequency_and_size_are_those_of_least_squares(sigmas: float) -> None:
    """Also where no chance is as small as that of so large a peak, nor as those of its neighbours."""
    rng = np.random.default_rng(3)
    line = tone(traces(rng, size=amplitude_of(sigmas)))
    assert line is not None and line.p_value < 1e-12
    assert line.frequency_hz == pytest.approx(0.15, abs=3e-4)
    np.testing.assert_allclose(line.amplitude_mps2, amplitude_of(sigmas), rtol=0.3)


def test_what_changes_its_phase_from_dwell_to_dwell_is_no_tone() -> None:
    rng = np.random.default_rng(4)
    found = [tone(traces(rng, size=amplitude_of(12.0), steady=False), 1e-3) for _ in range(10)]
    assert sum(line is not None for line in found) <= 1


def test_a_dwell_is_the_sum_of_its_blocks() -> None:
    rng, cells = np.random.default_rng(5), Cells(0.01, 12)
    at_s, readings = np.sort(rng.uniform(3.0, 40.0, 900)), rng.normal(size=(900, 3))
    whole = Trace.of(readings, at_s, cells)
    parts = [Trace.of(readings[part], at_s[part], cells) for part in np.array_split(np.arange(900), 7)]
    summed = Trace.joined(parts)
    assert whole.first == summed.first and whole.cell_s == pytest.approx(0.12) and whole.counts.sum() == 900
    np.testing.assert_array_equal(whole.counts, summed.counts)
    np.testing.assert_allclose(whole.sums, summed.sums, atol=1e-12)


def test_a_parabola_is_taken_out() -> None:
    at_s = np.arange(300) / RATE_HZ
    cells = Cells.of(at_s)
    assert cells is not None
    curve = np.column_stack([9.8 + 0.1 * at_s - 0.003 * at_s**2, np.ones(300), at_s])
    assert np.abs(Trace.of(curve, at_s, cells).residual_sums).max() < 1e-9


@pytest.mark.parametrize("cycles", [0.5, 1.5, 2.3, 7.0])
def test_what_a_parabola_leaves_of_a_sinusoid(cycles: float) -> None:
    """Against least squares on dense instants, over all phases."""
    u = np.linspace(-1.0, 1.0, 20_001)
    waves = np.column_stack([np.sin(np.pi * cycles * u), np.cos(np.pi * cycles * u)])
    curve = np.linalg.qr(np.vander(u, 3))[0]
    left = waves - curve @ (curve.T @ waves)
    assert float(_share_beside_parabola(np.array([np.pi * cycles]))[0]) == pytest.approx(
        (left**2).sum() / len(u), abs=1e-3
    )


def test_the_level_of_noise_is_as_sure_as_it_says() -> None:
    """Of 1000 spectra of independent exponential variates, whose mean is a cubic in logarithms: it has no bias, and the
    variance that is told, to a fifth."""
    frequency_hz, rng = np.geomspace(0.01, 2.0, 1000), np.random.default_rng(7)
    x = np.log(frequency_hz / 0.1)
    true = np.exp(0.3 - 0.8 * x + 0.2 * x**2 + 0.05 * x**3)
    levels, variance = _levels(rng.exponential(size=(1000, 1000)) * true, frequency_hz, 1.0)
    ratios = np.log(levels / true)
    assert np.abs(ratios.mean(axis=0)).max() < 0.05
    assert np.var(ratios, axis=0) == pytest.approx(variance, rel=0.2)


def test_every_frequency_counts_in_the_level() -> None:
    """Of 79 the last fifteen are too few for a band; they belong to the one before."""
    power, frequency_hz = np.random.default_rng(8).exponential(size=(3, 79)), np.linspace(1.0, 1.1, 79)
    louder = power * np.where(np.arange(79) < 64, 1.0, 100.0)
    before, after = (_levels(each, frequency_hz, 1.0)[0][:, -1] for each in (power, louder))
    assert np.all(after > 1.2 * before)


def test_too_little_is_not_searched() -> None:
    rng = np.random.default_rng(6)
    assert tone([Trace()]) is None and band_hz([Trace()]) == (np.inf, np.inf)
    assert Cells.of(np.array([0.0, 1.0])) is None
    short = Cells(0.1, 1)
    assert tone([Trace.of(rng.normal(size=(20, 3)), np.arange(20) * 0.1, short)], 1.0) is None
    apart = [Trace.of(rng.normal(size=(400, 3)), start_s + np.arange(400) * 0.1, short) for start_s in (0.0, 3e7)]
    assert not len(apart[1]) and band_hz(apart) == band_hz(apart[:1]), "what comes a year later is not kept"
    still = [Trace.of(np.ones((400, 3)), k * 50.0 + np.arange(400) * 0.1, short) for k in range(4)]
    assert tone(still, 1.0) is None
