"""Plans: where gravity points in them, and in which order."""

import ast
import os
import subprocess
import sys

import numpy as np
import pytest
from helpers.long_runs import slow

from kf_calib.bench.bench import Bench, axes_of, parse_axes
from kf_calib.errors import InputError
from kf_calib.sources.simulation import visit_plans
from kf_calib.sources.simulation.visit_plans import YZX, explicit_plan, six_faces, spread_plan, up_directions

OBLIQUE = parse_axes("1,1,0 z x")


def directions(plan, axes=YZX) -> np.ndarray:
    """The vertical in the platform frame (n, 3), by the package's own kinematics."""
    bench = Bench(axes=axes, gravity_mps2=1.0)
    return bench.specific_force(np.zeros(len(plan)), np.radians([visit.gimbal_deg for visit in plan]))


@pytest.mark.parametrize("axes", [YZX, axes_of("zx"), axes_of("xz"), axes_of("zyx"), OBLIQUE], ids=str)
@pytest.mark.parametrize("count", [12, *slow(40)])
def test_directions_fill_the_sphere(axes, count):
    up = directions(spread_plan(count, axes, seed=1), axes)
    # evenly spread: every eigenvalue is count / 3, and no two directions crowd
    assert np.linalg.eigvalsh(up.T @ up).min() > 0.8 * count / 3
    assert np.linalg.norm(up.mean(axis=0)) < 0.1
    cosines = up @ up.T - 2 * np.eye(count)
    nearest = np.degrees(np.arccos(cosines.max(axis=1)))
    assert nearest.min() > 0.6 * np.degrees(np.sqrt(4 * np.pi / count))


def test_angle_that_does_not_move_gravity_varies_too():
    outer = np.radians([visit.gimbal_deg[0] for visit in spread_plan(48, seed=3)])
    assert abs(np.exp(1j * outer).mean()) < 0.35
    assert set(np.floor(outer / (np.pi / 2)).astype(int)) == {-2, -1, 0, 1}


@pytest.mark.slow
def test_order_is_not_correlated_with_angle():
    up = directions(spread_plan(200, seed=5))
    order = np.linspace(-1, 1, 200)
    # the lattice itself runs from pole to pole: unshuffled, one correlation would be near 1
    assert np.abs([np.corrcoef(order, up @ axis)[0, 1] for axis in np.eye(3)]).max() < 0.25


def test_plan_depends_on_its_seed_alone():
    first = spread_plan(6, seed=2)
    visit_plans._spread_angles_deg.cache_clear()
    assert spread_plan(6, seed=2) == first
    assert spread_plan(6, seed=2) != spread_plan(6, seed=3)


def test_axes_that_reach_a_circle_only_get_it_filled():
    up = directions(spread_plan(24, axes_of("z"), seed=0), axes_of("z"))
    assert np.abs(up[:, 2]).max() < 1e-9
    gaps = np.diff(np.sort(np.arctan2(up[:, 1], up[:, 0])))
    assert gaps.max() < np.pi / 2


def test_six_faces_are_exact_and_simple():
    plan = six_faces(dwell_s=7.0)
    np.testing.assert_allclose(directions(plan), np.kron(np.eye(3), [[1.0], [-1.0]]), atol=1e-12)
    assert plan[2].gimbal_deg == (0.0, 0.0, 0.0)
    assert all(visit.dwell_s == 7.0 for visit in plan)
    assert sum(abs(angle) for visit in plan for angle in visit.gimbal_deg) == 540.0


def test_six_faces_refused_where_axes_cannot_show_them():
    with pytest.raises(InputError, match="spread plan"):
        six_faces(axes_of("yz"))


def test_own_kinematics_agree_with_the_package():
    angles = np.random.default_rng(0).uniform(-np.pi, np.pi, (50, 3))
    bench = Bench(axes=OBLIQUE, gravity_mps2=1.0)
    np.testing.assert_allclose(up_directions(OBLIQUE, angles), bench.specific_force(np.zeros(50), angles), atol=1e-14)


@pytest.mark.parametrize("up", ["y", "z", "-x"])
@pytest.mark.parametrize("axes", [YZX, axes_of("zx"), OBLIQUE], ids=str)
def test_one_set_of_angles_has_the_direction_that_it_has_among_many(axes, up):
    """The kinematics in numbers, which a search for angles asks, against those by scipy's rotations; tiny turns too."""
    angles = np.random.default_rng(1).uniform(-2 * np.pi, 2 * np.pi, (50, len(axes)))
    angles[:10] *= 1e-4
    one_by_one = [visit_plans._up_direction(axes, row, up) for row in angles.tolist()]
    np.testing.assert_allclose(one_by_one, up_directions(axes, angles, up), rtol=0, atol=5e-16)


def test_explicit_plan_keeps_order_and_angles():
    plan = explicit_plan([(0, 90, 1), (5, 0, 0)], dwell_s=3.0)
    assert [visit.gimbal_deg for visit in plan] == [(0.0, 90.0, 1.0), (5.0, 0.0, 0.0)]


def test_an_empty_plan_is_refused():
    with pytest.raises(InputError, match="one or more"):
        spread_plan(0)


def test_a_plan_does_not_depend_on_the_processor() -> None:
    """The angle that moves no gravity is where it was drawn: kernels that round otherwise do not choose it."""
    code = (
        "from kf_calib.sources.simulation.visit_plans import spread_plan; "
        "print([v.gimbal_deg for v in spread_plan(12, seed=3)])"
    )
    plans = [
        subprocess.run(
            [sys.executable, "-c", code], env={**os.environ, "OPENBLAS_CORETYPE": kernel}, capture_output=True,
            text=True, check=True, timeout=120,
        ).stdout
        for kernel in ("Prescott", "Haswell")
    ]  # fmt: skip
    one, other = (np.array(ast.literal_eval(text)) for text in plans)
    np.testing.assert_allclose(one, other, atol=1e-3)
