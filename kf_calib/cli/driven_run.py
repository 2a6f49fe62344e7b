"""A live run whose bench is driven: a drive beside the session, and one end for both, with the table stopped first."""

from __future__ import annotations

import json
import signal
import threading
import time
from collections.abc import Callable, Mapping
from contextvars import copy_context
from pathlib import Path
from typing import TYPE_CHECKING

from kf_calib.cli.echo import complain
from kf_calib.cli.live_run import LiveRun

if TYPE_CHECKING:
    from kf_calib.positioning.drive import Decision, Drive, Outcome
    from kf_calib.sources.live import LiveSource

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
        from kf_calib.sources.files.decision_records import DECISION_RECORD

        facts = {
            "number": str(decision.number), "at_s": f"{decision.at_s:.3f}", "purpose": decision.purpose,
            "gimbal_deg": json.dumps(decision.gimbal_deg), "stay_s": f"{decision.stay_s:g}", "why": decision.why,
        }  # fmt: skip
        self.source.mark(DECISION_RECORD, facts)

    def _mark_end(self, outcome: Outcome) -> None:
        from kf_calib.sources.files.decision_records import END_RECORD

        facts = {
            "ended": outcome.ended, "why": outcome.why, "stands_at_deg": json.dumps(outcome.stands_at),
            "stopped": str(outcome.stopped).lower(), "lasted_s": f"{outcome.lasted_s:.3f}",
        }  # fmt: skip
        self.source.mark(END_RECORD, facts)
        if outcome.is_halted:
            complain(halt_in_words(outcome))

    def _keys(self) -> Mapping[str, object]:
        from kf_calib.views.run import run_object

        return {} if self.drive is None else {"run": run_object(self.drive)}

    def _doing(self) -> str:
        from kf_calib.views.run import doing_in_words

        return "" if self.drive is None else doing_in_words(self.drive)


def halt_in_words(outcome: Outcome) -> str:
    """Why the table was stopped, where it stands, and what to do, in one sentence each."""
    from kf_calib.views.run import angles_in_words

    if not outcome.stopped:
        last = f"; it was last seen at {angles_in_words(outcome.stands_at)}" if outcome.stands_at else ""
        return (
            f"{outcome.why}: the positioner did not take the command to stop, AND THE TABLE MAY STILL MOVE{last}. "
            "Press its emergency stop, and look before you start again."
        )
    where = f"The table was stopped and stands at {angles_in_words(outcome.stands_at)}"
    return f"{outcome.why}. {where}; nothing moves before you start again."
