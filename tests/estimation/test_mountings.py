"""What differs in a mounting from what is stated: poses as they are meant, from poses as they were recorded."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations, product

import numpy as np
import pytest
from helpers.synthetic import G
from scipy.spatial.transform import Rotation

from kf_calib.bench.bench import Bench, axes_of
from kf_calib.estimation.mountings import AffineFit, DwellMeans, Misfits, Mounting, _reversed_gimbals


def test_angles_are_put_in_order_and_into_radians() -> None:
    stated = Mounting.stated(Bench(axes_of("yzx"), G))
    recorded = np.array([[10.0, 20.0, 30.0], [-40.0, 50.0, 180.0]])
    np.testing.assert_array_equal(stated.poses(recorded), recorded)
    other = replace(stated, order=(2, 0, 1), angle_unit=np.pi / 180.0)
    np.testing.assert_allclose(other.poses(recorded), np.radians(recorded[:, [2, 0, 1]]))


@pytest.mark.parametrize("real_first", [False, True])
@pytest.mark.parametrize("conjugate", [False, True])
def test_quaternions_are_those_of_the_rotation_that_is_meant(conjugate: bool, real_first: bool) -> None:
    """Of unit norm; scipy writes them with the real part last, and inverts them."""
    meant = Rotation.from_rotvec(np.random.default_rng(1).normal(size=(5, 3)))
    written = (meant.inv() if conjugate else meant).as_quat()
    recorded = np.roll(written, 1, axis=1) if real_first else written
    mounting = replace(Mounting.stated(Bench((), G)), conjugate=conjugate, real_first=real_first)
    np.testing.assert_allclose(np.linalg.norm(mounting.poses(recorded), axis=1), 1.0)
    np.testing.assert_allclose(Rotation.from_quat(mounting.poses(recorded)).as_matrix(), meant.as_matrix(), atol=1e-12)


def test_the_misfit_is_least_with_the_channels_as_they_are_wired() -> None:
    """Axes 20 deg off and scale factors a tenth off, wired in every order and with every sign; one that is dead."""
    turned = np.diag([1.1, 0.9, 1.05]) @ Rotation.from_euler("x", 20.0, degrees=True).as_matrix()
    stated, poses = Mounting.stated(Bench(axes_of("yzx"), G)), np.random.default_rng(1).uniform(-3.0, 3.0, (12, 3))
    means = DwellMeans(poses, np.zeros((12, 3)), np.zeros(12), tuple(range(1, 13)))
    orders = [tuple(s * k for s, k in zip(signs, order, strict=True))
              for order in permutations((1, 2, 3)) for signs in product((1, -1), repeat=3)]  # fmt: skip
    readings = G * means.force(stated) @ turned.T
    for wired in orders:
        altered = np.empty_like(readings)
        for channel, column in zip(wired, readings.T, strict=True):
            altered[:, abs(channel) - 1] = np.sign(channel) * column
        misfits = Misfits.of_mounting(replace(means, readings=altered), stated)
        assert orders[int(misfits.of(orders).argmin())] == wired
    silent = Misfits.of_mounting(replace(means, readings=readings * [1.0, 0.0, 1.0]), stated)
    assert silent.of([(1, 0, 3)])[0] < silent.of([(1, 2, 3)])[0]


def test_axes_and_scale_factors_are_near_nominal() -> None:
    turned = Rotation.from_euler("x", 44.0, degrees=True).as_matrix()
    assert AffineFit(turned, 0.0, np.eye(3)).is_near_nominal()
    farther = turned @ Rotation.from_euler("x", 2.0, degrees=True).as_matrix()
    assert not AffineFit(farther, 0.0, np.eye(3)).is_near_nominal()
    assert not AffineFit(np.diag([1.0, 1.0, 30.0]), 0.0, np.eye(3)).is_near_nominal()
    assert not AffineFit(np.diag([1.0, 0.03, 1.0]), 0.0, np.eye(3)).is_near_nominal()


@pytest.mark.parametrize("gimbal", [0, 1, 2])
def test_a_gimbal_that_turns_the_other_way_has_the_opposite_axis(gimbal: int) -> None:
    stated = Mounting.stated(Bench(((0.6, 0.0, 0.8), (0.0, 1.0, 0.0), (0.48, 0.64, 0.6)), G))
    signs = np.where(np.arange(3) == gimbal, -1.0, 1.0)[:, None]
    found = _reversed_gimbals([gimbal])(stated).bench.axes
    np.testing.assert_array_equal(np.array(found), signs * np.array(stated.bench.axes))
