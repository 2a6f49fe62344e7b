"""A run on a bench evaluated while it is recorded: batches of readings in, a ``Judgement`` out after every dwell.

The readings are folded as a replay of the recording folds them: the final result is the same to the last bit.

    session = Session(source, settings)
    session.listeners.append(print)     # each judgement, from the judging thread: must not block
    final = session.run()
    session.accept("second-order")      # from any thread during the run: the effect is in all later judgements
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

from kf_calib.bench.streams import Source
from kf_calib.dwells.sufficient_statistics import DwellFactor
from kf_calib.errors import InputError
from kf_calib.estimation.dwell_pass import Pass
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.settings import Settings
from kf_calib.online.evaluation import Evaluation
from kf_calib.online.status import Current, Judgement, Standing, current, judge_so_far, judge_whole_run


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
        self._refuse(self._passed.model)

    def accept(self, *names: str) -> None:
        with self._lock:
            settings = replace(self.settings, effects=(*self.settings.effects, *names))
            self._refuse(Model.of(self.source.bench, settings.effects), begun=True)
            self.settings = settings
            self._publish(notice=f"{' and '.join(names)} accepted", model=self.settings.effects)
            if self._last is not None and not self._waiting:
                self._waiting.append(self._last)
            self._lock.notify_all()

    def _refuse(self, model: Model, begun: bool = False) -> None:
        """Raise InputError where the model needs more than a source whose readings come once can give."""
        self._refuse_engine()
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
