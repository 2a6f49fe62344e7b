"""A live run in a thread of its own, beside the screen, the signals, and the keys pressed on its terminal."""

from __future__ import annotations

import contextlib
import errno
import os
import queue
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextvars import copy_context
from pathlib import Path
from typing import TYPE_CHECKING

from kf_calib.cli.echo import Printer, complain
from kf_calib.errors import InputError, KfCalibError
from kf_calib.support.text import counted

if TYPE_CHECKING:
    from kf_calib.bench.streams import Source
    from kf_calib.online.session import HandJudgement, HandSession, Session
    from kf_calib.online.status import Judgement
    from kf_calib.sources.live import LiveSource
    from kf_calib.views.live.content import Content, Doing


class LiveRun:
    """A session in a thread of its own: the main thread has the screen, the keys and the signals.

    begin: a class of sessions, with how it evaluates. judgements: those not shown yet. stopped: by a key or a signal.
    print: to standard output. further_keys: of every JSON object. doing: what a bench that drives itself does; None for
    another.
    """

    further_keys: Callable[[], Mapping[str, object]] = staticmethod(dict)
    doing: Callable[[], Doing | None] = staticmethod(lambda: None)

    def __init__(
        self,
        source: LiveSource,
        begin: Callable[..., Session | HandSession],
        record: Path | None,
        every: bool,
    ) -> None:
        self.source, self.stopped, self.unshown = source, False, 0
        self.print, self._is_warned = Printer(), False
        self.session: Session | HandSession | None = None
        self.final: Judgement | HandJudgement | None = None
        self.error: BaseException | None = None
        self.listeners: list[Callable[[Judgement | HandJudgement], None]] = [self._keep]
        self.judgements = queue.Queue["Judgement | HandJudgement"](256)
        self._record, self._begin = record, begin
        work = self._work, every
        self._thread = threading.Thread(target=copy_context().run, args=work, daemon=True)  # in the units chosen

    def content(self, name: str) -> Content:
        """What is shown of the run now; name: of its source."""
        from kf_calib.online.status import RunStatus
        from kf_calib.views.live.content import content_of

        standing = self.session.standing if self.session else RunStatus()
        return content_of(standing, self.source.status, name, str(self._record or ""), self.doing())

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
        unheard = f"{counted(lost, 'output')} could not be written to standard output: they are lost."
        return [f"the run was not recorded to its end: {trouble}"] * bool(trouble) + [unheard] * bool(lost)

    def accept(self) -> None:
        """The effect that is missing, as it stands."""
        from kf_calib.online.status import Judgement

        judgement = self.session.standing.judgement if self.session else None
        if self.session is None or not isinstance(judgement, Judgement):
            return
        try:
            if not (judgement.alarm and judgement.diagnosis.missing):
                raise InputError("no effect is known to be missing: nothing to accept.")
            self.session.accept(*judgement.diagnosis.missing)
        except InputError as error:
            self.session.say(str(error))

    @property
    def nothing_came(self) -> str:
        """That no reading came, and what came instead, if that is why nothing can be said; else empty."""
        status = self.source.status
        if status.samples or not isinstance(self.error, KfCalibError):
            return ""
        if self.session is None and (status.bytes or self.error is not self.source.failure):
            return ""  # what came, or what was asked for, is why it could not begin
        kinds = {"angle": status.poses, "temperature": status.temperatures, "refused line": status.refused}
        counts = [counted(count, what) for what, count in kinds.items() if count]
        instead = f", but {' and '.join(counts)}" if counts else ""
        refusal = f" (the first: {status.first_refusal})" if status.first_refusal else ""
        recorded = "nothing was recorded: " if self._record else ""
        return (f"{recorded}no reading came from {self.source.name}{instead}{refusal}: check that the bench is on and "
                "sends readings.")  # fmt: skip

    def recording(self) -> Source | None:
        """What was recorded of the run; None where nothing was, or not all."""
        from kf_calib.sources.files.recording import Recording

        status = self.source.status
        if self._record is None or status.recording_trouble or not status.samples:
            return None
        return Recording(self._record, angles=self.source.bench.angles)

    def _work(self, every: bool) -> None:
        try:
            self.session = self._begin(self.source, every=every, again=self.recording)
            for listener in self.listeners:
                self.session.listeners.append(listener)
            self.final = self.session.run()
        except BaseException as error:  # for the main thread to tell
            self.error = error

    def _keep(self, judgement: Judgement | HandJudgement) -> None:
        try:
            self.judgements.put_nowait(judgement)
        except queue.Full:
            self.unshown += 1


_LOOK_S = 0.02  # Windows can only be asked whether a key was pressed


@contextlib.contextmanager
def pressed_keys(use: bool) -> Iterator[Callable[[float], str]]:
    """A function that waits for a key so long, and gives it or nothing."""
    if not (use and sys.stdin.isatty()):
        yield _no_key
    elif sys.platform == "win32":
        yield _windows_key
    else:
        import termios
        import tty

        before = termios.tcgetattr(sys.stdin)
        tty.setcbreak(sys.stdin)
        try:
            yield _key
        finally:
            with contextlib.suppress(termios.error):  # the terminal is gone
                termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)


def _key(seconds: float) -> str:
    if not select.select([0], [], [], seconds)[0]:
        return ""
    key = os.read(0, 1)
    if not key:
        raise OSError(errno.EIO, os.strerror(errno.EIO))  # as a terminal says that is gone
    return key.decode(errors="replace")


def _windows_key(seconds: float) -> str:
    assert sys.platform == "win32"
    import msvcrt

    end_s = time.monotonic() + seconds
    while not msvcrt.kbhit():
        if time.monotonic() >= end_s:
            return ""
        time.sleep(_LOOK_S)
    key = msvcrt.getwch()
    if key == "\x03":  # where the console hands Ctrl-C on as a key
        raise KeyboardInterrupt
    return key


def _no_key(seconds: float) -> str:
    time.sleep(seconds)
    return ""
