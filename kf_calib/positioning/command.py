"""The command of the bench that drives itself: run.

A live run whose bench is driven: a drive beside the session, and one end for both, with the table stopped first.
"""

from __future__ import annotations

import json
import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from contextvars import copy_context
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import rich_click as click

from kf_calib.bench.keys import BenchKeys
from kf_calib.cli.command import POSITIVE, command, option
from kf_calib.cli.echo import complain, print_result, rendered
from kf_calib.cli.failures import answered
from kf_calib.cli.files import claimed, delivery, output_option
from kf_calib.cli.live import follow, outcome
from kf_calib.cli.live_page import PageOptions, page_server
from kf_calib.cli.live_run import LiveRun
from kf_calib.cli.options import (
    BenchOptions,
    Device,
    EvaluationOptions,
    Json,
    Overwrite,
    Save,
    SaveModel,
    ShownUnits,
    Strict,
    exit_if,
    target_option,
)
from kf_calib.errors import InputError
from kf_calib.support.text import angles_in_words, printable

if TYPE_CHECKING:
    from kf_calib.bench.bench import Bench
    from kf_calib.online.suggestion import Itinerary
    from kf_calib.positioning.drive import Decision, Drive, Outcome
    from kf_calib.positioning.opening import Opened
    from kf_calib.sources.live import LiveSource
    from kf_calib.views.live.content import Doing
    from kf_calib.views.live.server import PageServer

_WORDS = {signal.SIGINT: "Ctrl-C was pressed", signal.SIGTERM: "the program was told to end (SIGTERM)"}
_BEGIN_S = 0.02


class DrivenRun(LiveRun):
    """A live run with a drive in a thread of its own.

    make_drive: makes the drive when the session is there. signalled: the signal that broke the run off.
    """

    def __init__(
        self, source: LiveSource, begin: Callable[..., object], record: Path | None, every: bool,
        make_drive: Callable[[DrivenRun], Drive],
    ) -> None:  # fmt: skip
        super().__init__(source, begin, record, every)  # type: ignore[arg-type]
        self.drive: Drive | None = None
        self.drive_error: BaseException | None = None
        self.signalled: signal.Signals | None = None
        self._make_drive = make_drive
        self._driver = threading.Thread(target=copy_context().run, args=(self._drive,), name="drive", daemon=True)
        self.further_keys, self.doing = self._keys, self._doing

    def start(self) -> None:
        super().start()
        self._driver.start()

    @property
    def going(self) -> bool:
        return self._driver.is_alive() or super().going

    @property
    def outcome(self) -> Outcome | None:
        """How the drive ended; None while it goes on, or where it never began."""
        return None if self.drive is None else self.drive.outcome

    def stop(self) -> None:
        """Break the drive off: the table is stopped, and then the run ended."""
        self.break_off("the run was ended by a key")

    def break_off(self, reason: str) -> None:
        if self.drive is None:
            super().stop()
        else:
            self.stopped = True
            self.drive.break_off(reason)

    def handle_signal(self, number: signal.Signals) -> None:
        if self.signalled is not None and number == signal.SIGINT and not self._driver.is_alive():
            raise KeyboardInterrupt
        self.signalled = self.signalled or number
        self.break_off(_WORDS.get(number, "the terminal was closed"))

    def _drive(self) -> None:
        try:
            while self.session is None and self._thread.is_alive():
                time.sleep(_BEGIN_S)
            if self.session is not None:
                self.drive = drive = self._make_drive(self)
                drive.decided = self._mark
                if self.stopped:
                    drive.break_off("the run was ended before it began")
                self._mark_end(drive.run())
        except BaseException as error:  # for the main thread to tell
            self.drive_error = error
        finally:
            super().stop()

    def _mark(self, decision: Decision) -> None:
        """Write a decision into the recording."""
        from kf_calib.sources.files.record_files import DECISION_RECORD

        facts = {
            "number": str(decision.number), "at_s": f"{decision.at_s:.3f}", "purpose": decision.purpose,
            "gimbal_deg": json.dumps(decision.gimbal_deg), "stay_s": f"{decision.stay_s:g}", "why": decision.why,
        }  # fmt: skip
        self.source.mark(DECISION_RECORD, facts)

    def _mark_end(self, outcome: Outcome) -> None:
        from kf_calib.sources.files.record_files import END_RECORD

        facts = {
            "ended": outcome.ended, "why": outcome.why, "stands_at_deg": json.dumps(outcome.stands_at),
            "stopped": str(outcome.stopped).lower(), "lasted_s": f"{outcome.lasted_s:.3f}",
        }  # fmt: skip
        self.source.mark(END_RECORD, facts)
        if outcome.is_halted:
            complain(halt_in_words(outcome))

    def _keys(self) -> Mapping[str, object]:
        from kf_calib.positioning.text import run_object

        return {} if self.drive is None else {"run": run_object(self.drive)}

    def _doing(self) -> Doing | None:
        from kf_calib.positioning.text import doing_of

        return None if self.drive is None else doing_of(self.drive)


def halt_in_words(outcome: Outcome) -> str:
    """Why the table was stopped, where it stands, and what to do, in one sentence each."""

    if not outcome.stopped:
        last = f"; it was last seen at {angles_in_words(outcome.stands_at)}" if outcome.stands_at else ""
        return (
            f"{outcome.why}: the table was told to stop and was not seen to stand, IT MAY STILL MOVE{last}. "
            "Press its emergency stop, and look before you start again."
        )
    where = f"The table was stopped and stands at {angles_in_words(outcome.stands_at)}"
    return f"{outcome.why}. {where}; nothing moves before you start again."


DRIVING = "How it is driven"


_driving = partial(option, panel=DRIVING)


@dataclass(frozen=True)
class DriveOptions:
    """How the bench is driven."""

    # fmt: off
    source: Annotated[str | None, _driving(
        "--source", metavar="S", help="Where readings and angles come from, as for live.")] = None
    record: Annotated[Path | None, output_option(
        "--record", metavar="OUT.mcap", panel=DRIVING, help="Record the run here, with all decisions.")] = None
    targets: Annotated[tuple[str, ...], target_option(panel=DRIVING)] = ()
    budget_s: Annotated[float, _driving(
        "--budget-s", type=POSITIVE, show_default="none", help="End the run when this time is spent.")] = math.inf
    most: Annotated[int | None, _driving("--most", type=click.IntRange(min=1), metavar="N",
                                         show_default="60; 24 without a target", help="Orientations at most.")] = None
    stay_s: Annotated[float, _driving(
        "--stay-s", type=POSITIVE, help="Seconds of readings in each orientation, where no target is set.")] = 30.0
    improve: Annotated[bool, _driving("--improve", help="Add an effect that is named beyond doubt, and go on.")] = False
    dry_run: Annotated[bool, _driving("--dry-run", help="Print path and duration; nothing is moved.")] = False
    trust_profile: Annotated[bool, _driving("--trust-profile", help="Run the programs that a profile names "
                                            "unasked.")] = False
    # fmt: on


@command(
    'run --positioner "sim://?hide=second-order=20sigma&seed=3" --record run.mcap --target K=2ppm',
    "run --positioner acutrol3000 --source socket://10.0.0.5:5000 --bench bench.toml --record run.mcap "
    "--target K=2ppm --target angles=1arcsec --budget-s 3600",
    "run --positioner hand --source /dev/ttyUSB0 --axes 'y z x' --gravity 9.81 --target K=2ppm",
    "run --positioner acutrol3000 --bench bench.toml --dry-run",
    seldom=("accel_unit", "model_file", "left_out", "save_model", "stay_s", "most", "page_port"),
)
@click.pass_context
def run(
    ctx: click.Context,
    positioner: Annotated[str, _driving(
        "--positioner", required=True, metavar="P", help="sim://... (emulated, with its readings), hand, the name of a "
        "shipped profile (acutrol3000, lines, command), or the path of a profile in TOML.",
    )],
    options: DriveOptions, page: PageOptions, device: Device, bench: BenchOptions, evaluation: EvaluationOptions,
    overwrite: Overwrite, save: Save, save_model: SaveModel, strict: Strict, units: ShownUnits, as_json: Json,
) -> None:  # fmt: skip
    """Let the bench run by itself: it chooses orientations, moves, records and judges until every target is reached.

    It also ends when a missing effect is named beyond doubt, or when its time is spent. Limits, rates and forbidden
    zones of the gimbals come from the bench file. Whatever goes wrong, the table is stopped first. This is no
    substitute for interlocks and an emergency stop.
    """
    from kf_calib.bench.paper_parameters import targets_of
    from kf_calib.online.session import Session
    from kf_calib.positioning.opening import open_positioner
    from kf_calib.sources.live import files_of

    settings, wanted = evaluation.settings(), targets_of(options.targets)
    keys: BenchKeys = {**bench.keys, **device}
    source, record = options.source, options.record
    if options.dry_run:
        return _show_dry_run(positioner, keys, options, as_json)
    if not options.trust_profile:
        _ask_for_programs(positioner)
    outputs = claimed(files_of(source) if source else [], overwrite=overwrite)
    with ExitStack() as stack:
        server = stack.enter_context(page_server(page))
        live, emulated = _source(positioner, source, keys, record, overwrite)
        opened = stack.enter_context(live)
        driven = emulated or stack.enter_context(open_positioner(positioner, opened.bench, complain))
        make = partial(_drive, driven, options.most or (60 if wanted else 24), options)
        begin = partial(Session, settings=settings, wanted=wanted, auto=options.improve)
        running = DrivenRun(opened, begin, record, not sys.stdout.isatty() or as_json, make)
        with answered(running.handle_signal):
            _follow(running, positioner, driven, as_json, server)
            opened.close()
            code = _code(running)
            final = None if running.drive_error else outcome(running, as_json)
            _tell_end(running, as_json)
            if final is not None and final.result is not None:
                with delivery(outputs, as_json or running.print.lost > 0) as deliver:
                    deliver.calibration(save, final.result, running.recording() or opened)
                    deliver.model(save_model, final.result)
    if code:
        ctx.exit(code)
    exit_if(strict and final is not None and final.consistent is False)


def _ask_for_programs(positioner: str) -> None:
    """Ask on a terminal whether the programs that a profile names may run. Raises InputError where nobody is there to
    ask, or the answer is no."""
    from kf_calib.positioning.opening import programs_of

    programs = programs_of(positioner)
    if not programs:
        return
    shown = "\n".join(f"  {printable(each)}" for each in programs)
    asked = f"The profile {positioner} runs these programs, with your rights:\n{shown}\nRun them?"
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        raise InputError(f"{positioner} runs programs ({printable(programs[0])}): read it, and add --trust-profile.")
    if not click.confirm(asked, err=True):
        raise InputError(f"{positioner}: its programs were not run.")


def _source(positioner: str, source: str | None, keys: BenchKeys, record: Path | None, overwrite: bool
            ) -> tuple[LiveSource, Opened | None]:  # fmt: skip
    """The source of readings that is named, or that of the emulated bench, and then that bench."""
    from kf_calib.positioning.opening import open_simulation
    from kf_calib.sources.live import open_live
    from kf_calib.sources.live.source import LiveSource
    from kf_calib.support.output_files import Outputs

    if not positioner.startswith("sim:"):
        if source is None:
            raise click.UsageError("--source is missing: say where readings and angles come from, as for live.")
        return open_live(source, keys, record, overwrite), None
    if source is not None:
        raise click.UsageError("the emulated bench of sim:// has its own readings: leave out --source.")
    Outputs({"--record": record}, [], overwrite)
    emulated = open_simulation(positioner, keys)
    assert emulated.feed is not None
    return LiveSource(emulated.feed, record, overwrite), emulated


def _itinerary(bench: Bench, most: int, options: DriveOptions) -> Itinerary:
    from kf_calib.design.next_orientation import SlewTimes
    from kf_calib.online.suggestion import Itinerary

    stated = {"rate_degps": bench.rate_degps, "acceleration_degps2": bench.acceleration_degps2}
    slew_times = SlewTimes(**{name: value for name, value in stated.items() if value is not None})
    return Itinerary(bench, slew_times, most=most, stay_s=options.stay_s, ends_when_named=not options.improve)


def _drive(device: Opened, most: int, options: DriveOptions, running: DrivenRun) -> Drive:
    """The drive of a run whose session is there."""
    from kf_calib.online.session import Session
    from kf_calib.positioning.drive import Drive
    from kf_calib.positioning.loop import Rules
    from kf_calib.positioning.opening import SimulatedTime

    session = running.session
    assert isinstance(session, Session)
    itinerary = _itinerary(running.source.bench, most, options)
    rules = Rules(itinerary.limits, itinerary.slew_times, device.watch)
    if isinstance(device.clock, SimulatedTime):
        device.clock.wait = session.wait_until_judged
    return Drive(device.positioner, session, itinerary, rules, device.clock, trouble=partial(_trouble, running),
                 budget_s=options.budget_s)  # fmt: skip


def _trouble(running: DrivenRun) -> str:
    """Why the run must be broken off, by its source and its recording."""
    status = running.source.status
    if status.recording_trouble:
        return f"nothing can be recorded any more: {status.recording_trouble.removesuffix('.')}"
    if status.link == "lost":
        return f"the link to the readings is lost ({status.trouble or 'it is tried again'})"
    if status.link == "ended":
        return f"the readings have ended{f' ({status.trouble})' if status.trouble else ''}"
    if running.error is not None:
        return f"the evaluation ended: {running.error}"
    return ""


def _follow(running: DrivenRun, name: str, device: Opened, as_json: bool,
            page: PageServer | None) -> None:  # fmt: skip
    """The run to its end; with a person as the positioner, Enter says that the gimbals stand."""
    from kf_calib.positioning.positioner import HandPositioner

    hand = device.positioner
    if isinstance(hand, HandPositioner):

        def listen() -> None:
            for _ in sys.stdin:
                hand.done()

        threading.Thread(target=listen, name="enter", daemon=True).start()
    follow(running, name, as_json, page)


def _code(running: DrivenRun) -> int:
    """The exit code, without that of --strict."""
    if running.drive_error is not None:
        raise running.drive_error
    ended = running.outcome
    for said in running.troubles:
        complain(said)
    if running.signalled is not None:
        return 128 + int(running.signalled)
    if ended is None or ended.is_halted or running.troubles:
        return 2
    return 0


def _tell_end(running: DrivenRun, as_json: bool) -> None:
    from kf_calib.positioning.text import ended_in_words

    if running.outcome is not None and not running.outcome.is_halted and not as_json:
        running.print(rendered(ended_in_words(running.outcome)), end=False)


def _show_dry_run(name: str, keys: BenchKeys, options: DriveOptions, as_json: bool) -> None:
    """Print the opening with its ways and times; the orientations after it are decided in the run."""
    import numpy as np

    from kf_calib.bench.bench import Bench
    from kf_calib.design.gimbal_limits import route
    from kf_calib.positioning import text as views

    usual: BenchKeys = {"axes": "y z x", "gravity_mps2": 9.81} if name.startswith("sim:") else {}
    bench = Bench.from_metadata({**usual, **keys})
    itinerary = _itinerary(bench, 60, options)
    poses, here = itinerary.opening_poses, np.zeros(len(bench.axes))
    ways, slews_s = list[list[Any]](), list[float]()
    for pose in poses:
        way = route(itinerary.limits, here, pose)
        if way is None:
            begin, end = (angles_in_words(np.degrees(angles).tolist()) for angles in (here, pose))
            raise InputError(
                f"no way from {begin} to {end} keeps out of the forbidden zones: widen what the bench file allows."
            )
        stations = [here, *way]
        slews_s.append(sum(float(itinerary.slew_times.slews_s(a, b)) for a, b in zip(stations, way, strict=False)))
        ways.append(way)
        here = pose
    made = poses, ways, slews_s, options.stay_s, itinerary.slew_times.overhead_s
    print_result(as_json, views.dry_run_object, views.dry_run, *made)
