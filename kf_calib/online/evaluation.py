"""What every evaluation of a run has while the run goes on: two threads, neither of which waits for the other.

The thread that calls ``run`` folds the readings as they come, and looks at the open dwell after 1, 2, 4 ... s. A second
thread judges the dwells that have closed. Nobody who shows the results holds either up: what is known at the moment is
a ``Progress``. The readings are folded as a replay of the recording folds them.

Whoever has a loop of its own does without the threads: ``ingest`` takes a batch and judges the dwells that it closes,
``finish`` gives the final judgement.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextvars import copy_context
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats, one_blas_thread
from kf_calib.bench.streams import Batch, Source
from kf_calib.dwells.blocks import SampleCounts
from kf_calib.dwells.folding import Folder
from kf_calib.dwells.limits import FEWEST_READINGS
from kf_calib.dwells.sufficient_statistics import Dwell
from kf_calib.errors import InputError, KfCalibError
from kf_calib.estimation.dwell_pass import Pass
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.settings import Settings
from kf_calib.support.text import listing

_FIRST_LOOK_S = 1.0


@dataclass(frozen=True)
class Progress:
    """What is known of a run at a moment.

    samples: number of readings. elapsed_s: time of the last of them. dwells: number of closed dwells. judged_s,
    looked_s: times of the latest judgement, and of the latest look at the open dwell. problem: why there is no
    judgement. notice: the latest action, such as an effect that was accepted or refused. model: effects in the model.
    """

    samples: int = 0
    elapsed_s: float = 0.0
    dwells: int = 0
    judged_s: float = 0.0
    looked_s: float = 0.0
    problem: str = ""
    notice: str = ""
    model: Sequence[str] = ()


def targets(texts: Mapping[str, float]) -> Floats:
    """Targets (12,) of the sigmas in SI, from numbers by symbol; NaN where there is none."""
    return np.array([texts.get(symbol, np.nan) for symbol in paper_parameters.SYMBOLS])


J = TypeVar("J")
S = TypeVar("S", bound=Progress)


@dataclass(frozen=True)
class _Closed:
    """A state to be judged: the pass when a dwell closed, and the time of that moment in s."""

    passed: Pass
    elapsed_s: float


class Evaluation(ABC, Generic[J, S]):
    """The evaluation of a source as its readings come, with judgements of type J and a standing of type S.

    source: of the readings. settings: of the calibration. wanted: targets of sigmas by symbol, SI. every: judge after
    each dwell, even where dwells close faster than they are judged; False: judge the newest only. again: gives the
    readings once more when the source has ended, from its recording; None where there is none.
    """

    def __init__(
        self,
        source: Source,
        settings: Settings | None = None,
        wanted: Mapping[str, float] | None = None,
        *,
        every: bool = True,
        again: Callable[[], Source | None] | None = None,
    ) -> None:
        self.source, self.settings, self.wanted = source, settings or Settings(), targets(wanted or {})
        self.every, self.again = every, again
        self.listeners = list[Callable[[J], None]]()
        self.standing = self._first_standing()
        self._passed = Pass(source, self.settings)
        self._segmenter = self._passed.segmenter()
        self._closed, self._looked_s = 0, 0.0
        self._lock = threading.Condition()
        self._waiting, self._ended, self._hurried = deque[_Closed](), False, False
        self._last: _Closed | None = None
        self._before: J | None = None
        self._taken, self._is_judging = 0, False
        if self.settings.engine != "block":
            raise InputError(
                "a live run is evaluated from folded dwells, as the block engine does: leave out --engine, and check "
                "the recording with replay --engine filterpy."
            )
        self._refuse(self._passed.model)

    @abstractmethod
    def _first_standing(self) -> S:
        """Return the standing before the first reading."""

    @abstractmethod
    def _refuse(self, model: Model, begun: bool = False) -> None:
        """Raise InputError for a model that such a run cannot determine, or no longer where it has ``begun``."""

    @abstractmethod
    def _judged(self, passed: Pass, before: J | None) -> J:
        """Return the judgement of the dwells so far; raises KfCalibError where there can be none."""

    @abstractmethod
    def _judged_whole(self, passed: Pass, before: J | None, again: Source | None) -> J:
        """Return the judgement of the whole run; raises KfCalibError where there can be none."""

    @abstractmethod
    def _seen(self, dwell: Dwell) -> Any:
        """Return what the open dwell shows so far, for ``current`` of the standing."""

    def _judged_next(self, judgement: J) -> None:
        """Do what a judgement asks for, once it is published."""

    def _progress(self) -> Mapping[str, object]:
        """Return further parts of the standing that change with every batch."""
        return {}

    def accept(self, *names: str) -> None:
        """Add effects (names or formulas) to the model from now on; raises InputError where one cannot be added."""
        with self._lock:
            settings = replace(self.settings, effects=(*self.settings.effects, *names))
            self._refuse(Model.of(self.source.bench, settings.effects), begun=True)
            self.settings = settings
            self._publish(notice=f"{listing(names)} accepted", model=self.settings.effects)
            if self._last is not None and not self._waiting:
                self._waiting.append(self._last)
            self._lock.notify_all()

    def run(self) -> J:
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

    def ingest(self, batch: Batch) -> None:
        """Fold a batch and judge the dwells that it closes, all in the calling thread; not beside ``run``.

        Raises KfCalibError where the readings allow no evaluation.
        """
        with one_blas_thread():
            self._take(batch)
            self._judge_waiting()

    def finish(self) -> J:
        """Return the final judgement of all batches that were ingested.

        Raises KfCalibError where the readings allow no judgement.
        """
        with one_blas_thread():
            self._finish()
            self._judge_waiting()
            return self._conclude()

    def wait_until_judged(self, readings: int, seconds: float) -> bool:
        """Wait until so many readings have been taken in and all dwells that closed have been judged; False if that
        takes longer than ``seconds``, or the run has ended."""

        def is_done() -> bool:
            return self._ended or (self._taken >= readings and not self._waiting and not self._is_judging)

        with self._lock:
            return self._lock.wait_for(is_done, seconds) and not self._ended

    def hurry(self) -> None:
        """Skip all judgements but the final one, because the run is to end."""
        with self._lock:
            self._hurried = True
            self._waiting.clear()
            self._lock.notify_all()

    def say(self, notice: str) -> None:
        """Show a sentence to the user."""
        with self._lock:
            self._publish(notice=notice)

    def _take(self, batch: Batch) -> None:
        """Fold a batch, hand over the dwells that it closes, evaluate the open dwell when that is due, and count it."""
        passed, segmenter = self._passed, self._segmenter
        for rows in passed.rows_of(segmenter.push(batch)):
            passed.add(rows)
        elapsed_s = self.standing.elapsed_s
        if len(batch.accel) and segmenter.first_ns is not None:
            elapsed_s = max(elapsed_s, float(batch.accel.time_ns[-1] - segmenter.first_ns) / 1e9)
        standing, folded = segmenter.standing, passed.folder.dwells
        closed = sum(1 for dwell in folded[self._closed :] if standing is None or dwell.number < standing)
        with self._lock:
            self._publish(samples=passed.counts.read, elapsed_s=elapsed_s, **self._progress())
        self._close_next(closed, elapsed_s)
        self._snapshot(standing, elapsed_s)
        with self._lock:
            self._taken += len(batch.accel)
            self._lock.notify_all()

    def _finish(self) -> None:
        """Fold the last readings and hand over the dwells that are left."""
        passed = self._passed
        for rows in passed.rows_of(self._segmenter.finish()):
            passed.add(rows)
        self._close_next(len(passed.folder.dwells) - self._closed, self.standing.elapsed_s)
        with self._lock:
            self._publish(samples=passed.counts.read, current=None)

    def _close_next(self, count: int, elapsed_s: float) -> None:
        """Hand the next closed dwells to the judging thread, one by one; they do not change any more."""
        for _ in range(count):
            self._closed += 1
            passed, folder = self._passed, Folder()
            folder.dwells, folder.slews = passed.folder.dwells[: self._closed], list(passed.folder.slews)
            closed = _Closed(replace(passed, counts=replace(passed.counts), folder=folder), elapsed_s)
            with self._lock:
                self._last = closed
                if not self.every:
                    self._waiting.clear()
                if not self._hurried:
                    self._waiting.append(closed)
                self._looked_s = 0.0
                self._publish(dwells=self._closed, current=None)
                self._lock.notify_all()

    def _snapshot(self, standing: int | None, elapsed_s: float) -> None:
        """Evaluate a copy of the open dwell when it has lasted 1, 2, 4 ... s."""
        if standing is None:
            return
        folder, open_dwells = Folder(), self._passed.folder.dwells[self._closed :]
        folder.dwells = list(open_dwells[-1:])
        arrival_s = self._segmenter.arrival_s
        if elapsed_s - arrival_s < max(2.0 * self._looked_s, _FIRST_LOOK_S):
            return
        aside = replace(self._passed, counts=SampleCounts(), folder=folder)
        for rows in aside.rows_of(self._segmenter.waiting()):
            folder.add(rows)
        if not folder.dwells or folder.dwells[-1].count < FEWEST_READINGS:
            return
        self._looked_s = elapsed_s - arrival_s
        here = self._seen(folder.dwells[-1])
        with self._lock:
            self._publish(current=here, looked_s=elapsed_s)

    def _judge(self) -> None:
        """Judge dwells as they close, in order; this is what the judging thread runs."""
        while (closed := self._next()) is not None:
            self._judge_dwell(closed)

    def _judge_waiting(self) -> None:
        """Judge what waits to be judged."""
        while self._waiting:
            self._judge_dwell(self._waiting.popleft())

    def _judge_dwell(self, closed: _Closed) -> None:
        """Judge a state, publish the judgement, and do what it asks for."""
        with self._lock:
            settings = self.settings
        try:
            judgement = self._judged(replace(closed.passed, settings=settings), self._before)
        except KfCalibError as error:
            with self._lock:
                self._publish(problem=str(error))
            return
        except Exception as error:  # the run goes on; its end is judged from the start
            self.say(f"a dwell could not be judged: {error!r}")
            return
        self._before = judgement
        self._publish_judgement(judgement, closed.elapsed_s)
        self._judged_next(judgement)

    def _next(self) -> _Closed | None:
        """Wait for the next state to be judged; None after the end."""
        with self._lock:
            self._is_judging = False
            self._lock.notify_all()
            self._lock.wait_for(lambda: self._waiting or self._ended)
            self._is_judging = bool(self._waiting)
            return self._waiting.popleft() if self._waiting else None

    def _publish_judgement(self, judgement: J, elapsed_s: float) -> None:
        """Publish a judgement and pass it to the listeners."""
        with self._lock:
            self._publish(judgement=judgement, judged_s=elapsed_s, problem="")
        for listener in list(self.listeners):
            listener(judgement)

    def _conclude(self) -> J:
        """Return the final judgement of the whole run."""
        passed = replace(self._passed, settings=self.settings)
        final = self._judged_whole(passed, self._before, None if self.again is None else self.again())
        self._publish_judgement(final, self.standing.elapsed_s)
        return final

    def _publish(self, **changed: object) -> None:
        """Replace parts of the standing; to be called with the lock held."""
        self.standing = replace(self.standing, **changed)
