"""The simulator against closed forms and against the statistics its noise is stated to have."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from helpers.long_runs import slow
from helpers.recordings import read, streams_of
from scipy.signal import welch

from kf_calib.bench.bench import Bench, axes_of, parse_axes
from kf_calib.bench.streams import Batch
from kf_calib.errors import InputError, KfCalibError
from kf_calib.sources.simulation.detectability import write_truth
from kf_calib.sources.simulation.sensors import GRADES, NOMINAL, Sensors, TrueNoise
from kf_calib.sources.simulation.simulator import START_NS, Ambient, Simulation
from kf_calib.sources.simulation.visit_plans import PlannedVisit, explicit_plan, six_faces, spread_plan

G = 9.81
BENCH = Bench(axes=axes_of("yzx"), gravity_mps2=G)
ORTHOGONAL = Sensors({"theta1": 0.0, "theta3": 0.0})
QUIET = TrueNoise()
STILL = explicit_plan([(0, 0, 0)], dwell_s=1000.0)


def noise_of(noise: TrueNoise, count: int = 100_000, rate_hz: float = 100.0, seed: int = 1) -> np.ndarray:
    """The noise alone (n, 3): readings of a still, orthogonal block less their level."""
    plan = explicit_plan([(0, 0, 0)], dwell_s=count / rate_hz)
    values = read(Simulation(BENCH, ORTHOGONAL, noise, plan, sample_hz=rate_hz, seed=seed)).accel.values
    assert len(values) == count
    return values - [0.0, G, 0.0]


def dwell_means(simulation: Simulation, batch: Batch) -> np.ndarray:
    elapsed = batch.accel.time_ns - START_NS
    limits = zip(simulation.motion.arrive_ns, simulation.motion.leave_ns, strict=True)
    return np.array([batch.accel.values[(elapsed >= a) & (elapsed < b)].mean(axis=0) for a, b in limits])


# -- closed forms --


def test_six_faces_read_plus_and_minus_g_times_scale_plus_bias():
    sensors = replace(ORTHOGONAL, parameters={**ORTHOGONAL.parameters, "K1": 1.01, "b1": 0.1, "K2": 0.98, "b3": -0.2})
    simulation = Simulation(BENCH, sensors, QUIET, six_faces(dwell_s=2.0))
    expected = np.kron(np.diag([1.01, 0.98, 1.0]), [[G], [-G]]) + np.array([0.1, 0.0, -0.2])
    np.testing.assert_allclose(dwell_means(simulation, read(simulation)), expected, atol=1e-12)


def test_sensitive_axes_are_the_papers():
    first, second, third = {"theta1": 0.02, "phi1": 0.3, "K1": 1.1}, {"nu1": 0.04, "nu2": -0.05}, {"theta3": -0.01}
    sensors = Sensors(first | second | third | {"phi3": -1.5})
    expected = [
        [1.1 * math.cos(0.3) * math.cos(0.02), 1.1 * math.sin(0.02), -1.1 * math.sin(0.3) * math.cos(0.02)],
        [math.sin(0.04), math.sqrt(1 - math.sin(0.04) ** 2 - math.sin(0.05) ** 2), math.sin(0.05)],
        [math.cos(-1.5) * math.cos(0.01), -math.sin(0.01), math.sin(1.5) * math.cos(0.01)],
    ]
    np.testing.assert_allclose(sensors.sensitivities, expected, atol=1e-15)


def test_specific_force_of_three_gimbals():
    q1, q2, q3 = np.radians([40.0, 25.0, -70.0])
    simulation = Simulation(BENCH, ORTHOGONAL, QUIET, explicit_plan([(40, 25, -70)], dwell_s=1.0))
    expected = G * np.array([np.sin(q2), np.cos(q2) * np.cos(q3), -np.cos(q2) * np.sin(q3)])
    np.testing.assert_allclose(read(simulation).accel.values, np.tile(expected, (100, 1)), atol=1e-12)
    np.testing.assert_allclose(read(simulation).pose.values, np.tile([q1, q2, q3], (10, 1)), atol=1e-15)


@pytest.mark.parametrize(
    ("latitude_deg", "azimuth_deg", "moves"),
    [(90.0, 0.0, (0, 0, 0)), (0.0, 0.0, (0, 0, 1)), (0.0, 90.0, (1, 0, 0)), (0.0, 180.0, (0, 0, -1))],
)
def test_in_an_inertial_platform_the_vertical_goes_east(latitude_deg, azimuth_deg, moves):
    """At the pole it stays; at the equator it turns toward East, 15.041 deg an hour: bench z, x or -z by azimuth."""
    bench = replace(BENCH, reference="inertial", latitude_deg=latitude_deg, azimuth_deg=azimuth_deg)
    plan = explicit_plan([(0, 0, 0)], dwell_s=7200.0)
    accel = read(Simulation(bench, ORTHOGONAL, QUIET, plan, sample_hz=0.1)).accel
    turned = 7.292115e-5 * (accel.time_ns - START_NS)[:, None] * 1e-9 * np.linalg.norm(moves)
    expected = G * (np.cos(turned) * [0, 1, 0] + np.sin(turned) * moves)
    np.testing.assert_allclose(accel.values, expected, atol=1e-6)


@pytest.mark.parametrize("reference", ["base", "inertial"])
@pytest.mark.parametrize("axes", ["y z x", "z x", "1,1,0 -z x"])
def test_the_package_predicts_what_the_simulator_reads(axes, reference):
    """In dwells and in slews; both sides were written apart."""
    bench = Bench(parse_axes(axes), G, reference, latitude_deg=55.7, azimuth_deg=33.0)
    sensors = GRADES["mems"].sensors(seed=4)
    plan = spread_plan(5, bench.axes, dwell_s=20.0, seed=6)
    batch = read(Simulation(bench, sensors, QUIET, plan, sample_hz=20.0, angle_hz=20.0))
    force = bench.specific_force((batch.accel.time_ns - START_NS) * 1e-9, batch.pose.values)
    predicted = force @ sensors.sensitivities.T + sensors.biases_mps2
    np.testing.assert_allclose(batch.accel.values, predicted, atol=2e-8)


def test_a_bench_without_axes_records_attitudes():
    bench = Bench(axes=(), gravity_mps2=G)
    batch = read(Simulation(bench, ORTHOGONAL, QUIET, spread_plan(4, dwell_s=5.0), sample_hz=10.0))
    assert batch.pose.values.shape[1] == 4
    np.testing.assert_allclose(
        batch.accel.values, bench.specific_force(np.zeros(len(batch.accel)), batch.pose.values), atol=1e-12
    )


# -- motion and streams --


def test_slews_are_smooth_and_as_fast_as_stated():
    simulation = Simulation(BENCH, ORTHOGONAL, QUIET, spread_plan(5, dwell_s=5.0), angle_hz=100.0, slew_rate_degps=30.0)
    batch = read(simulation)
    rates_degps = np.degrees(np.diff(batch.pose.values, axis=0)) * 100.0
    elapsed, motion = batch.pose.time_ns[1:] - START_NS, simulation.motion
    for start, end in zip(motion.leave_ns[:-1], motion.arrive_ns[1:], strict=True):
        slew = (elapsed > start) & (elapsed <= end)
        assert np.abs(rates_degps[slew]).max() == pytest.approx(30.0, rel=1e-3)
    # no jump of the speed: the greatest acceleration of a minimum-jerk slew is 5.77 / 1.875^2 rate^2 / distance
    shortest_deg = np.degrees(np.abs(np.diff(motion.angles_rad, axis=0)).max(axis=1).min())
    assert np.abs(np.diff(rates_degps, axis=0)).max() * 100.0 < 1.65 * 30.0**2 / shortest_deg
    assert np.abs(np.diff(batch.accel.values, axis=0)).max() < 3 * G * np.radians(30.0) * 0.01


def test_without_slews_every_dwell_has_exactly_its_samples():
    plan = explicit_plan([(0, 0, 0), (0, 33, 70)], dwell_s=2000.0)
    batch = read(Simulation(BENCH, ORTHOGONAL, QUIET, plan, sample_hz=0.05, angle_hz=0.05, slew_rate_degps=math.inf))
    assert len(np.unique(batch.accel.values.round(9), axis=0)) == 2
    assert len(batch.accel) == 200
    assert np.ptp(batch.accel.values[100:], axis=0).max() < 1e-12


def test_streams_have_their_rates_and_end_with_the_plan():
    simulation = Simulation(BENCH, ORTHOGONAL, QUIET, STILL, sample_hz=8.0, angle_hz=2.5)
    batch = read(simulation)
    assert (len(batch.accel), len(batch.pose), len(batch.temperature)) == (8000, 2500, 1000)
    assert len(simulation) == 8000
    assert batch.accel.time_ns[0] == batch.pose.time_ns[0] == batch.temperature.time_ns[0] == START_NS
    assert simulation.fraction == 1.0 and simulation.warnings == []


EVERYTHING = TrueNoise(1e-3, 0.5, 1e-4, 1e-5, 1e-3, 0.01, 1e-3, 1e-4, 1e-2, 1.0, 0.01)


@pytest.mark.parametrize("batch_samples", [97, 1000, *slow(7)])
def test_samples_do_not_depend_on_the_size_of_batches(batch_samples):
    def run(size: int) -> Batch:
        bench = replace(BENCH, reference="inertial", latitude_deg=50.0)
        plan = spread_plan(4, dwell_s=2.0)
        return read(Simulation(bench, GRADES["mems"].sensors(), EVERYTHING, plan, seed=8, batch_samples=size))

    for one, other in zip(streams_of(run(batch_samples)), streams_of(run(1 << 20)), strict=True):
        assert np.array_equal(one.time_ns, other.time_ns)
        np.testing.assert_allclose(one.values, other.values, rtol=0, atol=1e-12)


def test_a_run_repeats_itself_and_another_seed_differs():
    simulation = Simulation(BENCH, ORTHOGONAL, EVERYTHING, spread_plan(3, dwell_s=2.0), seed=1)
    other = Simulation(BENCH, ORTHOGONAL, EVERYTHING, spread_plan(3, dwell_s=2.0), seed=2)
    assert np.array_equal(read(simulation).accel.values, read(simulation).accel.values)
    assert not np.any(read(simulation).accel.values == read(other).accel.values)


# -- noise --


def test_white_noise_has_its_sigma_and_no_memory():
    noise = noise_of(TrueNoise(white_mps2=2e-3))
    np.testing.assert_allclose(noise.std(axis=0), 2e-3, rtol=0.01)
    assert np.abs(np.corrcoef(noise.T) - np.eye(3)).max() < 0.015
    assert np.abs(_lag_one(noise)).max() < 0.015


def test_ar1_noise_keeps_the_sigma_and_has_its_correlation():
    noise = noise_of(TrueNoise(white_mps2=2e-3, ar1_phi=0.9), count=400_000)
    np.testing.assert_allclose(noise.std(axis=0), 2e-3, rtol=0.02)
    np.testing.assert_allclose(_lag_one(noise), 0.9, atol=0.005)
    first = np.array([noise_of(TrueNoise(2e-3, 0.9), count=1, seed=seed)[0] for seed in range(400)])
    np.testing.assert_allclose(first.std(), 2e-3, rtol=0.07)  # stationary from the first sample on


def test_flicker_has_a_spectrum_of_slope_minus_one_and_its_level():
    floor = 1e-4
    noise = noise_of(TrueNoise(flicker_mps2=floor), count=1 << 19)
    frequency, density = welch(noise, fs=100.0, nperseg=1 << 14, axis=0)
    band = (frequency > 0.02) & (frequency < 5.0)  # three decades short of both corners
    log_f, log_density = np.log(frequency[band]), np.log(density[band].mean(axis=1))
    assert np.polyfit(log_f, log_density, 1)[0] == pytest.approx(-1.0, abs=0.05)
    level = np.mean(density[band] * frequency[band][:, None])
    assert level == pytest.approx(floor**2 / (2 * math.log(2)), rel=0.05)


def test_flicker_has_a_flat_allan_deviation_and_goes_on_over_dwells():
    noise = noise_of(TrueNoise(flicker_mps2=1e-4), count=1 << 19)
    for length in (64, 512, 4096):
        means = noise.reshape(-1, length, 3).mean(axis=1)
        allan = np.sqrt(np.mean(np.diff(means, axis=0) ** 2) / 2)
        assert allan == pytest.approx(1e-4, rel=0.12)
    plan = explicit_plan([(0, 0, 0)] * 20, dwell_s=100.0)
    same = read(Simulation(BENCH, ORTHOGONAL, TrueNoise(flicker_mps2=1e-4), plan, seed=1)).accel.values - [0, G, 0]
    once = read(
        Simulation(BENCH, ORTHOGONAL, TrueNoise(flicker_mps2=1e-4), [PlannedVisit((0, 0, 0), 2000.0)], seed=1)
    ).accel
    np.testing.assert_array_equal(same, once.values - [0, G, 0])


def test_bias_walks_by_the_square_root_of_time():
    runs = [noise_of(TrueNoise(walk_mps2_per_sqrt_s=1e-4), count=401, rate_hz=4.0, seed=seed) for seed in range(150)]
    paths = np.concatenate(runs, axis=1)  # (401, 450)
    assert paths[-1].std() == pytest.approx(1e-4 * math.sqrt(401 / 4), rel=0.12)
    assert paths[100].std() == pytest.approx(1e-4 * math.sqrt(101 / 4), rel=0.12)


def test_outliers_have_their_rate_and_size():
    noise = noise_of(TrueNoise(outlier_rate=0.01, outlier_mps2=0.5))
    assert set(np.unique(noise.round(9))) == {-0.5, 0.0, 0.5}
    assert np.mean(noise != 0) == pytest.approx(0.01, rel=0.06)
    assert np.mean(noise[noise != 0] > 0) == pytest.approx(0.5, abs=0.04)


def test_scatter_is_constant_in_a_dwell_and_independent_between_them():
    plan = explicit_plan([(0, 0, 0), (0, 1, 0)] * 150, dwell_s=1.0)
    simulation = Simulation(BENCH, ORTHOGONAL, TrueNoise(scatter_mps2=1e-3), plan, slew_rate_degps=math.inf, seed=3)
    quiet = Simulation(BENCH, ORTHOGONAL, QUIET, plan, slew_rate_degps=math.inf)
    offsets = (read(simulation).accel.values - read(quiet).accel.values).reshape(300, 100, 3)
    assert np.ptp(offsets, axis=1).max() < 1e-14
    assert offsets[:, 0].std() == pytest.approx(1e-3, rel=0.08)
    assert np.abs(np.corrcoef(offsets[:, 0].T) - np.eye(3)).max() < 0.2
    assert np.abs(_lag_one(offsets[:, 0])).max() < 0.2


def test_setting_error_turns_the_force_and_keeps_its_size():
    plan = explicit_plan(np.random.default_rng(0).uniform(-180, 180, (300, 3)), dwell_s=1.0)
    sigma_deg = 0.05
    simulation = Simulation(BENCH, ORTHOGONAL, TrueNoise(setting_sigma_deg=sigma_deg), plan, sample_hz=2.0, seed=2)
    batch = read(simulation)
    np.testing.assert_allclose(np.linalg.norm(batch.accel.values, axis=1), G, rtol=1e-12)
    means = dwell_means(simulation, batch)
    stated = dwell_means(quiet := Simulation(BENCH, ORTHOGONAL, QUIET, plan, sample_hz=2.0), read(quiet))
    across = (means - stated) / G
    # two of the three rotations show, each with sigma; the third is about the vertical
    assert np.sqrt(np.mean(np.sum(across**2, axis=1)) / 2) == pytest.approx(np.radians(sigma_deg), rel=0.09)
    assert np.abs(np.sum(across * stated, axis=1)).max() / G < 1e-5
    np.testing.assert_array_equal(batch.pose.values, read(quiet).pose.values)  # the encoders do not see it


def test_a_platform_that_is_not_moved_is_not_set_anew():
    """Visits in a row at the same angles are one dwell, whatever is drawn for each dwell."""
    noise = TrueNoise(setting_sigma_deg=0.05, scatter_mps2=1e-3)
    rows, settings = [(0, 0, 0), (0, 90, 0), (0, 90, 0), (0, 90, 0), (0, 0, 0)], {"sample_hz": 2.0, "seed": 2}
    again = Simulation(BENCH, ORTHOGONAL, noise, explicit_plan(rows, dwell_s=5.0), **settings)
    once = [
        PlannedVisit(tuple(map(float, row)), dwell_s)
        for row, dwell_s in ((rows[0], 5.0), (rows[1], 15.0), (rows[0], 5.0))
    ]
    np.testing.assert_array_equal(
        read(again).accel.values, read(Simulation(BENCH, ORTHOGONAL, noise, once, **settings)).accel.values
    )


def test_encoders_err_and_round_without_moving_the_platform():
    noise = TrueNoise(encoder_sigma_deg=0.01, encoder_step_deg=0.002)
    batch = read(Simulation(BENCH, ORTHOGONAL, noise, explicit_plan([(10, 20, 30)], 1000.0)))
    degrees = np.degrees(batch.pose.values)
    np.testing.assert_allclose(degrees / 0.002, np.rint(degrees / 0.002), atol=1e-6)
    np.testing.assert_allclose((degrees - [10, 20, 30]).std(axis=0), 0.01, rtol=0.04)
    assert np.ptp(batch.accel.values, axis=0).max() < 1e-12


def test_vibration_is_felt_in_slews_only():
    simulation = Simulation(BENCH, ORTHOGONAL, TrueNoise(vibration_mps2=0.1), spread_plan(3, dwell_s=10.0))
    quiet = Simulation(BENCH, ORTHOGONAL, QUIET, simulation.plan)
    batch = read(simulation)
    added = batch.accel.values - read(quiet).accel.values
    elapsed = batch.accel.time_ns - START_NS
    limits = zip(simulation.motion.arrive_ns, simulation.motion.leave_ns, strict=True)
    still = np.any([(elapsed >= a) & (elapsed < b) for a, b in limits], axis=0)
    assert not added[still].any()
    assert added[~still].std() == pytest.approx(0.1, rel=0.1)


def test_temperature_follows_its_profile():
    ambient = Ambient(constant_c=20.0, swing_c=3.0, period_s=400.0, warm_up_c=5.0, warm_up_s=100.0, sigma_c=0.02)
    stream = read(Simulation(BENCH, ORTHOGONAL, QUIET, STILL, ambient=ambient, sample_hz=1.0)).temperature
    t = (stream.time_ns - START_NS) * 1e-9
    error = stream.values[:, 0] - (20 + 3 * np.sin(2 * np.pi * t / 400) - 5 * np.exp(-t / 100))
    assert error.std() == pytest.approx(0.02, rel=0.1)
    assert abs(error.mean()) < 0.003


# -- sensors, truth, refusals --


def test_the_papers_grade_is_its_table_1():
    deviations = {s: v - NOMINAL[s] for s, v in GRADES["paper"].sensors(seed=9).parameters.items()}
    for symbol, deviation in deviations.items():
        size = 5e-5 if symbol[0] in "Kb" else np.radians(30 / 3600)
        assert deviation == pytest.approx(size, rel=1e-9)


@pytest.mark.parametrize("name", ["navigation", "mems"])
def test_grades_draw_normal_deviations_of_their_size(name):
    grade = GRADES[name]
    draws = np.array([list(grade.sensors(seed).parameters.values()) for seed in range(400)]) - list(NOMINAL.values())
    sizes = np.array([grade.angle_rad, grade.angle_rad, grade.scale, grade.bias_mps2] * 3)
    np.testing.assert_allclose(draws.std(axis=0) / sizes, 1.0, atol=0.15)
    assert grade.sensors(3) == grade.sensors(3) != grade.sensors(4)


def test_truth_goes_into_a_file_beside_the_recording(tmp_path):
    sensors = GRADES["navigation"].sensors(7)
    simulation = Simulation(BENCH, sensors, EVERYTHING, STILL, seed=7, grade="navigation")
    path = write_truth(simulation, tmp_path / "run.mcap")
    assert path == tmp_path / "run.truth.json"
    truth = json.loads(path.read_text())
    assert truth["parameters"] == dict(sensors.parameters)
    assert (truth["seed"], truth["grade"], truth["effects"]) == (7, "navigation", [])
    assert TrueNoise(**truth["noise"]) == EVERYTHING
    with pytest.raises(KfCalibError, match="cannot be written"):
        write_truth(simulation, tmp_path / "absent" / "run.mcap")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"plan": []}, "no orientation"),
        ({"plan": [PlannedVisit((0, 0), 1.0)]}, "one number for each of 3 axes"),
        ({"plan": [PlannedVisit((0, 0, math.nan), 1.0)]}, "one number"),
        ({"plan": [PlannedVisit((0, 0, 0), -1.0)]}, "positive time"),
        ({"sample_hz": 0.0}, "sample_hz"),
        ({"angle_hz": math.nan}, "angle_hz"),
        ({"slew_rate_degps": 0.0}, "positive"),
    ],
)
def test_impossible_runs_are_refused(change, words):
    with pytest.raises(InputError, match=words):
        Simulation(**{"bench": BENCH, "sensors": ORTHOGONAL, "noise": QUIET, "plan": STILL} | change)


def test_impossible_sensors_and_noise_are_refused():
    with pytest.raises(InputError, match="theta2"):
        Sensors({"theta2": 0.0})
    with pytest.raises(InputError, match="white_mps2"):
        TrueNoise(white_mps2=-1.0)
    with pytest.raises(InputError, match="ar1_phi"):
        TrueNoise(white_mps2=1.0, ar1_phi=1.0)


def _lag_one(noise: np.ndarray) -> np.ndarray:
    centred = noise - noise.mean(axis=0)
    return np.sum(centred[1:] * centred[:-1], axis=0) / np.sum(centred**2, axis=0)
