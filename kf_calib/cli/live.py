"""The command that evaluates a run while it goes on: live."""

from __future__ import annotations

import contextlib
import math
import queue
import signal
import sys
import threading
from collections.abc import Callable, Mapping
from contextvars import copy_context
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich_click as click

from kf_calib.cli.echo import Printer, complain
from kf_calib.cli.files import claimed, delivery, output_option
from kf_calib.cli.live_keys import pressed_keys
from kf_calib.cli.numbers import NOT_NEGATIVE, POSITIVE
from kf_calib.cli.options import (
    INPUT,
    bench_options,
    columns_option,
    examples,
    filter_options,
    json_line,
    json_option,
    overrides,
    overwrite_option,
    pair,
    rendered,
    rrd_option,
    save_model_option,
    save_option,
    save_view,
    settings_of,
    strict_option,
    target_option,
    units_option,
)
from kf_calib.cli.signals import answered
from kf_calib.errors import InputError, KfCalibError
from kf_calib.support.plain_text import sentence

if TYPE_CHECKING:
    from kf_calib.bench.streams import Source
    from kf_calib.estimation.settings import Settings
    from kf_calib.online.session import Session
    from kf_calib.online.status import Judgement
    from kf_calib.sources.live import LiveSource
    from kf_calib.views.rerun.growing import GrowingView

RUNNING = "While it runs"
_REFRESH_S = 0.25


@click.command(
    epilog=examples(
        "live /dev/ttyUSB0 --bench bench.toml --record run.mcap --target theta=1arcsec --target K=2ppm --rerun",
        'live "sim://?speed=10&hide=second-order=4e-6" --target K=0.1ppm',
    )
)
@click.argument("source", metavar="SOURCE")
@output_option("--record", metavar="OUT.mcap", panel=RUNNING, help="Record the run here.")
@target_option(panel=RUNNING)
@click.option(
    "--auto", is_flag=True, panel=RUNNING, help="Accept a missing effect when it can be told from all others."
)
@click.option(
    "--rerun", "with_viewer", is_flag=True, panel=RUNNING, help="Show the run in the Rerun viewer, opened if none is."
)
@click.option(
    "--rerun-port",
    type=click.IntRange(1, 65535),
    default=9876,
    show_default=True,
    metavar="PORT",
    panel=RUNNING,
    help="The viewer's port.",
)
@click.option(
    "--rerun-bind",
    default="127.0.0.1",
    show_default=True,
    panel=RUNNING,
    metavar="ADDRESS",
    help="Address a viewer that is opened listens on.",
)
@columns_option
@click.option(
    "--header", default="", metavar="NAMES", panel=INPUT, help="Names of the columns of CSV rows that come without any."
)
@click.option(
    "--give-up-s",
    type=NOT_NEGATIVE,
    default=600.0,
    show_default=True,
    panel=INPUT,
    help="Seconds for which a lost link is tried again.",
)
@click.option(
    "--idle-s",
    type=POSITIVE,
    default=math.inf,
    show_default="never",
    panel=INPUT,
    help="End the run when nothing has come for so long.",
)
@bench_options
@filter_options
@overwrite_option
@rrd_option
@save_option
@save_model_option
@strict_option
@units_option
@json_option
@click.pass_context
def live(
    ctx: click.Context,
    source: str,
    record: Path | None,
    overwrite: bool,
    columns: tuple[str, ...],
    header: str,
    give_up_s: float,
    idle_s: float,
    targets: tuple[str, ...],
    auto: bool,
    with_viewer: bool,
    rerun_port: int,
    rerun_bind: str,
    rrd: Path | None,
    save: Path | None,
    save_model: Path | None,
    strict: bool,
    as_json: bool,
    **options: Any,
) -> None:
    """Evaluate a bench while it runs: sigmas, verdict and the next orientation as they stand; record it.

    SOURCE: a serial port, socket://HOST:PORT, rfc2217://HOST:PORT, - (standard input), a file that grows, or sim://.
    Ctrl-C ends the run: the recording is finished and the summary printed.
    """
    from kf_calib.bench.targets import targets_of
    from kf_calib.sources.live import files_of, open_live

    outputs = claimed(files_of(source), overwrite=overwrite)
    settings, wanted = settings_of(options), targets_of(targets)
    _refuse(settings)
    opening = open_live(
        source, overrides(options), record, overwrite, columns=dict(map(pair, columns)), header=header,
        give_up_s=give_up_s, idle_s=idle_s,
    )  # fmt: skip
    with opening as opened:
        run = _Run(opened, settings, wanted, auto, record, not sys.stdout.isatty() or as_json)
        view = _view(rrd, rerun_port if with_viewer else None, rerun_bind)
        if view is not None:
            run.listeners.append(lambda judgement: view.offer(judgement.result, judgement))
        with answered(run.handle_signal):  # until all is written: who closes a terminal sends several
            _follow(run, source, record, as_json)
            if view is not None:
                view.close()
            opened.close()
            final = _outcome(run, as_json)
            for said in [*_of_the_view(view), *run.troubles]:
                complain(said)
            if final is not None:
                if rrd and view is not None and view.began:
                    outputs.own(rrd)
                with delivery(outputs, as_json or run.print.lost > 0) as deliver:
                    deliver.calibration(save, final.result, run.recording() or opened)
                    deliver.model(save_model, final.result)
                    deliver.file(rrd, lambda path: save_view(final.result, path))  # by the noise of the whole run
    if run.troubles:
        ctx.exit(2)
    if strict and final is not None and final.consistent is False:
        ctx.exit(1)


class _Run:
    """A session in a thread of its own: the main thread has the screen, the keys and the signals.

    judgements: those not shown yet. stopped: by a key or a signal. print: to standard output.
    """

    def __init__(
        self,
        source: LiveSource,
        settings: Settings,
        wanted: Mapping[str, float],
        auto: bool,
        record: Path | None,
        every: bool,
    ) -> None:
        self.source, self.stopped, self.unshown = source, False, 0
        self.print, self._is_warned = Printer(), False
        self.session: Session | None = None
        self.final: Judgement | None = None
        self.error: BaseException | None = None
        self.listeners: list[Callable[[Judgement], None]] = [self._keep]
        self.judgements = queue.Queue["Judgement"](256)
        self._record = record
        work = self._work, settings, wanted, auto, every
        self._thread = threading.Thread(target=copy_context().run, args=work, daemon=True)  # in the units chosen

    def start(self) -> None:
        self._thread.start()

    @property
    def going(self) -> bool:
        return self._thread.is_alive() or not self.judgements.empty()

    def stop(self) -> None:
        self.stopped = True
        self.source.stop()
        if self.session is not None:
            self.session.hurry()

    def handle_signal(self, number: signal.Signals) -> None:
        """To end, by a signal, as its end would; a second Ctrl-C does not wait for it."""
        if number == signal.SIGINT and (self.stopped or not self.going):
            raise KeyboardInterrupt
        self.stop()

    def warn(self) -> None:
        """Say at once, and once, that nothing is recorded any more."""
        trouble = self.source.status.recording_trouble
        if trouble and not self._is_warned:
            complain(f"RECORDING HAS STOPPED: {trouble}")
            self._is_warned = True

    @property
    def troubles(self) -> list[str]:
        """What failed, though the run went on to its end: it is no success then."""
        trouble, lost = self.source.status.recording_trouble, self.print.lost
        unheard = f"{lost} output{'s' * (lost != 1)} could not be written to standard output: they are lost."
        return [f"the run was not recorded to its end: {trouble}"] * bool(trouble) + [unheard] * bool(lost)

    def accept(self) -> None:
        """The effect that is missing, as it stands."""
        judgement = self.session.standing.judgement if self.session else None
        if self.session is None or judgement is None:
            return
        try:
            if not (judgement.alarm and judgement.found.missing):
                raise InputError("no effect is known to be missing: nothing to accept.")
            self.session.accept(*judgement.found.missing)
        except InputError as error:
            self.session.say(str(error))

    def recording(self) -> Source | None:
        """What was recorded of the run; None where nothing was, or not all."""
        from kf_calib.sources.files.recording import Recording

        return Recording(self._record) if self._record and not self.source.status.recording_trouble else None

    def _work(self, settings: Settings, wanted: Mapping[str, float], auto: bool, every: bool) -> None:
        from kf_calib.online.session import Session

        try:
            self.session = Session(self.source, settings, wanted, every=every, auto=auto, again=self.recording)
            self.session.listeners += self.listeners
            self.final = self.session.run()
        except BaseException as error:  # for the main thread to tell
            self.error = error

    def _keep(self, judgement: Judgement) -> None:
        try:
            self.judgements.put_nowait(judgement)
        except queue.Full:
            self.unshown += 1


def _follow(run: _Run, name: str, record: Path | None, as_json: bool) -> None:
    """The run to its end, with a screen, lines or objects."""
    run.start()
    if not as_json and sys.stdout.isatty():
        try:
            _on_screen(run, name, record)
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


def _urgent_messages(run: _Run) -> dict[str, str]:
    """What a user must know at once, about what: said again where it changes."""
    standing, status = run.session.standing if run.session else None, run.source.status
    return {
        "evaluation": (standing.problem or standing.notice) if standing else "",
        "link": "the link is lost, and tried again" if status.link == "lost" else "",
        "clock": status.clock_trouble,
    }


def _print(run: _Run, judgement: Judgement, as_json: bool) -> None:
    from kf_calib.views import live as views

    assert run.session is not None
    if as_json:
        _echo(run, json_line(views.live_object(judgement, run.session.standing, run.source.status)))
    elif not judgement.final:
        _echo(run, sentence(views.line(judgement)))


def _echo(run: _Run, text: str) -> None:
    """Where nobody reads any more, a run that is recorded goes on in silence; another ends."""
    was_heard = run.print.is_heard
    run.print(text)
    if was_heard and not run.print.is_heard:
        if run.source.status.sync_age_s is None:
            run.stop()
        else:
            complain("nobody reads this output any more; the recording goes on.")


def _on_screen(run: _Run, name: str, record: Path | None) -> None:
    from rich.live import Live

    from kf_calib.online.status import Standing
    from kf_calib.views.live import screen
    from kf_calib.views.terminal import PlainConsole

    display = Live(console=PlainConsole(), auto_refresh=False, transient=True, redirect_stderr=sys.stderr.isatty())
    with pressed_keys(use=name != "-") as pressed, display:
        while run.going:
            with contextlib.suppress(queue.Empty):
                run.judgements.get_nowait()
            run.warn()
            standing = run.session.standing if run.session else Standing()
            hint = "ending ..." if run.stopped else "a: accept what is missing   q: end the run"
            display.update(screen(standing, run.source.status, name, str(record or ""), hint), refresh=True)
            key = pressed(_REFRESH_S)
            if key == "a":
                run.accept()
            elif key == "q":
                run.stop()


def _outcome(run: _Run, as_json: bool) -> Judgement | None:
    """The last judgement, after its summary; None where a run that was ended had nothing to evaluate yet."""
    if run.error is not None:
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
        from rich.console import Group
        from rich.text import Text

        from kf_calib.views import diagnosis
        from kf_calib.views.console import summary

        style = {True: "bold green", False: "bold yellow", None: "bold"}[final.consistent]
        run.print(rendered(Group(summary(final.result), Text(diagnosis.verdict(final.found), style=style))), end=False)
    return final


def _view(rrd: Path | None, port: int | None, bind: str) -> GrowingView | None:
    if rrd is None and port is None:
        return None
    from kf_calib.views.rerun.growing import GrowingView

    return GrowingView(rrd, port, bind)


def _of_the_view(view: GrowingView | None) -> list[str]:
    if view is None:
        return []
    late = f"the Rerun view left out {view.dropped} updates: it was slower than the run" if view.dropped else ""
    return [said for said in (view.trouble, late) if said]


def _refuse(settings: Settings) -> None:
    if settings.engine != "block":
        raise click.UsageError(
            "live evaluates folded dwells, as the block engine does: leave out --engine, and check the recording with "
            "replay --engine filterpy."
        )
