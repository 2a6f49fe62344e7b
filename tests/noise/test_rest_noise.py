"""Noise at rest: what was put in is found, and its intervals cover it; gaps, motions and readings that show nothing."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator

import numpy as np
import pytest
from helpers.bounded import traced
from helpers.long_runs import slow
from helpers.paths import REAL, ROOT
from helpers.resting import PERIOD_S, G, Resting, flicker, level, noisy

from kf_calib.bench.arrays import Floats
from kf_calib.bench.streams import Batch, Stream
from kf_calib.errors import InputError
from kf_calib.noise.power_laws import TERMS
from kf_calib.noise.rest_noise import ChannelGroup, ChannelNoise, RestNoise, channel_noise, noise_at_rest
from kf_calib.sources.files.recording import Recording
from kf_calib.sources.text.lines import Lines
from kf_calib.sources.text.means import open_table

N, K, B, Q = 1e-3, 2e-4, 5e-4, 1e-5


def of_stretches(*stretches: Floats) -> ChannelNoise:
    """The noise of one channel whose stretches (n,) these are."""
    group = ChannelGroup(["1"], "m/s^2")
    for values in stretches:
        group.push(PERIOD_S * np.arange(len(values)), values[:, None])
        group.end_rest()
    return channel_noise(group, 0)


def rest(count: int = 6000, seed: int = 3, **sizes: float) -> Floats:
    """Readings (n, 3) at rest."""
    rng = np.random.default_rng(seed)
    return level(np.array([noisy(rng, count, **({"white": N} | sizes)) for _ in range(3)]).T)


def coverage(truth: dict[str, float], seeds: int, count: int, dwells: int = 1) -> dict[str, float]:
    """Share of the seeds in which the interval of a term holds the truth, by the likelihood and by Allan variances."""
    held = defaultdict[str, list[bool]](list)
    for seed in range(seeds):
        rng = np.random.default_rng(9000 + seed)
        values = noisy(rng, count, truth["white"], truth["random_walk"], truth["quantisation"])
        values += flicker(rng, count, truth["bias_instability"])
        channel = of_stretches(*np.array_split(values, dwells))
        for way, terms in (("likelihood", channel.terms), ("allan", channel.by_allan)):
            for term, value in truth.items():
                size = terms[term]
                assert size.low <= (size.value or 0.0) <= size.high
                held[f"{way} {term}"].append(size.low <= value <= size.high)
    return {name: float(np.mean(each)) for name, each in held.items()}


TRUTHS = {
    "walk": {"quantisation": 0.0, "white": N, "bias_instability": 0.0, "random_walk": K},
    "strong walk": {"quantisation": 0.0, "white": N, "bias_instability": 0.0, "random_walk": 1e-3},
    "flicker": {"quantisation": 0.0, "white": N, "bias_instability": 1e-3, "random_walk": 0.0},
    "all": {"quantisation": Q, "white": N, "bias_instability": B, "random_walk": K},
}


@pytest.mark.parametrize(
    ("name", "count", "dwells"),
    slow(("walk", 20_000, 1), ("strong walk", 20_000, 12), ("flicker", 20_000, 1), ("all", 50_000, 1)),
)
def test_intervals_of_95_percent_hold_the_truth_in_three_hundred_runs(name: str, count: int, dwells: int) -> None:
    """Those of a weak walk hold 93 % of the truths (docs/limits.md); 300 runs tell a share to 1.5 %."""
    shares = coverage(TRUTHS[name], 300, count, dwells)
    assert min(shares.values()) >= 0.91, shares
    for way in ("likelihood", "allan"):
        assert shares[f"{way} white"] <= 0.99


def test_intervals_hold_the_truth_in_a_few_runs() -> None:
    shares = coverage(TRUTHS["strong walk"], 12, 4000)
    assert min(shares.values()) > 0.74, shares  # by chance below it in one of 500


def test_white_noise_and_a_walk_are_found_by_both_ways_and_nothing_else() -> None:
    channel = of_stretches(noisy(np.random.default_rng(5), 60_000, N, 1e-3))
    for terms in (channel.terms, channel.by_allan):
        assert terms["white"].value == pytest.approx(N, rel=0.02)
        assert terms["random_walk"].value == pytest.approx(1e-3, rel=0.15)
        for absent in ("quantisation", "bias_instability"):
            assert terms[absent].value is None and terms[absent].low == 0.0
        assert terms["bias_instability"].high < 2e-3 and terms["quantisation"].high < 3e-5
    assert channel.unclear == () and channel.inflation == 1.0 and channel.from_s == pytest.approx(PERIOD_S)


def test_flicker_is_found_and_is_where_the_deviation_stays() -> None:
    values = flicker(np.random.default_rng(6), 60_000, 1e-3) + noisy(np.random.default_rng(7), 60_000, 1e-4)
    channel = of_stretches(values)
    assert channel.terms["bias_instability"].value == pytest.approx(1e-3, rel=0.05)
    middle = (channel.tau_s > 0.5) & (channel.tau_s < 20.0)
    assert channel.deviation[middle] == pytest.approx(np.full(middle.sum(), 0.664e-3), rel=0.12)
    assert channel.terms["random_walk"].value is None


def test_rounded_increments_are_quantisation() -> None:
    channel = of_stretches(noisy(np.random.default_rng(8), 20_000, 1e-5, quantisation=Q))
    assert channel.terms["quantisation"].value == pytest.approx(Q, rel=0.03)
    assert channel.by_allan["quantisation"].value == pytest.approx(Q, rel=0.03)


def test_readings_of_a_filter_are_described_from_longer_clusters_on() -> None:
    """A filter over 16 readings leaves the white noise of longer clusters as it is."""
    values = np.convolve(noisy(np.random.default_rng(9), 60_000, N), np.ones(16) / 16, mode="valid")
    channel = of_stretches(values)
    assert 8 * PERIOD_S < channel.from_s < 300 * PERIOD_S and channel.p_value >= 0.01
    assert channel.terms["white"].value == pytest.approx(N, rel=0.15)
    assert channel.reading_sigma == pytest.approx(N / np.sqrt(PERIOD_S) / 16.0, rel=0.02)


def test_a_vibration_widens_the_intervals() -> None:
    """Between a swing of 8 s and the end there are too few sizes of clusters to begin behind it."""
    values = noisy(np.random.default_rng(10), 6000, N)
    quiet = of_stretches(values)
    shaken = of_stretches(values + 1e-2 * np.sin(2.0 * np.pi / 8.0 * PERIOD_S * np.arange(6000)))
    assert quiet.inflation == 1.0 < shaken.inflation and shaken.p_value < 0.01


def test_readings_that_do_not_change_have_no_sizes() -> None:
    readings = rest()
    readings[:, 1] = 0.125
    first, second, third = noise_at_rest(Resting(readings)).channels
    assert second.why_not == "its readings do not change" and not second.terms and not second.deviation.any()
    assert first.why_not == third.why_not == "" and first.terms["white"].value == pytest.approx(N, rel=0.05)


@pytest.mark.parametrize(("step", "is_coarse"), [(0.004, False), (0.05, True)])
def test_steps_of_readings_are_told(step: float, is_coarse: bool) -> None:
    """The noise of a reading is 0.01: two and a half steps, and a fifth of one."""
    readings = np.round(rest() / step) * step
    if is_coarse:
        readings += np.where(np.random.default_rng(1).random(readings.shape) < 0.02, step, 0.0)
    channel = noise_at_rest(Resting(readings)).channels[0]
    assert channel.step == pytest.approx(step) and channel.is_coarse == is_coarse
    if not is_coarse:
        assert channel.terms["white"].value == pytest.approx(N, rel=0.05)
    assert noise_at_rest(Resting(rest())).channels[0].step == 0.0


def test_a_gap_of_the_stamps_is_not_differenced_over() -> None:
    """Behind each gap the bias is another one, within what still counts as rest."""
    readings, time_s = rest(), PERIOD_S * np.arange(6000)
    for begin in (2000, 4500):
        time_s[begin:] += 3.0
        readings[begin:] += 6e-3
    found = noise_at_rest(Resting(readings, time_s))
    assert (found.gaps, found.stretches) == (2, 3) and found.rate_hz == pytest.approx(100.0, rel=1e-6)
    assert found.longest_s == pytest.approx(25.0, abs=0.02) and found.rest_s == pytest.approx(60.0, abs=0.1)
    expected = of_stretches(*(part[:, 0] for part in np.split(readings, [2000, 4500])))
    assert found.channels[0].deviation == pytest.approx(expected.deviation, rel=1e-6)


def test_readings_that_are_no_numbers_are_gaps() -> None:
    readings = rest()
    readings[3000] = np.nan
    found = noise_at_rest(Resting(readings))
    assert found.unusable == 1 and found.readings == 5999 and found.stretches == 2
    assert found.channels[2].terms["white"].value == pytest.approx(N, rel=0.05)


def test_what_moves_is_left_out() -> None:
    """Ten rests of 12 s between turns; the forces in them differ by g."""
    rng, parts = np.random.default_rng(11), list[Floats]()
    for k in range(10):
        parts.append(np.roll(rest(1200, seed=k), k, axis=1))
        parts.append(rest(150, seed=k) + rng.normal(0.0, 3.0, (150, 3)))
    found = noise_at_rest(Resting(np.concatenate(parts)))
    assert found.stretches == 10 and found.moving >= 1300 and found.settling > 500
    assert found.readings + found.moving + found.settling == 13_500
    for channel in found.channels:
        assert channel.terms["white"].value == pytest.approx(N, rel=0.05)
        assert channel.tau_s[-1] <= 4.0


def test_gyroscopes_are_taken_in_the_same_rests() -> None:
    """While it turns, the rates are a thousand times their noise."""
    rates = np.random.default_rng(12).normal(0.0, 1e-3, (9000, 3))
    readings, moving = rest(9000), slice(4000, 4400)
    readings[moving] += np.random.default_rng(13).normal(0.0, 3.0, (400, 3))
    rates[moving] += 1.0
    found = noise_at_rest(Resting(readings), gyroscopes=Resting(rates))
    gyroscopes = found.of_unit("rad/s")
    assert [channel.name for channel in gyroscopes] == ["x", "y", "z"] and len(found.of_unit("m/s^2")) == 3
    for channel in gyroscopes:
        assert channel.terms["white"].value == pytest.approx(1e-4, rel=0.05)


def test_the_thermometer_is_a_channel_where_it_is_asked_for() -> None:
    warm = 25.0 + noisy(np.random.default_rng(14), 6000, 1e-3)
    assert not noise_at_rest(Resting(rest(), temperature_c=warm)).of_unit("K")
    (channel,) = noise_at_rest(Resting(rest(), temperature_c=warm), with_temperature=True).of_unit("K")
    assert channel.terms["white"].value == pytest.approx(1e-3, rel=0.05)


def test_a_short_rest_says_that_it_is_too_short() -> None:
    """Forty readings at 4 Hz."""
    for channel in noise_at_rest(Resting(rest(40), 0.25 * np.arange(40))).channels:
        assert channel.why_not == "too few readings at rest follow each other without a gap"


def test_what_never_rests_is_refused() -> None:
    moving = np.random.default_rng(15).normal(0.0, 5.0, (3000, 3)).cumsum(axis=0)
    with pytest.raises(InputError, match="never stands still"):
        noise_at_rest(Resting(moving))


def test_a_table_is_refused() -> None:
    with pytest.raises(InputError, match="table of mean readings"):
        noise_at_rest(open_table(ROOT / "recordings" / "twelve_poses.csv", {"gravity_mps2": "9.81"}, angles=False))


def test_dwells_of_a_bench_have_the_noise_that_was_simulated() -> None:
    found = noise_at_rest(Recording(ROOT / "recordings" / "hidden.mcap", angles=False))
    assert found.stretches == 24
    for channel in found.channels:  # 5e-5 m/s^2 a reading, at 50 Hz
        assert channel.terms["white"].value == pytest.approx(5e-5 / np.sqrt(50.0), rel=0.05)


@pytest.mark.skipif(not REAL.is_dir(), reason="the recordings of others are not there")
def test_a_real_sensor_agrees_with_the_scatter_of_its_own_readings() -> None:
    """MPU-9150 at 100 Hz, in the hand: its readings scatter by their Allan deviation of neighbours, seen independently
    by the median of squares of differences, which no motion spoils."""
    path = REAL / "mpu9150_1.csv.gz"
    found = noise_at_rest(Lines(path, {"accel_unit": "m/s2"}, angles=False))
    readings = np.concatenate([batch.accel.values for batch in Lines(path, {"accel_unit": "m/s2"}, angles=False)])
    robust = np.sqrt(np.median(np.diff(readings, axis=0) ** 2, axis=0) / 0.4549 / 2.0)
    assert found.stretches >= 15
    for channel, sigma in zip(found.channels, robust, strict=True):
        assert channel.reading_sigma == pytest.approx(sigma, rel=0.15)
        assert channel.terms["white"].value is not None and set(channel.terms) == {*TERMS}


class Repeated(Resting):
    """The same readings again and again, as one rest."""

    times = 1

    def __iter__(self) -> Iterator[Batch]:
        lasts_ns = len(self.time_ns) * round(PERIOD_S * 1e9)
        for k in range(self.times):
            for batch in super().__iter__():
                yield Batch(Stream(batch.accel.time_ns + k * lasts_ns, batch.accel.values), batch.pose)


@pytest.mark.slow
def test_memory_is_that_of_a_short_rest_however_long_it_is() -> None:
    """Both have as many of the longest blocks, 625."""

    def peak(times: int) -> tuple[int, RestNoise]:
        source = Repeated(rest(10_000))
        source.times = times
        with traced() as memory:
            found = noise_at_rest(source)
        return memory.bytes, found

    peak(16)
    (half, _), (whole, found) = peak(16), peak(32)
    assert found.readings == 320_000 and found.stretches == 1
    assert whole < 1.15 * half < 30e6


def test_gravity_changes_nothing() -> None:
    """Only differences count."""
    readings = rest()
    first, second = (
        noise_at_rest(Resting(each)).channels[0] for each in (readings, readings + np.array([G / 2, 0.0, -G / 8]))
    )
    assert first.deviation == pytest.approx(second.deviation, rel=1e-6)
