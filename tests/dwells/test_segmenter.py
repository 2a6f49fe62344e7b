"""Dwells from the angles' own stillness, and from the readings where angles are absent during a motion."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from helpers.synthetic import G, Run

from kf_calib.bench.bench import Bench, axes_of
from kf_calib.bench.streams import Batch, Stream
from kf_calib.dwells.blocks import carry_on
from kf_calib.dwells.segmenter import Segmenter, dwell_blocks
from kf_calib.dwells.stationarity import Stillness
from kf_calib.errors import InputError
from kf_calib.estimation.calibration import calibrate

S = 1_000_000_000
BENCH = Bench(axes_of("zx"), 9.81)


class Given:
    warnings: tuple[str, ...] = ()
    fraction = 1.0

    def __init__(self, *batches: Batch, bench: Bench = BENCH) -> None:
        self.batches, self.bench = batches, bench

    def __iter__(self):
        return iter(self.batches)


def path(*points: tuple[float, float], rate_hz: float, noise_deg: float = 0.0) -> Stream:
    """Angle messages on a broken line of (seconds, degrees) of the first axis."""
    seconds, degrees = np.array(points).T
    at = np.arange(seconds[0], seconds[-1], 1 / rate_hz)
    angles = np.interp(at, seconds, degrees) + np.random.default_rng(0).normal(size=len(at)) * noise_deg
    return Stream(np.round(at * S).astype(np.int64), np.column_stack([np.radians(angles), 0 * at]))


def readings(pose: Stream, until_s: float, rate_hz: float = 100.0) -> Stream:
    at = np.arange(0, until_s, 1 / rate_hz)
    angle = np.interp(at * S, pose.time_ns, pose.values[:, 0])
    values = 9.81 * np.column_stack([np.sin(angle), np.cos(angle), 0 * at])
    values += np.random.default_rng(1).normal(size=values.shape) * 1e-3
    return Stream(np.round(at * S).astype(np.int64), values)


def spans(source: Given, **how) -> list[tuple[float, float]]:
    segmenter = Segmenter(source.bench, Stillness(**how))
    found: dict[int, list[float]] = {}
    for block in dwell_blocks(source, segmenter):
        found.setdefault(block.dwell, []).extend([block.elapsed_s[0], block.elapsed_s[-1]])
    spans.counts = segmenter.counts
    return [(min(times), max(times)) for times in found.values()]


SLEWS = [(0, 0), (10, 0), (14, 40), (24, 40), (25, 80), (35, 80)]


def assert_between_slews(dwells: list[tuple[float, float]], early_s: float, left_out_s: float) -> None:
    """The dwells between ``SLEWS``, but for a second after each arrival, begin and end within these margins."""
    assert len(dwells) == 3
    for (start, end), (low, high) in zip(dwells, [(0, 10), (15, 24), (26, 35)], strict=True):
        assert low - early_s <= start <= low + left_out_s
        assert high - left_out_s <= end <= high


@pytest.mark.parametrize("rate_hz, noise_deg", [(10, 0), (100, 0), (100, 0.005), (2, 0)])
def test_dwells_between_slews(rate_hz: float, noise_deg: float) -> None:
    pose = path(*SLEWS, rate_hz=rate_hz, noise_deg=noise_deg)
    assert_between_slews(spans(Given(Batch(readings(pose, 35), pose))), 0.01, 0.6 + 1 / rate_hz)
    counts = spans.counts
    assert counts.used + counts.moving + counts.settling + counts.without_pose == counts.read


@pytest.mark.parametrize("rate_hz, noise_deg", [(10, 0.03), (50, 0.03), (50, 0.2)])
def test_noisy_angles_do_not_move_the_platform(rate_hz: float, noise_deg: float) -> None:
    """Two messages of them differ by more than the tolerance."""
    pose = path(*SLEWS, rate_hz=rate_hz, noise_deg=noise_deg)
    assert_between_slews(spans(Given(Batch(readings(pose, 35), pose))), 0.1, 1.0 + 1 / rate_hz)
    (told,) = spans.counts.unmet_settings(Stillness())
    assert told.startswith("the angles scatter by ") and "--still-deg" in told
    assert np.degrees(spans.counts.noise_rad) == pytest.approx(noise_deg, rel=0.5)


def test_a_noisy_attitude_does_not_move_the_platform() -> None:
    """As a second sensor or a robot reports it, 0.05 deg about each axis."""
    from scipy.spatial.transform import Rotation

    pose, rng = path(*SLEWS, rate_hz=20), np.random.default_rng(4)
    turned = Rotation.from_rotvec(np.outer(pose.values[:, 0], [0, 0, 1]))
    noisy = turned * Rotation.from_rotvec(np.radians(0.05) * rng.normal(size=(700, 3)))
    attitudes = Stream(pose.time_ns, noisy.as_quat())
    assert_between_slews(spans(Given(Batch(readings(pose, 35), attitudes), bench=Bench((), 9.81))), 0.01, 1.1)


def test_a_slow_slew_is_no_dwell() -> None:
    pose = path((0, 0), (10, 0), (110, 20), (120, 20), rate_hz=50)  # 0.2 deg/s
    assert len(spans(Given(Batch(readings(pose, 120), pose)))) == 2


def gentle(rate_hz: float, slew_s: float = 60.0, noise_deg: float = 0.0) -> tuple[Stream, Stream]:
    """Three dwells of 30 s and slews of 90 deg that begin and end gently; angles, and readings of the true motion."""
    share = np.linspace(0, 1, 601)
    rise = share**3 * (10 - 15 * share + 6 * share**2)
    knots = [(0.0, 0.0)]
    for k in range(3):
        start = knots[-1][0] + 30.0
        knots += [(start, 90.0 * k)]
        knots += [(start + slew_s * x, 90.0 * (k + y)) for x, y in zip(share, rise, strict=True)] if k < 2 else []
    points = sorted(set(knots))
    return path(*points, rate_hz=rate_hz, noise_deg=noise_deg), readings(path(*points, rate_hz=200), points[-1][0])


@pytest.mark.parametrize("rate_hz", [0.5, 1, 1.7, 4, 20])
@pytest.mark.parametrize("slew_s", [20.0, 60.0, 200.0])
def test_a_gentle_slew_spoils_no_dwell_however_seldom_angles_come(rate_hz: float, slew_s: float) -> None:
    """Three dwells, and in each block the platform is where the block says: to a few thousandths of a degree."""
    pose, accel = gentle(rate_hz, slew_s)
    truth, _ = gentle(200.0, slew_s)
    blocks = list(dwell_blocks(Given(Batch(accel, pose)), Segmenter(BENCH)))
    assert {block.dwell for block in blocks} == {1, 2, 3}
    assert sum(len(block.elapsed_s) for block in blocks) > 0.8 * 90 * 100
    for block in blocks:
        was = np.degrees(np.interp(block.elapsed_s * S, truth.time_ns, truth.values[:, 0]))
        assert np.abs(was - np.degrees(block.pose[:, 0])).max() < 0.012
        assert abs(was.mean() - np.degrees(block.pose[:, 0]).mean()) < 0.001


def test_a_creeping_platform_is_used_though_it_never_rests() -> None:
    pose = path((0, 0), (60, 0.24), (64, 40), (124, 40.24), rate_hz=10)
    got = spans(Given(Batch(readings(pose, 124), pose)))
    assert [round(end - start) for start, end in got] == [60, 59]


@pytest.mark.parametrize(("creep_s", "end_s"), [(4.0, 36.0), (9.5, 30.5), (10.5, 40.0), (20.0, 40.0)])
def test_what_creeps_for_ten_seconds_leaves_and_what_creeps_for_longer_stands(creep_s: float, end_s: float) -> None:
    """Before a slew at 40 s, by 0.03 degrees, within the tolerance."""
    pose = path((0, 0), (40.0 - creep_s, 0), (40, 0.03), (44, 40), (70, 40), rate_hz=10)
    (_, end), _ = spans(Given(Batch(readings(pose, 70), pose)))
    assert end == pytest.approx(end_s, abs=0.6)


@pytest.mark.parametrize(("turn_deg", "told"), [(0.8, False), (1.3, True)])
def test_a_platform_that_turns_in_what_counts_as_still_is_told(turn_deg: float, told: bool) -> None:
    """By more than a degree within a block, of 40 seconds, where the tolerance is four degrees."""
    pose = path((0, 0), (60, 1.5 * turn_deg), (64, 40), (124, 40), rate_hz=10)
    segmenter = Segmenter(BENCH, Stillness(tolerance_deg=4.0))
    assert len(list(dwell_blocks(Given(Batch(readings(pose, 124), pose)), segmenter))) > 1
    assert segmenter.counts.turned_deg == pytest.approx(turn_deg, rel=0.05)
    sentences = segmenter.counts.unmet_settings(segmenter.stillness)
    assert any("the platform turns by" in sentence for sentence in sentences) == told


def test_what_waits_in_an_open_dwell_can_be_looked_at_and_stays() -> None:
    """After nine seconds of a dwell; the blocks are those without a look, to the bit."""
    pose = path(*SLEWS, rate_hz=10)
    whole, split = Batch(readings(pose, 35), pose), np.searchsorted(readings(pose, 35).time_ns, 9 * S)
    looked, other = Segmenter(BENCH), Segmenter(BENCH)
    assert np.isnan(looked.arrival_s)
    until = int(np.searchsorted(pose.time_ns, 9 * S))
    parts = Batch(whole.accel[:split], pose[:until]), Batch(whole.accel[split:], pose[until:])
    blocks = list(looked.push(parts[0]))
    (waiting,) = looked.waiting()
    assert not blocks and looked.standing == waiting.dwell == 1 and looked.counts.used == 0
    assert 7.5 < waiting.elapsed_s[-1] < 9.0 and len(waiting.elapsed_s) > 700
    assert looked.arrival_s <= 0.0, "the platform stood before the run began"
    blocks += [*looked.push(parts[1]), *looked.finish()]
    expected = [block for part in parts for block in other.push(part)] + list(other.finish())
    for one, two in zip(blocks, expected, strict=True):
        np.testing.assert_array_equal(one.accel_mps2, two.accel_mps2)
    np.testing.assert_array_equal(waiting.accel_mps2, blocks[0].accel_mps2[: len(waiting.accel_mps2)])
    assert Segmenter(BENCH).waiting() == []


def test_settling_is_left_out() -> None:
    pose = path(*SLEWS, rate_hz=10)
    assert spans(Given(Batch(readings(pose, 35), pose)), settle_s=3.0)[1][0] == pytest.approx(17.0, abs=0.2)


def test_a_third_is_left_out_of_a_dwell_that_is_too_short_for_settling_and_that_is_told() -> None:
    """Of 12 and of 6 seconds before the platform leaves; not of the last, which the end of the run cuts."""
    pose = path((0, 0), (10, 0), (14, 40), (26, 40), (27, 80), (33, 80), (37, 40), (44, 40), rate_hz=50)
    starts = [start for start, _ in spans(Given(Batch(readings(pose, 44), pose)), settle_s=5.0)]
    assert starts == pytest.approx([0, 14 + 12 / 3, 27 + 6 / 3, 37 + 7 / 3], abs=0.4)
    assert spans.counts.short_dwells == 2 and spans.counts.least_settling_s == pytest.approx(6 / 3, abs=0.15)
    (told,) = spans.counts.unmet_settings(Stillness(settle_s=5.0))
    assert told.startswith("2 dwells are too short to leave out 5 s after each arrival (--settle-s): a third of each")


def test_angles_absent_during_motion_readings_decide() -> None:
    """One angle message a dwell, at its middle: the dwells reach to where the readings move."""
    truth = path(*SLEWS, rate_hz=100)
    sparse = Stream(np.array([5, 19, 30]) * S, np.column_stack([np.radians([0, 40, 80]), np.zeros(3)]))
    got = spans(Given(Batch(readings(truth, 35), sparse)))
    assert len(got) == 3
    for (start, end), (low, high) in zip(got, [(4, 10), (14, 24), (25, 31)], strict=True):
        assert low - 0.01 <= start <= low + 2.0 and high - 1.0 <= end <= high + 0.01


@pytest.mark.parametrize("angle_hz", [0.9, 10.0])
@pytest.mark.parametrize("slew_s", [0.0, 8.0, 40.0])
def test_what_comes_out_does_not_depend_on_batches(angle_hz: float, slew_s: float) -> None:
    pose = path(*SLEWS, rate_hz=angle_hz, noise_deg=0.003)
    accel = readings(pose, 35)
    if slew_s:
        pose, accel = gentle(angle_hz, slew_s, noise_deg=0.003)
    whole = list(dwell_blocks(Given(Batch(accel, pose)), Segmenter(BENCH)))
    edges = np.arange(0, 180, 0.37)
    pieces = [
        Batch(
            accel[(accel.time_ns >= a * S) & (accel.time_ns < b * S)],
            pose[(pose.time_ns >= a * S) & (pose.time_ns < b * S)],
        )
        for a, b in itertools.pairwise(edges)
    ]
    again = list(dwell_blocks(Given(*pieces), Segmenter(BENCH)))
    assert len(whole) == len(again)
    for one, other in zip(whole, again, strict=True):
        np.testing.assert_array_equal(one.accel_mps2, other.accel_mps2)
        np.testing.assert_array_equal(one.pose, other.pose)
        assert one.arrival_felt_s == other.arrival_felt_s


@pytest.mark.parametrize("angle_hz", [2.0, 10.0, 100.0])
def test_an_arrival_is_known_to_a_reading_whatever_the_angles_say(angle_hz: float) -> None:
    """Slews end at 14 and 25 s; angles tell it to half a second."""
    pose, accel = path(*SLEWS, rate_hz=angle_hz), readings(path(*SLEWS, rate_hz=1000), 35)
    blocks = list(dwell_blocks(Given(Batch(accel, pose)), Segmenter(BENCH)))
    arrivals = {block.dwell: block.arrival_felt_s for block in blocks}
    assert [arrivals[2], arrivals[3]] == pytest.approx([14.0, 25.0], abs=0.02)


@pytest.mark.parametrize(
    ("windows", "left", "arrived"), [(3, 0.0, 0.75), (4, 0.25, 0.75), (8, 0.75, 1.25), (41, 4.75, 5.25)]
)
def test_readings_bracket_a_motion_by_a_quarter_of_a_second(windows: int, left: float, arrived: float) -> None:
    """In the middle of so many quarters of a second the readings jump: the old level ends a window before, and the new
    one begins a window after; three windows are too few to tell."""
    count = 25 * windows
    levels = np.where(np.arange(count)[:, None] < 25 * (windows // 2), [0.0, G, 0.0], [0.0, 0.0, G])
    values = levels + np.random.default_rng(4).normal(size=(count, 3)) * 1e-4
    accel, end_ns = Stream(np.arange(count) * 10_000_000, values), count * 10_000_000
    assert Stillness().moved_between(accel, 0, end_ns, G) == (round(left * 1e9), round(arrived * 1e9))


def test_an_attitude_in_place_of_angles() -> None:
    from scipy.spatial.transform import Rotation

    pose = path(*SLEWS, rate_hz=20)
    turns = (
        Rotation.from_rotvec(np.outer(pose.values[:, 0], [0, 0, 1])).as_quat()
        * np.where(np.sin(7 * np.arange(700)) < 0, -1, 1)[:, None]
    )
    bench = Bench((), 9.81)
    source = Given(Batch(readings(pose, 35), Stream(pose.time_ns, turns)), bench=bench)
    assert len(spans(source)) == 3


def test_bad_samples_are_dropped_and_counted() -> None:
    pose = path((0, 0), (20, 0), rate_hz=10)
    accel = readings(pose, 20)
    accel.values[5, 1] = np.nan
    accel.values[6, 2] = np.inf
    times = accel.time_ns.copy()
    times[10] = times[9]  # repeated
    times[20] = times[15]  # back
    times[30] += 3600 * S  # a damaged stamp far ahead
    got = spans(Given(Batch(Stream(times, accel.values), pose)))
    counts = spans.counts
    assert (counts.not_finite, counts.repeated, counts.backward, counts.leaping) == (2, 1, 1, 1)
    assert counts.used == 2000 - 5 and len(got) == 1
    said = " ".join(counts.sentences())
    assert "NaN" in said and "jumped back" in said and "repeated the stamp" in said and "far ahead" in said


@pytest.mark.parametrize("size", [2e12, 1e155, 1.7e308, -1e200])
def test_what_nothing_can_read_is_dropped_and_told(size: float) -> None:
    """One reading of 1e155, squared, made a run that could not be evaluated."""
    run, altered = Run(seed=1, dwells=14, count=100), Run(seed=1, dwells=14, count=100)
    altered.accel.values[1234, 1] = altered.pose.values[55, 2] = size
    heat = Stream(run.accel.time_ns[[0, 500, 900]], np.array([[20.0], [size], [21.0]]))
    batch = Batch(altered.accel, altered.pose, heat)
    result = calibrate(Given(batch, bench=run.bench))
    counts = result.counts
    assert (counts.too_large, counts.poses_dropped, counts.temperatures_dropped, counts.not_finite) == (1, 1, 1, 0)
    said = " ".join(result.warnings)
    assert "readings beyond 1e+12 m/s^2, which nothing can read, dropped: 1" in said
    assert "beyond 1e+06 rad" in said and "temperatures not finite or beyond 1e+06 degC, dropped: 1" in said
    expected = calibrate(run).estimate
    assert np.abs((result.estimate.parameters - expected.parameters) / expected.sigma).max() < 0.5


def test_counts_of_a_converter_are_left_to_the_check_of_the_unit() -> None:
    run = Run(seed=1, dwells=14, count=100)
    counts = Stream(run.accel.time_ns, np.round(run.accel.values / G * 2**31))
    with pytest.raises(InputError, match="they look like counts; give the size of one count"):
        calibrate(Given(Batch(counts, run.pose), bench=run.bench))


def test_counts_in_place_of_angles_are_told() -> None:
    run = Run(seed=1, dwells=14, count=100)
    counts = Stream(run.pose.time_ns, 1e9 + run.pose.values)
    with pytest.raises(InputError, match=r"none of the 140 angle messages can be used: .* beyond 1e.06 rad"):
        calibrate(Given(Batch(run.accel, counts), bench=run.bench))


def test_readings_outside_the_angles_are_counted() -> None:
    pose = path((5, 0), (10, 0), rate_hz=10)
    spans(Given(Batch(readings(path((0, 0), (20, 0), rate_hz=10), 20), pose)))
    assert spans.counts.without_pose == pytest.approx(400 + 900, abs=20)


def test_temperature_goes_on_as_it_went_last() -> None:
    """Before the first: none; after one: that; then the line through the last two, for as long as they lie apart."""
    pose = path((0, 0), (20, 0), rate_hz=10)
    warm = Stream(np.array([4, 6, 8]) * S, np.array([[20.0], [30.0], [32.0]]))
    blocks = list(dwell_blocks(Given(Batch(readings(pose, 20), pose, warm)), Segmenter(BENCH)))
    times, values = (np.concatenate([getattr(b, key) for b in blocks]) for key in ("elapsed_s", "temperature_c"))
    assert np.isnan(values[times < 4]).all() and (values[(times >= 4) & (times < 6)] == 20).all()
    rising = (times >= 6) & (times < 8)
    np.testing.assert_allclose(values[rising], 30 + 5 * (times[rising] - 6))
    np.testing.assert_allclose(values[times >= 8], 32 + np.minimum(times[times >= 8] - 8, 2.0))


def test_two_temperatures_of_one_time_make_no_line() -> None:
    warm = Stream(np.array([4, 6, 6]) * S, np.array([[20.0], [30.0], [31.0]]))
    assert carry_on(warm, np.array([5, 7, 30]) * S).tolist() == [20.0, 31.0, 31.0]


def test_a_gentle_start_of_a_slew_is_not_in_the_dwell() -> None:
    """A minimum-jerk slew stays within the tolerance for tenths of a second: none of it may reach the fit."""
    from kf_calib.estimation.calibration import calibrate
    from kf_calib.sources.simulation.sensors import GRADES
    from kf_calib.sources.simulation.simulator import Simulation
    from kf_calib.sources.simulation.visit_plans import spread_plan

    grade, bench = (
        GRADES["navigation"],
        Bench(axes_of("yzx"), 9.81, angle_sigma_deg=0.0, scatter_sigma_mps2=0.0),
    )
    p_values = []
    for seed in range(3):
        run = Simulation(
            bench, grade.sensors(seed), grade.noise, spread_plan(12, dwell_s=8.0), slew_rate_degps=20.0, seed=seed
        )
        result = calibrate(run)
        assert result.counts.gated <= 2
        p_values.append(result.consistency.p_value)
    assert np.mean(p_values) > 0.1


def stretch(whole: Batch, since_ns: tuple[int, int], until_ns: tuple[int, int]) -> Batch:
    """Readings and angles of a run between two stamps, of each its own."""
    cuts = zip((whole.accel, whole.pose), since_ns, until_ns, strict=True)
    return Batch(*(part[slice(*np.searchsorted(part.time_ns, (a, b)))] for part, a, b in cuts))


def in_parts(whole: Batch, seed: int, ahead_s: float) -> list[Batch]:
    """As a link delivers it: now more, now less, the angles behind the readings or ahead of them."""
    rng, end = np.random.default_rng(seed), int(whole.accel.time_ns[-1])
    parts, since = list[Batch](), (0, 0)
    while since[0] <= end:
        readings_ns = since[0] + round(rng.choice([0.02, 0.1, 0.5, 3.0]) * S)
        until = readings_ns, max(since[1], readings_ns + round(rng.uniform(-1.0, ahead_s) * S))
        parts.append(stretch(whole, since, until))
        since = until
    return [*parts, stretch(whole, since, (1 << 62, 1 << 62))]


def blocks_of(batches: list[Batch], slews: bool) -> list:
    segmenter = Segmenter(BENCH, slews=slews)
    found = list(dwell_blocks(Given(*batches), segmenter))
    return [vars(segmenter.counts)] + [
        (each.dwell, each.arrival_s, each.arrival_felt_s, each.turns, each.pose_sigma_rad, each.elapsed_s.tobytes(),
         each.accel_mps2.tobytes(), each.pose.tobytes()) for each in found
    ]  # fmt: skip


@pytest.mark.parametrize("slews", [False, True])
@pytest.mark.parametrize("rate_hz", [0.2, 0.5, 2.0, 20.0])
@pytest.mark.parametrize("ahead_s, noise_deg", [(0.0, 1e-4), (0.3, 1e-4), (8.0, 1e-4), (0.3, 0.02)])
def test_how_the_streams_come_in_parts_changes_no_bit(
    rate_hz: float, ahead_s: float, noise_deg: float, slews: bool
) -> None:
    """Angles that were ahead made readings of a slew those of a dwell; whole turns came with other roundings."""
    points = [(0, 10.0), (20, 10.0), (24, 250.0), (45, 250.0), (47, 10.0), (70, 10.0), (71, 350.0), (90.0, 350.0)]
    pose = path(*points, rate_hz=rate_hz, noise_deg=noise_deg)
    wrapped = (pose.values + np.pi) % (2.0 * np.pi) - np.pi
    whole = Batch(readings(pose, 90.0), Stream(pose.time_ns, wrapped))
    expected = blocks_of([whole], slews)
    assert len(expected) > 2
    for seed in range(6):
        assert blocks_of(in_parts(whole, seed, ahead_s), slews) == expected


def test_while_the_platform_moves_there_is_no_dwell_that_it_arrived_at() -> None:
    pose = path((0, 0), (10, 0), (30, 200), rate_hz=10)
    segmenter = Segmenter(BENCH)
    blocks = list(segmenter.push(Batch(readings(pose, 29), pose)))
    assert blocks and segmenter.standing is None and np.isnan(segmenter.arrival_s)


def test_a_run_with_a_single_message_of_its_angles_is_one_dwell() -> None:
    """From its first reading, whenever the message comes; without readings, or without angles, there is none."""
    accel = readings(path(*SLEWS[:2], rate_hz=10.0), 9.0)
    for at_s in (0.0, 4.0, 12.0):
        pose = Stream(np.array([round(at_s * S)]), np.zeros((1, 2)))
        ((begin, end),) = spans(Given(Batch(accel, pose)), settle_s=1.0)
        assert (begin, end) == pytest.approx((0.0, 8.99), abs=0.02)
        assert spans(Given(Batch(accel[:0], pose))) == []
    assert spans(Given(Batch(accel, pose[:0]))) == []
