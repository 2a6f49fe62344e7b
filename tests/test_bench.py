"""The gimbal chain, the Earth and gravity against scipy's rotations and closed forms."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from kf_calib.bench import (
    EARTH_RATE_RADPS,
    Bench,
    axes_of,
    interpolate_pose,
    normal_gravity,
    parse_axes,
    pose_distance,
    slerp,
    unwrap_pose,
)  # fmt: skip
from kf_calib.errors import BenchError

G = 9.81
UNITS = {"x": [1, 0, 0], "y": [0, 1, 0], "z": [0, 0, 1]}


def chain(axes: list[list[float]], angles: np.ndarray) -> Rotation:
    turned = Rotation.identity()
    for axis, angle in zip(axes, angles, strict=True):
        turned = turned * Rotation.from_rotvec(np.array(axis) / np.linalg.norm(axis) * angle)
    return turned


@pytest.mark.parametrize("letters", ["yzx", "xyz", "z", "zyxz", "yx"])
def test_attitude_is_the_product_of_rotations(letters: str) -> None:
    angles = np.random.default_rng(1).uniform(-4, 4, (20, len(letters)))
    expected = [chain([UNITS[c] for c in letters], row).as_matrix() for row in angles]
    np.testing.assert_allclose(Bench(axes_of(letters), G).attitude(angles), expected, atol=1e-14)


def test_axes_of_any_direction_and_sign() -> None:
    bench = Bench(parse_axes("-y 1,1,0 0,-0.6,0.8"), G)
    angles = np.array([[0.3, -1.1, 2.0]])
    expected = chain([[0, -1, 0], [1, 1, 0], [0, -0.6, 0.8]], angles[0]).as_matrix()
    np.testing.assert_allclose(bench.attitude(angles)[0], expected, atol=1e-14)
    assert Bench.from_metadata(bench.to_metadata()) == bench


def test_quaternion_gives_the_attitude_of_its_rotation() -> None:
    turns = Rotation.random(10, random_state=2)
    np.testing.assert_allclose(Bench((), G).attitude(2.5 * turns.as_quat()), turns.as_matrix(), atol=1e-14)


def test_six_faces() -> None:
    poses = np.radians([[0, 0, 0], [0, 90, 0], [0, -90, 0], [0, 0, 90], [0, 0, -90], [77, 180, 0]])
    force = Bench(axes_of("yzx"), G).specific_force(np.zeros(6), poses)
    faces = [[0, G, 0], [G, 0, 0], [-G, 0, 0], [0, 0, -G], [0, 0, G], [0, -G, 0]]
    np.testing.assert_allclose(force, faces, atol=1e-14)


def test_gravity_stands_still_on_a_base() -> None:
    force = Bench(axes_of("y"), G, latitude_deg=50.0).specific_force(np.array([0.0, 1e5]), np.zeros((1, 1)))
    np.testing.assert_allclose(force, [[0, G, 0]] * 2)


@pytest.mark.parametrize("latitude, azimuth", [(0.0, 0.0), (90.0, 10.0), (-35.0, 120.0), (55.75, -60.0)])
def test_gravity_turns_with_the_earth_in_an_inertial_platform(latitude: float, azimuth: float) -> None:
    bench = Bench(axes_of("y"), G, reference="inertial", latitude_deg=latitude, azimuth_deg=azimuth)
    hours = np.array([0.0, 1.0, 6.0])
    # Earth-centred: the bench's up at time t, seen in the axes (x, up, z) it had at t = 0
    lat, az = np.radians([latitude, azimuth])
    up = np.array([np.cos(lat), 0, np.sin(lat)])
    north, east = np.array([-np.sin(lat), 0, np.cos(lat)]), np.array([0, 1, 0])
    x = np.cos(az) * north + np.sin(az) * east
    basis = np.array([x, up, np.cross(x, up)])
    turns = Rotation.from_rotvec(np.outer(hours * 3600 * EARTH_RATE_RADPS, [0, 0, 1]))
    expected = G * turns.apply(up) @ basis.T
    np.testing.assert_allclose(bench.specific_force(hours * 3600, np.zeros((1, 1))), expected, atol=1e-12)


def test_earth_rate_is_fifteen_degrees_an_hour() -> None:
    assert np.degrees(EARTH_RATE_RADPS) * 3600 == pytest.approx(15.041, abs=1e-3)


@pytest.mark.parametrize("latitude, gravity", [(0.0, 9.7803253359), (45.0, 9.806197769), (90.0, 9.8321849379)])
def test_normal_gravity_of_the_standard(latitude: float, gravity: float) -> None:
    assert normal_gravity(latitude) == pytest.approx(gravity, abs=1e-9)


def test_normal_gravity_falls_with_height() -> None:
    assert normal_gravity(45.0, 1000.0) - normal_gravity(45.0) == pytest.approx(-3.086e-3, abs=2e-6)


def test_slerp_agrees_with_scipy_even_for_tiny_arcs() -> None:
    for step in (1e-9, 1e-3, 2.0):
        ends = Rotation.from_rotvec([[0.1, 0.2, 0.3], [0.1 + step, 0.2, 0.3]])
        weights = np.linspace(0, 1, 7)
        expected = Slerp([0, 1], ends)(weights)
        quaternions = ends.as_quat()
        got = slerp(np.repeat(quaternions[:1], 7, 0), np.repeat(-quaternions[1:], 7, 0), weights[:, None])
        assert (Rotation.from_quat(got).inv() * expected).magnitude().max() < 1e-14
        assert pose_distance(quaternions[0], quaternions[1], True) == pytest.approx(
            (ends[0].inv() * ends[1]).magnitude(), rel=1e-6
        )


def test_angles_are_interpolated_the_short_way_round() -> None:
    times = np.array([0, 1_000_000_000])
    poses, _ = unwrap_pose(np.radians([[359.0], [1.0]]), False)
    middle = interpolate_pose(np.array([500_000_000]), times, poses, False)
    assert np.cos(middle[0, 0]) == pytest.approx(1.0)


@pytest.mark.parametrize(
    "metadata, says",
    [
        ({"gravity_mps2": "9.81"}, "axes"),
        ({"axes": "y q", "gravity_mps2": "9.81"}, "'q'"),
        ({"axes": "y"}, "gravity"),
        ({"axes": "y", "gravity_mps2": "981"}, "m/s^2"),
        ({"axes": "y", "gravity_mps2": "nine"}, "nine"),
        ({"axes": "y", "gravity_mps2": "9.81", "reference": "inertial"}, "latitude"),
        ({"axes": "y", "gravity_mps2": "9.81", "reference": "moon"}, "moon"),
        ({"axes": "y", "latitude_deg": "123"}, "latitude"),
        ({"axes": "y", "gravity_mps2": "9.81", "format_version": "7"}, "7"),
        ({"axes": "y", "gravity_mps2": "9.81", "angle_sigma_deg": "-1"}, "angle_sigma_deg"),
        ({"axes": "y", "gravity_mps2": "9.81", "nominal": "[1]"}, "nominal"),
        ({"axes": "y", "gravity_mps2": "9.81", "axis": "x"}, "axis"),
    ],
)
def test_an_impossible_bench_is_one_sentence(metadata: dict[str, str], says: str) -> None:
    with pytest.raises(BenchError, match=re.escape(says)) as caught:
        Bench.from_metadata(metadata)
    assert "\n" not in str(caught.value)
