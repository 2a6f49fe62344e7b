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

A calibration by hand needs readings alone, and gives a ``HandJudgement`` after every pose:

    session = HandSession(source, settings, wanted)   # of a source without angles
    session.listeners.append(print)
    session.standing.task                             # what to do now, at any moment and from any thread
    final = session.run()                             # the same as replay gives
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats, one_blas_thread
from kf_calib.bench.bench import Bench
from kf_calib.bench.streams import Batch, Source
from kf_calib.design.sides import Sides, turn_in_words
from kf_calib.diagnosis.candidate_tests import LEVEL
from kf_calib.dwells.limits import FEWEST_READINGS
from kf_calib.dwells.rest_in_readings import RestSegmenter
from kf_calib.dwells.sufficient_statistics import Dwell
from kf_calib.dwells.table import DwellTable
from kf_calib.errors import InputError, UnobservableError
from kf_calib.estimation.calibration import conclude, evaluate_fit, with_remarks
from kf_calib.estimation.dwell_pass import Pass, refuse_unusable
from kf_calib.estimation.iterated_fit import fit
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.settings import Settings
from kf_calib.online.evaluation import Evaluation, Progress
from kf_calib.online.status import CurrentDwell, Judgement, RunStatus, current, judge_so_far, judge_whole_run
from kf_calib.online.suggestion import Itinerary, Suggestion, Visited, suggest


@dataclass(frozen=True)
class _Fed:
    """The source of a session that is fed: it only knows the bench."""

    bench: Bench
    warnings: list[str] = field(default_factory=list[str])
    fraction: float = math.nan

    def __iter__(self) -> Iterator[Batch]:
        return iter(())


class Session(Evaluation[Judgement, RunStatus]):
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
        super().__init__(source, settings, wanted, every=every, again=again)
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

    def _first_standing(self) -> RunStatus:
        return RunStatus(model=self.settings.effects)

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
        return judge_whole_run(passed, self.wanted, None if before is None else before.sequential, again)

    def _seen(self, dwell: Dwell) -> CurrentDwell:
        return current(dwell, self.standing.judgement)

    def _judged_next(self, judgement: Judgement) -> None:
        """With ``auto``, accept the missing effects once several judgements in a row were sure of them."""
        if not (self.auto and judgement.alarm and judgement.snapshot.settled):
            return
        diagnosis = judgement.diagnosis
        if not diagnosis.sure:
            return
        try:
            self.accept(*diagnosis.missing)
        except InputError as error:
            self.say(str(error))


ENOUGH_S = 4.0
"""Time at rest, beside that of settling, that a pose is to be held."""


@dataclass(frozen=True)
class HandJudgement:
    """What is known of a calibration by hand after a pose.

    result: the calibration; None while the poses do not determine it. dwells: the poses so far. sides: their sides, and
    the one to turn up next. wanted (12,): target of each sigma, SI; NaN where there is none. looks: how often the sizes
    of f have been tested. final: whether the run has ended.
    """

    result: Calibration | None
    dwells: DwellTable
    sides: Sides
    wanted: Floats
    looks: int = 0
    final: bool = False

    @property
    def sigma(self) -> Floats:
        """One sigma (12,), SI; NaN where a parameter is not determined or is fixed by the frame."""
        if self.result is None:
            return np.full(12, np.nan)
        fixed = [symbol in self.result.fixed for symbol in paper_parameters.SYMBOLS]
        return np.where(fixed, np.nan, self.result.estimate.sigma)

    @property
    def reached(self) -> bool:
        """Whether there are targets of parameters that are left without angles, and every one is reached."""
        aimed = np.isfinite(self.wanted) & ~np.isin(paper_parameters.SYMBOLS, ("theta1", "phi1", "nu2"))
        return bool(aimed.any() and (self.sigma <= self.aims)[aimed].all() and self.consistent is not None)

    @property
    def aims(self) -> Floats:
        """The sigmas (12,) by which targets are reached: below them where noise is known from few poses only."""
        return self.wanted if self.result is None else self.result.aims(self.wanted)

    @property
    def consistent(self) -> bool | None:
        """Whether the sizes of f agree; None while there is nothing to judge by.

        Of all tests of a run together the probability of a false alarm is that of one: the k-th has 1 / (k (k + 1)) of
        it.
        """
        if self.final and self.result is not None:
            return self.result.consistency.consistent
        if self.result is None or self.result.consistency.p_value is None:
            return None
        return self.result.consistency.p_value >= LEVEL / (self.looks * (self.looks + 1))

    @property
    def verdict(self) -> str:
        """What the poses tell, in a few words."""
        if self.result is None:
            return f"{', '.join(self.sides.missing)} not determined yet"
        if self.consistent is False:
            return "the sizes of gravity differ by more than noise: was it held still?"
        if self.result.model.square:
            return f"these angles are not told yet, and taken for square: {', '.join(self.result.model.square)}"
        return "the sizes of gravity agree" if self.consistent else "too few poses to test them by each other"


@dataclass(frozen=True)
class Held:
    """The pose that it is held in: number of the dwell, readings used so far, and the axes that point up."""

    number: int
    readings: int
    up: str


@dataclass(frozen=True)
class HandStanding(Progress):
    """What is known of a calibration by hand at a moment; see ``Progress``.

    current: the pose that it is held in. judgement: the latest judgement. sides: those of the poses so far, with that
    of the pose it is held in. rest_s: for how long it has rested by now, with the time of settling; 0 while it moves.
    enough_s: for how long it is to rest.
    """

    current: Held | None = None
    judgement: HandJudgement | None = None
    sides: Sides | None = None
    rest_s: float = 0.0
    enough_s: float = ENOUGH_S

    @property
    def task(self) -> str:
        """What to do now."""
        if self.sides is None:
            return f"hold still for {self.enough_s:g} s" if self.rest_s else "lay it on any side and hold it still"
        turn = f"turn it to a new side: {turn_in_words(self.sides.following)}"
        if self.rest_s >= self.enough_s:
            return self._over(f"enough: {turn}")
        if not self.rest_s:
            return self._over(f"{turn}; then hold it still")
        if self.current is not None and self.sides.repeats is not None:
            return f"on this side it was in pose {self.sides.repeats}, which tells little more: {turn}"
        return f"hold still for {self.enough_s:g} s"

    def _over(self, otherwise: str) -> str:
        """Return that the run may end, where every target is reached, or else what to do."""
        done = self.judgement is not None and self.judgement.reached
        return "every target is reached: end the run, or go on with more sides" if done else otherwise


class HandSession(Evaluation[HandJudgement, HandStanding]):
    """The evaluation of a sensor in the hand; see ``Evaluation``. Raises InputError for a model that needs angles."""

    def _first_standing(self) -> HandStanding:
        return HandStanding(enough_s=ENOUGH_S + self.settings.stillness.settle_s)

    def _refuse(self, model: Model, begun: bool = False) -> None:
        """Raise InputError for effects and a random walk of the biases, which need angles."""
        if model.effects or self.settings.walk_mps2_per_sqrt_s:
            raise InputError(
                "a live run without angles has scale factors, biases and the angles between the axes only: leave out "
                "effects (--with, --model) and --bias-walk."
            )

    def _progress(self) -> Mapping[str, object]:
        assert isinstance(self._segmenter, RestSegmenter)
        return {"rest_s": self._segmenter.rest_s}

    def _judged(self, passed: Pass, before: HandJudgement | None) -> HandJudgement:
        dwells, settings, bench = passed.dwells, passed.settings, self.source.bench
        refuse_unusable(dwells, passed.counts, bench)
        try:
            fitted = fit(dwells, passed.model, settings.walk_mps2_per_sqrt_s)
            result = with_remarks(evaluate_fit(fitted, settings), passed)
        except UnobservableError:
            result = None
        tested = result is not None and result.consistency.p_value is not None
        sides = Sides.of(dwells, bench, None if result is None else result.fit)
        return HandJudgement(result, dwells, sides, self.wanted, (before.looks if before else 0) + tested)

    def _judged_whole(self, passed: Pass, before: HandJudgement | None, again: Source | None) -> HandJudgement:
        result, looks = conclude(passed, again), before.looks if before else 0
        sides = Sides.of(passed.dwells, self.source.bench, result.fit)
        return HandJudgement(result, passed.dwells, sides, self.wanted, looks, final=True)

    def _judged_next(self, judgement: HandJudgement) -> None:
        self._show_sides(judgement.sides)

    def _seen(self, dwell: Dwell) -> Held:
        closed = [each for each in self._passed.folder.dwells[: self._closed] if each.count >= FEWEST_READINGS]
        judgement = self.standing.judgement
        fitted = None if judgement is None or judgement.result is None else judgement.result.fit
        sides = Sides.of(DwellTable.of([*closed, dwell]), self.source.bench, fitted)
        self._show_sides(sides)
        return Held(dwell.number, dwell.count, sides.last)

    def _show_sides(self, sides: Sides) -> None:
        """Show the sides of these poses, unless those of more poses are shown: a judgement takes its time."""
        with self._lock:
            shown = self.standing.sides
            if shown is None or len(shown.numbers) <= len(sides.numbers):
                self._publish(sides=sides)
