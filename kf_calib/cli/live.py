"""The command that evaluates a run while it goes on: live."""

from __future__ import annotations

import contextlib
import math
import queue
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import rich_click as click

from kf_calib.cli.command import INPUT, NOT_NEGATIVE, POSITIVE, argument, command, option
from kf_calib.cli.echo import complain, json_line, rendered
from kf_calib.cli.failures import answered
from kf_calib.cli.files import RerunFile, claimed, delivery, output_option, write_view
from kf_calib.cli.live_page import PageOptions, page_server, page_state
from kf_calib.cli.live_run import LiveRun, pressed_keys
from kf_calib.cli.options import (
    BenchOptions,
    Device,
    EvaluationOptions,
    ForeignColumns,
    Json,
    NoAngles,
    Overwrite,
    Save,
    SaveModel,
    ShownUnits,
    Strict,
    exit_if,
    renamed,
    target_option,
)
from kf_calib.errors import InputError, KfCalibError
from kf_calib.support.text import sentence

if TYPE_CHECKING:
    from kf_calib.estimation.settings import Settings
    from kf_calib.online.session import HandJudgement
    from kf_calib.online.status import Judgement
    from kf_calib.views.live.server import PageServer
    from kf_calib.views.rerun.growing import GrowingView

RUNNING = "While it runs"
_REFRESH_S = 0.25


_running, _reading = (partial(option, panel=panel) for panel in (RUNNING, INPUT))


@dataclass(frozen=True)
class LiveOptions:
    """What is done while it runs, and how the source is read."""

    # fmt: off
    record: Annotated[Path | None, output_option(
        "--record", metavar="OUT.mcap", panel=RUNNING, help="Record the run here.")] = None
    targets: Annotated[tuple[str, ...], target_option(panel=RUNNING)] = ()
    auto: Annotated[bool, _running(
        "--auto", help="Accept a missing effect when it can be told from all others.")] = False
    with_viewer: Annotated[bool, _running(
        "--rerun", help="Show the run in the Rerun viewer, opened if none is.")] = False
    with_web_viewer: Annotated[bool, _running(
        "--rerun-web", help="Show it in Rerun's viewer for a browser, while the run goes on.")] = False
    rerun_port: Annotated[int, _running(
        "--rerun-port", type=click.IntRange(1, 65535), metavar="PORT", help="The viewer's port.")] = 9876
    rerun_bind: Annotated[str, _running(
        "--rerun-bind", metavar="ADDRESS", help="Address a viewer that is opened listens on.")] = "127.0.0.1"
    no_angles: NoAngles = False
    columns: ForeignColumns = ()
    header: Annotated[str, _reading("--header", metavar="NAMES", show_default=False,
                                    help="Names of the columns of CSV rows that come without any.")] = ""
    give_up_s: Annotated[float, _reading(
        "--give-up-s", type=NOT_NEGATIVE, help="Seconds for which a lost link is tried again.")] = 600.0
    idle_s: Annotated[float, _reading("--idle-s", type=POSITIVE, show_default="never",
                                      help="End the run when nothing has come for so long.")] = math.inf
    # fmt: on


@command(
    "live /dev/ttyUSB0 --bench bench.toml --record run.mcap --target theta=1arcsec --target K=2ppm --rerun",
    'live "sim://?speed=10&hide=second-order=4e-6" --target K=0.1ppm',
    "live /dev/ttyACM0 --no-angles --record hand.mcap --target K=500ppm",
    seldom=("with_web_viewer", "rerun_port", "rerun_bind", "page_port", "header", "give_up_s", "idle_s", "accel_unit",
            "model_file", "left_out", "save_model"),
)  # fmt: skip
@click.pass_context
def live(
    ctx: click.Context, source: Annotated[str, argument(metavar="SOURCE")], options: LiveOptions, page: PageOptions,
    device: Device, bench: BenchOptions, evaluation: EvaluationOptions, overwrite: Overwrite, rrd: RerunFile,
    save: Save, save_model: SaveModel, strict: Strict, units: ShownUnits, as_json: Json,
) -> None:  # fmt: skip
    """Evaluate a bench while it runs: sigmas, verdict and the next orientation as they stand; record it.

    SOURCE: a serial port, socket://HOST:PORT, rfc2217://HOST:PORT, - (standard input), a file that grows, or sim://.
    With --no-angles it is a sensor in the hand, and what is shown is which side to turn up next.
    Ctrl-C ends the run: the recording is finished and the summary printed.
    """
    from kf_calib.bench.paper_parameters import targets_of
    from kf_calib.online.session import HandSession, Session
    from kf_calib.sources.live import files_of, open_live

    outputs, record = claimed(files_of(source), overwrite=overwrite), options.record
    settings, wanted = evaluation.settings(), targets_of(options.targets)
    _refuse(settings, options.auto and options.no_angles)
    opening = partial(
        open_live, source, {**bench.keys, **device}, record, overwrite, columns=renamed(options.columns),
        header=options.header, give_up_s=options.give_up_s, idle_s=options.idle_s, angles=not options.no_angles,
    )  # fmt: skip
    with page_server(page) as server, opening() as opened:
        begin = HandSession if options.no_angles else partial(Session, auto=options.auto)
        run = LiveRun(
            opened, partial(begin, settings=settings, wanted=wanted), record, not sys.stdout.isatty() or as_json
        )
        view = _view(rrd, options)
        if view is not None:
            run.listeners.append(partial(_offer, view))
        with answered(run.handle_signal):  # until all is written: who closes a terminal sends several
            follow(run, source, as_json, server)
            if view is not None:
                view.close()
            opened.close()
            final = outcome(run, as_json)
            for said in [*_of_the_view(view), *run.troubles]:
                complain(said)
            if final is not None and final.result is not None:
                if rrd and view is not None and view.began:
                    outputs.allow_replacing(rrd)
                with delivery(outputs, as_json or run.print.lost > 0) as deliver:
                    deliver.calibration(save, final.result, run.recording() or opened)
                    deliver.model(save_model, final.result)
                    deliver.file(rrd, partial(write_view, final.result))  # by the noise of the whole run
    if run.troubles:
        ctx.exit(2)
    exit_if(strict and final is not None and final.consistent is False)


def _offer(view: GrowingView, judgement: Judgement | HandJudgement) -> None:
    from kf_calib.online.status import Judgement

    if judgement.result is not None:
        view.offer(judgement.result, judgement if isinstance(judgement, Judgement) else None)


def follow(run: LiveRun, name: str, as_json: bool, page: PageServer | None) -> None:
    """The run to its end, with a screen, lines or objects, and a page where there is one."""
    if page is not None:
        page.state = partial(page_state, run, name)
    run.start()
    if not as_json and sys.stdout.isatty():
        try:
            _on_screen(run, name, "" if page is None else f"   page: {page.url}")
        except OSError as error:  # the terminal is gone: the run is not
            run.print.fail(error)
    told = dict[str, str]()
    while run.going:
        with contextlib.suppress(queue.Empty):
            judgement = run.judgements.get(timeout=_REFRESH_S)
            _print(run, judgement, as_json)
        run.warn()
        now = _urgent_messages(run)
        for about, said in now.items():
            if said and said != told.get(about) and not as_json:
                _echo(run, sentence(said))
        told = now
    if page is not None:
        page.end()


def _urgent_messages(run: LiveRun) -> dict[str, str]:
    """What a user must know at once, about what: said again where it changes."""
    from kf_calib.online.session import HandStanding

    standing, status, doing = run.session.standing if run.session else None, run.source.status, run.doing()
    return {
        "bench": doing.line if doing else "",
        "task": standing.task if isinstance(standing, HandStanding) else "",
        "evaluation": (standing.problem or standing.notice) if standing else "",
        "link": "the link is lost, and tried again" if status.link == "lost" else "",
        "clock": status.clock_trouble,
    }


def _print(run: LiveRun, judgement: Judgement | HandJudgement, as_json: bool) -> None:
    from kf_calib.views.live.objects import line, live_object

    assert run.session is not None
    if as_json:
        known = live_object(judgement, run.session.standing, run.source.status)
        _echo(run, json_line(known | dict(run.further_keys())))
    elif not judgement.final:
        _echo(run, sentence(line(judgement)))


def _echo(run: LiveRun, text: str) -> None:
    """Where nobody reads any more, a run that is recorded goes on in silence; another ends."""
    was_heard = run.print.is_heard
    run.print(text)
    if was_heard and not run.print.is_heard:
        if run.source.status.sync_age_s is None:
            run.stop()
        else:
            complain("nobody reads this output any more; the recording goes on.")


def _on_screen(run: LiveRun, name: str, where: str) -> None:
    from rich.live import Live

    from kf_calib.online.session import HandSession
    from kf_calib.views.live.screen import screen
    from kf_calib.views.terminal import PlainConsole

    display = Live(console=PlainConsole(), auto_refresh=False, transient=True, redirect_stderr=sys.stderr.isatty())
    size = display.console.size
    with pressed_keys(use=name != "-") as pressed, display:
        while run.going:
            with contextlib.suppress(queue.Empty):
                run.judgements.get_nowait()
            run.warn()
            keys = "" if isinstance(run.session, HandSession) else "a: accept what is missing   "
            hint = "ending ..." if run.stopped else f"{keys}q: end the run{where}"
            if display.console.size != size:  # what was drawn for another width would stay in pieces
                size = display.console.size
                display.console.clear()
            display.update(screen(run.content(name), hint), refresh=True)
            key = pressed(_REFRESH_S)
            if key == "a":
                run.accept()
            elif key == "q":
                run.stop()


def outcome(run: LiveRun, as_json: bool) -> Judgement | HandJudgement | None:
    """The last judgement, after its summary; None where a run that was ended had nothing to evaluate yet."""
    if run.error is not None:
        if said := run.nothing_came:
            raise InputError(said)
        if not (run.stopped and isinstance(run.error, KfCalibError)):
            raise run.error
        if as_json:
            samples = run.session.standing.samples if run.session else 0
            run.print(json_line({"samples": samples, "dwells": 0, "final": True, "problem": str(run.error)}))
        else:
            complain(f"nothing to evaluate: {run.error}")
        return None
    final = run.final
    assert final is not None
    if not as_json:
        from rich.console import Group, RenderableType
        from rich.text import Text

        from kf_calib.online.status import Judgement
        from kf_calib.views import diagnosis
        from kf_calib.views.console import summary
        from kf_calib.views.terminal import VERDICT_STYLES

        assert final.result is not None
        diagnosed = isinstance(final, Judgement)
        parts: list[RenderableType] = [summary(final.result, diagnosed)]
        if diagnosed:
            parts.append(Text(diagnosis.verdict(final.diagnosis), style=VERDICT_STYLES[final.consistent]))
        run.print(rendered(Group(*parts)), end=False)
    return final


def _view(rrd: Path | None, options: LiveOptions) -> GrowingView | None:
    is_seen, web = options.with_viewer or options.with_web_viewer, options.with_web_viewer
    if rrd is None and not is_seen:
        return None
    from kf_calib.views.rerun.growing import GrowingView

    view = GrowingView(rrd, options.rerun_port if is_seen else None, options.rerun_bind, web=web)
    if view.url:
        complain(f"the Rerun view of this run is at {view.url}")
    return view


def _of_the_view(view: GrowingView | None) -> list[str]:
    if view is None:
        return []
    late = f"the Rerun view left out {view.dropped} updates: it was slower than the run" if view.dropped else ""
    return [said for said in (view.trouble, late) if said]


def _refuse(settings: Settings, accepts_by_hand: bool) -> None:
    if accepts_by_hand:
        raise click.UsageError("--auto accepts effects, which need the angles: leave out --auto or --no-angles.")
    if settings.engine != "block":
        raise click.UsageError(
            "live evaluates folded dwells, as the block engine does: leave out --engine, and check the recording with "
            "replay --engine filterpy."
        )
