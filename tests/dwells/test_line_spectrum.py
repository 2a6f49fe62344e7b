"""Lines in the averaged spectrum of readings within dwells: how often noise has one, and how large a line is found."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.long_runs import slow
from scipy.signal import lfilter, welch
from scipy.stats import binom

from kf_calib.bench.arrays import Floats
from kf_calib.dwells.folding import detrended
from kf_calib.dwells.line_spectrum import (
    SpectralLine,
    Spectrum,
    _leakage,
    _level,
    _running_median,
    _Search,
    independent,
    lines,
    lowest_hz,
)


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


@pytest.mark.parametrize("runs", [30, *slow(100)])
def test_dwells_of_unequal_noise_have_no_line_if_they_count_by_their_weights(runs: int) -> None:
    """At 1 %; the bound is passed once in 200 times. Without the weights, noise has lines."""
    rng, time_s, alarms = np.random.default_rng(4), np.arange(600) / 100.0, [0, 0]
    for _ in range(runs):
        sizes = np.exp(rng.normal(size=20))
        spectra = [Spectrum.of(detrended(size * rng.normal(size=(3, 600))), time_s) for size in sizes]
        alarms[0] += bool(lines(spectra))
        alarms[1] += bool(lines(each.times((size**-2.0,) * 3) for each, size in zip(spectra, sizes, strict=True)))
    assert alarms[1] <= binom.ppf(0.995, runs, 0.01) < alarms[0]


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


@pytest.mark.slow
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


@pytest.mark.parametrize(("count", "length"), [(100, 96), (1500, 1024), (2500, 2048), (9000, 4000)])
def test_a_spectrum_is_that_of_welch_without_overlap(count: int, length: int) -> None:
    """In segments of the longest length that fits, of 64, 96, 128 ... 2048, 4000 readings; its density is |X|^2 over
    rate and sum of squares of the Hann window, and twice that but at the ends."""
    values, time_s = np.random.default_rng(7).normal(size=(3, count)), np.arange(count) / 50.0
    ((own, total),) = Spectrum.of(values, time_s).sums.items()
    density = welch(values, 50.0, "hann", length, noverlap=0, detrend=False)[1]
    density[:, 1:-1] *= 0.5
    assert own == length and total.segments == count // length
    assert total.duration_s == pytest.approx(length * total.segments / 50.0)
    np.testing.assert_allclose(total.power.T, density * total.segments * 50.0 * 0.375 * length, rtol=1e-9)
    assert lowest_hz([Spectrum.of(values, time_s)]) == pytest.approx(3.0 * 50.0 / length)


@pytest.mark.parametrize(("reach", "skipped"), [(6, 0), (32, 3)])
def test_the_level_between_bins_is_the_median_of_their_neighbours(reach: int, skipped: int) -> None:
    """Without the three lowest bins, the highest, and those beside a bin that its line may fill; at the ends, of as
    many bins, but to one side."""
    values = np.random.default_rng(8).normal(size=200)
    median = _running_median(values, reach, skipped)
    for k in (3, 20, 100, 190, 198):
        first = min(max(k - reach, 3), 199 - (2 * reach + 1))
        window = [j for j in range(first, first + 2 * reach + 1) if not skipped or abs(j - k) >= skipped]
        assert median[k] == np.median(values[window])


def test_channels_that_share_noise_count_as_fewer() -> None:
    """Three alike as one; of a correlation of a half between all, 9 / 6; a line in all of them does not count."""
    rng = np.random.default_rng(9)
    own, common = rng.normal(size=(50_000, 3)), rng.normal(size=(50_000, 1))
    assert independent(np.repeat(common, 3, axis=1)) == pytest.approx(1.0)
    assert independent(own + common) == pytest.approx(1.5, rel=0.03)
    own[::100] += 100.0
    assert independent(own) == pytest.approx(3.0, rel=0.2) and independent(own[:, :1]) == 1.0
