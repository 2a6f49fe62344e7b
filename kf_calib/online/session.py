"""A run on a bench evaluated while it is recorded: batches of readings in, a ``Judgement`` out after every dwell.

The readings are folded as a replay of the recording folds them: the final result is the same to the last bit.

    session = Session(source, settings)
    session.listeners.append(print)     # each judgement, from the judging thread: must not block
    final = session.run()
    session.accept("second-order")      # from any thread during the run: the effect is in all later judgements

A script that drives a bench of its own has no source to be read, and asks where to go:

    session = Session.fed(bench, wanted={"K1": 2e-6})
    while not (suggestion := session.suggest()).ended:
        move(suggestion.gimbal_deg)
        for batch in readings(suggestion.stay_s):      # readings and angles, those of the slew too
            session.ingest(batch)
    final = session.finish()
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

from kf_calib.bench.bench import Bench
from kf_calib.bench.streams import Batch, Source
from kf_calib.dwells.sufficient_statistics import DwellFactor
from kf_calib.errors import InputError
from kf_calib.estimation.dwell_pass import Pass
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.settings import Settings
from kf_calib.online.evaluation import Evaluation
from kf_calib.online.status import Current, Judgement, Standing, current, judge_so_far, judge_whole_run
from kf_calib.online.suggestion import Itinerary, Suggestion, Visited, suggest
from kf_calib.support.threads import one_blas_thread


@dataclass(frozen=True)
class _Fed:
    """The source of a session that is fed: it only knows the bench."""

    bench: Bench
    warnings: list[str] = field(default_factory=list[str])
    fraction: float = math.nan

    def __iter__(self) -> Iterator[Batch]:
        return iter(())


class Session(Evaluation[Judgement, Standing]):
    """The evaluation of a bench as its readings come; see ``Evaluation``.

    auto: accept an effect that is missing once it has been told from all others.
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
        standing = Standing(model=(settings or Settings()).effects)
        super().__init__(source, settings, wanted, standing, every=every, again=again)
        self.auto = auto

    @classmethod
    def fed(
        cls,
        bench: Bench,
        settings: Settings | None = None,
        wanted: Mapping[str, float] | None = None,
        *,
        auto: bool = False,
    ) -> Session:
        """A session whose batches come by ``ingest``."""
        return cls(_Fed(bench), settings, wanted, auto=auto)

    def suggest(self, itinerary: Itinerary | None = None) -> Suggestion:
        """Where to go next and for how long, or that the run is to end; to be asked at the end of a stay.

        itinerary: how the run is driven (None: as the bench states its limits).
        """
        with self._lock:
            standing, last = self.standing, self._last
        itinerary = itinerary or Itinerary(self.source.bench)
        closed = [] if last is None else last.passed.folder.dwells
        stays = [(dwell.recorded_pose, dwell.end_s - dwell.start_s) for dwell in closed]
        if standing.current is not None:
            stays.append((standing.current.pose, standing.stayed_s))
        judged = 0 if standing.judgement is None else len(standing.judgement.result.visits)
        with one_blas_thread():
            return suggest(itinerary, Visited(stays, min(judged, len(stays))), standing.judgement)

    def _refuse(self, model: Model, begun: bool = False) -> None:
        """Raise InputError where the model needs more than a source whose readings come once can give."""
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

    def _judged(self, passed: Pass, before: Judgement | None) -> Judgement:
        return judge_so_far(passed, self.wanted, before)

    def _judged_whole(self, passed: Pass, before: Judgement | None, again: Source | None) -> Judgement:
        return judge_whole_run(passed, self.wanted, None if before is None else before.watch, again)

    def _seen(self, dwell: DwellFactor) -> Current:
        return current(dwell, self.standing.judgement)

    def _judged_next(self, judgement: Judgement) -> None:
        """With ``auto``, accept the missing effects once several judgements in a row were sure of them."""
        if not (self.auto and judgement.alarm and judgement.look.settled):
            return
        diagnosis = judgement.diagnosis
        if not diagnosis.sure:
            return
        try:
            self.accept(*diagnosis.missing)
        except InputError as error:
            self.say(str(error))
