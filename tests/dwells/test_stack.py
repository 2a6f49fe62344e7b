"""Arrays over dwells hold what each dwell says of itself."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from helpers.by_hand import by_hand
from helpers.synthetic import Run

from kf_calib.bench.bench import Bench, axes_of
from kf_calib.bench.streams import Orientations, Source
from kf_calib.dwells.folding import dwells_of_table
from kf_calib.dwells.pieces import OfPieces, of_all_pieces
from kf_calib.dwells.stack import Attitudes, DwellStack, Folded
from kf_calib.dwells.sufficient_statistics import DwellFactor, dwells_before, dwells_without
from kf_calib.estimation.dwell_pass import Pass
from kf_calib.estimation.settings import Settings

SOURCES = {"angles": Run(seed=3, dwells=7), "noisy_angles": Run(seed=4, dwells=6, count=700, encoder_deg=0.001)}


def folded(source: Source) -> list[DwellFactor]:
    return Pass(source, Settings()).fold()


@pytest.fixture(params=[*SOURCES, "left_out", "by_hand"])
def dwells(request: pytest.FixtureRequest) -> list[DwellFactor]:
    if request.param == "by_hand":
        return folded(by_hand(poses=9))
    if request.param == "left_out":
        return dwells_without(folded(SOURCES["angles"]), (0, 3))
    return folded(SOURCES[request.param])


def changed(dwells: list[DwellFactor], rng: np.random.Generator) -> DwellStack:
    """Dwells about other forces, with setting errors, and something added to their readings."""
    stack, count = DwellStack.of(dwells), len(dwells)
    attitudes = Attitudes(
        0.01 * rng.standard_normal((count, 3)), 1e-4 * rng.random(count), 1e-3 * rng.standard_normal((count, 3, 3))
    )
    turned = stack.linearised(0.02 * rng.standard_normal((count, 3)), attitudes)
    return turned.plus(1e-3 * rng.standard_normal((int(stack.folded.ends[-1]), 3, 3)))


@pytest.mark.parametrize("is_changed", [False, True])
def test_a_stack_says_what_its_dwells_say(dwells: list[DwellFactor], is_changed: bool) -> None:
    stack = changed(dwells, np.random.default_rng(1)) if is_changed else DwellStack.of(dwells)
    each, numbers = list(stack), np.repeat(np.arange(len(dwells)), [len(dwell.pieces) for dwell in dwells])
    np.testing.assert_allclose(stack.means, [dwell.means for dwell in each], rtol=1e-13, atol=1e-13)
    felt = [dwell.felt_force(dwell.means[None, 1:4])[0] for dwell in each]
    np.testing.assert_allclose(stack.felt_means_mps2, felt, rtol=1e-13, atol=1e-13)
    at_nodes = np.concatenate([dwell.felt_force(dwell.nodes.force_mps2) for dwell in each])
    np.testing.assert_allclose(stack.felt_force_mps2, at_nodes, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(stack.poses, [dwell.pose for dwell in each], rtol=1e-13)
    np.testing.assert_array_equal(stack.folded.ends_s, [(dwell.start_s, dwell.end_s) for dwell in each])
    np.testing.assert_array_equal(stack.folded.counts, [dwell.count for dwell in each])
    np.testing.assert_array_equal(stack.folded.squares, np.concatenate([dwell.squares for dwell in each]))
    np.testing.assert_allclose(stack.folded.shaking[0], np.concatenate([dwell.shaking[0] for dwell in each]))
    for shape, triangles in zip(stack.folded.shapes, stack.triangles, strict=True):
        for k, pieces, own in zip(shape.dwells, shape.pieces, triangles, strict=True):
            assert (numbers[pieces] == k).all()
            np.testing.assert_allclose(own, each[k].triangles, rtol=1e-13, atol=1e-12)
    before = dwells_before(each)
    np.testing.assert_allclose(stack.before[0], [dwell.means[1:4] for dwell in before], rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(stack.before[1], [dwell.pose for dwell in before], rtol=1e-13)


def test_a_dwell_of_a_stack_faces_the_force_it_is_given(dwells: list[DwellFactor]) -> None:
    rng, count = np.random.default_rng(2), len(dwells)
    forces, poses = rng.standard_normal((count, 3)), rng.standard_normal((count, dwells[0].pose.size))
    stack = DwellStack.of(dwells).facing_forces(forces, poses, None, {2: dwells[0]})
    np.testing.assert_allclose(stack.means, [dwell.means for dwell in stack], rtol=1e-13, atol=1e-13)
    np.testing.assert_array_equal(stack.means[:, 1:4], forces)
    assert stack[2].came_from is dwells[0] and stack[1].came_from is None
    np.testing.assert_allclose(stack.before[0][2], dwells[0].means[1:4], rtol=1e-13)
    np.testing.assert_array_equal(stack.before[1][1], poses[0])


def test_stacks_are_the_same_if_nothing_was_changed(dwells: list[DwellFactor]) -> None:
    stack = DwellStack.of(dwells)
    assert DwellStack.of(stack) is stack and list(stack) == dwells
    assert stack.is_same(DwellStack.of(list(dwells))) and not stack.is_same(DwellStack.of(dwells[:-1]))
    assert not stack.is_same(changed(dwells, np.random.default_rng(3)))


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


def test_the_arrays_of_a_table_are_those_of_its_dwells() -> None:
    of_table = dwells_of_table(table_of(7), Bench(axes_of("yz"), 9.81)).folded
    one_by_one = Folded(list(of_table.dwells))
    for name in ("piece_numbers", "ends", "widths", "moving", "pose_sigmas_rad", "piece_counts", "reading_counts",
                 "counts", "squares", "elapsed_s", "ends_s", "force_mps2", "pose", "before"):  # fmt: skip
        np.testing.assert_array_equal(getattr(of_table, name), getattr(one_by_one, name), name)
    for name in ("since_arrival_s", "temperature_c"):
        np.testing.assert_array_equal(of_table.of_nodes(name), one_by_one.of_nodes(name))
    np.testing.assert_array_equal(of_table.rates("rate_radps"), one_by_one.rates("rate_radps"))
    np.testing.assert_array_equal(of_table.triangles[0], one_by_one.triangles[0])
    np.testing.assert_allclose(of_table.spreads, one_by_one.spreads, rtol=1e-6, atol=1e-12)
    np.testing.assert_array_equal(of_table.shaking[0], one_by_one.shaking[0])
    assert of_table.came_from == one_by_one.came_from == {} and of_table.autocovariance.count == 0
    assert of_table.shows_means_only and one_by_one.shows_means_only
    assert not Folded(folded(SOURCES["angles"])).shows_means_only


def test_a_row_of_a_table_takes_no_more_than_its_numbers() -> None:
    """A dwell as an object would take 1.5 kB."""
    table, bench = table_of(4000), Bench(axes_of("yz"), 9.81)
    tracemalloc.start()
    stack = dwells_of_table(table, bench)
    used = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert used < 700 * len(stack) and len(list(stack.folded.dwells[:3])) == 3


def test_what_is_known_of_dwells_is_shared_with_a_stack_of_the_same_dwells_alone(dwells: list[DwellFactor]) -> None:
    stack = DwellStack.of(dwells)
    assert DwellStack.of(list(dwells), stack).folded is stack.folded
    assert DwellStack.of(dwells[::-1], stack).folded is not stack.folded
    assert DwellStack.of(dwells[1:], stack).folded is not stack.folded
