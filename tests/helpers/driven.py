"""A driven simulated bench whose time passes and whose readings are judged in the calling thread."""

from dataclasses import replace
from typing import Any

from kf_calib.bench.paper_parameters import targets_of
from kf_calib.design.next_orientation import SlewTimes
from kf_calib.online.session import Session
from kf_calib.online.suggestion import Itinerary
from kf_calib.positioning.drive import Drive
from kf_calib.positioning.loop import Rules
from kf_calib.positioning.opening import SimulatedPositioner
from kf_calib.sources.simulation.driven import DrivenBench, Servo
from kf_calib.sources.simulation.options import options_from_query, simulation


class SteppedTime:
    """Lets the bench measure, and its session evaluate, while the loop sleeps."""

    tick_s = 0.2

    def __init__(self, bench: DrivenBench, session: Session) -> None:
        self.bench, self.session = bench, session

    def now_s(self) -> float:
        return self.bench.now_s

    def sleep(self, seconds: float) -> None:
        self.session.ingest(self.bench.advance(seconds))


def driven(
    query: str = "seed=4&sample_hz=50", servo: Servo | None = None, targets: tuple[str, ...] = ("K=5ppm",),
    keys: dict[str, str] | None = None, auto: bool = False, **itinerary: Any,
) -> Drive:  # fmt: skip
    """A drive of a simulated bench that stands at zero."""
    run = simulation(options_from_query(query), keys or {})
    bench = DrivenBench(run, servo or Servo(), [0.0] * len(run.bench.axes))
    session = Session.fed(run.bench, wanted=targets_of(targets), auto=auto)
    slew_times = SlewTimes(run.bench.rate_degps or 20.0, run.bench.acceleration_degps2 or 40.0)
    plan = replace(Itinerary(run.bench, slew_times), **itinerary)
    rules = Rules(plan.limits, plan.slew_times)
    return Drive(SimulatedPositioner(bench), session, plan, rules, SteppedTime(bench, session))
