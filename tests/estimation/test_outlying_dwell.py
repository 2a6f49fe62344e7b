"""A dwell that alone is wrong is named, with the turn that mends it; effects and noise are no such dwell."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.altered import Altered, mistyped, short_run
from helpers.long_runs import slow

from kf_calib.diagnosis.missing_effect import diagnose
from kf_calib.errors import InputError
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.outlying_dwell import _written_as
from kf_calib.estimation.settings import Settings

OPTIONS = [{}, {"unstated": True}, {"setting_sigma_deg": 0.01}, {"grade": "mems"}]
ERRORS = [(7, 1, 10.0), (1, 2, -90.0), (4, 2, 1.0), (24, 1, 0.5)]
LARGEST_OR_LEAST = [(options, *ERRORS[1 if k % 2 else 3]) for k, options in enumerate(OPTIONS)]
OTHERS = [case for options in OPTIONS for error in ERRORS if (case := (options, *error)) not in LARGEST_OR_LEAST]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "number", "gimbal", "error_deg"),
    [LARGEST_OR_LEAST[0], *slow(*LARGEST_OR_LEAST[1:], *OTHERS)],
    ids=str,
)
def test_a_mistyped_pose_is_named_and_mended(options, number: int, gimbal: int, error_deg: float) -> None:
    run = short_run(**options)
    typed = np.array(run.plan[number - 1].gimbal_deg)
    source = Altered(run, poses=mistyped(run, number, gimbal, error_deg))
    result = calibrate(source)
    (found,) = result.outlying
    assert found.number == number
    (turn,) = [turn for turn in found.turns if turn.gimbal == gimbal]
    assert abs(turn.recorded_deg - typed[gimbal] - error_deg) < 1e-3
    assert abs(turn.mended_deg - typed[gimbal]) < 5.0 * turn.sigma_deg
    assert f"dwell {number} " in str(found) and f"--leave-out {number}" in str(found)
    told = diagnose(result)
    assert told.unknown and not told.missing and f"dwell {number} " in told.verdict

    alone = calibrate(source, Settings(left_out=(number,)))
    assert alone.consistency.consistent and len(alone.visits) == 23
    for symbol, parameter in found.without.parameters.items():
        assert parameter.value == alone.parameters[symbol].value
        assert parameter.value == pytest.approx(run.sensors.parameters[symbol], abs=5 * parameter.sigma)


@pytest.mark.parametrize(("number", "error_deg", "warming"), [(1, 0.02, True), (1, 2.0, False), (2, 0.02, False)])
def test_the_first_dwell_may_have_been_warming_up(number: int, error_deg: float, warming: bool) -> None:
    """If it is off by less than 10 mg."""
    run = short_run()
    (found,) = calibrate(Altered(run, poses=mistyped(run, number, 2, error_deg))).outlying
    assert (" or the block was still warming up; without it" in str(found)) == warming


def test_where_two_dwells_could_be_it_both_are_named() -> None:
    """Of six faces, opposite ones only are told by each other."""
    run = short_run(plan="faces")
    found = calibrate(Altered(run, poses=mistyped(run, 4, 2, 1.0))).outlying
    assert [each.number for each in found] == [3, 4]


def test_a_knock_that_no_turn_explains() -> None:
    run = short_run()
    begin, end = run.motion.arrive_ns[10] * 1e-9 - 0.1, run.motion.leave_ns[10] * 1e-9 + 0.1
    source = Altered(run, lambda t, a: a + np.where(((t > begin) & (t < end))[:, None], [0.5, 0.6, -0.4], 0.0))
    (found,) = calibrate(source).outlying
    assert found.number == 11 and not found.turns
    assert "no turn of one gimbal explains" in str(found)


@pytest.mark.parametrize(
    "hidden",
    ["second-order=40sigma", *slow("warm-up=40sigma;tau=20", "hysteresis=30sigma", "base-tilt=100sigma")],
)
@pytest.mark.parametrize("seeds", [range(1), *slow(range(1, 2))])
def test_an_effect_is_no_outlying_dwell(hidden: str, seeds: range) -> None:
    for seed in seeds:
        assert not calibrate(short_run(hidden=(hidden,), seed=seed)).outlying


@pytest.mark.parametrize("runs", [2, *slow(8)])
def test_noise_is_no_outlying_dwell(runs: int) -> None:
    for seed in range(runs):
        run = short_run(count=10, dwell_s=1.5, seed=seed, setting_sigma_deg=0.02, unstated=seed % 2)
        assert not calibrate(run).outlying


def test_poses_are_those_that_were_recorded() -> None:
    """Angles that go on beyond a turn are shown as they were typed."""
    run = short_run(count=8)
    typed = np.degrees(np.array([visit.dwell.recorded_pose for visit in calibrate(run).visits]))
    np.testing.assert_allclose(typed, [visit.gimbal_deg for visit in run.plan], atol=1e-9)


def test_a_dwell_to_leave_out_must_be_there() -> None:
    with pytest.raises(InputError, match=r"no dwell 9 to leave out \(--leave-out\): the run has dwells 1 to 8"):
        calibrate(short_run(count=8), Settings(left_out=(2, 9)))


@pytest.mark.parametrize(
    ("recorded_deg", "angle_deg", "written_deg"),
    [
        (55.35, 415.35, 55.35),
        (-170.0, -190.0, 170.0),
        (350.0, 370.0, 10.0),
        (200.0, -15.0, 345.0),
        (725.0, 735.0, 735.0),
    ],
)
def test_an_angle_is_told_as_the_recorded_ones_are_written(
    recorded_deg: float, angle_deg: float, written_deg: float
) -> None:
    assert _written_as(recorded_deg, angle_deg) == pytest.approx(written_deg)
