"""All candidates against one fit: which explain more than chance would, and how small an effect would be found."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.bayes_factor import as_fall
from kf_calib.diagnosis.within_dwell_trend import Trend, trend
from kf_calib.dwells.coherent_tone import band_hz
from kf_calib.dwells.line_spectrum import Line, lowest_hz
from kf_calib.dwells.sufficient_statistics import DwellFactor
from kf_calib.effects import Effect, effect_named, names, walk_named
from kf_calib.estimation.dwell_columns import stimulus_of
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.results import consistency
from kf_calib.estimation.score_test import Candidate, Frame, Scan
from kf_calib.support import stage
from kf_calib.support.tail_probabilities import sidak

LEVEL = 0.01
"""Chance of a false alarm a run."""

SHARE = 0.4
"""Of the chance of a false alarm: the misfit's, and the scan's."""

REST = 0.5 * (1.0 - 2.0 * SHARE)
"""The lines', and the trends'."""

EQUAL = 6.63
"""Suspects whose chi-squared is this close to the best cannot be told from it (1 %, 1 dof)."""


@functools.cache
def rival_margin(dof: int, tried: int = 1) -> float:
    """By so much noise lets an effect explain more than the one that is really missing, in 1 of 100 runs at most.

    tried: it is the best of so many values of its constant.

    Where the missing effect's space and the other's make angles a, the other's fall less its own is the sum over them
    of (x cos a + n sin a)^2 - x^2, which is largest at x = n / tan a, and n^2 there: chi-squared of the other's dof.
    """
    from scipy.special import chdtri

    return float(chdtri(dof, 0.01 / tried))


def margin_of(candidate: Candidate | None) -> float:
    """The lead of a candidate, its constant being looked for, too; None: a walk, a line, of one number."""
    if candidate is None:
        return rival_margin(1)
    return rival_margin(candidate.dof + (candidate.effect.unknown is not None), candidate.tried)


_DRAWS = 4000
_FEWEST_WALKED = 8  # dwells: a walk of the biases is looked for in that many


@dataclass(frozen=True)
class CandidateTests:
    """All candidates against one fit: a candidate an effect, the best of the values where it has an unknown.

    scores: chi-squared falls less the threshold of their degrees of freedom: above zero is beyond chance.
    p_values: of the run. misfit_p: of the sum of squares as a whole (None: nothing left over to judge by).
    trend: what goes on within dwells beside the model and the noise (None: not to be judged, as where there are lines).
    lines: in the spectrum of the readings within dwells, and the name of the effect they speak for. vibration: those
    that are no oscillation of one amplitude, and count as noise. without_lines: the test with its lines as vibration.
    between: in words, of an oscillation what is too fast for the scan and too slow for a line. paths: what a walk's
    score gains on that of columns, whose falls are those of their best directions, as its likelihood is not of its best
    path.
    """

    scan: Scan
    best: dict[str, int]
    scores: dict[str, float]
    p_values: dict[str, float]
    misfit_p: float | None
    walking: str
    effective_tests: float
    in_slews_only: tuple[str, ...]
    lines: tuple[Line, ...]
    oscillating: str = ""
    vibration: tuple[Line, ...] = ()
    without_lines: CandidateTests | None = None
    between: str = ""
    paths: float = 0.0
    trend: Trend | None = None

    @property
    def p_value(self) -> float | None:
        """Of the run: the smallest of the misfit's, the best suspect's, the best line's and the trends', each at its
        share."""
        found = [*self.p_values.values(), *([self.misfit_p] if self.misfit_p is not None else [])]
        found += [self.trend.p_value * SHARE / REST] if self.trend else []
        return min(1.0, min(found) / SHARE) if found else None

    @property
    def consistent(self) -> bool | None:
        return None if self.p_value is None else self.p_value >= LEVEL

    @property
    def count(self) -> int:
        """How many effects were looked for or could not be."""
        return len(self.best) + len(self.in_slews_only) + bool(self.walking)

    @property
    def ranked(self) -> list[str]:
        """Names, the likeliest first."""
        return sorted(self.scores, key=lambda name: -self.scores[name])

    @cached_property
    def invisible(self) -> list[str]:
        """Effects of which these orientations show nothing, and those that only slews could show."""
        return [*self.unseen, *([self.between] if self.between else [])]

    @cached_property
    def unseen(self) -> list[str]:
        """The effects among them of which nothing at all shows."""
        return [*(name for name, k in self.best.items() if not self.scan.candidates[k].dof), *self.in_slews_only]

    def nearness(self, name: str) -> float:
        """The score without what many values of a constant cost: that speaks against chance, not for a rival."""
        if name not in self.best:
            return self.scores[name]
        own, tests = self.candidate(name), self.effective_tests
        return self.scores[name] + chance_fall(own, tests) - chance_fall(replace(own, tried=1), tests)

    def rivals(self, first: str) -> list[str]:
        """Effects that noise could have let the first get ahead of, the likeliest first."""
        ahead, out = margin_of(self.candidate(first) if first in self.best else None), list[str]()
        for name in self.ranked:
            behind = self.scores[first] - self.nearness(name)
            if first in self.best and name in self.best:  # more coefficients cost what chance gives them, at most
                falls = (float(self.scan.statistics[self.best[each]]) for each in (first, name))
                behind = max(behind, next(falls) - next(falls))
            if behind < ahead and name != first:
                out.append(name)
        return out

    def holding(self, name: str) -> list[str]:
        """Effects that can do all that this one can in this run, and more: no reading speaks against them."""
        if name not in self.best:
            return []
        own = self.candidate(name)
        return [
            other for other in self.ranked if other != name and other in self.best and own.within(self.candidate(other))
        ]

    def candidate(self, name: str) -> Candidate:
        return self.scan.candidates[self.best[name]]


def candidates(model: Model) -> list[Effect]:
    """The effects of the catalogue that are not in the model; one with an unknown at every value of a coarse grid."""
    inside, out = {str(effect) for effect in model.effects}, list[Effect]()
    for name in names(model.bench):
        effect = effect_named(name, model.bench)
        if name in inside or effect.dynamic or effect.walks or effect.oscillates:
            continue
        out += [effect] if effect.unknown is None else [effect.at(value) for value in effect.unknown.grid(2.0)]
    return out


def assess_candidates(
    fitted: Fit, tests: float | None = None, seed: int = 0, frames: list[Frame] | None = None
) -> CandidateTests:
    """Score tests of all candidates, calibrated on their own columns by drawing residuals as noise alone makes them.

    tests: as how many independent ones they count, where that is known from nearly the same columns. frames: where a
    frame of columns is kept for all fits of a run that are judged by the same noise.
    """
    from scipy.special import chdtrc

    model, agreed = fitted.carried.model, consistency(fitted)
    frame = candidate_frame(fitted, [] if frames is None else frames)
    found = _scanned(fitted, frame)
    statistics = found.statistics
    tests = tests or independent_tests(found, seed)
    best, scores, p_values = dict[str, int](), dict[str, float](), dict[str, float]()
    for k, candidate in enumerate(found.candidates):
        name = str(candidate.effect)
        score = float(statistics[k]) - chance_fall(candidate, tests) if candidate.dof else -np.inf
        if name not in best or score > scores.get(name, -np.inf):
            best[name] = k
            if candidate.dof:
                own = sidak(float(chdtrc(candidate.dof, statistics[k])), candidate.tried)
                scores[name], p_values[name] = score, sidak(own, tests)
    name, paths = _walking(fitted), 0.0
    if name:
        # of a million, chi-squared of the dwells' means is not that of the scan to a part in a hundred
        fall = max(2.0 * fitted.walk_gain - max(fitted.misfit - agreed.statistic, 0.0), 0.0)
        p_values[name] = sidak(0.5 * float(chdtrc(1, fall)), tests)
        beyond = fall - threshold(1, tests)
        paths = _beside_best(found, scores, tests) if beyond > 0.0 else 0.0
        scores[name] = beyond + paths
    slewing = tuple(name for name in names(model.bench) if effect_named(name, model.bench).dynamic)
    test = CandidateTests(found, best, scores, p_values, agreed.p_value, name, tests, slewing, (), paths=paths)
    return _with_lines(test, fitted, frame)


def candidate_frame(fitted: Fit, frames: list[Frame]) -> Frame:
    """The columns of all candidates of the catalogue in the noise of a fit: those in ``frames``, where they serve."""
    carried, noise = fitted.carried, fitted.noise.judging
    for known in frames:
        if known.serves(carried, noise):
            return known
    tried = candidates(Model(carried.model.bench))
    stage.say(f"scanning {len({str(each) for each in tried})} effects")
    frames[:] = [Frame(carried, noise, tried)]  # one is all that memory should hold
    return frames[0]


def _scanned(fitted: Fit, frame: Frame) -> Scan:
    """The scan of all candidates, and of an oscillation at the frequency, below those of lines, that explains most."""
    carried, effect = fitted.carried, _oscillation(fitted.carried.model)
    values = np.zeros(0) if effect is None or carried.model.oscillates else slow_hz(fitted, effect)
    if effect is None or not len(values):
        return frame.scan(carried)
    best = values[np.argmax(frame.falls(carried, effect, values))]
    near = [effect.at(hz) for hz in best + 0.125 * values[0] * np.arange(-3, 4)]
    found = frame.scan(carried, near)
    others, swinging = found.candidates[: -len(near)], found.candidates[-len(near) :]
    last = swinging[int(np.argmax(found.statistics[-len(near) :]))]
    return replace(found, candidates=(*others, replace(last, tried=len(values))))


def _oscillation(model: Model) -> Effect | None:
    every = (effect_named(name, model.bench) for name in names(model.bench))
    return next((effect for effect in every if effect.oscillates), None)


def slow_hz(fitted: Fit, effect: Effect) -> Floats:
    """Frequencies of oscillations too slow to show within dwells, in halves of 1/run: from a cycle a run up."""
    stimulus = stimulus_of(fitted.dwells, fitted.carried.model.bench, fitted.carried.state)
    values = effect.grid(stimulus)[2::2]
    return values[values < min(_searched_hz(fitted.dwells))]


def _searched_hz(dwells: Sequence[DwellFactor]) -> tuple[float, float, float]:
    """From which frequency to which a steady oscillation is looked for, and from which on lines; infinite: not."""
    steady, first = band_hz([dwell.trace for dwell in dwells]), lowest_hz(dwell.spectrum for dwell in dwells)
    return *steady, first


def _with_lines(test: CandidateTests, fitted: Fit, frame: Frame) -> CandidateTests:
    """The test with the lines of the spectrum: they speak for an oscillation, whatever of it is slow."""
    from scipy.special import chdtri

    effect = _oscillation(fitted.carried.model)
    if effect is None or fitted.carried.model.oscillates:
        return replace(test, trend=trend(fitted))
    name, slow, (low, high, first) = str(effect), slow_hz(fitted, effect), _searched_hz(fitted.dwells)
    top = float(slow[-1]) if len(slow) else low
    gaps = [(top, low), (high, first)] if np.isfinite(low) else [(top, first)]
    bands = [f"of {a:.2g} to {b:.2g} Hz" if np.isfinite(b) else f"above {a:.2g} Hz" for a, b in gaps if b > 1.5 * a]
    if bands:
        test = replace(test, between=f"{name} {' and '.join(bands)}")
    seen = frame.lines(LEVEL * REST)
    if not seen:
        return replace(test, trend=trend(fitted))
    p_value = seen[0].p_value
    return replace(
        test,
        best={key: k for key, k in test.best.items() if key != name},
        scores=test.scores | {name: float(chdtri(1, max(p_value, 1e-300))) - threshold(1, 1.0)},
        p_values=test.p_values | {name: p_value * SHARE / REST},
        lines=seen,
        oscillating=name,
        without_lines=replace(test, vibration=seen),
    )


def chance_fall(candidate: Candidate, tests: float) -> float:
    """The fall of chi-squared that chance gives one of so many candidates.

    A constant looked for counts as one degree of freedom more, or, where it takes many tests, as these.
    """
    looked_for = candidate.effect.unknown is not None and candidate.tried == 1
    return threshold(candidate.dof + looked_for, tests * candidate.tried)


@functools.cache
def threshold(dof: int, tests: float) -> float:
    from scipy.special import chdtri

    return float(chdtri(dof, LEVEL / tests))


def independent_tests(found: Scan, seed: int = 0) -> float:
    """As many independent tests would reach the smallest p-value that one run in 100 reaches."""
    seen = np.flatnonzero([each.dof for each in found.candidates])
    if not len(seen):
        return 1.0
    return LEVEL / max(float(np.quantile(_smallest_p(found, seen, seed), LEVEL)), 1e-12)


def _smallest_p(found: Scan, seen: NDArray[np.intp], seed: int) -> Floats:
    """The smallest p-value among all candidates in each of many runs in which nothing is missing.

    Drawn by the symmetric root of the covariance of all scores: which way the frame and the bases in it are turned is
    up to rounding, and the draws would be those of the machine.
    """
    from scipy.special import chdtrc

    scores = [found.candidates[k].directions for k in seen]
    stacked, starts = np.concatenate(scores, axis=1), np.cumsum([0, *(own.shape[1] for own in scores[:-1])])
    values, vectors = np.linalg.eigh(stacked.T @ stacked)
    root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    draws = np.random.default_rng(seed).standard_normal((_DRAWS, len(root)))
    squares = np.add.reduceat((draws @ root) ** 2, starts, axis=1)
    return chdtrc(np.array([found.candidates[k].dof for k in seen], float), squares).min(axis=1)


def _walking(fitted: Fit) -> str:
    """The name of the effect that lets the biases walk; empty where it is in the model, or cannot be looked for."""
    model = fitted.carried.model
    if model.walks or len(fitted.dwells) < _FEWEST_WALKED or fitted.noise.walk_mps2_per_sqrt_s:
        return ""
    return walk_named(model.bench)


def _beside_best(found: Scan, scores: Mapping[str, float], tests: float) -> float:
    """So much more than its fall less its threshold is the score of a walk, to be ahead of the best column where its
    likelihood is.

    That is over all paths; the likelihood of a column is its mean over all directions and values of its constant.
    """
    best = max(scores, key=lambda name: scores[name], default="")
    if not best or scores[best] <= 0.0:
        return 0.0
    own = values_of(found, best)
    return walk_path_margin(found, own, found.statistics[own], scores[best], tests)


def walk_path_margin(found: Scan, own: Sequence[int], falls: Floats, score: float, tests: float) -> float:
    """The same against the candidates ``own`` of one effect, by what each lowers chi-squared and the best one's score,
    alone or beside another effect."""
    return score + threshold(1, tests) - evidence_as_fall(found, own, falls)


def values_of(found: Scan, name: str) -> list[int]:
    """Candidates of one effect, one for each value of its constant at which anything shows."""
    return [k for k, each in enumerate(found.candidates) if str(each.effect) == name and each.dof]


def evidence_as_fall(found: Scan, own: Sequence[int], falls: Floats) -> float:
    """What it is worth beside a likelihood (``as_fall``) that the candidates ``own`` of one effect, at values of its
    constant, lower chi-squared by ``falls``."""
    each = [found.candidates[k] for k in own]
    tried = max(_values(found, each[0]), *(one.tried for one in each))
    return as_fall(np.array([one.dof for one in each]), falls, tried)


def joint_evidence_as_fall(found: Scan, own: Sequence[int]) -> float:
    """The same of effects together, each at one value of its constant, the best of all of them."""
    each = [found.candidates[k] for k in own]
    fall, dof = found.explained(np.concatenate([one.basis for one in each], axis=1))
    tried = int(np.prod([max(_values(found, one), one.tried) for one in each]))
    return as_fall(np.array([dof]), np.array([fall]), tried)


def _values(found: Scan, candidate: Candidate) -> int:
    return sum(str(other.effect) == str(candidate.effect) for other in found.candidates)
