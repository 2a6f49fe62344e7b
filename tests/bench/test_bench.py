"""The gimbal chain, the Earth and gravity against scipy's rotations and closed forms."""

import math
import re

import numpy as np
import pytest
from helpers.long_runs import slow
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from kf_calib.bench.bench import (
    EARTH_RATE_RADPS,
    Bench,
    axes_of,
    interpolate_pose,
    metadata_of,
    normal_gravity,
    parse_axes,
    pose_distance,
    slerp,
    unwrap_pose,
)
from kf_calib.bench.keys import KEYS
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


def test_angles_beyond_the_ends_and_between_stamps() -> None:
    """Against numpy's own interpolation; a stamp that comes twice is no division by zero."""
    times, rng = np.array([5, 10, 10, 30, 40]) * 10**9, np.random.default_rng(4)
    poses = rng.normal(size=(5, 2))
    at = np.array([0, 5, 7, 20, 33, 40, 99]) * 10**9
    own = interpolate_pose(at, times, poses, False)
    kept = np.array([0, 2, 3, 4])
    expected = np.column_stack([np.interp(at, times[kept], column[kept]) for column in poses.T])
    np.testing.assert_allclose(own[at >= 10 * 10**9], expected[at >= 10 * 10**9], atol=1e-14)
    np.testing.assert_allclose(own[:2], poses[[0, 0]], atol=1e-14)


def test_quaternions_are_brought_to_one_sign_and_stay_what_they_were() -> None:
    """All at once, and in parts: signs are remembered from part to part."""
    rng = np.random.default_rng(5)
    smooth = 1.5 * Rotation.from_rotvec(np.outer(np.arange(12), [0.05, 0.1, -0.2])).as_quat()
    recorded = smooth * rng.choice([-1.0, 1.0], (12, 1))
    whole, signs = unwrap_pose(recorded, True)
    np.testing.assert_allclose(whole, smooth * np.sign(recorded[0] @ smooth[0]), atol=1e-14)
    assert set(signs.ravel()) <= {-1.0, 1.0}
    first, said = unwrap_pose(recorded[:5], True)
    rest, _ = unwrap_pose(recorded[5:], True, (recorded[4], said[-1]))
    np.testing.assert_array_equal(np.vstack([first, rest]), whole)


def test_angles_are_made_continuous_as_numpy_does_it() -> None:
    angles = np.cumsum(np.random.default_rng(6).uniform(-3.0, 3.0, (40, 3)), axis=0)
    folded = np.angle(np.exp(1j * angles))
    whole, turns = unwrap_pose(folded, False)
    np.testing.assert_allclose(whole, np.unwrap(folded, axis=0), atol=1e-12)
    np.testing.assert_array_equal(turns, np.rint(turns))
    first, said = unwrap_pose(folded[:17], False)
    rest, _ = unwrap_pose(folded[17:], False, (folded[16], said[-1]))
    np.testing.assert_array_equal(np.vstack([first, rest]), whole)


@pytest.mark.parametrize(
    ("axes", "letters"),
    [("y z x", ("y", "z", "x")), ("-y z", ("y", "z")), ("y", ("y",)), ("y z y", ()), ("y 1,1,0", ()), ("y -y", ())],
)
def test_axes_have_letters_where_all_differ(axes: str, letters: tuple[str, ...]) -> None:
    assert Bench(parse_axes(axes), G).axis_letters == letters


def test_distance_of_angles_is_that_of_the_gimbal_that_turns_most() -> None:
    assert pose_distance(np.array([0.1, 0.2, 0.3]), np.array([0.2, -0.3, 0.3]), False) == pytest.approx(0.5)


@pytest.mark.parametrize("number", [0.5, 1e-12])
def test_length_of_an_axis_does_not_matter_and_a_unit_vector_stays(number: float) -> None:
    ((x, y, z),) = parse_axes(f"{3 * number!r},0,{4 * number!r}")
    assert (x, y, z) == pytest.approx((0.6, 0.0, 0.8), abs=1e-15)
    length = math.hypot(0.6, 0.8) * (1.0 + 3e-13)
    assert parse_axes(f"{0.6 * length!r},0,{0.8 * length!r}") == ((0.6 * length, 0.0, 0.8 * length),)
    assert math.hypot(*parse_axes("0.6000001,0,0.8")[0]) == pytest.approx(1.0, abs=1e-15)


@pytest.mark.parametrize(
    ("key", "inside", "outside"),
    [
        ("gravity_mps2", ("1", "30"), ("0.99", "30.1")),
        ("latitude_deg", ("-90", "90"), ("-90.1", "90.1")),
        ("height_m", ("-12000", "100000"), ("-12001", "100001")),
        ("azimuth_deg", ("-360", "360"), ("-361", "361")),
        ("angle_sigma_deg", ("0", "180"), ("-1e-9", "181")),
        ("scatter_sigma_mps2", ("0", "100"), ("-1e-9", "101")),
        ("square_sigma_deg", ("1e-4", "45"), ("0", "9e-5", "46")),
        ("nominal", ('{"theta1": 6.3}', '{"phi3": -6.3}', '{"K2": -10}', '{"b1": 100}', '{"nu2": 0.78}'),
         ('{"theta1": 6.4}', '{"phi3": -6.4}', '{"K2": 10.1}', '{"b1": -101}', '{"nu2": -0.79}')),
    ],
)  # fmt: skip
def test_limits_of_keys_are_those_of_the_page(key: str, inside: tuple[str, ...], outside: tuple[str, ...]) -> None:
    keys = {"axes": "y z x", "gravity_mps2": "9.81"}
    for value in inside:
        Bench.from_metadata({**keys, key: value})
    for value in outside:
        with pytest.raises(BenchError, match=key):
            Bench.from_metadata({**keys, key: value})


@pytest.mark.parametrize(
    ("typed", "text"),
    [
        ({"gravity_mps2": 9.8123}, {"gravity_mps2": "9.8123"}),
        ({"latitude_deg": 50.0, "height_m": 120}, {"latitude_deg": "50", "height_m": "120"}),
        ({"gravity_mps2": 9.81, "nominal": {"theta1": 0.0}}, {"gravity_mps2": "9.81", "nominal": '{"theta1": 0}'}),
        ({"gravity_mps2": 9.81, "accel_scale": 3.9e-6}, {"gravity_mps2": "9.81", "accel_scale": "3.9e-6"}),
        ({"gravity_mps2": 9.81, "restate_input": True}, {"gravity_mps2": "9.81", "restate_input": "true"}),
    ],
)
def test_keys_in_their_types_state_the_same_bench_as_text(typed: dict[str, object], text: dict[str, str]) -> None:
    assert Bench.from_metadata({"axes": "y z x", **typed}) == Bench.from_metadata({"axes": "y z x", **text})


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
        ({"axes": "y", "gravity_mps2": "9.81", "nominal": '{"theta1": NaN}'}, "theta1: it must be a finite number"),
        ({"axes": "y", "gravity_mps2": "9.81", "nominal": '{"theta9": 0}'}, "theta9: it is unknown"),
        ({"axes": "y", "gravity_mps2": "9.81", "nominal": '{"nu1": 1}'}, "nu1: it must be less than or equal to 0.78"),
        ({"axes": "y", "gravity_mps2": "9.81", "nominal": "[" * 100_000}, "nominal"),
        ({"axes": "y", "gravity_mps2": "9" * 400}, "gravity_mps2"),
        ({"axes": "y", "gravity_mps2": "9.81\0"}, "gravity_mps2"),
        ({"axes": "y", "gravity_mps2": "9.81", "azimuth_deg": "1e300"}, "azimuth_deg"),
        ({"axes": "y", "gravity_mps2": "9.81", "note": "\ud800"}, "note"),
        ({"axes": "y", "gravity_mps2": "9.81", "bench": "\x1b[2J"}, "without control characters"),
        ({"axes": "y", "gravity_mps2": "9.81", "operator": "x" * 1_000_000}, "at most 1000 characters"),
        ({"axes": "y", "gravity_mps2": "9.81", "x" * 1_000_000: "1"}, "is not known"),
        ({"axes": 5, "gravity_mps2": "9.81"}, "axes"),
        ({"axes": "y", "gravity_mps2": True}, "gravity_mps2"),
        ({"axes": "y", "gravity_mps2": None}, "gravity_mps2"),
    ],
    ids=lambda value: value[:20] if isinstance(value, str) else "",
)
def test_an_impossible_bench_is_one_sentence(metadata: dict[str, str], says: str) -> None:
    with pytest.raises(BenchError, match=re.escape(says)) as caught:
        Bench.from_metadata(metadata)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 500


@pytest.mark.parametrize(
    "values, key",
    [({"nominal": {"theta1": math.nan}}, "nominal"), ({"nominal": {"K1": math.inf}}, "nominal"),
     ({"azimuth_deg": math.nan}, "azimuth_deg"), ({"height_m": math.inf}, "height_m"),
     ({"gravity_mps2": math.nan}, "gravity_mps2"), ({"gravity_mps2": None}, "gravity_mps2"),
     ({"notes": {"note": "\x9b2J"}}, "note"), ({"angle_sigma_deg": "x"}, "angle_sigma_deg")],
)  # fmt: skip
def test_a_bench_made_in_python_is_held_to_the_same(values: dict[str, object], key: str) -> None:
    with pytest.raises(BenchError, match=f"bench key {key} is "):
        Bench(**{"axes": axes_of("y"), "gravity_mps2": G, **values})


JSON_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**500), 10**500) | st.floats() | st.text()
    | st.characters(categories=["Cs"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=9), inner, max_size=3),
    max_leaves=6,
)  # fmt: skip
BENCH_VALUES = st.dictionaries(
    st.sampled_from(sorted(KEYS)), JSON_VALUES | st.sampled_from(["y z x", "9.81", "1,2,3", "z"])
)


@pytest.mark.parametrize("examples", [40, *slow(500)])
def test_whatever_values_say_is_a_bench_or_a_sentence(examples: int) -> None:
    """As they come in a recording (text), in JSON or TOML (made text), and from Python."""

    @settings(max_examples=examples, deadline=None, database=None, suppress_health_check=list(HealthCheck))
    @example({"nominal": {"\n": None}})
    @example({"accel_scale": 10**400})
    @example({"nominal": {"theta1": 10**400}})
    @given(BENCH_VALUES)
    def try_one(values: dict[str, object]) -> None:
        for metadata in ({**values}, metadata_of({"axes": "y z x", "gravity_mps2": 9.81} | values)):
            try:
                bench = Bench.from_metadata(metadata)
            except BenchError as error:
                assert "\n" not in str(error) and len(str(error)) < 1000
            else:
                assert np.isfinite([*bench.nominal.values(), bench.gravity_mps2, bench.azimuth_deg]).all()
                assert Bench.from_metadata(bench.to_metadata()) == bench
                "".join(bench.to_metadata().values()).encode()

    try_one()
