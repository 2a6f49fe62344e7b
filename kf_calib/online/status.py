"""How a run stands while it goes on: sigmas, verdict, what is missing, where to go next, and how long it takes.

A ``Judgement`` is made when a dwell closes, from the dwell factors so far, by the code that evaluates a recording. A
look at every dwell is a look too many for the chance of a false alarm that one run has: until the ``Watch`` raises its
alarm the model counts as consistent. Trying all candidates is a ``Look``, which takes longer than all the rest: it is
made again when it may say something else. The last judgement is that of ``diagnose``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.bench.streams import Source
from kf_calib.design.gimbal_limits import wrapped
from kf_calib.design.next_orientation import Advice, Course, course
from kf_calib.diagnosis.candidate_tests import LEVEL, assess_candidates
from kf_calib.diagnosis.missing_effect import diagnose
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.dwells.sufficient_statistics import DwellFactor
from kf_calib.estimation.calibration import conclude, evaluate, with_remarks
from kf_calib.estimation.cross_validation import SAME_POSE_DEG
from kf_calib.estimation.dwell_pass import Pass, refuse_unusable
from kf_calib.estimation.noise_model import mean_covariances
from kf_calib.estimation.results import Calibration, format_p
from kf_calib.online.sequential_test import Watch
from kf_calib.support.threads import one_blas_thread

_FEWEST = 5  # dwells: with fewer nothing is left over to judge by
_FEWEST_UNSTATED = 12  # where the noise from dwell to dwell has to be told from a misfit
_QUIET = 0.1  # of the variance from dwell to dwell: readings whose mean is that good add nothing
_LITTLE = 0.1  # of what a dwell has brought: more of it would bring less
_STAYING = (2.0, 4.0, 8.0, 16.0, 32.0)


_GROWN = 1.25  # by which a run has grown when all candidates are tried again
_AGREEING = 3  # looks in a row that say the same
_FREEDOM = 9  # degrees left over with what is missing in the model, at least


@dataclass(frozen=True)
class Look:
    """All candidates tried against a run as it stood; diagnosed where the watch had raised its alarm.

    agreed: how many looks in a row have said the same.
    """

    result: Calibration
    watch: Watch | None
    diagnosed: Diagnosis | None = None
    agreed: int = 1

    @cached_property
    def found(self) -> Diagnosis:
        return self.diagnosed or _not_judged(self.result, self.watch)

    @property
    def settled(self) -> bool:
        """Whether enough looks in a row have said the same, of enough dwells: after few, a wrong effect may be the only
        one that fits."""
        after = None if self.diagnosed is None else self.diagnosed.after
        return self.agreed >= _AGREEING and (after is None or after.consistency.dof >= _FREEDOM)

    def again(self, result: Calibration, watch: Watch | None) -> Look:
        """The look at the run as it stands now: this one, unless it may say something else."""
        return _look(result, watch, self) if self._is_due(result, watch) else self

    def _is_due(self, result: Calibration, watch: Watch | None) -> bool:
        before = self.result
        if len(result.visits) >= _GROWN * len(before.visits) or result.settings.effects != before.settings.effects:
            return True
        if (watch is None) != (self.watch is None) or _alarmed(watch) != (self.diagnosed is not None):
            return True
        return self.diagnosed is not None and (not self.settled or self._is_followed(result))

    def _is_followed(self, result: Calibration) -> bool:
        """Whether the platform has been where this look sent it."""
        going = self.found.next_orientation
        if going is None:
            return False
        poses = np.array([visit.dwell.pose for visit in result.visits[len(self.result.visits) :]])
        apart = np.abs(wrapped(poses - np.radians(going[0].gimbal_deg)))
        return bool((apart.max(axis=1) < np.radians(SAME_POSE_DEG)).any()) if len(poses) else False


def _look(result: Calibration, watch: Watch | None, before: Look | None = None) -> Look:
    if not _alarmed(watch):
        return Look(result, watch)
    found = diagnose(result)
    same = before is not None and before.diagnosed is not None and _said(found) == _said(before.diagnosed)
    return Look(result, watch, found, before.agreed + 1 if before and same else 1)


def _said(found: Diagnosis) -> tuple[object, ...]:
    """What must be the same for two diagnoses to agree."""
    enough = found.after is not None and found.after.consistency.dof >= _FREEDOM
    return found.test.consistent, frozenset(found.missing), frozenset(found.ambiguity), enough


def _alarmed(watch: Watch | None) -> bool:
    return watch is not None and watch.alarmed is not None


@dataclass(frozen=True)
class Judgement:
    """A run after a dwell. look: at all candidates, made now or a few dwells ago. wanted (12,): target of each sigma,
    SI; NaN where none is set. course: how the sigmas would go on, None while they are not determined."""

    result: Calibration
    look: Look
    watch: Watch | None
    wanted: Floats
    course: Course | None = None
    final: bool = False

    @property
    def found(self) -> Diagnosis:
        """Of the look: of so many dwells as there were then."""
        return self.look.found

    @property
    def alarm(self) -> bool:
        """Whether the stream, or in the end the run, is beyond chance."""
        return (self.final or _alarmed(self.watch)) and self.found.test.consistent is False

    @property
    def consistent(self) -> bool | None:
        if self.final:
            return self.found.test.consistent
        return None if self.watch is None or self.watch.p_value is None else not self.alarm

    @property
    def p_value(self) -> float | None:
        """Of the run where it is final, else of the stream up to now; None while it is not judged."""
        if self.final:
            return self.found.test.p_value
        return None if self.watch is None else self.watch.p_value

    @property
    def suspects(self) -> tuple[str, ...]:
        """Names of what may be missing, the likeliest first."""
        if not self.alarm:
            return ()
        found = self.found
        return found.ambiguity or tuple(suspect.name for suspect in found.suspects if suspect.fits)

    @property
    def disagreeing(self) -> tuple[int, int, float]:
        """The dwell (from 1) and the accelerometer whose residual is largest in its sigma, and that ratio."""
        ratios = replace(self.found, before=self.result).residual_ratios
        dwell, channel = np.unravel_index(int(np.argmax(np.abs(ratios))), ratios.shape)
        return int(dwell) + 1, int(channel) + 1, float(ratios[dwell, channel])

    @cached_property
    def verdict(self) -> str:
        """In a few words, for a screen."""
        if self.consistent is None:
            return (
                f"not judged before {_least(self.result)} dwells" if self.watch is None else "nothing to judge by yet"
            )
        looks = f", look {self.watch.looks}" if self.watch is not None and not self.final else ""
        if not self.alarm:
            return f"model consistent (p {format_p(self.p_value)}{looks})"
        dwell, channel, ratio = self.disagreeing
        named = f"suspects {', '.join(self.suspects)}" if self.suspects else "no known effect explains it"
        if self.found.missing and len(self.suspects) == len(self.found.missing):
            named = f"missing: {' and '.join(self.suspects)}"
        return f"orientation {dwell} disagrees: accelerometer {channel} by {ratio:+.1f} sigma; {named}"

    @property
    def advice(self) -> tuple[Advice, str] | None:
        """Where to go next because of what is missing, and why; None while nothing is beyond chance."""
        return self.found.next_orientation if self.final or self.alarm else None

    @cached_property
    def next_orientation(self) -> tuple[tuple[float, ...], str] | None:
        """Gimbal angles, deg, and why: what tells suspects apart, else what sharpens the worst sigma."""
        if self.advice is not None:
            return self.advice[0].gimbal_deg, self.advice[1]
        if self.course is None:
            return None
        symbol, fall = self.course.sharpened(self.worst)
        return self.course.gimbal_deg, f"sharpens {symbol}, sigma x {fall:.2f}"

    @cached_property
    def worst(self) -> Floats:
        """Sizes (12,) by which a sigma counts as large."""
        return _sizes(self.result, self.wanted)

    @cached_property
    def left_s(self) -> Floats:
        """Seconds (12,) to each target, or where there is none to half of the sigma; inf where never, NaN unknown."""
        if self.course is None:
            return np.full(12, np.nan)
        sigma = self.result.estimate.sigma
        return self.course.seconds_to(np.where(np.isfinite(self.wanted), self.wanted, sigma / 2.0), sigma)


@dataclass(frozen=True)
class Current:
    """The open dwell: its number from 1, pose (k,), readings and seconds in it that are used, and the twelve sigmas
    with it. enough: more of it no longer helps (None: not known yet). stay_s (12,): seconds more in it to each target,
    inf where it does not lead there."""

    number: int
    pose: Floats
    readings: int
    seconds: float
    sigma: Floats
    enough: bool | None
    stay_s: Floats


@dataclass(frozen=True)
class Standing:
    """What is known at a moment. elapsed_s: bench time of the last reading; judged_s: that of the judgement; problem:
    why there is none; notice: the last thing that was done (an effect accepted or refused)."""

    samples: int = 0
    elapsed_s: float = 0.0
    dwells: int = 0
    current: Current | None = None
    judgement: Judgement | None = None
    judged_s: float = 0.0
    problem: str = ""
    notice: str = ""
    model: Sequence[str] = ()

    @property
    def sigma(self) -> Floats:
        """1 sigma (12,) of the parameters, the open dwell included; NaN where not determined."""
        if self.current is not None and np.isfinite(self.current.sigma).any():
            return self.current.sigma
        return np.full(12, np.nan) if self.judgement is None else self.judgement.result.estimate.sigma

    @property
    def left_s(self) -> Floats:
        """Seconds (12,) to each target, by staying here or by going on, whichever is sooner."""
        if self.judgement is None:
            return np.full(12, np.nan)
        going = np.maximum(self.judgement.left_s - (self.elapsed_s - self.judged_s), 0.0)
        return going if self.current is None else np.fmin(going, self.current.stay_s)


def targets(texts: Mapping[str, float]) -> Floats:
    """Sigmas wanted (12,) by symbol, SI; NaN where there is none."""
    return np.array([texts.get(symbol, np.nan) for symbol in paper_parameters.SYMBOLS])


def judged(passed: Pass, wanted: Floats, before: Judgement | None = None) -> Judgement:
    """The run after the dwells folded so far, ``before``: after fewer of them. Raises InputError where the readings
    cannot be used as they are."""
    settings, bench, dwells = passed.settings, passed.source.bench, passed.dwells
    with one_blas_thread():
        refuse_unusable(dwells, passed.tally, bench)
        result = with_remarks(evaluate(dwells, bench, settings, passed.folder.slews), passed)
        watch = _watched(dwells, result, None if before is None else before.watch)
        look = _look(result, watch) if before is None else before.look.again(result, watch)
        return Judgement(result, look, watch, wanted, _course(result, wanted))


def _watched(dwells: list[DwellFactor], result: Calibration, watch: Watch | None) -> Watch | None:
    bench, settings = result.bench, result.settings
    if len(dwells) < _least(result):
        return None
    if watch is None or watch.settings.effects != settings.effects:
        return Watch.over(dwells, bench, settings, 0 if watch is None else watch.looks, result.fit)
    for dwell in dwells[len(watch.dwells) :]:
        watch = watch.after(dwell, result.fit)
    return watch


def _least(result: Calibration) -> int:
    """Dwells before which the model is not judged."""
    stated = result.bench.angle_sigma_deg is not None and result.bench.scatter_sigma_mps2 is not None
    return _FEWEST if stated else _FEWEST_UNSTATED


def _not_judged(result: Calibration, watch: Watch | None) -> Diagnosis:
    """What can be said without an alarm: what the run could show so far, and that nothing is beyond chance."""
    test = assess_candidates(result.fit, None if watch is None else watch.tests, frames=result.frames)
    said = "Nothing is beyond chance so far: no effect is missing that this run has shown."
    if watch is None:
        said = "Too few orientations so far to judge the model by: visit more."
    return Diagnosis(result, test, (), (), False, (), {}, None, said)


def judge_whole_run(passed: Pass, wanted: Floats, watch: Watch | None, again: Source | None = None) -> Judgement:
    """The last judgement: the calibration and the diagnosis of the whole run, as of its recording (``again``)."""
    with one_blas_thread():
        result = conclude(passed, again)
        look = Look(result, watch, diagnose(result))
        return Judgement(result, look, watch, wanted, _course(result, wanted), final=True)


def _course(result: Calibration, wanted: Floats) -> Course | None:
    return None if result.estimate.unseen.all() else course(result.fit, _sizes(result, wanted))


def _sizes(result: Calibration, wanted: Floats) -> Floats:
    """What sigmas are compared by (12,): their targets (inf where there is none); without any, rad, one and g."""
    if np.isfinite(wanted).any():
        return np.where(np.isfinite(wanted), wanted, np.inf)
    return np.array([result.bench.gravity_mps2 if unit == "m/s^2" else 1.0 for unit in paper_parameters.UNITS])


def current(dwell: DwellFactor, judgement: Judgement | None) -> Current:
    """The open dwell, as far as it is folded, beside the judgement of those before it."""
    seconds, unknown = dwell.end_s - dwell.start_s, np.full(12, np.nan)
    here = Current(dwell.number, dwell.recorded_pose, dwell.count, seconds, unknown, None, unknown)
    if judgement is None:
        return here
    result, wanted = judgement.result, judgement.wanted
    sigma, longer = result.during(dwell).sigma, {k: result.during(dwell.repeated(k)).sigma for k in _STAYING}
    stay_s = np.full(12, np.inf)
    for k in reversed(_STAYING):
        stay_s[longer[k] <= wanted] = (k - 1.0) * seconds
    stay_s[sigma <= wanted] = 0.0
    enough = _quiet(dwell, result) or _saturated(result.estimate.sigma, sigma, longer[2.0])
    return replace(here, sigma=sigma, stay_s=stay_s, enough=enough)


def _quiet(dwell: DwellFactor, result: Calibration) -> bool:
    """Whether the noise of the dwell's mean is well below what dwells scatter by anyway."""
    noise, means = result.noise, result.carried.means[[-1]]
    means = replace(means, counts=np.array([float(dwell.count)]))
    whole = np.diag(mean_covariances(noise, means, result.carried.state)[0])
    own = noise.effective_sigma_mps2**2 / dwell.count
    return bool((own < _QUIET * (whole - own)).all())


def _saturated(before: Floats, now: Floats, doubled: Floats) -> bool | None:
    """Whether as much again would bring less than a tenth of what this dwell has brought; None: nothing to go by."""
    known = np.isfinite(before) & np.isfinite(now) & np.isfinite(doubled)
    if not known.any():
        return None
    gained, further = (before - now)[known] / now[known], (now - doubled)[known] / now[known]
    return bool(further.max() < _LITTLE * gained.max())


__all__ = ["LEVEL", "Current", "Judgement", "Standing", "current", "judge_whole_run", "judged", "targets"]
