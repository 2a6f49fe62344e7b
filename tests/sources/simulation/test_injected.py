"""Hidden effects of the simulator against closed forms on poses with known numbers."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from helpers.bounded import traced
from helpers.long_runs import slow
from helpers.recordings import read, record
from scipy.optimize import brentq

from kf_calib.bench.bench import Bench, axes_of, parse_axes
from kf_calib.bench.streams import Batch
from kf_calib.errors import InputError
from kf_calib.sources.files.recording import Recording
from kf_calib.sources.simulation.detectability import truth_of, write_truth
from kf_calib.sources.simulation.injected import catalogue, parse, si
from kf_calib.sources.simulation.physics import Ambient
from kf_calib.sources.simulation.sensors import GRADES, Sensors, TrueNoise
from kf_calib.sources.simulation.simulator import Simulation
from kf_calib.sources.simulation.visit_plans import YZX, explicit_plan, spread_plan

G = 9.81
BENCH = Bench(axes=axes_of("yzx"), gravity_mps2=G)
ORTHOGONAL = Sensors({"theta1": 0.0, "theta3": 0.0})
QUIET = TrueNoise()
C = 1.0 / math.sqrt(2.0)

KNOWN = """
    bias-asymmetry scale-asymmetry second-order third-order odd-quadratic cross-coupling-ip cross-coupling-io
    cross-coupling-po cross-axis-square output-square memory thermal-hysteresis bias-drift bias-walk scale-drift
    warm-up scale-warm-up thermal-bias
    thermal-bias-2 thermal-scale thermal-misalignment thermal-rate thermal-lag settling hysteresis magnetic sinusoid
    vibration-rectification dead-zone quantisation saturation outliers base-tilt base-tilt-drift encoder-offset
    encoder-scale encoder-harmonic-1 encoder-harmonic-2 backlash axis-nonorthogonality flexure platform-drift
    earth-rotation gravity-error cross-talk latency lever-arm uneven-flexure
    """
"""The catalogue's names, fixed."""


def readings(text: str, poses, *, dwell_s=1.0, sample_hz=1.0, slew=math.inf, bench=BENCH, **options) -> np.ndarray:
    """Readings (n, 3) with the effects of ``text``, white space between them."""
    plan = explicit_plan(poses, dwell_s)
    hidden = parse(text.split(), bench.axes)
    return read(
        Simulation(
            bench, options.pop("sensors", ORTHOGONAL), options.pop("noise", QUIET), plan,
            sample_hz=sample_hz, slew_rate_degps=slew, hidden=hidden, **options,
        )
    ).accel.values  # fmt: skip


def contribution(text: str, poses, **options) -> np.ndarray:
    """What the effects change in the readings."""
    return readings(text, poses, **options) - readings("", poses, **options)


def at(dwell_s: float, constant_c: float = 25.0) -> dict:
    return {"dwell_s": dwell_s, "ambient": Ambient(constant_c=constant_c)}


def test_the_registry_holds_the_catalogue_and_others():
    kinds = catalogue()
    assert {name for name, kind in kinds.items() if kind.known} == set(KNOWN.split())
    assert sum(not kind.known for kind in kinds.values()) >= 6
    for kind in kinds.values():
        assert bool(kind.family) == bool(kind.driver) == (not kind.known), kind.name
        assert kind.title and kind.physics.endswith("."), kind.name
        for grade in ("paper", "navigation", "mems"):
            least, greatest = kind.typical(grade)
            assert 0.0 < least <= greatest


# -- nonlinearities: f = g (sin q2, cos q2 cos q3, -cos q2 sin q3) --

POSES = {
    "+x": (0, 90, 0), "-x": (0, -90, 0), "xy": (0, 45, 0), "yz": (0, 0, -45), "zx": (0, 45, -90),
    "xyz": (0, math.degrees(math.asin(1 / math.sqrt(3))), -45),
}  # fmt: skip
"""Specific force along an axis, or halfway between axes."""

THIRD = 1.0 / math.sqrt(27.0)
NONLINEAR = {  # power of g, then the contributions in units of k = (1, 2, 3) and that power
    "bias-asymmetry": (0, {"+x": (0.5, 0, 0), "-x": (-0.5, 0, 0), "xy": (0.5, 1, 0), "yz": (0, 1, 1.5)}),
    "scale-asymmetry": (1, {"+x": (0.5, 0, 0), "-x": (0.5, 0, 0), "xy": (C / 2, C, 0), "zx": (C / 2, 0, 1.5 * C)}),
    "second-order": (2, {"+x": (1, 0, 0), "-x": (1, 0, 0), "xy": (0.5, 1, 0), "yz": (0, 1, 1.5)}),
    "third-order": (3, {"+x": (1, 0, 0), "-x": (-1, 0, 0), "xy": (C / 2, C, 0), "yz": (0, C, 1.5 * C)}),
    "odd-quadratic": (2, {"+x": (1, 0, 0), "-x": (-1, 0, 0), "xy": (0.5, 1, 0), "zx": (0.5, 0, 1.5)}),
    "cross-coupling-ip": (2, {"+x": (0, 0, 0), "xy": (0.5, 0, 0), "yz": (0, 1, 0), "zx": (0, 0, 1.5)}),
    "cross-coupling-io": (2, {"+x": (0, 0, 0), "xy": (0, 1, 0), "yz": (0, 0, 1.5), "zx": (0.5, 0, 0)}),
    "cross-coupling-po": (2, {"+x": (0, 0, 0), "xy": (0, 0, 1.5), "yz": (0.5, 0, 0), "zx": (0, 1, 0)}),
    "cross-axis-square": (2, {"+x": (0, 0, 3), "-x": (0, 0, 3), "xy": (0.5, 0, 1.5), "yz": (0.5, 1, 0)}),
    "fifth-order": (5, {"+x": (1, 0, 0), "-x": (-1, 0, 0), "xy": (C / 4, C / 2, 0)}),
    "triple-product": (3, {"+x": (0, 0, 0), "xy": (0, 0, 0), "xyz": (THIRD, 2 * THIRD, 3 * THIRD)}),
    "fourth-harmonic": (0, {"+x": (1, 0.75, 1.125), "-x": (1, 0.75, 1.125), "xy": (-13 / 32, -26 / 32, 1.125)}),
    "third-cosine": (0, {"+x": (1, 0, 0), "-x": (-1, 0, 0), "xy": (-C, 2 * C / 2, 0), "yz": (0, -2 * C, 1.5 * C)}),
}  # fmt: skip


@pytest.mark.parametrize("name", NONLINEAR)
def test_nonlinearity_on_known_poses(name):
    power, expected = NONLINEAR[name]
    found = contribution(f"{name}=1e-6,2e-6,3e-6", [POSES[pose] for pose in expected])
    np.testing.assert_allclose(found, 1e-6 * G**power * np.array(list(expected.values())), atol=1e-13 * G**power)


def test_nonlinearities_see_the_true_input_axis_and_the_platforms_other_axes():
    sensors = Sensors({"theta1": math.radians(30), "theta3": 0.0, "K1": 1.5})
    options = {"sensors": sensors}
    squared = contribution("second-order=1e-6,0,0", [POSES["+x"]], **options)  # 30 deg away from the vertical
    np.testing.assert_allclose(squared, [[1e-6 * G**2 * 0.75, 0, 0]], atol=1e-12)
    # 60 deg: the input axis is vertical, platform y reads g / 2; the scale factor does not count
    product = contribution("cross-coupling-ip=1e-6,0,0", [(0, 60, 0)], **options)
    np.testing.assert_allclose(product, [[1e-6 * G**2 * 0.5, 0, 0]], atol=1e-12)


def test_dead_zone_holds_the_reading_at_the_bias():
    poses = [(0, q, 0) for q in (-0.02, -0.005, 0.0, 0.005, 0.02)]
    sensors = Sensors({"theta1": 0.0, "theta3": 0.0, "K1": 1.1, "b1": 0.3})
    inside = readings("dead-zone=0.001,0,0", poses, sensors=sensors)
    outside = readings("", poses, sensors=sensors)
    np.testing.assert_array_equal(inside[[1, 2, 3], 0], 0.3)
    np.testing.assert_array_equal(inside[[0, 4]], outside[[0, 4]])
    np.testing.assert_array_equal(inside[:, 1:], outside[:, 1:])
    assert abs(outside[1, 0] - 0.3) > 5e-4


# -- temperature --


def test_thermal_effects_ten_kelvin_above_the_reference():
    poses, warm = [POSES["+x"], POSES["xy"]], at(1.0, 35.0)
    k = np.array([1e-4, 2e-4, 3e-4])
    f = G * np.array([[1, 0, 0], [C, C, 0]])
    for text, expected in {
        "thermal-bias": 10 * k + 0 * f,
        "thermal-bias-2": 100 * k + 0 * f,
        "thermal-scale": 10 * k * f,
        "thermal-scale-2": 100 * k * f,
        "thermal-lag": 10 * k + 0 * f,  # in balance from the first sample on
        "thermal-rate": 0 * f,
    }.items():
        np.testing.assert_allclose(contribution(f"{text}=1e-4,2e-4,3e-4", poses, **warm), expected, atol=1e-12)
    told = contribution("thermal-bias=1e-4;reference=45", poses, **warm)
    np.testing.assert_allclose(np.abs(told), 1e-3, rtol=1e-9)


def test_thermal_misalignment_turns_the_input_axis():
    found = readings("thermal-misalignment=0,0,0,1e-3,2e-3,0", [POSES["+x"]], **at(1.0, 35.0))
    # the second leans toward its output axis x by atan 0.01, the third toward its pendulous axis x by atan 0.02
    np.testing.assert_allclose(
        found, [[G, G * math.sin(math.atan(0.01)), G * math.sin(math.atan(0.02))]], rtol=0, atol=1e-12
    )
    kept = readings("thermal-misalignment=1e-3,0,0,0,0,0", [POSES["+x"]], **at(1.0, 35.0))
    assert kept[0, 0] == pytest.approx(G * math.cos(math.atan(0.01)), abs=1e-12)


def test_thermal_hysteresis_lags_behind_every_turn_by_its_play():
    """Temperature 4 sin: with a play of 1 K the sensor stays at 0 up to 1, goes 1 behind up to 3, and waits there."""
    swing = Ambient(swing_c=4.0, period_s=360.0)
    found = contribution("thermal-hysteresis=1e-3,0,0;play=1", [(0, 0, 0)], dwell_s=720.0, ambient=swing)[:, 0]
    true = 4.0 * np.sin(np.radians(np.arange(720.0)))
    rising, falling = np.arange(15, 91), np.arange(151, 271)
    np.testing.assert_allclose(found[:14], 0.0, atol=1e-12)
    np.testing.assert_allclose(found[rising], 1e-3 * (true[rising] - 1.0), atol=1e-12)
    np.testing.assert_allclose(found[90:150], 1e-3 * 3.0, atol=1e-12)
    np.testing.assert_allclose(found[falling], 1e-3 * (true[falling] + 1.0), atol=1e-12)
    np.testing.assert_allclose(found[271:329], 1e-3 * -3.0, atol=1e-12)


def test_thermal_rate_follows_the_derivative():
    ambient = Ambient(swing_c=3.0, period_s=400.0, warm_up_c=5.0, warm_up_s=100.0)
    found = contribution("thermal-rate=2,0,0", [(0, 0, 0)], dwell_s=500.0, ambient=ambient)
    t = np.arange(500.0)
    slope = (ambient(t + 0.01) - ambient(t - 0.01)) / 0.02
    np.testing.assert_allclose(found[:, 0], 2 * slope, atol=1e-8)


def test_thermal_lag_of_a_sine_and_an_exponential():
    """tau y' + y = e^(-t/s) has y = (e^(-t/s) - (tau/s) e^(-t/tau)) / (1 - tau/s) from balance at the start."""
    s, tau, t = 300.0, 120.0, np.arange(2000.0)
    ambient = Ambient(constant_c=25.0, warm_up_c=4.0, warm_up_s=s)
    found = contribution(f"thermal-lag=1e-3,0,0;tau={tau}", [(0, 0, 0)], dwell_s=2000.0, ambient=ambient)[:, 0]
    expected = -4e-3 * (np.exp(-t / s) - tau / s * np.exp(-t / tau)) / (1 - tau / s)
    np.testing.assert_allclose(found, expected, atol=1e-7)
    w = 2 * np.pi / 500.0
    swing = Ambient(constant_c=25.0, swing_c=2.0, period_s=500.0)
    found = contribution(f"thermal-lag=1e-3,0,0;tau={tau}", [(0, 0, 0)], dwell_s=2000.0, ambient=swing)[1500:, 0]
    expected = 2e-3 * np.sin(w * t[1500:] - math.atan(w * tau)) / math.hypot(1, w * tau)
    np.testing.assert_allclose(found, expected, atol=1e-7)


# -- time --

TIMED = {
    "bias-drift=1e-5,0,0": lambda t: 1e-5 * t,
    "scale-drift=1e-6,0,0": lambda t: 1e-6 * G * t,
    "warm-up=1e-3,0,0;tau=50": lambda t: 1e-3 * np.exp(-t / 50),
    "sinusoid=1e-3,0,0;frequency=0.01;phase=0": lambda t: 1e-3 * np.sin(2 * np.pi * t / 100),
    "power-warm-up=1e-3,0,0;tau=10": lambda t: 1e-3 * (1 + t / 10) ** -0.5,
    "chirp=1e-3,0,0;frequency=0.01;chirp=1e-4": lambda t: 1e-3 * np.sin(2 * np.pi * (0.01 + 0.5e-4 * t) * t),
    "bias-jump=1e-3,0,0;share=0.25": lambda t: 1e-3 * (t >= 50),
    "double-warm-up=1e-3,0,0;tau=10;slow=100;share=0.3": lambda t: 0.7e-3 * np.exp(-t / 10) + 0.3e-3 * np.exp(-t / 100),
    "creep-and-walk=1e-3,0,0;tau=20;share=1e-20": lambda t: 1e-3 * np.log(1 + t / 20),
}


@pytest.mark.parametrize("text", TIMED)
def test_what_changes_with_time(text):
    found = contribution(text, [POSES["+x"]] * 2, dwell_s=100.0)
    np.testing.assert_allclose(found[:, 0], TIMED[text](np.arange(200.0)), atol=1e-12)
    assert not found[:, 1:].any()


def test_bias_walk_grows_by_the_square_root_of_time():
    paths = np.hstack(
        [contribution("bias-walk=1e-3", [(0, 0, 0)], dwell_s=401.0, sample_hz=4.0, seed=seed) for seed in range(100)]
    )
    assert paths[399].std() == pytest.approx(1e-3 * math.sqrt(100), rel=0.15)
    assert paths[1599].std() == pytest.approx(1e-3 * math.sqrt(400), rel=0.15)
    assert abs(np.corrcoef(paths[399], paths[1599])[0, 1] - 0.5) < 0.15


@pytest.mark.parametrize("noise", [QUIET, TrueNoise(walk_mps2_per_sqrt_s=1e-3)])
def test_the_truth_says_where_biases_have_walked_to(noise):
    plan, hidden = explicit_plan([(0, 0, 0)], 300.0), parse(["bias-walk=1e-3,0,2e-3"], BENCH.axes)
    run = Simulation(BENCH, ORTHOGONAL, noise, plan, sample_hz=4.0, seed=3, hidden=hidden, batch_samples=500)
    still = run.hiding((), QUIET)
    truth = truth_of(run)
    moved = np.array([truth["parameters_at_end"][name] - truth["parameters"][name] for name in ("b1", "b2", "b3")])
    np.testing.assert_allclose(read(run).accel.values[-1] - read(still).accel.values[-1], moved, atol=1e-12)
    assert np.all(moved[[0, 2]] != 0.0) and bool(moved[1]) == bool(noise.walk_mps2_per_sqrt_s)
    assert "parameters_at_end" not in truth_of(still)


def test_vibration_is_seen_and_rectified():
    text = "vibration-rectification=0.01,0.02,0;rms=2;period=100"
    found = contribution(text, [(0, 0, 0)], dwell_s=100.0, sample_hz=100.0)
    np.testing.assert_allclose(found.mean(axis=0), [0.01 * 4 * 3 / 8, 0.02 * 4 * 3 / 8, 0], atol=1e-4)
    windows = found.reshape(10, 1000, 3).std(axis=1)
    assert windows[[4, 5]].min() > 10 * windows[[0, 9]].max()
    assert windows.max() == pytest.approx(2.0, rel=0.1)


def test_telegraph_has_two_levels_and_its_time():
    found = contribution("telegraph=1e-3;tau=20", [(0, 0, 0)], dwell_s=40_000.0)
    assert set(np.unique(found.round(9))) == {-1e-3, 1e-3}
    switches = np.abs(np.diff(np.sign(found), axis=0)).sum() / 2
    assert switches / 3 / 40_000 == pytest.approx((1 - math.exp(-0.1)) / 2, rel=0.06)


def test_creep_gives_way_to_a_walk():
    """The walk: variance share^2 t / tau about the creep."""
    text = "creep-and-walk=1e-3,1e-3,1e-3;tau=10;share=0.5"
    paths = np.hstack([contribution(text, [(0, 0, 0)], dwell_s=401.0, seed=seed) for seed in range(100)])
    for t in (100, 400):
        assert paths[t].mean() == pytest.approx(1e-3 * math.log(1 + t / 10), abs=3e-3 * 0.5 * math.sqrt(t / 10 / 300))
        assert paths[t].std() == pytest.approx(1e-3 * 0.5 * math.sqrt(t / 10), rel=0.15)


def test_the_output_of_one_accelerometer_steps_once():
    channels, instants = set[int](), list[int]()
    for seed in range(20):
        found = contribution("output-step=1e-3", [(0, 0, 0)], dwell_s=100.0, seed=seed)
        (channel,) = np.flatnonzero(found[-1])
        instants.append(int(np.argmax(found[:, channel] != 0.0)))
        np.testing.assert_allclose(found[:, channel], found[-1, channel] * (np.arange(100) >= instants[-1]), atol=1e-15)
        assert not np.delete(found, channel, axis=1).any() and abs(found[-1, channel]) == pytest.approx(1e-3)
        channels.add(int(channel))
    assert channels == {0, 1, 2} and 20 <= min(instants) < 40 and 60 < max(instants) <= 80


# -- history --


def test_settling_follows_the_last_step():
    poses = [POSES["+x"], POSES["-x"], (0, 0, 0)]
    found = contribution("settling=0.001,0.002,0;tau=5", poses, dwell_s=10.0)
    decay = 1e-3 * G * np.exp(-np.arange(10) / 5.0)
    np.testing.assert_allclose(found[:10], 0.0, atol=1e-15)
    np.testing.assert_allclose(found[10:20], np.outer(decay, [-2, 0, 0]), atol=1e-12)
    np.testing.assert_allclose(found[20:], np.outer(decay, [1, 2, 0]), atol=1e-12)


def test_settling_is_continuous_at_arrival():
    options = {"dwell_s": 5.0, "sample_hz": 50.0, "slew": 30.0}
    found = contribution("settling=0.001,0,0;tau=1e9", [POSES["+x"], POSES["-x"]], **options)[:, 0]
    assert found.min() == pytest.approx(-2e-3 * G, rel=1e-6)
    assert np.abs(np.diff(found)).max() < 1e-3 * G * 0.02 * math.radians(30) * 1.1


def test_hysteresis_knows_the_side_it_came_from():
    poses = [(0, 20, 0), (0, 50, 0), (0, 20, 0), (0, 20, 90)]
    found = contribution("hysteresis=1e-3,2e-3,3e-3", poses)
    np.testing.assert_allclose(found, 1e-3 * np.array([[0, 0, 0], [1, -2, 0], [-1, 2, 0], [0, -2, -3]]), atol=1e-12)


def test_previous_pose_and_cable():
    poses = [(0, 0, 30), (0, 0, 90), (0, 0, 180)]
    found = contribution("previous-pose=1e-3,0,0", poses)[:, 0]
    np.testing.assert_allclose(found, [0, 0.5e-3, 1e-3], atol=1e-15)
    found = contribution("cable-torque=1e-3,0,0", poses)[:, 0]
    np.testing.assert_allclose(found, [1e-3 / 36, 1e-3 / 4, 1e-3], atol=1e-15)


# -- positioner --


def force(q2: float, q3: float) -> np.ndarray:
    """At true angles, rad."""
    return G * np.array([math.sin(q2), math.cos(q2) * math.cos(q3), -math.cos(q2) * math.sin(q3)])


@pytest.mark.parametrize(
    ("error", "true"),
    [
        ("encoder-offset:{}=0.01", lambda q: q + 0.01),
        ("encoder-scale:{}=0.01", lambda q: 1.01 * q),
        ("encoder-harmonic-1:{}=0.01,0.02", lambda q: q + 0.01 * math.sin(q) + 0.02 * math.cos(q)),
        ("encoder-harmonic-2:{}=0.01,0.02", lambda q: q + 0.01 * math.sin(2 * q) + 0.02 * math.cos(2 * q)),
        ("encoder-harmonic-3:{}=0.01,0.02", lambda q: q + 0.01 * math.sin(3 * q) + 0.02 * math.cos(3 * q)),
    ],
)
def test_encoders_read_what_the_platform_is_not(error, true):
    q2, q3 = math.radians(40), math.radians(-70)
    pose = [(10, 40, -70)]
    np.testing.assert_allclose(readings(error.format("z"), pose), [force(true(q2), q3)], atol=1e-12)
    np.testing.assert_allclose(readings(error.format("inner"), pose), [force(q2, true(q3))], atol=1e-12)
    np.testing.assert_allclose(readings(error.format("1"), pose), [force(q2, q3)], atol=1e-12)  # about the vertical


def test_play_stays_on_the_side_that_a_gimbal_came_from():
    """z goes forward, x back; then x alone goes forward, and z stays behind its encoder."""
    poses, play = [(10, 40, -70), (10, 60, -80), (10, 60, 30)], 0.01
    middle, inner = (np.radians([pose[k] for pose in poses]) for k in (1, 2))
    senses = {"z": [0.0, 1.0, 1.0], "x": [0.0, -1.0, 1.0]}
    at_z = middle - 0.5 * play * np.array(senses["z"])
    at_x = inner - 0.5 * play * np.array(senses["x"])
    for name, q2, q3 in (("z", at_z, inner), ("x", middle, at_x)):
        np.testing.assert_allclose(readings(f"backlash:{name}={play}", poses), list(map(force, q2, q3)), atol=1e-12)


def test_nonorthogonal_axis():
    """The z axis tilted by u about x is n = (0, -sin u, cos u): half a turn about it takes y to 2 n (n . y) - y."""
    u = v = 0.01
    half = readings("axis-nonorthogonality:z=0.01,0", [(0, 180, 0)])
    np.testing.assert_allclose(half, [[0, -G * math.cos(2 * u), -G * math.sin(2 * u)]], atol=1e-12)
    quarter = readings("axis-nonorthogonality:z=0,0.01", [(0, 90, 0)])  # about y: n = (sin v, 0, cos v), f = -n x y
    np.testing.assert_allclose(quarter, [[G * math.cos(v), 0, -G * math.sin(v)]], atol=1e-12)
    still = readings("axis-nonorthogonality=0.01", [(0, 0, 0)])
    np.testing.assert_allclose(still, [[0, G, 0]], atol=1e-12)


def test_tilted_axes_add_up():
    """The outer axis leans by u = 0.01 about z, the inner one is turned half about it and a tilted middle one."""
    both = readings("axis-nonorthogonality:y=0.01,0 axis-nonorthogonality:z=0.01,0", [(180, 180, 0)])
    outer = np.array([-math.sin(0.01), math.cos(0.01), 0.0])
    middle = np.array([0.0, -math.sin(0.01), math.cos(0.01)])
    half = [2 * np.outer(n, n) - np.eye(3) for n in (outer, middle)]
    np.testing.assert_allclose(both[0], half[1] @ half[0] @ [0, G, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("name", "dwell_s", "ambient"),
    [
        ("base-tilt=0.01,0 base-tilt=0,0.02", 1.0, Ambient()),
        ("base-tilt-drift=0.001,0 base-tilt-drift=0,0.002", 11.0, Ambient()),
        ("thermal-tilt=0.001,0 thermal-tilt=0,0.002", 1.0, Ambient(constant_c=35.0)),
    ],
)
def test_tilted_base(name, dwell_s, ambient):
    north, east = name.split()
    options = {"dwell_s": dwell_s, "ambient": ambient}
    about_north, about_east = (readings(text, [(0, 0, 0)], **options)[-1] for text in (north, east))
    np.testing.assert_allclose(about_north, [0, G * math.cos(0.01), -G * math.sin(0.01)], atol=1e-12)
    np.testing.assert_allclose(about_east, [G * math.sin(0.02), G * math.cos(0.02), 0], atol=1e-12)
    toward_east = replace(BENCH, azimuth_deg=90.0)  # bench x to the East, z to the South
    about_north = readings(north, [(0, 0, 0)], bench=toward_east, **options)[-1]
    np.testing.assert_allclose(about_north, [-G * math.sin(0.01), G * math.cos(0.01), 0], atol=1e-12)


def test_platform_drifts_in_its_own_axes():
    for pose, rate, expected in [
        ((0, 0, 0), "0.001,0,0", [0, G * math.cos(0.01), -G * math.sin(0.01)]),
        ((0, 90, 0), "0,0.001,0", [G * math.cos(0.01), 0, G * math.sin(0.01)]),
        ((0, 0, 0), "0,0.001,0", [0, G, 0]),
    ]:
        found = readings(f"platform-drift={rate}", [pose], dwell_s=11.0)[-1]
        np.testing.assert_allclose(found, expected, atol=1e-12)


def test_flexure_is_the_bend_under_the_torque_it_leaves():
    """y up, offset along x: the platform turns by -phi about z, where phi = d g cos phi; offset along y: no torque."""
    phi = brentq(lambda phi: phi - 2e-3 * G * math.cos(phi), 0, 0.1)
    bent = readings("flexure=2e-3,0,0", [(0, 0, 0)])
    np.testing.assert_allclose(bent, [[-G * math.sin(phi), G * math.cos(phi), 0]], atol=1e-9)
    np.testing.assert_allclose(readings("flexure=0,2e-3,0", [(0, 0, 0)]), [[0, G, 0]], atol=1e-12)


def test_uneven_flexure_gives_way_about_each_axis_by_its_own_compliance():
    """y up: the torque about z leaves z's compliance in the bend, and without it nothing bends."""
    phi = brentq(lambda phi: phi - 3 * 2e-3 * G * math.cos(phi), 0, 0.1)
    bent = readings("uneven-flexure=2e-3,0,0;cx=1e-9;cy=1e-9;cz=3", [(0, 0, 0)])
    np.testing.assert_allclose(bent, [[-G * math.sin(phi), G * math.cos(phi), 0]], atol=1e-9)
    stiff = readings("uneven-flexure=2e-3,0,0;cx=3;cy=3;cz=1e-12", [(0, 0, 0)])
    np.testing.assert_allclose(stiff, [[0, G, 0]], atol=1e-9)
    poses = [POSES["xyz"], (0, 20, 30)]
    even = contribution("uneven-flexure=2e-3,1e-3,-1e-3;cx=1;cy=1;cz=1", poses)
    np.testing.assert_array_equal(even, contribution("flexure=2e-3,1e-3,-1e-3", poses))


def test_a_loose_mount_mostly_lies_where_gravity_pulls_it():
    """About x it follows gravity along y: with y up, down and level the turn of z by y tells the angle."""
    poses = [(0, 0, 0), (0, 0, 180), (0, 0, 90)] * 200
    found = readings("loose-mount=1e-3,0,0", poses)
    up, down, level = (found[k::3] for k in range(3))
    angles = np.column_stack([-up[:, 2], down[:, 2], -level[:, 1]]) / G  # the platform turned about x
    assert np.abs(angles).max() <= 1e-3 and np.ptp(angles[:, 2]) > 1.9e-3
    assert not np.abs(up[:, 0]).max() and np.abs(up[:, 1] - G).max() < 1e-5
    # where gravity lies along y the mean is that of clip(1 + z, -1, 1), 0.6095, z standard normal
    assert angles.mean(axis=0) == pytest.approx([0.61e-3, -0.61e-3, 0.0], abs=0.15e-3)


@pytest.mark.parametrize("pose", [(10, 40, -70), (0, 0, 0)])
def test_an_eccentric_bearing_is_two_errors_with_one_coefficient(pose):
    together = readings("eccentric-bearing:z=1e-2,2e-2;share=0.5", [pose])
    apart = readings("encoder-harmonic-1:z=1e-2,2e-2 axis-nonorthogonality:z=5e-3,1e-2", [pose])
    np.testing.assert_allclose(together, apart, atol=1e-12)
    assert np.abs(together - readings("", [pose])).max() > 1e-3


def test_lever_arms_in_a_turn_about_the_vertical():
    """Minimum jerk by D in T: centripetal -w^2 r along the arm, tangential w' x r."""
    plan = [(0, 0, 0), (90, 0, 0)]
    options = {"sample_hz": 100.0, "slew": 45.0, "dwell_s": 1.0}
    along_x = contribution("lever-arm=0.1,0,0,0,0,0,0.1,0,0", plan, **options)
    along_z = contribution("lever-arm=0,0,0.1,0,0.1,0,0,0,0", plan, **options)
    turn, lasts = math.pi / 2, 1.875 * 90 / 45
    u = np.clip((np.arange(len(along_x)) / 100.0 - 1.0) / lasts, 0, 1)
    rate = turn / lasts * (30 * u**2 - 60 * u**3 + 30 * u**4)
    acceleration = turn / lasts**2 * (60 * u - 180 * u**2 + 120 * u**3)
    np.testing.assert_allclose(along_x[:, 0], -0.1 * rate**2, atol=1e-7)
    np.testing.assert_allclose(along_x[:, 2], -0.1 * acceleration, atol=1e-5)
    np.testing.assert_allclose(along_z[:, 0], 0.1 * acceleration, atol=1e-5)
    np.testing.assert_allclose(along_z[:, 1], 0.0, atol=1e-8)  # on the axis
    assert 0.1 * rate.max() ** 2 > 0.03 and 0.1 * acceleration.max() > 0.03


def test_latency_delays_the_readings():
    options = {"sample_hz": 50.0, "slew": 45.0, "dwell_s": 1.0}
    plan = [(0, 0, 0), (0, 60, 30)]
    now, late = readings("", plan, **options), readings("latency=0.1", plan, **options)
    np.testing.assert_allclose(late[5:], now[:-5], atol=1e-12)
    np.testing.assert_allclose(late[:5], now[:1].repeat(5, axis=0), atol=1e-12)


# -- surroundings and electronics --


def test_wrong_gravity_and_cross_talk():
    pose, f = [(10, 40, -70)], force(math.radians(40), math.radians(-70))
    np.testing.assert_allclose(readings("gravity-error=1e-3", pose)[0], 1.001 * f, rtol=1e-12)
    mixed = np.array([[1, 1e-3, 2e-3], [3e-3, 1, 4e-3], [5e-3, 6e-3, 1]]) @ f
    np.testing.assert_allclose(readings("cross-talk=1e-3,2e-3,3e-3,4e-3,5e-3,6e-3", pose)[0], mixed, rtol=1e-12)


@pytest.mark.parametrize("reference", ["base", "inertial"])
def test_rotation_of_the_earth_moves_the_vertical_east(reference):
    bench = replace(BENCH, latitude_deg=0.0, reference=reference)
    found = readings("earth-rotation=1", [(0, 0, 0)], bench=bench, dwell_s=3601.0, sample_hz=1 / 3600)[-1]
    turned = math.radians(15.0411) * (2 if reference == "inertial" else 1)
    np.testing.assert_allclose(found, [0, G * math.cos(turned), G * math.sin(turned)], atol=1e-4)


def test_magnetic_field_is_fixed_to_the_earth():
    text = "magnetic=1,2,3;north=2e-5;up=-4e-5;east=1e-5"
    found = contribution(text, [(0, 0, 0), (180, 0, 0), (0, 0, 180)])
    field = np.array([[2, -4, 1], [-2, -4, -1], [2, 4, -1]]) * 1e-5
    np.testing.assert_allclose(found, field * [1, 2, 3], atol=1e-12)
    inertial = replace(BENCH, latitude_deg=90.0, reference="inertial")  # a quarter turn at the pole: North goes to -z
    options = {"bench": inertial, "dwell_s": 86164.0905, "sample_hz": 4 / 86164.0905}
    quarter = contribution(text, [(0, 0, 0)], **options)[1]
    np.testing.assert_allclose(quarter, [1e-5, -8e-5, -6e-5], atol=1e-9)


def test_saturation_quantisation_and_outliers():
    poses, noise = [POSES["+x"], POSES["-x"], (0, 20, 30)], TrueNoise(white_mps2=1e-2)
    options = {"noise": noise, "dwell_s": 500.0, "sample_hz": 2.0}
    free = readings("", poses, **options)
    np.testing.assert_array_equal(readings("saturation=9,0,0", poses, **options)[:, 0], np.clip(free[:, 0], -9, 9))
    np.testing.assert_array_equal(readings("saturation=9,0,0", poses, **options)[:, 1:], free[:, 1:])
    coarse = readings("quantisation=0.02,0,0.05", poses, **options)
    np.testing.assert_array_equal(coarse[:, 1], free[:, 1])
    steps = coarse[:, [0, 2]] / [0.02, 0.05]
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-9)
    assert np.abs(coarse - free).max() <= 0.025 + 1e-12
    jumps = contribution("outliers=0.5,0.5,0;rate=0.05", poses, **options)
    assert set(np.unique(jumps.round(9))) == {-0.5, 0.0, 0.5}
    assert np.mean(jumps[:, :2] != 0) == pytest.approx(0.05, rel=0.15) and not jumps[:, 2].any()


# -- what holds for every effect --

AMBIENT = Ambient(swing_c=3.0, period_s=40.0)
VISIBLE = {name: kind.typical("mems")[1] for name, kind in catalogue().items()}


def run(text: str | list[str], batch_samples: int = 1 << 20, inertial: bool = False) -> Batch:
    bench = replace(BENCH, reference="inertial", latitude_deg=50.0) if inertial else BENCH
    texts = [text] if isinstance(text, str) else text
    return read(
        Simulation(
            bench, GRADES["mems"].sensors(3), TrueNoise(1e-3, setting_sigma_deg=0.01), spread_plan(4, dwell_s=2.0),
            ambient=AMBIENT, sample_hz=25.0, slew_rate_degps=90.0, seed=8, batch_samples=batch_samples,
            hidden=parse(texts, BENCH.axes),
        )
    )  # fmt: skip


PLAIN = run([])


@pytest.mark.parametrize("name", catalogue())
def test_every_effect_is_absent_at_zero_and_seen_only_in_the_readings(name):
    assert np.array_equal(run(f"{name}=0").accel.values, PLAIN.accel.values)
    batch = run(f"{name}={VISIBLE[name]}")
    assert np.abs(batch.accel.values - PLAIN.accel.values).max() > 1e-6
    for with_effect, without in zip((batch.pose, batch.temperature), (PLAIN.pose, PLAIN.temperature), strict=True):
        assert np.array_equal(with_effect.values, without.values)
        assert np.array_equal(with_effect.time_ns, without.time_ns)
    assert np.array_equal(batch.accel.time_ns, PLAIN.accel.time_ns)


@pytest.mark.parametrize("name", sorted(set(catalogue()) - {"quantisation", "saturation", "dead-zone", "latency"}))
def test_small_effects_are_linear_in_their_size(name):
    size, constants = catalogue()[name].typical("navigation")[0], ""
    if name == "vibration-rectification":  # the vibration itself is there whatever the size
        size, constants = 1e-3, ";rms=1"
    none, one, two = (run(f"{name}={times * size}{constants}").accel.values for times in (1e-20, 1, 2))
    np.testing.assert_allclose(two - none, 2 * (one - none), rtol=0, atol=2e-3 * np.abs(two - none).max() + 1e-13)


@pytest.mark.parametrize("batch_samples", [97, *slow(1, 7)])
def test_batches_do_not_matter_to_all_effects_at_once(batch_samples):
    texts = [f"{name}={size}" for name, size in VISIBLE.items() if name not in ("saturation", "quantisation")]
    assert np.array_equal(run(texts, batch_samples, inertial=True).accel.values, run(texts, inertial=True).accel.values)


def test_a_run_starts_afresh():
    texts = ["settling=1e-2", "telegraph=1e-2", "thermal-lag=1e-2", "bias-walk=1e-2", "hysteresis=1e-2"]
    simulation = Simulation(
        BENCH, ORTHOGONAL, QUIET, spread_plan(3, dwell_s=2.0), ambient=AMBIENT, hidden=parse(texts, BENCH.axes)
    )
    assert np.array_equal(read(simulation).accel.values, read(simulation).accel.values)


@pytest.mark.slow
def test_memory_does_not_grow_with_the_run():
    def peak(dwell_s: float) -> int:
        texts = [f"{name}={size}" for name, size in VISIBLE.items()]
        simulation = Simulation(
            BENCH, ORTHOGONAL, QUIET, explicit_plan([(0, 0, 0), (0, 90, 0)], dwell_s),
            ambient=AMBIENT, sample_hz=250.0, batch_samples=500, hidden=parse(texts, BENCH.axes),
        )  # fmt: skip
        with traced() as found:
            for _ in simulation:
                pass
        return found.bytes

    peak(1.0)
    assert peak(12.0) < 1.2 * peak(4.0)


@pytest.mark.parametrize("axes", ["z x", "y z x", ""])
def test_what_random_draws_works_on_any_bench(axes):
    bench = replace(BENCH, axes=parse_axes(axes))
    for seed in range(12):
        hidden = parse(["random-known", "random-unknown"], bench.axes or YZX, seed=seed)
        plan = spread_plan(2, bench.axes or YZX, dwell_s=1.0)
        batch = read(Simulation(bench, ORTHOGONAL, QUIET, plan, sample_hz=10.0, hidden=hidden))
        assert np.isfinite(batch.accel.values).all()


# -- truth and recording --


def test_truth_tells_and_the_recording_does_not(tmp_path):
    texts = ["second-order=4e-5", "encoder-harmonic-2:z=2e-5,1e-5", "warm-up=1e-4;tau=600"]
    recorded = {}
    for label, hidden in (("with", parse(texts, BENCH.axes)), ("without", [])):
        path = tmp_path / f"{label}.mcap"
        simulation = Simulation(BENCH, ORTHOGONAL, QUIET, spread_plan(2, dwell_s=2.0), hidden=hidden)
        record(path, read(simulation), BENCH)
        truth = json.loads(write_truth(simulation, path).read_text())
        recorded[label] = Recording(path).bench, truth["effects"]
        assert not any(word in path.read_bytes() for word in (b"second-order", b"harmonic", b"warm-up", b"hidden"))
    assert recorded["with"][0].to_metadata() == recorded["without"][0].to_metadata()
    assert recorded["without"][1] == []
    first, second, third = recorded["with"][1]
    assert (first["name"], first["unit"], first["in_catalogue"]) == ("second-order", "1/(m/s^2)", True)
    assert {key: abs(value) for key, value in first["sizes"].items()} == {"1": 4e-5, "2": 4e-5, "3": 4e-5}
    assert (second["name"], second["sizes"]) == ("encoder-harmonic-2:z", {"s": 2e-5, "c": 1e-5})
    assert (first["family"], parse(["bias-jump=1"], BENCH.axes)[0].truth["family"]) == ("", "bias in time")
    assert third["inner"] == {"tau": {"value": 600.0, "unit": "s"}}


# -- texts --


def sizes(text: str, seed: int = 0) -> tuple[float, ...]:
    return parse([text], BENCH.axes, seed=seed)[0].sizes


def test_one_number_is_the_size_of_all_with_signs_from_the_seed():
    drawn = {sizes("second-order=4e-5", seed) for seed in range(60)}
    assert len(drawn) == 8 and {abs(size) for triple in drawn for size in triple} == {4e-5}
    assert sizes("second-order=4e-5", 3) == sizes("second-order=4e-5", 3)
    assert sizes("second-order=-4e-5,0,2e-5") == (-4e-5, 0.0, 2e-5)
    assert sizes("quantisation=1e-3") == (1e-3,) * 3


def test_units_are_converted():
    assert si("4ug/g^2") == pytest.approx(4e-6 / 9.80665, rel=1e-12)
    assert si("-3 mg/g^3") == pytest.approx(-3e-3 / 9.80665**2, rel=1e-12)
    assert si("100 ppm/K") == pytest.approx(1e-4, rel=1e-12)
    assert si("1arcsec") == pytest.approx(4.84813681e-6, rel=1e-8)
    assert si("1 deg/h") == pytest.approx(4.84813681e-6, rel=1e-8)
    assert si("10ug/G") == pytest.approx(0.980665, rel=1e-12)
    assert si("1ug*min/K") == pytest.approx(60 * 9.80665e-6, rel=1e-12)
    assert si("4e-5") == 4e-5 and si(".5") == 0.5 and si("1g") == 9.80665
    assert sizes("encoder-offset:z=2arcsec")[0] ** 2 == pytest.approx(si("2arcsec") ** 2)


@pytest.mark.parametrize(
    ("axes", "names"),
    [
        ("y z x", ["y", "z", "x"]),
        ("-y z", ["y", "z"]),
        ("y z y", ["1", "z", "3"]),
        ("1,1,0 -z x", ["1", "z", "x"]),
    ],
)
def test_axis_wise_effects_have_the_names_of_the_axes(axes, names):
    bench_axes = parse_axes(axes)
    effects = parse(["encoder-offset=1e-5"], bench_axes)
    assert [effect.name for effect in effects] == [f"encoder-offset:{name}" for name in names]
    assert [effect.axis for effect in effects] == list(range(len(bench_axes)))
    assert parse(["encoder-offset:inner=1"], bench_axes)[0].name == f"encoder-offset:{names[-1]}"
    assert parse(["encoder-offset:1=1"], bench_axes)[0].axis == 0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("secnd-order=1", "did you mean second-order"),
        ("random-unknwon", "no size"),
        ("qqqq=1", "bias-drift"),
        ("second-order", "no size"),
        ("second-order=", "no size"),
        ("second-order=1,2", "give 1 or 3"),
        ("second-order=big", "not a number"),
        ("second-order=1e999", "finite"),
        ("second-order=1stone", "'stone' is not known"),
        ("second-order:x=1", "no gimbal axis"),
        ("second-order=1;tau=3", "no constant 'tau'"),
        ("warm-up=1;tau=-3", "positive"),
        ("dead-zone=-1", "zero or a positive"),
        ("encoder-offset:w=1", "use y, z, x, outer or inner"),
        ("encoder-offset=1e-5 encoder-offset:z=1e-5", "twice"),
    ],
)
def test_what_cannot_be_is_refused_in_one_sentence(text, words):
    with pytest.raises(InputError, match=words) as caught:
        parse(text.split(), BENCH.axes)
    assert "\n" not in str(caught.value)


def test_random_draws_from_the_seed_and_to_the_grade():
    kinds = {
        pool: [parse([pool], BENCH.axes, seed=seed)[0] for seed in range(200)]
        for pool in ("random", "random-known", "random-unknown")
    }
    assert {effect.kind.known for effect in kinds["random"]} == {True, False}
    assert {effect.kind.known for effect in kinds["random-known"]} == {True}
    assert {effect.kind.known for effect in kinds["random-unknown"]} == {False}
    assert len({effect.kind.name for effect in kinds["random"]}) > 30
    for effect in kinds["random"]:
        least, greatest = effect.kind.typical("navigation")
        assert all(least * (1 - 1e-9) <= abs(size) <= greatest * (1 + 1e-9) for size in effect.sizes)
    nav, mems = (parse(["random"], BENCH.axes, seed=6, grade=grade)[0] for grade in ("navigation", "mems"))
    assert nav.name == mems.name and nav.sizes != mems.sizes
    assert nav.truth == parse(["random"], BENCH.axes, seed=6)[0].truth
    several = parse(["random"] * 5, BENCH.axes, seed=1)
    assert len({effect.name for effect in several}) == 5
