"""Sizes of hidden effects in sigma, against generalised least squares written out sample by sample."""

import json
import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from helpers.bounded import traced
from helpers.long_runs import slow
from helpers.recordings import read, record

from kf_calib.bench.bench import Bench, axes_of
from kf_calib.errors import InputError
from kf_calib.sources.simulation.detectability import sized, sizes_in_sigma, truth_of, write_truth
from kf_calib.sources.simulation.injected import Hidden, NoSizeError, catalogue, parse
from kf_calib.sources.simulation.physics import Ambient
from kf_calib.sources.simulation.sensors import GRADES, Sensors, TrueNoise
from kf_calib.sources.simulation.simulator import Simulation
from kf_calib.sources.simulation.visit_plans import PlannedVisit, spread_plan

G = 9.81
BENCH = Bench(axes=axes_of("yzx"), gravity_mps2=G, latitude_deg=50.0)
SENSORS = GRADES["mems"].sensors(1)
WHITE = TrueNoise(white_mps2=2e-4)
NOISES = {
    "white": WHITE,
    "AR(1)": replace(WHITE, ar1_phi=0.6),
    "setting error": replace(WHITE, setting_sigma_deg=0.002),
    "scatter": replace(WHITE, scatter_mps2=1e-4),
    "all": TrueNoise(2e-4, ar1_phi=0.3, flicker_mps2=7e-5, scatter_mps2=1e-4, setting_sigma_deg=0.001),
}
DWELL_S, HZ, COUNT = 6.0, 2.5, 12
PLAN = spread_plan(COUNT, dwell_s=DWELL_S, seed=2)
AMBIENT = Ambient(swing_c=3.0, period_s=40.0)


def simulation(noise: TrueNoise = WHITE, bench: Bench = BENCH, **options) -> Simulation:
    """Platform jumps: dwell k lasts from 6 k s to 6 (k + 1) s."""
    options = {"sample_hz": HZ, "slew_rate_degps": math.inf, "ambient": AMBIENT, "seed": 5} | options
    return Simulation(bench, options.pop("sensors", SENSORS), noise, options.pop("plan", PLAN), **options)


def size(run: Simulation, text: str) -> float | None:
    return sizes_in_sigma(run, parse([text], BENCH.axes))[0]


def asked(run: Simulation, text: str, **options) -> Hidden:
    return parse([text], BENCH.axes, sized=partial(sized, run), **options)[0]


# -- the same number, sample by sample --

DWELL = np.repeat(np.arange(COUNT), int(DWELL_S * HZ))
TIME_S = np.arange(len(DWELL)) / HZ
SINCE_S = TIME_S - DWELL_S * DWELL
COUNTS = (SINCE_S >= 1.0) & (SINCE_S < DWELL_S - 0.25)


def force(q2: np.ndarray, q3: np.ndarray) -> np.ndarray:
    """Specific force (n, 3) in the platform at true angles of the y z x gimbals."""
    return G * np.column_stack([np.sin(q2), np.cos(q2) * np.cos(q3), -np.cos(q2) * np.sin(q3)])


ANGLES = np.radians([visit.gimbal_deg for visit in PLAN])
FORCE = force(ANGLES[:, 1], ANGLES[:, 2])[DWELL]
INPUT = FORCE @ SENSORS.input_axes.T
STEP = np.diff(INPUT[np.searchsorted(DWELL, range(COUNT))], axis=0, prepend=INPUT[:1])[DWELL]


def encoder_error(size: float) -> np.ndarray:
    q2 = ANGLES[:, 1] + size * np.sin(ANGLES[:, 1]) - size * np.cos(ANGLES[:, 1])
    return (force(q2, ANGLES[:, 2])[DWELL] - FORCE) @ SENSORS.sensitivities.T


ADDED = {
    "second-order=1e-5,2e-5,-3e-5": np.array([1, 2, -3]) * 1e-5 * INPUT**2,
    "bias-drift=1e-5,-2e-5,0": np.array([1, -2, 0]) * 1e-5 * TIME_S[:, None],
    "encoder-harmonic-1:z=1e-4,-1e-4": encoder_error(1e-4),
    "encoder-harmonic-1:z=3e-2,-3e-2": encoder_error(3e-2),
    "settling=1e-4,2e-4,0;tau=2": np.array([1, 2, 0]) * 1e-4 * STEP * np.exp(-SINCE_S / 2.0)[:, None],
    "hysteresis=1e-3,-1e-3,2e-3": np.array([1, -1, 2]) * 1e-3 * np.sign(STEP),
    "sinusoid=1e-3,0,0;frequency=1.1;phase=0": np.outer(np.sin(2 * np.pi * 1.1 * TIME_S), [1e-3, 0, 0]),
}


def covariance(noise: TrueNoise, force: np.ndarray, dwell: np.ndarray, sensors: Sensors = SENSORS) -> np.ndarray:
    """V (3 n, 3 n), sample after sample."""
    together = dwell[:, None] == dwell
    flicker = noise.flicker_mps2**2 * max(np.log(COUNT) / (2 * np.log(2)), 1)  # means of dwells about their mean
    offset = noise.scatter_mps2**2 + flicker
    white = noise.white_mps2**2 * (1 + noise.ar1_phi) / (1 - noise.ar1_phi)
    v = np.kron(white * np.eye(len(dwell)) + offset * together, np.eye(3))
    for axis in np.eye(3):  # a turn about each axis of the platform
        felt = (np.cross(force, axis) @ sensors.sensitivities.T).ravel()
        v += math.radians(noise.setting_sigma_deg) ** 2 * np.outer(felt, felt) * np.kron(together, np.ones((3, 3)))
    return v


def left_over(values: np.ndarray, v: np.ndarray, force: np.ndarray) -> np.ndarray:
    """V^(-1/2) of values (n, 3) or (n, 3, m), less what twelve affine parameters absorb: (3 n, m)."""
    design = np.kron(np.column_stack([force / G, np.ones(len(force))]), np.eye(3))
    root = np.linalg.cholesky(v)
    design, whitened = np.linalg.solve(root, design), np.linalg.solve(root, values.reshape(len(v), -1))
    return whitened - design @ np.linalg.lstsq(design, whitened, rcond=None)[0]


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("text", ADDED)
def test_size_is_that_of_generalised_least_squares(text, noise):
    v = covariance(NOISES[noise], FORCE[COUNTS], DWELL[COUNTS])
    expected = np.linalg.norm(left_over(ADDED[text][COUNTS], v, FORCE[COUNTS]))
    assert size(simulation(NOISES[noise]), text) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("setting_deg", [1e3, 1e6])
def test_where_attitudes_are_not_known_the_size_is_that_along_the_force(setting_deg):
    """Of each dwell one combination of the readings is left, m = S^-T f, which no rotation changes."""
    firsts = np.searchsorted(DWELL, range(COUNT))
    weights = np.linalg.solve(SENSORS.sensitivities.T, FORCE[firsts].T).T
    scales = np.linalg.norm(weights, axis=1) * WHITE.white_mps2 / np.sqrt(np.bincount(DWELL[COUNTS]))
    text = "second-order=1e-5,2e-5,-3e-5"
    along = np.sum(weights * ADDED[text][firsts], axis=1) / scales
    affine = np.column_stack([FORCE[firsts] / G, np.ones(COUNT)])
    design = (weights[:, :, None] * affine[:, None, :]).reshape(COUNT, 12) / scales[:, None]
    expected = np.linalg.norm(along - design @ np.linalg.lstsq(design, along, rcond=1e-12)[0])
    assert size(simulation(replace(WHITE, setting_sigma_deg=setting_deg)), text) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("name", ["second-order", "bias-drift", "encoder-harmonic-1:z", "settling", "hysteresis"])
def test_what_is_asked_for_is_what_generalised_least_squares_finds(name, noise):
    run = simulation(NOISES[noise])
    effect = asked(run, f"{name}=10sigma")
    with_effect, without = (read(run.hiding(hidden, TrueNoise())).accel.values for hidden in ([effect], []))
    v = covariance(NOISES[noise], FORCE[COUNTS], DWELL[COUNTS])
    assert np.linalg.norm(left_over((with_effect - without)[COUNTS], v, FORCE[COUNTS])) == pytest.approx(10, rel=0.02)


def test_on_a_stabilised_platform_the_force_turns_within_a_dwell():
    bench = replace(BENCH, reference="inertial")
    noise, nominal = NOISES["all"], Sensors({"theta1": 0.0, "theta3": 0.0})  # whose readings are the specific force
    run = simulation(noise, bench, plan=[PlannedVisit(visit.gimbal_deg, 60.0) for visit in PLAN], sample_hz=0.5)
    felt, without, with_effect = (
        read(some).accel.values
        for some in (
            simulation(TrueNoise(), bench, plan=run.plan, sample_hz=0.5, sensors=nominal),
            run.hiding([], TrueNoise()),
            run.hiding(parse(["earth-rotation=0.01"], BENCH.axes), TrueNoise()),
        )
    )
    counts = (np.arange(len(felt)) % 30 >= 1) & (np.arange(len(felt)) % 30 * 2 < 60 - 0.25)
    v = covariance(noise, felt[counts], np.repeat(np.arange(COUNT), 30)[counts])
    expected = np.linalg.norm(left_over((with_effect - without)[counts], v, felt[counts]))
    assert np.ptp(felt[:30], axis=0).max() > 1e-2
    assert size(run, "earth-rotation=0.01") == pytest.approx(expected, rel=1e-3)


@pytest.mark.slow
def test_misfit_rises_by_the_square():
    """In the simulator's own noise; the mean over the seeds of n^2 + 2 n z, z normal."""
    noise = replace(NOISES["all"], ar1_phi=0.0, flicker_mps2=0.0)
    effect = asked(simulation(noise), "second-order=10sigma")
    runs = [simulation(noise, seed=seed, hidden=hidden) for hidden in ([effect], []) for seed in range(60)]
    values = np.stack([read(run).accel.values for run in runs], axis=2)
    left = left_over(values[COUNTS], covariance(noise, FORCE[COUNTS], DWELL[COUNTS]), FORCE[COUNTS])
    with_effect, without = np.sum(left**2, axis=0).reshape(2, 60)
    assert np.mean(without) == pytest.approx(3 * np.count_nonzero(COUNTS) - 12, rel=0.03)
    assert np.mean(with_effect - without) == pytest.approx(100, abs=4 * 2 * 10 / math.sqrt(60))
    assert np.std(with_effect - without) == pytest.approx(2 * 10, rel=0.4)


# -- every kind of effect --

UNSEEN = {
    "latency", "gravity-error", "encoder-offset:y", "encoder-offset:x", "encoder-scale:y", "encoder-harmonic-1:y",
    "encoder-harmonic-2:y", "encoder-harmonic-3:y", "backlash:y", "lever-arm", "cross-talk", "dead-zone",
}  # fmt: skip
RECORDED = {"outliers", "saturation", "quantisation"}
NAMES = [
    f"{name}:{axis}" if axis else name
    for name, kind in catalogue().items()
    for axis in ("yzx" if kind.per_axis else [""])
]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("grade", ["navigation", *slow("mems")])
def test_every_effect_has_the_size_asked_for_or_a_sentence(name, grade):
    sensors, noise = GRADES[grade].sensors(3), GRADES[grade].noise
    run = simulation(noise, sensors=sensors, sample_hz=20.0, slew_rate_degps=90.0)
    if name in UNSEEN | RECORDED:
        with pytest.raises(NoSizeError, match=r"so no size in sigma exists for it: give a size with a unit\.$") as told:
            asked(run, f"{name}=10sigma", grade=grade)
        reason = "acts on readings together with their noise" if name in RECORDED else "cannot be seen with these"
        assert f"{name} {reason}" in str(told.value)
        assert sizes_in_sigma(run, parse([f"{name}=1e-3"], BENCH.axes)) == [None]
        return
    effect = asked(run, f"{name}=10 sigma", grade=grade)
    assert sizes_in_sigma(run, [effect])[0] == pytest.approx(10, rel=0.01)
    drawn = parse([f"{name}=1"], BENCH.axes)[0].sizes  # the same signs
    np.testing.assert_allclose(effect.sizes, np.abs(effect.sizes[0]) * np.array(drawn), rtol=1e-12)


def test_large_sizes_of_what_is_not_proportional():
    run = simulation(replace(WHITE, white_mps2=0.05))
    for text in ("encoder-harmonic-1:z=300sigma", "axis-nonorthogonality:z=300sigma", "flexure=300sigma"):
        assert sizes_in_sigma(run, [asked(run, text)])[0] == pytest.approx(300, rel=0.01)
    with pytest.raises(NoSizeError, match=r"comes to 1e\+06 sigma at no size"):  # a circle has no more
        asked(run, "encoder-harmonic-1:z=1e6sigma")


def test_temperature_that_does_not_change_shows_nothing():
    run = simulation(ambient=Ambient())
    with pytest.raises(NoSizeError, match="thermal-scale cannot be seen with these orientations and temperatures"):
        asked(run, "thermal-scale=10sigma")


def test_an_odd_nonlinearity_does_not_show_on_six_faces():
    poses = [(0, 90, 0), (0, -90, 0), (0, 0, 0), (0, 180, 0), (0, 0, -90), (0, 0, 90)]
    run = simulation(plan=[PlannedVisit(pose, 10.0) for pose in poses])
    assert size(run, "third-order=1e-4") is None and size(run, "second-order=1e-4") is not None


def test_vibration_itself_does_not_count_to_its_rectification():
    run = simulation(sample_hz=100.0)
    one, ten = (size(run, f"vibration-rectification={k};period=20") for k in ("1e-6", "1e-5"))
    assert one is not None and one < 5 and ten == pytest.approx(10 * one, rel=1e-6)


def test_of_a_rectified_vibration_its_mean_over_a_cycle_counts():
    """K2 rms^2 sin^4(pi t / T), beside what a bias absorbs; as much is at twice its frequency."""
    run = simulation(sample_hz=100.0, plan=[PlannedVisit((0, 0, 0), 400.0)])
    found = size(run, "vibration-rectification=1e-6,0,0;rms=2;period=20")
    t = np.arange(100.0, 39_975.0) / 100.0
    mean = 1e-6 * 4.0 * np.sin(np.pi * t / 20.0) ** 4
    assert found == pytest.approx(float(np.linalg.norm(mean - mean.mean())) / run.noise.white_mps2, rel=1e-3)


def test_size_does_not_depend_on_batches_nor_on_what_else_is_hidden():
    texts = ["settling=1e-4", "thermal-lag=1e-4;tau=30", "telegraph=1e-4;tau=20", "vibration-rectification=1e-5"]
    options = {"sample_hz": 20.0, "slew_rate_degps": 90.0}
    together = sizes_in_sigma(simulation(**options), parse(texts, BENCH.axes))
    np.testing.assert_allclose([size(simulation(**options), text) for text in texts], together, rtol=1e-9)
    cut = sizes_in_sigma(simulation(batch_samples=17, **options), parse(texts, BENCH.axes))
    np.testing.assert_allclose(cut, together, rtol=1e-9)


def test_memory_stays_flat():
    def peak(dwell_s: float) -> int:
        plan = spread_plan(4, dwell_s=dwell_s)
        run = simulation(plan=plan, sample_hz=500.0, batch_samples=1000)
        with traced() as found:
            size(run, "settling=1e-4")
        return found.bytes

    peak(1.0)
    assert peak(20.0) < 1.2 * peak(4.0)


def test_without_white_noise_there_is_no_size():
    run = simulation(TrueNoise(scatter_mps2=1e-4))
    assert size(run, "second-order=1e-5") is None
    for text in ("second-order=10sigma", "random=10sigma"):
        with pytest.raises(InputError, match="white noise"):
            asked(run, text)


# -- texts --


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("second-order=0sigma", "one positive number"),
        ("second-order=-3 sigma", "one positive number"),
        ("second-order=sigma", "one positive number"),
        ("second-order=10sigma,2", "one positive number"),
        ("second-order=1,2,3sigma", "one positive number"),
        ("second-order=10ugsigma", "one positive number"),
        ("second-order=infsigma", "one positive number"),
        ("random=4e-5", "write random=10sigma or random"),
        ("random-known=", "write random-known=10sigma or random-known"),
        ("second-order=10sigma;tau=3", "no constant 'tau'"),
    ],
)
def test_sizes_that_cannot_be_are_refused_in_one_sentence(text, words):
    with pytest.raises(InputError, match=words) as caught:
        asked(simulation(), text)
    assert "\n" not in str(caught.value)


def test_sizes_in_sigma_need_a_run():
    for text in ("second-order=10sigma", "random=10sigma"):
        with pytest.raises(InputError, match="needs a run"):
            parse([text], BENCH.axes)


def test_each_axis_gets_the_size_and_constants_stand():
    run = simulation()
    effects = parse(["axis-nonorthogonality=5sigma"], BENCH.axes, sized=partial(sized, run))
    assert [effect.name[-2:] for effect in effects] == [":y", ":z", ":x"]
    np.testing.assert_allclose(np.array(sizes_in_sigma(run, effects), float), 5, rtol=0.01)
    assert asked(run, "settling=10sigma;tau=3").truth["inner"]["tau"]["value"] == 3.0


@pytest.mark.slow
def test_random_draws_what_can_be_seen():
    run = simulation(sample_hz=10.0)
    names = set[str]()
    for seed in range(12):
        for pool, sigmas, known in (
            ("random", 10, {True, False}),
            ("random-known", 8, {True}),
            ("random-unknown", 15, {False}),
        ):
            effect = asked(run, f"{pool}={sigmas}sigma", seed=seed)
            assert effect.kind.known in known and effect.name not in UNSEEN | RECORDED
            assert sizes_in_sigma(run, [effect])[0] == pytest.approx(sigmas, rel=0.01)
            names.add(effect.name)
    assert len(names) > 12
    again, same = (asked(run, "random=10sigma", seed=3) for _ in range(2))
    assert again.truth == same.truth
    plain = parse(["random"], BENCH.axes, seed=3)[0]  # what is drawn first, if it can be seen
    assert again.kind == plain.kind or plain.name in UNSEEN | RECORDED
    several = parse(["random=5sigma"] * 3, BENCH.axes, seed=1, sized=partial(sized, run))
    assert len({effect.name for effect in several}) == 3


def test_nothing_to_draw():
    run = simulation(plan=[PlannedVisit((0, 0, 0), 6.0)], ambient=Ambient(), sensors=Sensors(), sample_hz=0.1)
    with pytest.raises(InputError, match="no effect that was drawn can be seen"):
        asked(run, "random-known=10sigma")


# -- truth and recording --


def test_truth_tells_the_size_of_every_effect_and_the_recording_none(tmp_path):
    bare = simulation()
    texts = ["second-order=10sigma", "bias-drift=2e-5", "gravity-error=1e-4", "outliers=0.1"]
    run = bare.hiding(parse(texts, BENCH.axes, sized=partial(sized, bare)))
    path = tmp_path / "run.mcap"
    record(path, read(run), BENCH)
    effects = {effect["name"]: effect for effect in json.loads(write_truth(run, path).read_text())["effects"]}
    assert effects["second-order"]["size_sigma"] == pytest.approx(10, rel=0.01)
    assert effects["bias-drift"]["size_sigma"] == pytest.approx(size(bare, "bias-drift=2e-5"), rel=1e-9)
    assert effects["gravity-error"]["size_sigma"] is None and effects["outliers"]["size_sigma"] is None
    assert not any(word in path.read_bytes() for word in (b"second-order", b"sigma_", b"size", b"hidden", b"10sigma"))
    assert truth_of(simulation())["effects"] == []


def test_hiding_leaves_the_run_as_it_was():
    run = simulation()
    before = read(run).accel.values
    other = run.hiding(parse(["second-order=1e-3"], BENCH.axes))
    changed = read(other).accel.values
    assert run.hidden == () and len(other.hidden) == 1 and other.noise is run.noise
    np.testing.assert_array_equal(read(run).accel.values, before)
    assert np.abs(changed - before).max() > 1e-3
