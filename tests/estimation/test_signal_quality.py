"""Steps, flat tops and crowded outliers are found in the readings, at their true size, and not where there are none."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.long_runs import slow
from helpers.synthetic import Run

from kf_calib.bench.streams import Stream
from kf_calib.diagnosis.refits import Refits
from kf_calib.errors import UnobservableError
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.signal_quality import (
    Readings,
    _first_seen,
    _reach,
    _repeating,
    clustering,
    common_step,
    missing_above,
)
from kf_calib.sources.files.recording import Recording

QUICK = ["--orientations", "24", "--dwell-s", "8", "--slew-degps", "360", "--sample-hz", "100", "--seed", "3"]
FACES = np.array([(0, b, c) for b, c in itertools.product(np.radians([0.0, 90, 180, 270]), np.radians([0.0, 45, 90]))])


def readings(run: Run, change=lambda values: values) -> Readings:
    run.accel = Stream(run.accel.time_ns, change(run.accel.values))
    return calibrate(run).readings


def stepped(step: float):
    return lambda values: step * np.rint(values / step)


def stored(values: np.ndarray) -> np.ndarray:
    return values.astype(np.float32).astype(float)


@pytest.mark.parametrize("sigmas", [0.1, 1.0, 2.0, 4.0, 300.0])
@pytest.mark.parametrize("store", [lambda values: values, stored, lambda values: 9.80665 * stored(values / 9.80665)])
def test_the_step_is_found_and_matters_where_averaging_cannot_help(sigmas: float, store) -> None:
    step = sigmas * 1e-4
    if sigmas == 0.1 and store(np.full(1, np.pi))[0] != np.pi:
        return  # a hundredth of a microradian of g: no more than ten steps of float32
    found = readings(Run(seed=1), lambda values: store(stepped(step)(values)))
    assert [each.channel for each in found.quantisation] == [1, 2, 3]
    for each in found.quantisation:
        assert each.step_mps2 == pytest.approx(step, rel=1e-3)
        assert each.matters == (sigmas > 2.0)
        assert each.mean_error_mps2 <= each.step_mps2 / 2
    assert not found.saturation and found.outliers.clustered_p is None


def test_values_repeat_where_there_are_half_as_many_as_readings() -> None:
    """100 and 101 values in 200 readings, and all of them in 1000, of which every fourth is compared."""
    twice = np.repeat(np.arange(100.0), 2)
    once_more = np.append(twice[:-1], 100.0)
    block = np.random.default_rng(6).permutation(np.column_stack([twice, once_more, np.arange(200.0)]))
    seen = _first_seen(1, block)
    assert seen.distinct.tolist() == [100.0, 101.0, 200.0] and seen.sampled == 200
    assert [bool(_repeating([seen], channel)[0]) for channel in range(3)] == [True, False, False]
    longer = _first_seen(1, np.repeat(block, 5, axis=0))
    assert longer.sampled == 250 and longer.distinct.max() == 200.0
    assert [len(values) for values in longer.values] == [32, 32, 0]


@pytest.mark.parametrize("sigmas", [1.0, 2.0, 3.0, 4.0, 8.0])
def test_means_are_off_by_no_more_than_is_said(sigmas: float) -> None:
    """Readings of a hundred levels, many enough that noise averages out."""
    found = readings(Run(seed=5), stepped(sigmas * 1e-4)).quantisation[0]
    rng = np.random.default_rng(0)
    levels = np.linspace(0.0, 1.0, 101)[:, None]
    means = np.rint(levels + rng.normal(size=(101, 20_000)) / sigmas).mean(axis=1)
    largest = found.step_mps2 * np.abs(means - levels[:, 0]).max()
    assert largest < 1.25 * found.mean_error_mps2 + 4.0 * 1.1e-4 / np.sqrt(20_000)
    assert largest > 0.4 * found.mean_error_mps2


@pytest.mark.parametrize("seeds", [range(2), *slow(range(100))], ids=len)
@pytest.mark.parametrize("kind", ["white", "ar1", "float32", "counts", "correlated counts"])
def test_no_false_alarm(kind: str, seeds: range) -> None:
    for seed in seeds:
        mems, phi = "counts" in kind, 0.9 if kind in ("ar1", "correlated counts") else 0.0
        run = Run(seed=seed, dwells=12, count=200, phi=phi, white_mps2=0.02 if mems else 1e-4)
        change = stepped(9.81 / 16384 * (1, 4, 16, 32)[seed % 4]) if mems else stored if kind == "float32" else np.copy
        found = readings(run, change)
        assert not found.warnings and not found.saturation, (seed, found)
        assert not found.quantisation or mems, (seed, found)


def test_a_real_imu_counts_in_2048ths_of_g(ferraris: Path) -> None:
    found = calibrate(Recording(ferraris)).readings
    assert [each.step_mps2 for each in found.quantisation] == pytest.approx([9.81 / 2048] * 3, rel=1e-9)
    assert not found.warnings


CHANGES = (np.copy, stored, stepped(5e-5), stepped(2e-4))


@pytest.mark.parametrize(
    "limit, change",
    [
        (7.0, np.copy), *((9.0, change) for change in CHANGES), (9.7, np.copy),
        *slow(*((limit, change) for limit in (7.0, 9.7) for change in CHANGES[1:])),
    ],
)  # fmt: skip
def test_flat_tops_are_found_where_they_are(limit: float, change) -> None:
    clean = calibrate(Run(seed=1, poses=FACES, dwells=12))
    beyond = {
        (i + 1, sign): tuple(k + 1 for k, visit in enumerate(clean.visits) if sign * visit.dwell.means[4 + i] > limit)
        for i in range(3)
        for sign in (1, -1)
    }
    found = readings(Run(seed=1, poses=FACES, dwells=12), lambda v: change(np.clip(v, -limit, limit)))
    got = {(each.channel, int(np.sign(each.level_mps2))): each for each in found.saturation}
    assert {key: each.dwells for key, each in got.items()} == {key: at for key, at in beyond.items() if at}
    for each in found.saturation:
        assert abs(each.level_mps2) == pytest.approx(limit, abs=1e-4)
        assert each.share == pytest.approx(len(each.dwells) / 12, abs=0.02)


@pytest.mark.parametrize("below_sigmas", [-4.0, -2.0, 0.0, 2.0])
def test_a_top_cut_within_the_noise_is_found_by_what_is_missing_above(below_sigmas: float) -> None:
    run = Run(seed=2, poses=FACES, dwells=12, count=2000)
    level = max(visit.dwell.means[4] for visit in calibrate(Run(seed=2, poses=FACES, dwells=12)).visits)
    found = readings(run, lambda v: np.minimum(v, [level - below_sigmas * 1e-4, 99.0, 99.0])).saturation
    assert [each.channel for each in found] == ([] if below_sigmas == -4.0 else [1])


@pytest.mark.parametrize("blocks", [1, 3, 50])
@pytest.mark.parametrize("static", [True, False])
def test_readings_at_the_ends_of_a_dwell_are_counted_however_it_comes(blocks: int, static: bool) -> None:
    values = np.clip(np.random.default_rng(4).normal(size=(600, 3)), [-1.0, -1.5, -9.0], [1.5, 1.0, 9.0])
    seen = _first_seen(1, values)
    for part in np.array_split(values, blocks):
        rows: Any = SimpleNamespace(static=static, readings=part, innovation=np.ascontiguousarray(part.T) - 0.3)
        _reach(seen, rows)
    ends = np.append(values.max(axis=0), -values.min(axis=0))
    np.testing.assert_array_equal(seen.ends, ends)
    both = np.hstack([values, -values])
    np.testing.assert_array_equal(seen.stuck, np.count_nonzero(both == ends, axis=0))


def test_what_noise_puts_above_a_step() -> None:
    rng = np.random.default_rng(3)
    values = np.rint(rng.normal(size=1_000_000) / 0.7)
    for top in (1.0, 2.0, 3.0):  # cut there, as many are missing as lay above
        stuck = (values == top).sum() / (values <= top).sum()
        count = float((values <= top).sum())
        share_at_or_above = (values >= top).mean()
        expected = (values > top).mean() * 1e6
        got = missing_above(np.array([share_at_or_above * 1e6]), np.array([1e6]), 0.7)[0]
        assert got == pytest.approx(expected, rel=0.05)
        assert 0 < stuck < 1 and count > 0


def test_outliers_crowd_or_do_not() -> None:
    rng = np.random.default_rng(4)
    spread, crowded = Run(seed=4), Run(seed=4)
    hit = rng.random(len(spread.accel)) < 0.01
    spread.accel.values[hit, 1] += 0.1
    place = 7 * 300 + 30 + 3 * np.arange(30)
    crowded.accel.values[place, 2] -= 0.1
    one, other = calibrate(spread), calibrate(crowded)
    assert one.readings.outliers.count == one.counts.gated > 30
    assert one.readings.outliers.by_channel == (0, one.counts.gated, 0)
    assert one.readings.outliers.share == pytest.approx(0.01, rel=0.3)
    assert one.readings.outliers.clustered_p is not None and one.readings.outliers.clustered_p > 0.01
    found = other.readings.outliers
    assert (found.count, found.by_channel, found.dwells) == (30, (0, 0, 30), (8,))
    assert found.clustered_p is not None and found.clustered_p < 1e-9
    assert any("crowded in dwell 8" in warning for warning in other.warnings)
    assert not any("crowded" in warning for warning in one.warnings)


def test_the_p_of_crowding_is_no_smaller_than_chance() -> None:
    rng, counts = np.random.default_rng(6), np.array([100.0] * 12 + [900.0] * 12)
    for total in (2, 20, 200):
        p = [clustering(rng.multinomial(total, counts / counts.sum()).astype(float), counts)[0] for _ in range(1000)]
        assert np.mean(np.array(p, float) < 0.05) < 0.07
    assert clustering(np.ones(1), np.array([10.0])) == (None, slice(0, 0))
    hits, many = np.zeros(5000), np.full(5000, 100.0)
    hits[4000:4100] = 1.0
    p_value, dwells = clustering(hits, many)
    assert p_value is not None and p_value < 1e-50 and 4000 < (dwells.start + dwells.stop) / 2 < 4101


def test_common_step() -> None:
    rng = np.random.default_rng(7)
    for step in (1e-5, 0.03, 2.0):
        values = step * rng.integers(-300, 300, 40) + 0.123
        assert common_step(values, 1e-12) == pytest.approx(step, rel=1e-9)
    coarse = 0.05 * np.array([0.0, 6, 16, 31])  # differences of 6, 10 and 15: no two share the step alone
    assert common_step(coarse + rng.uniform(-1e-6, 1e-6, 4), 2e-6) == pytest.approx(0.05, rel=1e-3)
    for tolerances in (10.0, 20.0, 39.0):  # hardly above rounding: neighbours on the grid are one step apart
        rounded = np.arange(30.0) * tolerances + rng.uniform(-0.5, 0.5, 30)
        assert common_step(rounded, 1.0) == pytest.approx(tolerances, rel=0.01)
    assert common_step(rng.normal(size=40), 1e-6) is None
    assert common_step(np.array([1.0, 2.0, 3.0]), 1e-6) is None


def test_a_step_is_found_through_rounding_that_adds_up_over_many_steps() -> None:
    """The least difference is known to four tolerances: over thirty steps the errors of its multiples add up."""
    rng = np.random.default_rng(3)
    for _ in range(100):
        places = np.cumsum(rng.integers(2, 31, 24))
        values = places * 100.0 + rng.uniform(-0.03, 0.03, 24)
        assert common_step(values, 0.03) == pytest.approx(100.0 * np.gcd.reduce(np.diff(places)), rel=1e-4)


def test_degenerate_readings_say_nothing_wrong() -> None:
    short, holed, one = Run(seed=8, count=40, dwells=6), Run(seed=8), Run(seed=8, dwells=8)
    holed.accel.values[::7] = np.nan
    assert readings(short) == readings(holed) == Readings()
    one.accel.values[:300, 0] = 3.0  # stuck within the range is no end of it
    assert not readings(one).saturation
    five = Run(seed=8, dwells=5)
    five.accel.values[:300, 0] = 3.0
    with pytest.raises(UnobservableError, match=r"the 5 dwells disagree with every calibration, by about \d+ µg"):
        readings(five)
    crowd = Run(seed=8)
    crowd.accel.values[330, 0] = 50.0  # one outlier is neither a flat top nor a crowd
    assert not readings(crowd).warnings


def test_a_refit_keeps_what_was_seen() -> None:
    run = Run(seed=1)
    run.accel = Stream(run.accel.time_ns, np.clip(run.accel.values, -9.0, 9.0))
    before = calibrate(run)
    assert before.readings.saturation and Refits().of(before, ["second-order"]).readings == before.readings


@pytest.fixture
def printed(run):
    """What a command prints that must end well, without a word of warning."""

    def call(*words: object) -> str:
        code, out, err = run(*words)
        assert not code and not err
        return out

    return call


def simulated(printed, path: Path, *hide: str) -> Path:
    printed("simulate", path, *QUICK, *(word for text in hide for word in ("--hide", text)))
    return path


def test_hidden_flat_tops_are_said_before_an_effect_is_named(printed, tmp_path: Path) -> None:
    path = tmp_path / "flat.mcap"
    printed("simulate", path, *QUICK, "--plan", "faces", "--hide", "saturation=0,9.5,0")
    found = json.loads(printed("diagnose", path, "--json"))
    assert {each["channel"] for each in found["readings"]["saturation"]} == {2}
    assert {abs(each["level_mps2"]) for each in found["readings"]["saturation"]} == {9.5}
    assert found["verdict"].startswith("Readings of accelerometer 2 are cut off at ")
    replayed = json.loads(printed("replay", path, "--json"))
    assert replayed["readings"] == found["readings"]
    assert any("cut off" in warning for warning in replayed["warnings"])


@pytest.mark.slow
def test_hidden_flat_tops_are_printed_before_an_effect(printed, tmp_path: Path) -> None:
    path = tmp_path / "flat.mcap"
    printed("simulate", path, *QUICK, "--plan", "faces", "--hide", "saturation=0,9.5,0")
    words, details = printed("diagnose", path), printed("diagnose", path, "--details")
    assert words.startswith("Readings of accelerometer 2 are cut off at ")
    assert "saturation of accelerometer 2" in details
    replayed = json.loads(printed("replay", path, "--json"))
    assert words.count("widen its range") == len(replayed["readings"]["saturation"])


@pytest.mark.parametrize("step, matters", [(2e-5, False), (1e-3, True)])
def test_a_hidden_step(printed, tmp_path: Path, step: float, matters: bool) -> None:
    path = simulated(printed, tmp_path / "steps.mcap", f"quantisation={step}")
    found = json.loads(printed("replay", path, "--json"))
    assert [each["step_mps2"] for each in found["readings"]["quantisation"]] == pytest.approx([step] * 3, rel=1e-6)
    assert [each["matters"] for each in found["readings"]["quantisation"]] == [matters] * 3
    assert any("averaging does not help" in warning for warning in found["warnings"]) == matters
    assert found["readings"]["saturation"] == []


@pytest.mark.slow
def test_hidden_outliers_and_none(printed, tmp_path: Path) -> None:
    found = json.loads(printed("replay", simulated(printed, tmp_path / "a.mcap", "outliers=10mg;rate=2e-3"), "--json"))
    assert found["readings"]["outliers"]["count"] == found["counts"]["gated"] > 20
    assert found["readings"]["outliers"]["clustered_p"] > 1e-3
    clean = json.loads(printed("diagnose", simulated(printed, tmp_path / "b.mcap"), "--json"))["readings"]
    assert clean["quantisation"] == clean["saturation"] == [] and clean["outliers"]["count"] == 0
