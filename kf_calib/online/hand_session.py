"""A calibration by hand evaluated while it goes on: readings alone in, a ``HandJudgement`` out after every pose.

session = HandSession(source, settings, wanted)   # of a source without angles
session.listeners.append(print)
session.standing.task                             # what to do now, at any moment and from any thread
final = session.run()                             # the same as replay gives
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from kf_calib.bench.streams import Source
from kf_calib.design.sides import Sides
from kf_calib.dwells.rest_in_readings import RestSegmenter
from kf_calib.dwells.sufficient_statistics import DwellFactor
from kf_calib.errors import InputError
from kf_calib.estimation.dwell_pass import LEAST_READINGS, Pass
from kf_calib.estimation.settings import Settings
from kf_calib.online.evaluation import Evaluation
from kf_calib.online.hand_status import ENOUGH_S, HandJudgement, HandStanding, Held, judge_all_poses, judge_poses


class HandSession(Evaluation[HandJudgement, HandStanding]):
    """The evaluation of a sensor in the hand; see ``Evaluation``. Raises InputError for a model that needs angles."""

    def __init__(
        self,
        source: Source,
        settings: Settings | None = None,
        wanted: Mapping[str, float] | None = None,
        *,
        every: bool = True,
        again: Callable[[], Source | None] | None = None,
    ) -> None:
        settings = settings or Settings()
        standing = HandStanding(enough_s=ENOUGH_S + settings.stillness.settle_s)
        super().__init__(source, settings, wanted, standing, every=every, again=again)
        self._refuse_engine()
        if settings.effects or settings.walk_mps2_per_sqrt_s:
            self.accept(*settings.effects)

    def accept(self, *names: str) -> None:
        raise InputError(
            "a live run without angles has scale factors, biases and the angles between the axes only: leave out "
            "effects (--with, --model) and --bias-walk."
        )

    def _progress(self) -> Mapping[str, object]:
        assert isinstance(self._segmenter, RestSegmenter)
        return {"rest_s": self._segmenter.rest_s}

    def _judged(self, passed: Pass, before: HandJudgement | None) -> HandJudgement:
        return judge_poses(passed, self.wanted, before)

    def _judged_whole(self, passed: Pass, before: HandJudgement | None, again: Source | None) -> HandJudgement:
        return judge_all_poses(passed, self.wanted, before.looks if before else 0, again)

    def _judged_next(self, judgement: HandJudgement) -> None:
        self._show_sides(judgement.sides)

    def _seen(self, dwell: DwellFactor) -> Held:
        closed = [each for each in self._passed.folder.dwells[: self._closed] if each.count >= LEAST_READINGS]
        judgement = self.standing.judgement
        fitted = None if judgement is None or judgement.result is None else judgement.result.fit
        sides = Sides.of([*closed, dwell], self.source.bench, fitted)
        self._show_sides(sides)
        return Held(dwell.number, dwell.count, sides.last)

    def _show_sides(self, sides: Sides) -> None:
        """Show the sides of these poses, unless those of more poses are shown: a judgement takes its time."""
        with self._lock:
            shown = self.standing.sides
            if shown is None or len(shown.numbers) <= len(sides.numbers):
                self._publish(sides=sides)
