"""A simulated bench that drives itself: to its targets, round forbidden zones, to a stop where anything fails."""

import numpy as np
import pytest
from helpers.driven import driven

from kf_calib.design.gimbal_limits import GimbalLimits
from kf_calib.positioning.drive import Drive
from kf_calib.positioning.loop import Phase
from kf_calib.positioning.positioner import Positioner, PositionerError
from kf_calib.sources.simulation.driven import FAULTS, DrivenBench, Servo

WORDS = {
    "stuck": "did not begin", "stall": "instead of", "off": "instead of", "drive": "drive tripped",
    "link": "does not answer", "readback": "leaps", "runaway": "off its way",
}  # fmt: skip


class Witness:
    """Passes commands on, and keeps where the platform truly was."""

    def __init__(self, drive: Drive) -> None:
        self.inner, self.moves, self.stops = drive.positioner, list[tuple[float, ...]](), 0
        self.calls = list[str]()
        drive.positioner = self

    def move_to(self, gimbal_deg: tuple[float, ...]) -> None:
        self.moves.append(gimbal_deg)
        self.calls.append("move")
        self.inner.move_to(gimbal_deg)

    def read(self) -> tuple[float, ...]:
        return self.inner.read()

    def stop(self) -> None:
        self.calls.append("stop")
        self.inner.stop()

    def fault(self) -> str:
        return self.inner.fault()


def bench_of(drive: Drive) -> DrivenBench:
    return drive.clock.bench


def test_a_run_ends_with_every_target_reached_and_the_platform_where_it_began() -> None:
    drive = driven()
    assert isinstance(drive.positioner, Positioner)
    outcome = drive.run()
    assert outcome.ended == "targets" and outcome.stopped
    final = drive.session.finish()
    sigma = final.result.estimate.sigma
    assert (sigma[np.isfinite(final.wanted)] <= final.wanted[np.isfinite(final.wanted)]).all()
    # one stay before the first decision, none after the last, and the first small move of each gimbal
    assert len(final.result.visits) == len(outcome.decisions) + 3
    assert outcome.stands_at == pytest.approx((0.0, 0.0, 0.0), abs=0.01)
    assert [decision.purpose for decision in outcome.decisions][-2:] == ["return", "end"]
    truth = bench_of(drive).run.sensors.parameters
    for name, parameter in final.result.parameters.items():
        assert abs(parameter.value - truth[name]) < 5.0 * parameter.sigma, name


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_stops_the_table_and_nothing_moves_after_it(fault: str) -> None:
    drive = driven(servo=Servo(fault=fault, fault_s=20.0))
    witness = Witness(drive)
    outcome = drive.run()
    assert outcome.is_halted and WORDS[fault] in outcome.why, outcome.why
    assert witness.calls[-1] == "stop"
    assert drive.state.phase is Phase.ENDED or fault == "link"
    if fault == "link":  # what it was told last it may still do: the words say so, and no command follows
        assert not outcome.stopped
    else:
        assert outcome.stopped and not bench_of(drive).moving
        assert outcome.stands_at == pytest.approx(drive.positioner.read(), abs=0.01)


def test_what_breaks_a_run_off_stops_the_table_amid_a_move() -> None:
    drive = driven()
    moving = list[bool]()

    def trouble() -> str:
        moving.append(bench_of(drive).moving)
        return "the disk is full" if moving[-3:] == [True] * 3 else ""

    drive._trouble = trouble
    outcome = drive.run()
    assert outcome.is_halted and outcome.why == "the disk is full"
    assert moving[-1] and not bench_of(drive).moving


def test_an_error_of_the_program_itself_stops_the_table() -> None:
    drive = driven()
    witness = Witness(drive)

    def suggest(*_: object) -> None:
        raise ZeroDivisionError("a mistake")

    drive.session.suggest = suggest
    outcome = drive.run()
    assert outcome.is_halted and "ZeroDivisionError" in outcome.why and witness.calls[-1] == "stop"


@pytest.mark.parametrize("kind", [KeyboardInterrupt, SystemExit])
def test_a_way_out_of_the_program_leads_over_the_stop(kind: type[BaseException]) -> None:
    drive = driven()
    witness, count = Witness(drive), 0
    sleep = drive.clock.sleep

    def ended(seconds: float) -> None:
        nonlocal count
        count += 1
        if count == 65:
            raise kind
        sleep(seconds)

    drive.clock.sleep = ended
    with pytest.raises(kind):
        drive.run()
    assert witness.calls[-1] == "stop" and drive.outcome is not None and drive.outcome.is_halted


def test_commands_and_ways_keep_within_limits_and_out_of_forbidden_zones() -> None:
    """By where the platform truly was, at every look."""
    keys = {"limits_deg": "outer=-120:120 x=-100:100", "forbidden_deg": "z=20:70,x=-40:40; y=60:90,z=-90:-30"}
    drive = driven(keys=keys, targets=("K=10ppm", "b=60ug"))
    limits, witness = GimbalLimits.of(bench_of(drive).run.bench), Witness(drive)
    been, sleep = list[tuple[float, ...]](), drive.clock.sleep

    def watched(seconds: float) -> None:
        sleep(seconds)
        been.append(drive.positioner.read())

    drive.clock.sleep = watched
    outcome = drive.run()
    assert outcome.ended == "targets", outcome.why
    assert limits.allowed(np.radians(been)).all()
    assert limits.allowed(np.radians(witness.moves)).all()
    rates = np.abs(np.diff(been, axis=0)).max() / drive.clock.tick_s
    assert rates <= 20.0 + 1e-6


def test_no_command_where_the_platform_stands_in_a_forbidden_zone() -> None:
    drive = driven(keys={"forbidden_deg": "x=-10:10"})
    witness = Witness(drive)
    outcome = drive.run()
    assert outcome.is_halted and "forbidden zone" in outcome.why and witness.moves == []


def test_a_stream_that_disagrees_with_the_read_back_is_noticed_before_anything_moves() -> None:
    drive = driven()
    witness = Witness(drive)
    read = witness.inner.read
    witness.inner.read = lambda: tuple(angle + 5.0 for angle in read())  # a zero that is off
    outcome = drive.run()
    assert outcome.is_halted and "check signs, zeros and order" in outcome.why and witness.moves == []


def test_a_budget_of_time_ends_the_run() -> None:
    drive = driven(targets=("K=0.001ppm",))
    drive._budget_s = 60.0
    outcome = drive.run()
    assert outcome.ended == "budget" and 60.0 < outcome.lasted_s < 90.0


@pytest.mark.slow
def test_a_bench_with_backlash_overshoot_and_noise_is_driven_to_the_end() -> None:
    servo = Servo(overshoot_deg=0.3, backlash_deg=0.001, position_sigma_deg=0.002, rate_degps=35.0)
    drive = driven(servo=servo, keys={"rate_degps": "35", "angle_sigma_deg": "0.001"}, targets=("K=10ppm",))
    assert drive.run().ended in ("targets", "named", "disagrees")
    assert drive.positioner.read() == pytest.approx(drive.outcome.stands_at, abs=0.02)


def test_a_link_that_fails_raises_an_error_of_the_positioner() -> None:
    drive = driven(servo=Servo(fault="link"))
    for act in (drive.positioner.read, drive.positioner.stop, drive.positioner.fault):
        with pytest.raises(PositionerError, match="does not answer"):
            act()
