"""What differs in a mounting from what is stated: poses as they are meant, from poses as they were recorded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.synthetic import G
from scipy.spatial.transform import Rotation

from kf_calib.bench.bench import Bench, axes_of
from kf_calib.estimation.mountings import Mounting


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
