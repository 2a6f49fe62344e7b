"""A set-up that is wrong is refused with what mends it; what mends it, mends it; and a sound one is left alone."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations, product
from pathlib import Path

import numpy as np
import pytest
from helpers.altered import Altered, short_run
from helpers.long_runs import slow
from helpers.thresholds import begins_at
from scipy.spatial.transform import Rotation

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench, parse_axes
from kf_calib.bench.keys import UP
from kf_calib.bench.raw_input import RawInput, parse_channels
from kf_calib.bench.streams import Table
from kf_calib.dwells.blocks import SampleCounts
from kf_calib.dwells.table import DwellTable
from kf_calib.errors import BlunderError, InputError
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.dwell_pass import refuse_unusable
from kf_calib.estimation.setup_blunders import common_scale
from kf_calib.sources.opening import opened
from kf_calib.sources.text.means import open_table


def reordered(*channels: int):
    """Readings as they come where accelerometer i is wired to channel |channels[i]|."""

    def change(_: Floats, readings: Floats) -> Floats:
        out = np.empty_like(readings)
        for i, channel in enumerate(channels):
            out[:, abs(channel) - 1] = np.sign(channel) * readings[:, i]
        return out

    return change


def mended(bench: Bench, message: str) -> list[Bench]:
    """The benches that a message's options would state."""
    out = []
    for options in re.findall(r"--(?:up|axes|channels)[^)?]*?(?=[),]? (?:or|and)|\)|\.$)", message):
        words = shlex.split(options.rstrip("."))
        keys = dict(zip(words[::2], words[1::2], strict=True))
        axes = parse_axes(keys["--axes"]) if "--axes" in keys else bench.axes
        channels = parse_channels(keys["--channels"]) if "--channels" in keys else bench.input.channels
        out.append(replace(bench, axes=axes, input=RawInput(channels), up=keys.get("--up", bench.up)))
    return out


def refused(source: Altered) -> str:
    with pytest.raises(BlunderError) as told:
        calibrate(source)
    return str(told.value)


WIRINGS = [
    tuple(sign * place for sign, place in zip(signs, places, strict=True))
    for places in permutations((1, 2, 3))
    for signs in product((1, -1), repeat=3)
]
WRONG = [wiring for wiring in WIRINGS if wiring != (1, 2, 3)]


@pytest.mark.parametrize("channels", [*WRONG[::8], *slow(*((w,) for k, w in enumerate(WRONG) if k % 8))], ids=str)
def test_each_of_47_wrong_wirings_is_refused_and_its_mending_mends(channels: tuple[int, int, int]) -> None:
    run = short_run(count=8, dwell_s=1.5)
    source = Altered(run, reordered(*channels))
    options = mended(run.bench, refused(source))
    assert options
    for bench in options:
        source.bench = bench
        result = calibrate(source)
        assert result.consistency.consistent
    source.bench = replace(run.bench, input=RawInput(channels))
    found = calibrate(source).parameters
    for symbol, expected in run.sensors.parameters.items():
        assert found[symbol].value == pytest.approx(expected, abs=6 * found[symbol].sigma)


@pytest.mark.parametrize(
    ("readings", "poses", "words"),
    [
        (reordered(1, -2, 3), None, "channel 2 reads -g where +g is expected: channel 2 reversed? Try --channels 1,-2"),
        (reordered(2, 1, 3), None, "channels 1 and 2 are exchanged? Try --channels 2,1,3."),
        (reordered(2, 3, 1), None, "Try --channels 2,3,1."),
        (reordered(-1, -2, -3), None, "acceleration in place of specific force"),
        (None, lambda _, q: q * [1, -1, 1], 'gimbal z turns the other way (--axes "y -z x")'),
        (None, lambda _, q: q * [1, 1, -1], 'gimbal x turns the other way (--axes "y z -x")'),
        (None, lambda _, q: np.degrees(q), "the angles are in degrees? Try --angle-unit deg."),
        (None, lambda _, q: np.radians(q), "turned from degrees into radians twice"),
        (None, lambda _, q: q[:, ::-1], "--joints"),
        (None, lambda _, q: q * [1, 0, 0], "in many orientations, the angles in few, and no order or sign of channels"),
        (lambda _, a: a * [1, 1, 1e-6], None, "channel 3 is dead"),
        (lambda _, a: np.where([True, True, False], a, 0.3), None, "channel 3 is stuck: all along it reads 0.3"),
        (lambda _, a: a * [1, 1 / 9.80665, 1], None, "channel 2 feels 0."),
        (
            lambda t, a: np.where((t > 60)[:, None], a[:, [1, 0, 2]], a), None,
            "up to dwell 8 channels are as stated, from dwell 9 on (at 67 s) channels 1 and 2 are exchanged",
        ),
        (lambda t, a: np.where((t > 60)[:, None] & [False, False, True], 1.5, a), None, "stuck: from dwell 9 on"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("grade", ["navigation", *slow("mems")])
def test_blunders_are_named(grade: str, readings, poses, words: str) -> None:
    assert words in refused(Altered(short_run(grade=grade), readings, poses))


def test_a_bench_with_z_up_that_is_said_to_be_the_usual_one() -> None:
    run = short_run({"axes": "z y x", "up": "z"})
    source = Altered(run, bench=replace(run.bench, axes=parse_axes("y z x"), up="y"))
    message = refused(source)
    assert message.index("z is up when all angles are zero") < message.index('(--axes "z y x" --up z)')
    for bench in mended(source.bench, message):
        source.bench = bench
        assert calibrate(source).consistency.consistent


@pytest.mark.parametrize("up", UP)
def test_any_axis_may_be_up(up: str) -> None:
    run = short_run({"axes": "z y x", "up": up, "channels": "-3,1,2"}, count=12)
    result = calibrate(run)
    assert result.consistency.consistent
    errors = [(p.value - run.sensors.parameters[s]) / p.sigma for s, p in result.parameters.items()]
    assert np.abs(errors).max() < 4.0


@pytest.mark.parametrize(
    "options", [{}, {"plan": "faces"}, {"count": 4}, {"count": 3}, {"grade": "mems"}, {"grade": "paper"}], ids=str
)
def test_sound_runs_are_left_alone(options) -> None:
    for seed in range(3):
        calibrate(short_run(seed=seed, **options))


def test_a_block_that_is_mounted_so_is_stated() -> None:
    """An accelerometer that does point the other way: K2 is negative, and parameters and state are one to one."""
    run = short_run()
    bench = replace(run.bench, nominal={"K2": -1.0})
    k2 = calibrate(Altered(run, reordered(1, -2, 3), bench=bench)).parameters["K2"]
    assert k2.value == pytest.approx(-run.sensors.parameters["K2"], abs=6 * k2.sigma)


def test_attitudes_of_the_inverse_rotation_are_told() -> None:
    run = short_run()
    source = Altered(
        run, poses=lambda _, q: np.column_stack([-q[:, :3], q[:, 3]]), bench=replace(run.bench, axes=())
    )  # fmt: skip
    run.bench = source.bench
    assert "the attitude is that of the bench in the platform" in refused(source)


def test_scale_factors_that_are_all_off_by_the_same() -> None:
    bench = Bench(parse_axes("y z x"), 9.8123)
    local = np.full(3, 9.80665 / 9.8123)
    differing, sigmas = np.array([1e-6, 0.0, -1e-6]), np.full(3, 1e-6)
    assert "--accel-scale 1.0005761" in common_scale(local + differing, sigmas, bench)
    assert "not 9.8123 m/s^2 as stated, but 9.82211" in common_scale(np.full(3, 1.001), sigmas, bench)
    assert not common_scale(1.0 + np.array([3e-4, 2e-4, 3e-4]), sigmas, bench)
    assert not common_scale(np.full(3, 1.0 + 3e-6), sigmas, bench)

    run = short_run({"gravity_mps2": "9.8123"})
    scales = np.array([run.sensors.parameters[f"K{i}"] for i in (1, 2, 3)])
    notes = calibrate(Altered(run, lambda _, a: a * local / scales)).warnings
    assert "off by the same -576 ppm" in " ".join(notes)
    assert "off by the same" not in " ".join(calibrate(run).warnings)


@pytest.mark.parametrize(("sigma", "least", "apart"), [(1e-7, 20e-6, 50e-6), (1e-4, 500e-6, 300e-6)])
def test_scale_factors_are_off_by_the_same_from_five_sigma_and_20_ppm_on(
    sigma: float, least: float, apart: float
) -> None:
    """If all three are within three sigma of their mean, or a twentieth of it: that of three about 1000 ppm."""
    bench, sigmas = Bench(parse_axes("y z x"), 9.8123), np.array([0.0, sigma, 0.0])
    off = begins_at(lambda each: common_scale(np.full(3, 1.0 + each), sigmas, bench), 1e-6, 1e-2)
    assert off == pytest.approx(least, rel=1e-6)
    sides = np.array([1.0, 0.0, -1.0])
    off = begins_at(lambda each: not common_scale(1.001 + each * sides, sigmas, bench), 1e-6, 1e-2)
    assert off == pytest.approx(apart, rel=1e-6)


def test_angles_look_like_degrees_from_three_turns_on() -> None:
    """Of a gimbal in which nothing stands still; the farthest angle is told in turns."""
    bench = Bench(parse_axes("y z x"), 9.8123)

    def refusal(turns: float) -> str:
        with pytest.raises(InputError) as refused:
            refuse_unusable(
                DwellTable.of([]), SampleCounts(read=1000, poses=100, farthest_rad=2.0 * np.pi * turns), bench
            )
        return str(refused.value)

    assert begins_at(lambda turns: "degrees" in refusal(turns), 0.1, 100.0) == pytest.approx(3.0)
    assert "angles of up to 57 turns look like degrees" in refusal(57.3)


def test_degrees_of_a_noisy_encoder_in_which_nothing_stands_still() -> None:
    run = short_run(encoder_sigma_deg=0.2, angle_hz=50.0)
    with pytest.raises(InputError, match=r"look like degrees \(--angle-unit deg\)"):
        calibrate(Altered(run, poses=lambda _, q: np.degrees(q)))


FACES = {"+x": (1, 0, 0), "-x": (-1, 0, 0), "+y": (0, 1, 0), "-y": (0, -1, 0), "+z": (0, 0, 1), "-z": (0, 0, -1)}


def means_of_faces(order: Sequence[str], seed: int) -> Floats:
    """Means (6, 3) of six faces by sensors of 0.3 % and 10 mg, 1 mrad from square."""
    rng = np.random.default_rng(seed)
    sensitivity = np.eye(3) * (1.0 + 0.003 * rng.normal(size=3)) + 1e-3 * rng.normal(size=(3, 3))
    return 9.81 * (np.array([FACES[name] for name in order], float) @ sensitivity.T + 0.01 * rng.normal(size=3))


def faces_in_order(order: Sequence[str], reversed_channel: int, seed: int) -> Table:
    """The table of six faces with one channel reversed."""
    means = means_of_faces(order, seed)
    means[:, reversed_channel - 1] *= -1.0
    columns = {"face": list(order), **{f"a{axis}_mps2": means[:, k] for k, axis in enumerate("xyz")}}
    return open_table(columns, {"gravity_mps2": "9.81"})


@pytest.mark.parametrize("channel", [1, 2, 3])
def test_a_reversed_channel_is_told_in_whatever_order_the_faces_come(channel: int) -> None:
    """Where the first dwells lie along one axis, the signs of the other two channels do not show in them; that is no
    change in the course of the run."""
    channels = ["1", "2", "3"]
    channels[channel - 1] = f"-{channel}"
    orders = list(permutations(FACES))
    for seed, order in enumerate(orders[channel :: len(orders) // 24]):
        with pytest.raises(BlunderError) as told:
            calibrate(faces_in_order(order, channel, seed))
        assert f"channel {channel} reversed? Try --channels {','.join(channels)}." in str(told.value)


@pytest.mark.parametrize("dwell", range(6))
def test_one_reading_of_the_wrong_sign_is_told_by_its_dwell(dwell: int) -> None:
    """Of a face only the reading along it is large: its sign, or the face, is wrong."""
    means, channel = means_of_faces(list(FACES), dwell), dwell // 2
    columns = {"face": list(FACES), **{f"a{axis}_mps2": means[:, k] for k, axis in enumerate("xyz")}}
    calibrate(open_table(columns, {"gravity_mps2": "9.81"}))
    means[dwell, channel] *= -1.0
    with pytest.raises(BlunderError, match=rf"dwell {dwell + 1} .*channel {channel + 1} reads .*--leave-out"):
        calibrate(open_table(columns, {"gravity_mps2": "9.81"}))


@pytest.mark.parametrize("channel", [1, 2, 3])
def test_a_reversed_channel_in_a_run_that_begins_along_z_is_told(channel: int) -> None:
    """Twelve orientations after four along z: outer gimbal about z, inner about x, y up."""
    rng = np.random.default_rng(channel)
    outer = np.concatenate([np.zeros(4), rng.uniform(0.0, 360.0, 12)])
    inner = np.concatenate([[90.0, 270.0, 90.0, 270.0], rng.uniform(0.0, 360.0, 12)])
    bench = Bench(parse_axes("z x"), 9.81)
    force = bench.specific_force(np.zeros(16), np.radians(np.column_stack([outer, inner])))
    assert np.abs(force[:4, 2]) == pytest.approx(9.81)
    means = force + rng.normal(0.0, 0.02, 3)
    means[:, channel - 1] *= -1.0
    columns = {
        "outer [deg]": outer,
        "inner [deg]": inner,
        **{f"a{axis}_mps2": means[:, k] for k, axis in enumerate("xyz")},
    }
    with pytest.raises(BlunderError, match=f"channel {channel} reversed"):
        calibrate(open_table(columns, {"axes": "z x", "gravity_mps2": "9.81"}))


@pytest.mark.parametrize("tail", [("+y", "-y", "+z", "-z"), ("+x", "+y")])
def test_channels_that_are_exchanged_late_are_still_a_change_in_the_course_of_the_run(tail: tuple[str, ...]) -> None:
    """Up to the last two of 18 dwells."""
    rng = np.random.default_rng(7)
    order = [*FACES, *FACES, *(name for name in FACES if name not in tail), *tail]
    means = 9.81 * np.array([FACES[name] for name in order], float) + rng.normal(0.0, 0.05, 3)
    means += rng.normal(0.0, 1e-3, means.shape)
    last = 18 - len(tail)
    means[last:] = means[last:, [1, 0, 2]]
    columns = {"face": order, **{f"a{axis}_mps2": means[:, k] for k, axis in enumerate("xyz")}}
    told = rf"up to dwell {last} channels are as stated, from dwell {last + 1} on .* exchanged"
    with pytest.raises(BlunderError, match=told):
        calibrate(open_table(columns, {"gravity_mps2": "9.81"}))


@pytest.mark.parametrize("level, said", [(0.0, "all readings are zero"), (9.81, "the readings never change")])
def test_readings_of_a_sensor_that_stands_still_in_itself_are_told(level: float, said: str, tmp_path: Path) -> None:
    path = tmp_path / "still.csv"
    rows = [f"{0.01 * k:.2f},0,0,{level}" for k in range(600)]
    path.write_text("\n".join(["time_s,ax_mps2,ay_mps2,az_mps2", *rows]) + "\n")
    with pytest.raises(InputError, match=said):
        calibrate(opened(path, angles=False))


def nearly_level(upside: str, seed: int = 1, poses: int = 10) -> Table:
    """Attitudes within some degrees of level with z up, of sensors of 0.5 % and 10 mg, as a bench whose ``upside`` is
    up."""
    rng = np.random.default_rng(seed)
    attitudes = Rotation.from_euler("ZXY", rng.uniform(-1.0, 1.0, (poses, 3)) * [180.0, 4.0, 4.0], degrees=True)
    force = attitudes.inv().apply([0.0, 0.0, 9.81])
    means = force * (1.0 + 0.005 * rng.normal(size=3)) + rng.normal(0.0, 0.1, 3) + rng.normal(0.0, 1e-3, force.shape)
    columns = {f"a{axis}_mps2": means[:, k] for k, axis in enumerate("xyz")}
    columns |= {f"q{axis}": attitudes.as_quat()[:, k] for k, axis in enumerate("xyzw")}
    return open_table(columns, {"gravity_mps2": "9.81", "up": upside})


@pytest.mark.parametrize("seed", range(3))
def test_nearly_level_poses_under_another_axis_that_is_up_are_refused(seed: int) -> None:
    assert len(calibrate(nearly_level("z", seed)).visits) == 10
    with pytest.raises(BlunderError, match=r"not those of the stated mounting.*--up z") as told:
        calibrate(nearly_level("y", seed))
    assert told.value.options in ("--up z", "")
    with pytest.raises(BlunderError, match="--up z"):
        calibrate(nearly_level("-z", seed))
