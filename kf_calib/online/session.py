"""A run evaluated while it is recorded: batches of readings in, a ``Judgement`` out after every dwell.

The thread that calls ``run`` folds the readings as they come, and evaluates the open dwell after 1, 2, 4 ... s. A
second thread judges the dwells that have closed. Neither waits for the other or for whoever shows the results. The
readings are folded as a replay of the recording folds them: the final result is the same to the last bit.

    session = Session(source, settings)
    session.listeners.append(print)     # each judgement, from the judging thread: must not block
    final = session.run()
    session.accept("second-order")      # from any thread during the run: the effect is in all later judgements
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Mapping
from contextvars import copy_context
from dataclasses import dataclass, replace

from kf_calib.bench.streams import Batch, Source
from kf_calib.dwells.blocks import Tally
from kf_calib.dwells.sufficient_statistics import Folder
from kf_calib.errors import InputError, KfCalibError
from kf_calib.estimation.dwell_pass import Pass
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.settings import Settings
from kf_calib.online.status import Judgement, Standing, current, judge_so_far, judge_whole_run, targets
from kf_calib.support.threads import one_blas_thread

_FIRST_LOOK_S = 1.0


@dataclass(frozen=True)
class _Closed:
    """A state to be judged: the pass when a dwell closed, and the bench time of that moment in s."""

    passed: Pass
    elapsed_s: float


class Session:
    """The evaluation of a source as its readings come.

    source: of the readings. settings: of the calibration. wanted: targets of sigmas by symbol, SI. every: judge after
    each dwell, even where dwells close faster than they are judged; False: judge the newest only. auto: accept an
    effect that is missing once it has been told from all others. again: gives the readings once more when the source
    has ended, from its recording; None where there is none.
    """

    def __init__(
        self,
        source: Source,
        settings: Settings | None = None,
        wanted: Mapping[str, float] | None = None,
        *,
        every: bool = True,
        auto: bool = False,
        again: Callable[[], Source | None] | None = None,
    ) -> None:
        self.source, self.settings, self.wanted = source, settings or Settings(), targets(wanted or {})
        self.every, self.auto, self.again = every, auto, again
        self.listeners = list[Callable[[Judgement], None]]()
        self.standing = Standing(model=self.settings.effects)
        self._passed = Pass(source, self.settings)
        self._refuse(self._passed.model)
        self._segmenter = self._passed.segmenter()
        self._closed, self._looked_s = 0, 0.0
        self._lock = threading.Condition()
        self._waiting, self._ended, self._hurried = deque[_Closed](), False, False
        self._last: _Closed | None = None

    def run(self) -> Judgement:
        """Evaluate the source to its end and return the final judgement.

        Raises KfCalibError where the readings allow no judgement.
        """
        failure: Exception | None = None
        with one_blas_thread():  # for both threads: setting it in one would change the other's
            judge = threading.Thread(target=copy_context().run, args=(self._judge,), name="judge", daemon=True)
            judge.start()
            try:
                for batch in self.source:  # read to its end even after a failure, as the source may be recording
                    try:
                        if failure is None:
                            self._take(batch)
                    except Exception as error:
                        failure = error
                        self.say(f"the evaluation stopped: {error}")
                if failure is None:
                    self._finish()
            finally:
                with self._lock:
                    self._ended = True
                    self._lock.notify_all()
                judge.join()
            if failure is not None:
                raise failure
            return self._conclude()

    def accept(self, *names: str) -> None:
        """Add effects (names or formulas) to the model from now on; raises InputError where one cannot be added."""
        with self._lock:
            settings = replace(self.settings, effects=(*self.settings.effects, *names))
            self._refuse(Model.of(self.source.bench, settings.effects), begun=True)
            self.settings = settings
            self._publish(notice=f"{' and '.join(names)} accepted", model=self.settings.effects)
            if self._last is not None and not self._waiting:
                self._waiting.append(self._last)
            self._lock.notify_all()

    def hurry(self) -> None:
        """Skip all judgements but the final one, because the run is to end."""
        with self._lock:
            self._hurried = True
            self._waiting.clear()
            self._lock.notify_all()

    def _refuse(self, model: Model, begun: bool = False) -> None:
        """Raise InputError where the model needs more than a source whose readings come once can give."""
        if self.settings.engine != "block":
            raise InputError(
                "a live run is evaluated from folded dwells, as the block engine does: leave out --engine, and check "
                "the recording with replay --engine filterpy."
            )
        if model.oscillates:
            raise InputError(
                f"{model.oscillation} needs a second pass over the readings: record the run, then "
                f"replay the recording --with {model.oscillation}."
            )
        moving = [str(effect) for effect in model.dynamic]
        if begun and moving and not self._segmenter.slews:
            raise InputError(
                f"{moving[0]} shows in slews, which have not been kept from the start: begin with --with {moving[0]}, "
                "or replay the recording with it."
            )

    def _take(self, batch: Batch) -> None:
        """Fold a batch, hand over the dwells that it closes, and evaluate the open dwell when that is due."""
        passed, segmenter = self._passed, self._segmenter
        for rows in passed.rows_of(segmenter.push(batch)):
            passed.add(rows)
        elapsed_s = self.standing.elapsed_s
        if len(batch.accel) and segmenter.first_ns is not None:
            elapsed_s = max(elapsed_s, float(batch.accel.time_ns[-1] - segmenter.first_ns) / 1e9)
        standing, folded = segmenter.standing, passed.folder.dwells
        closed = sum(1 for dwell in folded[self._closed :] if standing is None or dwell.number < standing)
        with self._lock:
            self._publish(samples=passed.tally.read, elapsed_s=elapsed_s)
        self._close_next(closed, elapsed_s)
        self._look(standing, elapsed_s)

    def _finish(self) -> None:
        """Fold the last readings and hand over the dwells that are left."""
        passed = self._passed
        for rows in passed.rows_of(self._segmenter.finish()):
            passed.add(rows)
        self._close_next(len(passed.folder.dwells) - self._closed, self.standing.elapsed_s)
        with self._lock:
            self._publish(samples=passed.tally.read, current=None)

    def _close_next(self, count: int, elapsed_s: float) -> None:
        """Hand over the next closed dwells, one by one."""
        for _ in range(count):
            self._closed += 1
            self._close(elapsed_s)

    def _close(self, elapsed_s: float) -> None:
        """Hand the dwells that have closed to the judging thread; they do not change any more."""
        passed, folder = self._passed, Folder()
        folder.dwells, folder.slews = passed.folder.dwells[: self._closed], list(passed.folder.slews)
        closed = _Closed(replace(passed, tally=replace(passed.tally), folder=folder), elapsed_s)
        with self._lock:
            self._last = closed
            if not self.every:
                self._waiting.clear()
            if not self._hurried:
                self._waiting.append(closed)
            self._looked_s = 0.0
            self._publish(dwells=self._closed, current=None)
            self._lock.notify_all()

    def _look(self, standing: int | None, elapsed_s: float) -> None:
        """Evaluate a copy of the open dwell when it has lasted 1, 2, 4 ... s."""
        if standing is None:
            return
        folder, open_dwells = Folder(), self._passed.folder.dwells[self._closed :]
        folder.dwells = list(open_dwells[-1:])
        arrival_s = self._segmenter.arrival_s
        if elapsed_s - arrival_s < max(2.0 * self._looked_s, _FIRST_LOOK_S):
            return
        aside = replace(self._passed, tally=Tally(), folder=folder)
        for rows in aside.rows_of(self._segmenter.waiting()):
            folder.add(rows)
        if not folder.dwells or folder.dwells[-1].count < 8:
            return
        self._looked_s = elapsed_s - arrival_s
        here = current(folder.dwells[-1], self.standing.judgement)
        with self._lock:
            self._publish(current=here)

    def _judge(self) -> None:
        """Judge dwells as they close, in order; this is what the judging thread runs."""
        before = None
        while (closed := self._next()) is not None:
            with self._lock:
                settings = self.settings
            try:
                judgement = judge_so_far(replace(closed.passed, settings=settings), self.wanted, before)
            except KfCalibError as error:
                with self._lock:
                    self._publish(problem=str(error))
                continue
            except Exception as error:  # the run goes on; its end is judged from the start
                self.say(f"a dwell could not be judged: {error!r}")
                continue
            before = judgement
            self._publish_judgement(judgement, closed.elapsed_s)
            self._automatic(judgement)

    def _next(self) -> _Closed | None:
        """Wait for the next state to be judged; None after the end."""
        with self._lock:
            self._lock.wait_for(lambda: self._waiting or self._ended)
            return self._waiting.popleft() if self._waiting else None

    def _publish_judgement(self, judgement: Judgement, elapsed_s: float) -> None:
        """Publish a judgement and pass it to the listeners."""
        with self._lock:
            self._publish(judgement=judgement, judged_s=elapsed_s, problem="")
        for listener in list(self.listeners):
            listener(judgement)

    def _automatic(self, judgement: Judgement) -> None:
        """With ``auto``, accept the missing effects once several judgements in a row were sure of them."""
        if not (self.auto and judgement.alarm and judgement.look.settled):
            return
        found = judgement.found
        if not found.sure:
            return
        try:
            self.accept(*found.missing)
        except InputError as error:
            self.say(str(error))

    def _conclude(self) -> Judgement:
        """Return the final judgement of the whole run."""
        before = self.standing.judgement
        passed = replace(self._passed, settings=self.settings)
        again = None if self.again is None else self.again()
        final = judge_whole_run(passed, self.wanted, None if before is None else before.watch, again)
        self._publish_judgement(final, self.standing.elapsed_s)
        return final

    def say(self, notice: str) -> None:
        """Show a sentence to the user."""
        with self._lock:
            self._publish(notice=notice)

    def _publish(self, **changed: object) -> None:
        """Replace parts of the standing; to be called with the lock held."""
        self.standing = replace(self.standing, **changed)
