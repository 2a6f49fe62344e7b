"""Merged pieces are those that the same readings give at once; dwells of hours and runs of days have few of them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from helpers.hidden_effects import BENCH
from helpers.long_runs import slow
from helpers.synthetic import plan_of

from kf_calib.bench.arrays import Floats
from kf_calib.dwells import folding, pieces
from kf_calib.dwells.pieces import FEWEST_PIECES, MOST_PIECES, Pieces, coarsened, merged_piece
from kf_calib.dwells.qr import square_triangle
from kf_calib.dwells.rows import Nodes, basis
from kf_calib.dwells.sufficient_statistics import Dwell
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.results import Calibration
from kf_calib.sources.simulation.sensors import GRADES, TrueNoise
from kf_calib.sources.simulation.simulator import Simulation


def piece_of(time_s: Floats, readings: Floats, arrival_s: float = 0.0, carrier_hz: float = 0.0) -> Pieces:
    """A piece folded from readings (n, 3), its temperature a parabola of time."""
    middle, half = 0.5 * (time_s[0] + time_s[-1]), 0.5 * (time_s[-1] - time_s[0])
    rows = np.vstack([basis((time_s - middle) / half, time_s, carrier_hz), readings.T]).T
    at = np.array([time_s[0], middle, time_s[-1]])
    nodes = Nodes(
        at, at - arrival_s, np.tile([0.0, 9.81, 0.0], (3, 1)), np.zeros((3, 3)), 20.0 + 0.1 * at + 3e-4 * at**2
    )
    counts = np.array([len(time_s)])
    return Pieces(square_triangle(rows)[None], nodes, counts, counts, carrier_hz)


def standing(hours: float, rate_hz: float = 0.5, block_s: float = 20.0) -> Iterator[Pieces]:
    """Pieces of a dwell, block by block."""
    rng, count = np.random.default_rng(0), int(block_s * rate_hz)
    for number in range(int(hours * 3600.0 / block_s)):
        time_s = number * block_s + np.arange(count) / rate_hz
        yield piece_of(time_s, rng.normal(size=(count, 3)))


@pytest.mark.parametrize("carrier_hz", [0.0, 0.013])
def test_merged_pieces_are_those_that_the_readings_give_at_once(carrier_hz: float) -> None:
    """Of unequal lengths, with a gap between; the triangle is unique but for the signs of its rows."""
    rng = np.random.default_rng(1)
    time_s = np.concatenate([np.arange(100.0, 130.0), np.arange(130.0, 190.0), np.arange(200.0, 260.0)])
    readings = rng.normal(9.81, 1e-3, (len(time_s), 3))
    parts = [slice(0, 30), slice(30, 90), slice(90, 150)]
    one = merged_piece(Pieces.joined([piece_of(time_s[own], readings[own], 90.0, carrier_hz) for own in parts]))
    whole = piece_of(time_s, readings, 90.0, carrier_hz)
    of_one, of_whole = one.triangles[0], whole.triangles[0]
    np.testing.assert_allclose(of_one.T @ of_one, of_whole.T @ of_whole, rtol=1e-10, atol=1e-9)
    for name in ("elapsed_s", "since_arrival_s", "force_mps2", "pose", "temperature_c"):
        np.testing.assert_allclose(getattr(one.nodes, name), getattr(whole.nodes, name), rtol=1e-12, err_msg=name)
    assert (one.counts, one.reading_counts, one.carrier_hz) == ([150], [150], carrier_hz)


@pytest.mark.parametrize("hours", [12.0, *slow(72.0)])
def test_a_dwell_of_days_has_a_bounded_number_of_pieces(hours: float) -> None:
    """Short after the arrival and even later, each reading in one of them."""
    kept, total = list[Pieces](), 0
    for piece in standing(hours=hours):
        if len(kept) == MOST_PIECES:
            merged = coarsened(Pieces.joined(kept))
            kept = [merged[k : k + 1] for k in range(len(merged))]
            assert len(kept) <= MOST_PIECES // 2 + 16
        kept.append(piece)
        total += int(piece.counts.sum())
    whole = Pieces.joined(kept)
    lengths, begins = np.diff(whole.spans_s)[:, 0], whole.nodes.since_arrival_s[::3]
    assert whole.counts.sum() == total and (np.diff(begins) > 0.0).all()
    assert lengths[0] < 20.0 and (lengths[1:] <= np.maximum(begins[1:], 20.0)).all()
    assert lengths.max() < hours * 3600.0 / 32.0


@pytest.mark.parametrize("arrival_s", [-7.0, 0.0, 40.0])
def test_merged_pieces_are_as_long_as_they_may_be(arrival_s: float) -> None:
    """At most the time since the arrival when it begins, and a share of all; one piece more would make it longer."""
    kept = Pieces.joined([piece_of(10.0 * k + 45.0 + np.arange(5.0), np.ones((5, 3)), arrival_s) for k in range(300)])
    longest_s = (kept.nodes.elapsed_s[-1] - 45.0) / 20.0
    merged = coarsened(kept, 20)
    begins, ends = merged.spans_s.T
    allowed = np.minimum(longest_s, begins - arrival_s)
    several = merged.counts > 5
    assert several.any() and (ends - begins <= allowed)[several].all()
    assert (ends[:-1] + 10.0 - begins[:-1] > allowed[:-1]).all()
    assert merged.counts.sum() == 1500


def test_a_run_of_days_has_a_bounded_number_of_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    """Long dwells lose half of theirs again and again, short ones none; no reading is lost."""
    monkeypatch.setattr(folding, "MOST_RUN_PIECES", 300)
    long, short = list(standing(hours=0.4)), list(standing(hours=0.05))
    dwells, numbers = folding._DwellSequence(), list[int]()
    for number in range(1, 61):
        for piece in long if number % 2 else short:
            dwells.add(Dwell(number, piece))
        numbers.append(sum(len(dwell.pieces) for dwell in dwells.folded))
    counts = [len(dwell.pieces) for dwell in dwells.folded]
    assert max(counts[:48:2]) <= FEWEST_PIECES and set(counts[1::2]) == {len(short)} and max(numbers) < 30 * 29
    assert [dwell.count for dwell in dwells.folded[:2]] == [Pieces.joined(each).counts.sum() for each in (long, short)]


@pytest.mark.slow
def test_fewer_pieces_tell_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a bench with 1/f noise whose temperature swings: parameters, sigmas and p-value."""
    results = list[Calibration]()
    for most in (10_000, 50):
        monkeypatch.setattr(folding, "MOST_RUN_PIECES", most)
        noise = TrueNoise(white_mps2=1e-4, flicker_mps2=3e-6)
        plan = plan_of(14, dwell_s=1200.0, seed=2)
        results.append(
            calibrate(Simulation(BENCH, GRADES["navigation"].sensors(2), noise, plan, sample_hz=1.0, seed=2))
        )
    whole, merged = results
    assert sum(len(dwell.pieces) for dwell in merged.fit.dwells) < 0.8 * sum(
        len(dwell.pieces) for dwell in whole.fit.dwells
    )
    assert np.abs((merged.estimate.parameters - whole.estimate.parameters) / whole.estimate.sigma).max() < 0.01
    np.testing.assert_allclose(merged.estimate.sigma, whole.estimate.sigma, rtol=0.01)
    assert merged.consistency.p_value == pytest.approx(whole.consistency.p_value, abs=0.01)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7, 40, 20_000])
def test_moments_of_a_walk_are_sums_over_its_steps(count: int) -> None:
    """Each step moves all later readings; two readings lie on their line."""
    u = np.linspace(-1.0, 1.0, count) if count > 1 else np.zeros(1)
    design = np.column_stack([np.ones(count), u, u * u][: max(count, 1)])
    onto = np.vstack([np.linalg.pinv(design), np.zeros((3 - design.shape[1], count)), np.arange(count) == count - 1])
    steps = np.cumsum(onto[:, ::-1], axis=1)[:, ::-1][:, 1:]
    covariance, squares = pieces._moments(count)
    np.testing.assert_allclose(covariance, steps @ steps.T, atol=1e-9 * count)
    fitted = np.trace(design.T @ design @ covariance[: design.shape[1], : design.shape[1]])
    assert squares == pytest.approx(0.5 * count * (count - 1) - fitted, rel=1e-6, abs=1e-9)
