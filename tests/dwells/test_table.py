"""A table of dwells holds in arrays what each of its rows, a dwell, says of itself."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from helpers.by_hand import by_hand
from helpers.synthetic import Run
from scipy.spatial.transform import Rotation

from kf_calib.bench.bench import Bench, axes_of
from kf_calib.bench.streams import Orientations, Source
from kf_calib.dwells.folding import dwells_of_table
from kf_calib.dwells.pieces import OfPieces, of_all_pieces
from kf_calib.dwells.table import Attitudes, DwellTable, FoldedDwells, computed_once
from kf_calib.estimation.dwell_pass import Pass
from kf_calib.estimation.settings import Settings

SOURCES = {"angles": Run(seed=3, dwells=7), "noisy_angles": Run(seed=4, dwells=6, count=700, encoder_deg=0.001)}


def folded(source: Source) -> DwellTable:
    return Pass(source, Settings()).fold()


@pytest.fixture(params=[*SOURCES, "left_out", "by_hand"])
def dwells(request: pytest.FixtureRequest) -> DwellTable:
    if request.param == "by_hand":
        return folded(by_hand(poses=9))
    if request.param == "left_out":
        return folded(SOURCES["angles"]).without((0, 3))
    return folded(SOURCES[request.param])


def changed(dwells: DwellTable, rng: np.random.Generator) -> DwellTable:
    """Dwells about other forces, with setting errors, and something added to their readings."""
    count = len(dwells)
    attitudes = Attitudes(
        0.01 * rng.standard_normal((count, 3)), 1e-4 * rng.random(count), 1e-3 * rng.standard_normal((count, 3, 3))
    )
    turned = dwells.linearised(0.02 * rng.standard_normal((count, 3)), attitudes)
    return turned.plus(1e-3 * rng.standard_normal((len(dwells.folded.pieces), 3, 3)))


@pytest.mark.parametrize("is_changed", [False, True])
def test_a_row_of_a_table_is_a_dwell(dwells: DwellTable, is_changed: bool) -> None:
    table = changed(dwells, np.random.default_rng(1)) if is_changed else dwells
    rows, folded = list(table), table.folded
    np.testing.assert_allclose(table.means, [dwell.means for dwell in rows], rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(table.poses, [dwell.pose for dwell in rows], rtol=1e-13)
    np.testing.assert_array_equal(folded.ends_s, [(dwell.start_s, dwell.end_s) for dwell in rows])
    np.testing.assert_array_equal(folded.counts, [dwell.count for dwell in rows])
    np.testing.assert_array_equal(folded.weights, [dwell.weights for dwell in rows])
    again = DwellTable.of(rows)
    np.testing.assert_array_equal(again.triangles, table.triangles)
    np.testing.assert_array_equal(again.force_mps2, table.force_mps2)
    np.testing.assert_array_equal(again.folded.squares, folded.squares)
    assert [dwell.number for dwell in again] == folded.numbers.tolist()


def test_what_is_felt_is_turned_by_the_effects_and_then_by_the_setting_error(dwells: DwellTable) -> None:
    table = changed(dwells, np.random.default_rng(1))
    assert table.turned_rad is not None and table.attitudes is not None
    for k, force_mps2 in enumerate(table.means[:, 1:4]):
        of_effects, error = (Rotation.from_rotvec(each[k]) for each in (table.turned_rad, table.attitudes.rotation_rad))
        felt_mps2 = table.attitudes.length[k] * (error * of_effects).apply(force_mps2)
        np.testing.assert_allclose(table.felt_means_mps2[k], felt_mps2, rtol=1e-12, atol=1e-12)
    numbers = np.repeat(np.arange(len(table)), 3 * table.folded.piece_numbers)
    for at, felt_mps2 in enumerate(table.felt_force_mps2):
        (alone,) = table[numbers[at] : numbers[at] + 1].felt(table.force_mps2[at : at + 1])
        np.testing.assert_array_equal(felt_mps2, alone)


def test_the_dwell_before_is_the_last_one_at_rest_also_where_it_was_left_out() -> None:
    whole = folded(SOURCES["angles"])
    forces, poses = whole.before
    np.testing.assert_array_equal(forces, whole.means[[0, *range(len(whole) - 1)], 1:4])
    some = whole.without((0, 3))
    kept = [k for k in range(len(whole)) if k not in (0, 3)]
    np.testing.assert_array_equal(some.before[0], forces[kept])
    np.testing.assert_array_equal(some.before[1], poses[kept])
    np.testing.assert_array_equal(some.without((0,)).before[0], forces[kept[1:]])
    both = some[1:].beside(whole[:2])
    np.testing.assert_array_equal(both.before[0], [*forces[kept[1:]], whole.means[-1, 1:4], whole.means[0, 1:4]])


@pytest.mark.parametrize("is_changed", [False, True])
def test_tables_side_by_side_are_the_whole_table(dwells: DwellTable, is_changed: bool) -> None:
    table = changed(dwells, np.random.default_rng(1)) if is_changed else dwells
    both = table[:2].beside(table[2:])
    assert both.folded.equals(table.folded) and not both.folded.equals(table[1:].folded)
    for name in ("means", "poses", "felt_force_mps2", "triangles", "bendings"):
        np.testing.assert_array_equal(getattr(both, name), getattr(table, name), name)
    assert both.sharing(table).folded is table.folded and both[1:].sharing(table).folded is not table.folded
    np.testing.assert_array_equal(table.take([-1]).means, table.means[-1:])
    beside = table[:2].beside(dwells[2:])
    np.testing.assert_array_equal(beside.felt_means_mps2[2:], dwells.felt_means_mps2[2:])
    np.testing.assert_array_equal(beside.triangles[-1], dwells.triangles[-1])


def test_a_dwell_of_a_table_faces_the_force_it_is_given(dwells: DwellTable) -> None:
    rng, count = np.random.default_rng(2), len(dwells)
    forces, poses = rng.standard_normal((count, 3)), rng.standard_normal((count, dwells.poses.shape[1]))
    table = replace(dwells, facing=(forces, poses))
    np.testing.assert_allclose(table.means, [dwell.means for dwell in table], rtol=1e-13, atol=1e-13)
    np.testing.assert_array_equal(table.means[:, 1:4], forces)
    np.testing.assert_array_equal(table.poses, poses)
    both = table[:1].beside(dwells[1:])
    np.testing.assert_array_equal(both.means[0, 1:4], forces[0])
    np.testing.assert_allclose(both.felt_means_mps2[1:], dwells.felt_means_mps2[1:], rtol=1e-12)


def test_a_dwell_grows_piece_by_piece() -> None:
    table = folded(Run(seed=3, dwells=2, count=6000))
    parts = list(table.prefixes(1))
    numbers = [len(part.folded.pieces) for part in parts]
    assert numbers == sorted(set(numbers)) and numbers[0] == 1 and numbers[-1] == table.folded.piece_numbers[1]
    np.testing.assert_array_equal(parts[-1].triangles, table[1:].triangles)
    np.testing.assert_array_equal(parts[0].triangles, table[1:].triangles[:1])


def test_columns_by_piece_are_a_sequence_by_dwell() -> None:
    values = np.arange(24.0).reshape(4, 3, 1, 2)
    columns = OfPieces(values, np.array([0, 1, 4]))
    assert len(columns) == 2 and [len(own) for own in columns] == [1, 3]
    np.testing.assert_array_equal(columns[-1], values[1:])
    assert of_all_pieces(columns) is values
    np.testing.assert_array_equal(of_all_pieces(columns[0:2]), values)
    np.testing.assert_array_equal(columns.beside(columns).values[..., 2:], values)
    np.testing.assert_array_equal(columns.first(1).values, values[..., :1])


def table_of(count: int) -> Orientations:
    """A table of angles, in which one row has no standard deviation."""
    rng = np.random.default_rng(count)
    sigmas = rng.uniform(1e-4, 2e-4, (count, 3))
    sigmas[1] = np.nan
    return Orientations(
        rng.normal(size=(count, 3)), rng.uniform(-3.0, 3.0, (count, 2)), np.cumsum(rng.uniform(30.0, 60.0, count)),
        sigmas, rng.integers(4, 500, count), rng.normal(25.0, 1.0, count),
    )  # fmt: skip


def test_the_arrays_of_a_table_of_means_are_those_of_its_dwells() -> None:
    table = dwells_of_table(table_of(7), Bench(axes_of("yz"), 9.81))
    of_table, one_by_one = table.folded, FoldedDwells.of(list(table))
    for name in ("piece_numbers", "ends", "moving", "pose_sigmas_rad", "piece_counts", "counts", "squares",
                 "elapsed_s", "ends_s", "before", "spreads", "variances"):  # fmt: skip
        np.testing.assert_array_equal(getattr(of_table, name), getattr(one_by_one, name), name)
    np.testing.assert_array_equal(of_table.rates("rate_radps"), np.zeros((21, 3)))
    assert all(each.count == 0 for each in of_table.autocovariances) and of_table.shows_means_only
    assert not folded(SOURCES["angles"]).folded.shows_means_only


def test_the_spread_of_readings_is_their_covariance() -> None:
    """Of a table of means, that of what it states; of readings, that of the readings themselves."""
    run = Run(seed=3, dwells=3, count=700)
    table = folded(run)
    at_s = (run.accel.time_ns - run.accel.time_ns[0]) * 1e-9
    for k, (start_s, end_s) in enumerate(table.folded.ends_s):
        inside = (at_s >= start_s - 1e-9) & (at_s <= end_s + 1e-9)
        np.testing.assert_allclose(table.folded.spreads[k], np.cov(run.accel.values[inside].T, bias=True), atol=1e-12)
    orientations = table_of(7)
    spreads = dwells_of_table(orientations, Bench(axes_of("yz"), 9.81)).folded.spreads
    assert orientations.sigma_mps2 is not None and not spreads[1].any()
    np.testing.assert_allclose(np.diagonal(spreads[2:], axis1=1, axis2=2), orientations.sigma_mps2[2:] ** 2, rtol=0.6)


def test_a_row_of_a_table_takes_no_more_than_its_numbers() -> None:
    """A dwell as an object would take 1.5 kB."""
    table, bench = table_of(4000), Bench(axes_of("yz"), 9.81)
    tracemalloc.start()
    dwells = dwells_of_table(table, bench)
    used = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert used < 700 * len(dwells) and len(list(dwells[:3])) == 3


def test_what_is_computed_of_dwells_is_computed_once() -> None:
    calls, table = list[int](), folded(SOURCES["angles"])

    @computed_once
    def count(dwells: FoldedDwells) -> int:
        calls.append(len(dwells.numbers))
        return calls[-1]

    assert count(table.folded) == count(changed(table, np.random.default_rng(3)).folded) == 7
    assert count(table[1:].folded) == 6 and calls == [7, 6]
