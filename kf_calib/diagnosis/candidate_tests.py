"""Score tests of all candidate effects against one fit, with a false-alarm rate that holds for the whole run."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.within_dwell_trend import Trend, trend
from kf_calib.dwells.coherent_tone import band_hz
from kf_calib.dwells.line_spectrum import Line, lowest_hz
from kf_calib.dwells.sufficient_statistics import DwellFactor
from kf_calib.effects import Effect, effect_named, names, oscillation_of, slew_effects, walk_named
from kf_calib.estimation.dwell_columns import stimulus_of
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.results import consistency
from kf_calib.estimation.score_test import Candidate, Frame, Scan
from kf_calib.support import stage
from kf_calib.support.tail_probabilities import LEVEL, sidak

SHARE = 0.4
"""Share of the false-alarm probability that is given to the test of the misfit, and as much to the scan."""

REST = 0.5 * (1.0 - 2.0 * SHARE)
"""Share that is given to the test of spectral lines, and as much to that of trends within dwells."""

_DRAWS = 4000
_FEWEST_WALKED = 8  # dwells that are needed before a random walk of the biases is tested


@dataclass(frozen=True)
class CandidateTests:
    """Results of the tests of all candidates against one fit.

    A candidate is one effect; where an effect has an unknown constant, it is the value that explains most.

    scan: candidates and residual in their common frame. best: number in the scan of the best candidate of each effect.
    scores: fall of chi-squared of each effect less the threshold for its degrees of freedom; positive is significant.
    p_values: family-wise p-value of each effect. misfit_p: p-value of the sum of squares as a whole (None: no degrees
    of freedom are left). walking: name of the random walk of the biases ("": it was not tested). effective_tests:
    number of independent tests that the scan amounts to. in_slews_only: effects that only slews could show. lines:
    significant lines in the spectrum of the readings within dwells. oscillating: name of the effect that would explain
    them. vibration: lines that are not an oscillation of constant amplitude, and so count as noise. without_lines: the
    same tests with the lines treated as vibration. between: in words, the frequencies of an oscillation that are too
    fast for the scan and too slow for a line. trend: the test of trends within dwells
    (None: it cannot be made, or there are lines). noise_p: p-value of noise from dwell to dwell that was not stated
    against all explanations (``hypothesis_table.noise_p``; None: all was stated).
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
    trend: Trend | None = None
    noise_p: float | None = None

    @property
    def p_value(self) -> float | None:
        """The p-value of the run: the smallest of all tests, each at its share, and of ``noise_p``; None where nothing
        could be tested."""
        found = [*self.p_values.values(), *([self.misfit_p] if self.misfit_p is not None else [])]
        found += [self.trend.p_value * SHARE / REST] if self.trend else []
        least = [] if self.noise_p is None else [self.noise_p]
        return min(1.0, min(found) / SHARE, *least) if found else None

    @property
    def consistent(self) -> bool | None:
        """Whether the model agrees with the run at ``LEVEL``; None where nothing could be tested."""
        return None if self.p_value is None else self.p_value >= LEVEL

    @property
    def count(self) -> int:
        """Number of effects that were tested or that this run cannot show."""
        return len(self.best) + len(self.in_slews_only) + bool(self.walking)

    @cached_property
    def invisible(self) -> list[str]:
        """Effects invisible in these orientations, effects of slews only, and oscillations at untested frequencies."""
        return [*self.unseen, *([self.between] if self.between else [])]

    @cached_property
    def unseen(self) -> list[str]:
        """Effects of which the run shows nothing: those invisible in these orientations, and those of slews only."""
        return [*(name for name, k in self.best.items() if not self.scan.candidates[k].dof), *self.in_slews_only]

    def candidate(self, name: str) -> Candidate:
        """The best candidate of an effect."""
        return self.scan.candidates[self.best[name]]


def candidates(model: Model) -> list[Effect]:
    """Effects of the catalogue that are not in the model and can be scanned, at each value of a grid of a constant."""
    inside, out = {str(effect) for effect in model.effects}, list[Effect]()
    for name in names(model.bench):
        effect = effect_named(name, model.bench)
        if name in inside or not effect.scannable:
            continue
        out += [effect] if effect.unknown is None else [effect.at(value) for value in effect.unknown.grid(2.0)]
    return out


def assess_candidates(
    fitted: Fit, tests: float | None = None, seed: int = 0, frames: list[Frame] | None = None
) -> CandidateTests:
    """Score tests of all candidates of the catalogue against a fit.

    The false-alarm rate is calibrated for the columns of this run, by drawing residuals that contain only noise.

    fitted: the fit to be tested. tests: effective number of independent tests, where it is known from nearly the same
    columns (None: it is found by the draws). seed: of the draws. frames: list that keeps the frame of candidate columns
    for further fits of the run that are judged by the same noise.
    """
    from scipy.special import chdtrc

    model, agreed = fitted.linearised.model, consistency(fitted)
    frame = candidate_frame(fitted, [] if frames is None else frames)
    found = _scanned(fitted, frame)
    statistics = found.statistics
    tests = tests or independent_tests(found, seed)
    best, scores, p_values = dict[str, int](), dict[str, float](), dict[str, float]()
    for k, candidate in enumerate(found.candidates):
        name = str(candidate.effect)
        score = float(statistics[k]) - critical_delta_chi2(candidate, tests) if candidate.dof else -np.inf
        if name not in best or score > scores.get(name, -np.inf):
            best[name] = k
            if candidate.dof:
                own = sidak(float(chdtrc(candidate.dof, statistics[k])), candidate.tried)
                scores[name], p_values[name] = score, sidak(own, tests)
    name = _walking(fitted)
    if name:
        # The likelihood uses the chi-squared of the dwells' means. Where the misfit is huge, that exceeds the
        # chi-squared of the scan by up to one per cent, which must not count for the walk.
        delta_chi2 = max(2.0 * fitted.walk_gain - max(fitted.misfit - agreed.statistic, 0.0), 0.0)
        p_values[name] = sidak(0.5 * float(chdtrc(1, delta_chi2)), tests)
        scores[name] = delta_chi2 - threshold(1, tests)
    slewing = slew_effects(model.bench)
    test = CandidateTests(found, best, scores, p_values, agreed.p_value, name, tests, slewing, ())
    return _with_lines(test, fitted, frame)


def candidate_frame(fitted: Fit, frames: list[Frame]) -> Frame:
    """The frame of the columns of all candidates in the noise of a fit: one of ``frames``, or a new one put there."""
    linearised, noise = fitted.linearised, fitted.noise.for_goodness_of_fit
    for known in frames:
        if known.serves(linearised, noise):
            return known
    tried = candidates(Model(linearised.model.bench))
    stage.say(f"scanning {len({str(each) for each in tried})} effects")
    frames[:] = [Frame(linearised, noise, tried)]  # only one frame is kept, to save memory
    return frames[0]


def _scanned(fitted: Fit, frame: Frame) -> Scan:
    """Return the scan of all candidates and of slow oscillations, of which the best frequency is kept."""
    linearised, effect = fitted.linearised, oscillation_of(fitted.linearised.model.bench)
    values = np.zeros(0) if effect is None or linearised.model.oscillates else slow_hz(fitted, effect)
    if effect is None or not len(values):
        return frame.scan(linearised)
    best = values[np.argmax(frame.delta_chi2(linearised, effect, values))]
    near = [effect.at(hz) for hz in best + 0.125 * values[0] * np.arange(-3, 4)]
    found = frame.scan(linearised, near)
    others, swinging = found.candidates[: -len(near)], found.candidates[-len(near) :]
    last = swinging[int(np.argmax(found.statistics[-len(near) :]))]
    return replace(found, candidates=(*others, replace(last, tried=len(values))))


def slow_hz(fitted: Fit, effect: Effect) -> Floats:
    """Frequencies (Hz) of oscillations too slow to show within dwells: from one cycle per run in half-cycle steps."""
    stimulus = stimulus_of(fitted.dwells, fitted.linearised.model.bench, fitted.linearised.state)
    values = effect.grid(stimulus)[2::2]
    return values[values < min(_searched_hz(fitted.dwells))]


def _searched_hz(dwells: Sequence[DwellFactor]) -> tuple[float, float, float]:
    """Return the band in which a steady oscillation is searched and the lowest frequency of lines; infinite: none."""
    steady, first = band_hz([dwell.trace for dwell in dwells]), lowest_hz(dwell.spectrum for dwell in dwells)
    return *steady, first


def _with_lines(test: CandidateTests, fitted: Fit, frame: Frame) -> CandidateTests:
    """Return the tests with the lines of the spectrum, which count for an oscillation in place of slow frequencies."""
    from scipy.special import chdtri

    effect = oscillation_of(fitted.linearised.model.bench)
    if effect is None or fitted.linearised.model.oscillates:
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


def critical_delta_chi2(candidate: Candidate, tests: float) -> float:
    """The fall of chi-squared that a candidate has to exceed to be significant in the whole run.

    An unknown constant counts as one more degree of freedom. Where many of its values were tried as separate tests, it
    counts as that many tests instead.

    tests: effective number of independent tests in the run.
    """
    looked_for = candidate.effect.unknown is not None and candidate.tried == 1
    return threshold(candidate.dof + looked_for, tests * candidate.tried)


@functools.cache
def threshold(dof: int, tests: float) -> float:
    """The fall of chi-squared that noise exceeds in any of n independent tests with a probability of ``LEVEL``."""
    from scipy.special import chdtri

    return float(chdtri(dof, LEVEL / tests))


def independent_tests(found: Scan, seed: int = 0) -> float:
    """The effective number of independent tests that the correlated tests of all candidates amount to.

    It is n = 0.01 / q, where q is the 1 % quantile of the smallest p-value of these tests in runs with noise alone.
    """
    seen = np.flatnonzero([each.dof for each in found.candidates])
    if not len(seen):
        return 1.0
    return LEVEL / max(float(np.quantile(_smallest_p(found, seen, seed), LEVEL)), 1e-12)


def _smallest_p(found: Scan, seen: NDArray[np.intp], seed: int) -> Floats:
    """Draw the smallest p-value among all candidates in many runs in which no effect is missing.

    The draws use the symmetric root of the covariance of all scores. The bases of the candidates are defined up to a
    rotation that depends on rounding, and with another root the draws would differ from machine to machine.
    """
    from scipy.special import chdtrc

    scores = [found.candidates[k].directions for k in seen]
    stacked, starts = np.concatenate(scores, axis=1), np.cumsum([0, *(own.shape[1] for own in scores[:-1])])
    values, vectors = np.linalg.eigh(stacked.T @ stacked)
    root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    draws = np.random.default_rng(seed).standard_normal((_DRAWS, len(root)))
    squares = np.add.reduceat((draws @ root) ** 2, starts, axis=1)
    dofs = np.array([found.candidates[k].dof for k in seen])
    tallest = {dof: squares[:, dofs == dof].max(axis=1) for dof in np.unique(dofs).tolist()}  # has the smallest p-value
    return np.min([chdtrc(dof, square) for dof, square in tallest.items()], axis=0)


def _walking(fitted: Fit) -> str:
    """Return the name of the random walk of the biases, or "" where it is in the model or cannot be tested."""
    model = fitted.linearised.model
    if model.walks or len(fitted.dwells) < _FEWEST_WALKED or fitted.noise.walk_mps2_per_sqrt_s:
        return ""
    return walk_named(model.bench)


def values_of(found: Scan, name: str) -> list[int]:
    """Numbers of the candidates of one effect: one for each value of its constant at which it is visible."""
    return [k for k, each in enumerate(found.candidates) if str(each.effect) == name and each.dof]


def overlap_matrix(test: CandidateTests, names: Sequence[str]) -> Floats:
    """The overlaps (n, n) of effects with each other: 1 with a random walk, which can take any path, and NaN with an
    effect that has no columns in the scan and is no walk."""
    out = np.ones((len(names), len(names)))
    for (j, one), (k, other) in itertools.product(enumerate(names), repeat=2):
        if one in test.best and other in test.best:
            out[j, k] = test.candidate(one).overlap(test.candidate(other))
        elif not {one, other} <= {*test.best, test.walking}:
            out[j, k] = np.nan
    return out
