"""Status of a run while it is recorded: sigmas, verdict, missing effects, next orientation and remaining time.

A ``Judgement`` is made when a dwell closes, from the dwell factors so far, by the code that evaluates a recording. To
keep the false-alarm probability of a single run, the model counts as consistent until the ``SequentialTest`` raises its
alarm. A ``CandidateSnapshot`` tests all candidates; as it takes longer than all the rest, it is repeated only when its
result may have changed. The final judgement is that of ``diagnose``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats, one_blas_thread
from kf_calib.bench.streams import Source
from kf_calib.design.gimbal_limits import wrap
from kf_calib.design.next_orientation import Advice, SigmaForecast, forecast
from kf_calib.diagnosis.candidate_tests import assess_candidates
from kf_calib.diagnosis.missing_effect import diagnose
from kf_calib.diagnosis.refits import Refits
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.verdict import explanations_in_words
from kf_calib.dwells.sufficient_statistics import Dwell
from kf_calib.dwells.table import DwellTable
from kf_calib.estimation.calibration import conclude, evaluate_fit, with_remarks
from kf_calib.estimation.cross_validation import SAME_POSE_DEG
from kf_calib.estimation.dwell_pass import Pass, fitted_to, refuse_unusable
from kf_calib.estimation.results import Calibration, format_p
from kf_calib.noise.noise_model import mean_covariances
from kf_calib.online.evaluation import Progress
from kf_calib.online.sequential_test import SequentialTest

_DETERMINES = 1e-3  # share of its sigma to which a parameter comes down that was not determined at all
_RISEN = 1.5  # times a sigma that the next dwell may take it up by before that is told
_FEWEST = 5  # dwells before the model is judged: fewer leave no degrees of freedom
_FEWEST_UNSTATED = 12  # the same where the noise from dwell to dwell has to be estimated, too
_QUIET = 0.1  # share of the variance from dwell to dwell below which the noise of a mean no longer matters
_LITTLE = 0.1  # share of the gain of a dwell below which a further gain no longer matters
_STAYING = (2.0, 4.0, 8.0, 16.0, 32.0)  # lengths of the open dwell that are tried, as multiples of its present one
_GROWN = 1.25  # factor by which a run has to grow before all candidates are tested again
_AGREEING = 3  # number of looks in a row that have to agree
_FREEDOM = 9  # degrees of freedom that the model with the missing effects has to leave


@dataclass(frozen=True)
class CandidateSnapshot:
    """A test of all candidates against a run as it stood, with a diagnosis if the sequential test had raised its alarm.

    result: the calibration then. sequential: the sequential test then (None: too few dwells). diagnosed: the diagnosis
    (None: no alarm). agreed: number of looks in a row with the same result.
    """

    result: Calibration
    sequential: SequentialTest | None
    diagnosed: Diagnosis | None = None
    agreed: int = 1

    @cached_property
    def diagnosis(self) -> Diagnosis:
        """The diagnosis, or without an alarm a statement that nothing is significant so far."""
        return self.diagnosed or _not_judged(self.result, self.sequential)

    @property
    def settled(self) -> bool:
        """Whether enough looks in a row agree, of enough dwells.

        With few degrees of freedom, a wrong effect may be the only one that fits.
        """
        after = None if self.diagnosed is None else self.diagnosed.after
        return self.agreed >= _AGREEING and (after is None or after.consistency.dof >= _FREEDOM)

    def again(self, result: Calibration, sequential: SequentialTest | None) -> CandidateSnapshot:
        """The snapshot of the run as it stands now: this one, unless its result may have changed."""
        return _snapshot(result, sequential, self) if self._is_due(result, sequential) else self

    def _is_due(self, result: Calibration, sequential: SequentialTest | None) -> bool:
        """Tell whether a new one is due: run, model or alarm has changed, or a diagnosis needs to be confirmed."""
        before = self.result
        if len(result.visits) >= _GROWN * len(before.visits) or result.settings.effects != before.settings.effects:
            return True
        if (sequential is None) != (self.sequential is None) or _alarmed(sequential) != (self.diagnosed is not None):
            return True
        return self.diagnosed is not None and (not self.settled or self._is_followed(result))

    def _is_followed(self, result: Calibration) -> bool:
        """Tell whether the platform has visited the orientation that this snapshot advised."""
        going = self.diagnosis.next_orientation
        if going is None:
            return False
        poses = np.array([visit.dwell.pose for visit in result.visits[len(self.result.visits) :]])
        apart = np.abs(wrap(poses - np.radians(going[0].gimbal_deg)))
        return bool((apart.max(axis=1) < np.radians(SAME_POSE_DEG)).any()) if len(poses) else False


def _snapshot(
    result: Calibration, sequential: SequentialTest | None, before: CandidateSnapshot | None = None
) -> CandidateSnapshot:
    """Return a snapshot of the run; it counts agreement with the one before."""
    if not _alarmed(sequential):
        return CandidateSnapshot(result, sequential)
    diagnosis = diagnose(result)
    diagnosed = before.diagnosed if before else None
    same = diagnosed is not None and _conclusion(diagnosis) == _conclusion(diagnosed)
    return CandidateSnapshot(result, sequential, diagnosis, before.agreed + 1 if before and same else 1)


def _conclusion(diagnosis: Diagnosis) -> tuple[object, ...]:
    """Return the parts of a diagnosis that have to be equal for two diagnoses to agree."""
    enough = diagnosis.after is not None and diagnosis.after.consistency.dof >= _FREEDOM
    return diagnosis.test.consistent, frozenset(diagnosis.missing), frozenset(diagnosis.ambiguity), enough


def _alarmed(sequential: SequentialTest | None) -> bool:
    """Tell whether the sequential test has raised its alarm."""
    return sequential is not None and sequential.alarmed is not None


@dataclass(frozen=True)
class Judgement:
    """What is known of a run after a dwell.

    result: the calibration. snapshot: the latest test of all candidates, which may be a few dwells old. sequential: the
    sequential test (None: too few dwells). wanted (12,): target of each sigma, SI; NaN where there is none. forecast:
    predicted sigmas if the run goes on (None: not determined yet). final: whether the run has ended.
    sigma_before (12,): the sigmas a dwell before (None: there were none).
    """

    result: Calibration
    snapshot: CandidateSnapshot
    sequential: SequentialTest | None
    wanted: Floats
    forecast: SigmaForecast | None = None
    final: bool = False
    sigma_before: Floats | None = None

    @property
    def risen(self) -> tuple[str, float] | None:
        """The parameter whose sigma has risen most with the last dwell, and how many times; None if none has by much.

        More readings raise no sigma: what does is noise that is estimated anew, or an effect that was added.
        """
        if self.sigma_before is None:
            return None
        with np.errstate(invalid="ignore"):
            factors = np.nan_to_num(self.result.estimate.sigma / self.sigma_before)
        k = int(np.argmax(factors))
        return (paper_parameters.SYMBOLS[k], float(factors[k])) if factors[k] > _RISEN else None

    @property
    def diagnosis(self) -> Diagnosis:
        """The diagnosis of the latest snapshot, which may be of fewer dwells."""
        return self.snapshot.diagnosis

    @property
    def alarm(self) -> bool:
        """Whether the sequential test, or after the end the whole run, rejects the model."""
        return (self.final or _alarmed(self.sequential)) and self.diagnosis.test.consistent is False

    @property
    def consistent(self) -> bool | None:
        """Whether the model agrees with the run; None while it is not judged."""
        if self.final:
            return self.diagnosis.consistent
        return None if self.sequential is None or self.sequential.p_value is None else not self.alarm

    @property
    def p_value(self) -> float | None:
        """The p-value of the whole run where it is final, else of the latest sequential test; None if not judged."""
        if self.final:
            return self.diagnosis.test.p_value
        return None if self.sequential is None else self.sequential.p_value

    @property
    def suspects(self) -> tuple[str, ...]:
        """Names of the effects that may be missing, the likeliest first; empty without an alarm."""
        if not self.alarm:
            return ()
        found = self.diagnosis
        return found.ambiguity or tuple(suspect.name for suspect in found.suspects if suspect.fits)

    @property
    def disagreeing(self) -> tuple[int, int, float]:
        """The dwell and the accelerometer (both from 1) with the largest residual in units of sigma, and that ratio."""
        ratios = replace(self.diagnosis, before=self.result).residual_ratios
        dwell, channel = np.unravel_index(int(np.argmax(np.abs(ratios))), ratios.shape)
        return int(dwell) + 1, int(channel) + 1, float(ratios[dwell, channel])

    @cached_property
    def verdict(self) -> str:
        """The verdict in a few words, for a screen."""
        if self.final and self.diagnosis.condition is not None:
            return f"model consistent (p {format_p(self.p_value)}) if {self.diagnosis.condition}"
        if self.consistent is None:
            seen, least = len(self.result.visits), _least(self.result)
            return (
                f"too early to judge the model: {seen} of at least {least} orientations"
                if self.sequential is None and seen < least
                else "too few measurements to judge the model"
            )
        looks = f", look {self.sequential.looks}" if self.sequential is not None and not self.final else ""
        if not self.alarm:
            return f"model consistent (p {format_p(self.p_value)}{looks})"
        dwell, channel, ratio = self.disagreeing
        named = explanations_in_words(self.diagnosis) or "no known effect explains it"
        return f"orientation {dwell} disagrees: accelerometer {channel} by {ratio:+.1f} sigma; {named}"

    @property
    def advice(self) -> tuple[Advice, str] | None:
        """Where to go next because of what is missing, and why; None while nothing is beyond chance."""
        return self.diagnosis.next_orientation if self.final or self.alarm else None

    @cached_property
    def next_orientation(self) -> tuple[tuple[float, ...], str] | None:
        """Gimbal angles of the next orientation in deg, and the reason; None where there is no advice.

        With suspects it tells them apart, else it reduces the worst sigma.
        """
        if self.advice is not None:
            return self.advice[0].gimbal_deg, self.advice[1]
        if self.forecast is None:
            return None
        symbol, factor = self.forecast.next_reduction(self.worst)
        if not factor > _DETERMINES:
            return self.forecast.gimbal_deg, f"determines {symbol} for the first time"
        return self.forecast.gimbal_deg, f"lowers sigma of {symbol} by {100.0 * (1.0 - factor):.0f} %"

    @cached_property
    def aims(self) -> Floats:
        """The sigmas (12,) by which targets are reached: below them where noise is known from few dwells only."""
        return self.result.aims(self.wanted)

    def reached(self, sigma: Floats) -> bool:
        """Whether there are targets, every one is reached by these sigmas (12,), and the model was judged."""
        given = np.isfinite(self.wanted)
        return bool(given.any() and (sigma <= self.aims)[given].all() and self.consistent is not None)

    @cached_property
    def worst(self) -> Floats:
        """Scales (12,) by which the sigmas are compared to find the worst."""
        return _sizes(self.result, self.wanted)

    @cached_property
    def left_s(self) -> Floats:
        """Time (12,) until each sigma reaches its target, or half its value where there is no target, in s.

        Infinite where it never will, NaN where it is not known.
        """
        if self.forecast is None:
            return np.full(12, np.nan)
        sigma = self.result.estimate.sigma
        return self.forecast.seconds_to(np.where(np.isfinite(self.wanted), self.wanted, sigma / 2.0), sigma)


@dataclass(frozen=True)
class CurrentDwell:
    """The open dwell.

    number: of the dwell, from 1. pose (k,): gimbal angles, rad. readings, seconds: number and duration of the readings
    used. sigma (12,): of the parameters with this dwell included. enough: whether staying longer no longer helps (None:
    not known yet). stay_s (12,): further time in this dwell until each target is reached, s; infinite where it never
    is.
    """

    number: int
    pose: Floats
    readings: int
    seconds: float
    sigma: Floats
    enough: bool | None
    stay_s: Floats


@dataclass(frozen=True)
class RunStatus(Progress):
    """What is known of a run on a bench at a moment; see ``Progress``.

    current: the open dwell. judgement: the latest judgement.
    """

    current: CurrentDwell | None = None
    judgement: Judgement | None = None

    @property
    def stayed_s(self) -> float:
        """Duration of the readings of the open dwell by now, s: those of the latest look at it, and what came since."""
        return 0.0 if self.current is None else self.current.seconds + self.elapsed_s - self.looked_s

    @property
    def sigma(self) -> Floats:
        """One sigma (12,) of the parameters with the open dwell included, SI; NaN where not determined."""
        if self.current is not None and np.isfinite(self.current.sigma).any():
            return self.current.sigma
        return np.full(12, np.nan) if self.judgement is None else self.judgement.result.estimate.sigma

    @property
    def left_s(self) -> Floats:
        """Time (12,) until each target is reached, s: the shorter of staying in this orientation and going on."""
        if self.judgement is None:
            return np.full(12, np.nan)
        going = np.maximum(self.judgement.left_s - (self.elapsed_s - self.judged_s), 0.0)
        return going if self.current is None else np.fmin(going, self.current.stay_s)


def judge_so_far(passed: Pass, wanted: Floats, before: Judgement | None = None) -> Judgement:
    """The judgement of the run after the dwells folded so far.

    passed: the pass over the readings. wanted (12,): targets of the sigmas. before: the judgement after fewer dwells.
    Raises InputError where the readings cannot be used as they are.
    """
    dwells = passed.dwells
    with one_blas_thread():
        refuse_unusable(dwells, passed.counts, passed.source.bench)
        result = with_remarks(evaluate_fit(fitted_to(passed, dwells), passed.settings), passed)
        sequential = _sequential_test(dwells, result, None if before is None else before.sequential)
        snapshot = _snapshot(result, sequential) if before is None else before.snapshot.again(result, sequential)
        sigma_before = None if before is None else before.result.estimate.sigma
        return Judgement(result, snapshot, sequential, wanted, _forecast(result, wanted), sigma_before=sigma_before)


def _sequential_test(
    dwells: DwellTable, result: Calibration, sequential: SequentialTest | None
) -> SequentialTest | None:
    """Return the sequential test with all dwells so far, begun again if the model has changed; None if too few."""
    bench, settings = result.bench, result.settings
    if len(dwells) < _least(result):
        return None
    if sequential is None or sequential.settings.effects != settings.effects:
        return SequentialTest.over(dwells, bench, settings, 0 if sequential is None else sequential.looks, result.fit)
    for k in range(len(sequential.dwells), len(dwells)):
        sequential = sequential.after(dwells[k : k + 1], result.fit, dwells[: k + 1])
    return sequential


def _least(result: Calibration) -> int:
    """Return the number of dwells before which the model is not judged."""
    stated = result.bench.angle_sigma_deg is not None and result.bench.scatter_sigma_mps2 is not None
    return _FEWEST if stated else _FEWEST_UNSTATED


def _not_judged(result: Calibration, sequential: SequentialTest | None) -> Diagnosis:
    """Return a diagnosis without an alarm: nothing is significant so far, and what the run could show."""
    test = assess_candidates(result.fit, None if sequential is None else sequential.tests)
    said = "Nothing is beyond chance so far: no effect is missing that this run has shown."
    if sequential is None:
        said = "Too few orientations so far to judge the model by: visit more."
    return Diagnosis(before=result, test=test, verdict=said)


def judge_whole_run(
    passed: Pass, wanted: Floats, sequential: SequentialTest | None, again: Source | None = None
) -> Judgement:
    """The final judgement: the calibration and the diagnosis of the whole run.

    passed: the pass over all readings. wanted (12,): targets of the sigmas. sequential: its test so far. again: the
    recording, to be read once more where that is needed.
    """
    with one_blas_thread():
        result = conclude(passed, again)
        snapshot = CandidateSnapshot(result, sequential, diagnose(result, Refits(again)))
        return Judgement(result, snapshot, sequential, wanted, _forecast(result, wanted), final=True)


def _forecast(result: Calibration, wanted: Floats) -> SigmaForecast | None:
    """Return the predicted sigmas if the run goes on, or None while nothing is determined."""
    return None if result.estimate.unseen.all() else forecast(result.fit, _sizes(result, wanted))


def _sizes(result: Calibration, wanted: Floats) -> Floats:
    """Return scales (12,) for comparing sigmas: their targets (infinite without one); if none is set, rad, 1 and g."""
    if np.isfinite(wanted).any():
        return np.where(np.isfinite(wanted), wanted, np.inf)
    return np.array([result.bench.gravity_mps2 if unit == "m/s^2" else 1.0 for unit in paper_parameters.UNITS])


def current(dwell: Dwell, judgement: Judgement | None) -> CurrentDwell:
    """The state of the open dwell, as far as it is folded.

    dwell: the open dwell. judgement: of the dwells before it (None: there is none yet, so that sigmas are NaN).
    """
    seconds, unknown = dwell.end_s - dwell.start_s, np.full(12, np.nan)
    here = CurrentDwell(dwell.number, dwell.recorded_pose, dwell.count, seconds, unknown, None, unknown)
    if judgement is None:
        return here
    result, wanted = judgement.result, judgement.aims
    sigma, longer = result.during(dwell).sigma, {k: result.during(dwell.repeat(k)).sigma for k in _STAYING}
    stay_s = np.full(12, np.inf)
    for k in reversed(_STAYING):
        stay_s[longer[k] <= wanted] = (k - 1.0) * seconds
    stay_s[sigma <= wanted] = 0.0
    enough = _quiet(dwell, result) or _saturated(result.estimate.sigma, sigma, longer[2.0])
    return replace(here, sigma=sigma, stay_s=stay_s, enough=enough)


def _quiet(dwell: Dwell, result: Calibration) -> bool:
    """Tell whether the noise of the dwell's mean is well below the scatter from dwell to dwell."""
    noise, means = result.noise, result.linearised.means[[-1]]
    means = replace(means, counts=np.full((1, 3), float(dwell.count)))
    whole = np.diag(mean_covariances(noise, means, result.linearised.state)[0])
    own = noise.effective_sigma_mps2**2 / dwell.count
    return bool((own < _QUIET * (whole - own)).all())


def _saturated(before: Floats, now: Floats, doubled: Floats) -> bool | None:
    """Tell whether doubling the dwell would gain less than a tenth of what it has gained; None where unknown."""
    known = np.isfinite(before) & np.isfinite(now) & np.isfinite(doubled)
    if not known.any():
        return None
    gained, further = (before - now)[known] / now[known], (now - doubled)[known] / now[known]
    return bool(further.max() < _LITTLE * gained.max())
