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
from kf_calib.dwells.coherent_tone import band_hz
from kf_calib.dwells.line_spectrum import SpectralLine, lowest_hz
from kf_calib.dwells.sufficient_statistics import lines_of
from kf_calib.dwells.table import DwellTable
from kf_calib.effects import Coefficient, Effect, effect_named, names, oscillation_of, slew_effects, walk_named
from kf_calib.estimation.candidate_scan import Candidate, Scan
from kf_calib.estimation.dwell_columns import stimulus_of
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.observability import is_seen, smallest_size
from kf_calib.estimation.results import Consistency, consistency
from kf_calib.estimation.score_test import periodogram, scan
from kf_calib.estimation.within_dwell_trend import Trend, trend
from kf_calib.support import stage
from kf_calib.support.tail_probabilities import LEVEL, REST, SHARE, f_tail, sidak

_TIE = 1e-6  # of chi-squared: of values of a constant that explain as much, the first is taken, whatever rounding does
_DRAWS = 4000
GRID = 2.0
"""Ratio of neighbouring values of a constant that are tried."""

_FEWEST_WALKED = 8  # dwells that are needed before a random walk of the biases is tested


@dataclass(frozen=True)
class EffectTests:
    """The tests of all effects against one fit.

    A candidate is an effect with its unknown constant, if it has one, at one value; the best candidate of an effect is
    the value that explains most.

    - scan: all candidates and the residual, in their common frame.
    - best: the number of each effect's best candidate in the scan.
    - scores: the decrease of chi-squared by each effect, less the critical one; positive is significant.
    - p_values: the family-wise p-value of each effect.
    - walk: the name of the random walk of the biases, which has no columns in the scan; "" where it was not tested.
    - independent_tests: the number of independent tests that the scan amounts to.
    - in_slews_only: effects that only slews could show.
    """

    scan: Scan
    best: dict[str, int]
    scores: dict[str, float]
    p_values: dict[str, float]
    walk: str
    independent_tests: float
    in_slews_only: tuple[str, ...]

    @property
    def count(self) -> int:
        """Number of effects that were tested or that this run cannot show."""
        return len(self.best) + len(self.in_slews_only) + bool(self.walk)

    @cached_property
    def unseen(self) -> list[str]:
        """Effects of which the run shows nothing: those invisible in these orientations, and those of slews only."""
        hidden = (name for name in self.best if not is_seen(self.candidate(name), self._chance))
        return [*hidden, *self.in_slews_only]

    def smallest_size(self, name: str) -> tuple[Coefficient, float] | None:
        """The coefficient of an effect that is hardest to find, and the size (SI) from which on it is found in 9 of 10
        runs; None where none is determined by itself."""
        return smallest_size(self.candidate(name), self._chance)

    @property
    def _chance(self) -> float:
        """The probability that noise alone makes one effect significant."""
        return SHARE * LEVEL / self.independent_tests

    def candidate(self, name: str) -> Candidate:
        """The best candidate of an effect."""
        return self.scan.candidates[self.best[name]]


@dataclass(frozen=True)
class LineTests:
    """The test of lines in the spectrum of the readings within dwells.

    - significant: the lines that noise does not explain.
    - oscillation: the name of the effect that would explain them; "" where there are none.
    - vibration: lines that are not an oscillation of constant amplitude, and so count as noise.
    - untested_band: in words, the frequencies of an oscillation that are too fast for the scan and too slow for a line.
    """

    significant: tuple[SpectralLine, ...] = ()
    oscillation: str = ""
    vibration: tuple[SpectralLine, ...] = ()
    untested_band: str = ""

    @property
    def vibration_in_words(self) -> str:
        """The frequencies of vibration, with their unit; "" where there is none."""
        return ", ".join(f"{line.frequency_hz:.4g}" for line in self.vibration) + " Hz" * bool(self.vibration)


@dataclass(frozen=True)
class CandidateTests:
    """All tests of one fit: of its misfit, of each effect, of spectral lines and of trends within dwells.

    - effects: the tests of all effects.
    - misfit_p: the p-value of the sum of squares as a whole; None where no degrees of freedom are left.
    - lines: the test of spectral lines.
    - trend: the test of trends within dwells; None where it cannot be made, or where there are lines.
    - noise_p: the p-value of noise from dwell to dwell that was not stated, against all other explanations
      (``hypothesis_table.noise_p``); None where all of it was stated.
    - without_lines: the same tests with the lines counted as vibration; None where there are none.
    """

    effects: EffectTests
    misfit_p: float | None
    lines: LineTests = LineTests()
    trend: Trend | None = None
    noise_p: float | None = None
    without_lines: CandidateTests | None = None

    @property
    def p_value(self) -> float | None:
        """The p-value of the run: the smallest of all tests, each at its share, and of ``noise_p``; None where nothing
        could be tested."""
        p_values = [*self.effects.p_values.values(), *([self.misfit_p] if self.misfit_p is not None else [])]
        p_values += [self.trend.p_value * SHARE / REST] if self.trend else []
        of_noise = [] if self.noise_p is None else [self.noise_p]
        return min(1.0, min(p_values) / SHARE, *of_noise) if p_values else None

    @property
    def consistent(self) -> bool | None:
        """Whether the model agrees with the run at ``LEVEL``; None where nothing could be tested."""
        return None if self.p_value is None else self.p_value >= LEVEL

    @cached_property
    def invisible(self) -> list[str]:
        """Effects that the run cannot show, and oscillations at untested frequencies."""
        return [*self.effects.unseen, *([self.lines.untested_band] if self.lines.untested_band else [])]

    def with_vibration(self, lines: tuple[SpectralLine, ...]) -> CandidateTests:
        """The same tests, with these lines counted as vibration."""
        return replace(self, lines=replace(self.lines, vibration=lines))


def candidates(model: Model) -> list[Effect]:
    """Effects of the catalogue that are not in the model and can be scanned, at each value of a grid of a constant."""
    in_model, effects = {str(effect) for effect in model.effects}, list[Effect]()
    for name in names(model.bench):
        effect = effect_named(name, model.bench)
        if name in in_model or not effect.scannable:
            continue
        effects += [effect] if effect.unknown is None else [effect.at(value) for value in effect.unknown.grid(GRID)]
    return effects


def assess_candidates(fitted: Fit, tests: float | None = None, seed: int = 0) -> CandidateTests:
    """Score tests of all candidates of the catalogue against a fit.

    The false-alarm rate is calibrated for the columns of this run, by drawing residuals that contain only noise.

    - fitted: the fit to be tested.
    - tests: effective number of independent tests, where it is known from nearly the same columns; None: the draws
      give it.
    - seed: of the draws.
    """
    from scipy.special import chdtrc

    model, agreed = fitted.linearised.model, consistency(fitted)
    scanned = _scanned(fitted)
    statistics = scanned.statistics
    tests = tests or independent_tests(scanned, seed)
    best, scores, p_values = dict[str, int](), dict[str, float](), dict[str, float]()
    for k, candidate in enumerate(scanned.candidates):
        name = str(candidate.effect)
        score = float(statistics[k]) - critical_delta_chi2(candidate, tests) if candidate.dof else -np.inf
        if name not in best or score > scores.get(name, -np.inf) + _TIE:
            best[name] = k
            if candidate.dof:
                p_alone = sidak(_p_alone(fitted, candidate.dof, float(statistics[k]), agreed), candidate.tried)
                scores[name], p_values[name] = score, sidak(p_alone, tests)
    name = _walk_to_test(fitted)
    if name:
        # The likelihood uses the chi-squared of the dwells' means. Where the misfit is huge, that exceeds the
        # chi-squared of the scan by up to one per cent, which must not count for the walk.
        delta_chi2 = max(2.0 * fitted.walk_gain - max(fitted.misfit - agreed.statistic, 0.0), 0.0)
        p_values[name] = sidak(0.5 * float(chdtrc(1, delta_chi2)), tests)
        scores[name] = delta_chi2 - threshold(1, tests)
    effects = EffectTests(scanned, best, scores, p_values, name, tests, slew_effects(model.bench))
    return _with_lines(CandidateTests(effects, agreed.p_value), fitted)


def _p_alone(fitted: Fit, dof: int, delta_chi2: float, agreed: Consistency) -> float:
    """Return the p-value of a fall of chi-squared; by F, where all noise was estimated from what the model leaves."""
    from scipy.special import chdtrc

    if fitted.noise.within_seen:
        return float(chdtrc(dof, delta_chi2))
    rest = agreed.dof - dof
    left = max(agreed.statistic - delta_chi2, 1e-12 * agreed.statistic)
    return f_tail(dof, rest, delta_chi2 / dof / (left / rest)) if rest > 0 and left > 0.0 else 1.0


def _scanned(fitted: Fit) -> Scan:
    """Return the scan of all candidates and, with angles, of slow oscillations, of which the best frequency is kept.

    In a hand, few dwells would have an oscillation of some frequency by chance: whatever scatters them.
    """
    linearised, noise = fitted.linearised, fitted.noise.for_goodness_of_fit
    effects, untried = candidates(linearised.model), linearised.model.oscillates or fitted.noise.attitude_unknown
    stage.say(f"scanning {len({str(effect) for effect in effects})} effects")
    effect = None if untried else oscillation_of(linearised.model.bench)
    frequencies_hz = np.zeros(0) if effect is None else slow_hz(fitted, effect)
    if effect is None or not len(frequencies_hz):
        return scan(linearised, noise, effects)
    best_hz = frequencies_hz[np.argmax(periodogram(linearised, noise, effect, frequencies_hz))]
    tones = [effect.at(hz) for hz in best_hz + 0.125 * frequencies_hz[0] * np.arange(-3, 4)]
    scanned = scan(linearised, noise, [*effects, *tones])
    others, tone_candidates = scanned.candidates[: -len(tones)], scanned.candidates[-len(tones) :]
    best_tone = tone_candidates[int(np.argmax(scanned.statistics[-len(tones) :]))]
    return replace(scanned, candidates=(*others, replace(best_tone, tried=len(frequencies_hz))))


def slow_hz(fitted: Fit, effect: Effect) -> Floats:
    """Frequencies (Hz) of oscillations too slow to show within dwells: from one cycle per run in half-cycle steps."""
    stimulus = stimulus_of(fitted.dwells, fitted.linearised.model.bench, fitted.linearised.state)
    frequencies_hz = effect.grid(stimulus)[2::2]
    return frequencies_hz[frequencies_hz < min(_searched_hz(fitted.dwells))]


def _searched_hz(dwells: DwellTable) -> tuple[float, float, float]:
    """Return the band in which a steady oscillation is searched and the lowest frequency of lines; infinite: none."""
    steady, lowest_line_hz = band_hz(dwells.folded.traces), lowest_hz(dwells.folded.spectra)
    return *steady, lowest_line_hz


def _with_lines(test: CandidateTests, fitted: Fit) -> CandidateTests:
    """Return the tests with the lines of the spectrum, which count for an oscillation in place of slow frequencies."""
    from scipy.special import chdtri

    effect = oscillation_of(fitted.linearised.model.bench)
    if effect is None or fitted.linearised.model.oscillates:
        return replace(test, trend=trend(fitted))
    if fitted.noise.attitude_unknown:  # a body in the hand trembles: its lines are vibration
        test, lines = replace(test, lines=LineTests(untested_band=str(effect))), lines_of(fitted.dwells, LEVEL * REST)
        return test.with_vibration(lines) if lines else replace(test, trend=trend(fitted))
    name, slow, (low_hz, high_hz, lowest_line_hz) = str(effect), slow_hz(fitted, effect), _searched_hz(fitted.dwells)
    highest_hz = slow[-1] if len(slow) else low_hz
    steady_hz = (low_hz, high_hz) if np.isfinite(low_hz) else ()
    edges_hz = [highest_hz, *steady_hz, lowest_line_hz]
    gaps_hz = zip(edges_hz[::2], edges_hz[1::2], strict=True)
    bands = [f"of {a:.2g} to {b:.2g} Hz" if np.isfinite(b) else f"above {a:.2g} Hz" for a, b in gaps_hz if b > 1.5 * a]
    if bands:
        test = replace(test, lines=LineTests(untested_band=f"{name} {' and '.join(bands)}"))
    lines = lines_of(fitted.dwells, LEVEL * REST)
    if not lines:
        return replace(test, trend=trend(fitted))
    p_value, effects = lines[0].p_value, test.effects
    return replace(
        test,
        effects=replace(
            effects,
            best={key: k for key, k in effects.best.items() if key != name},
            scores=effects.scores | {name: float(chdtri(1, max(p_value, 1e-300))) - threshold(1, 1.0)},
            p_values=effects.p_values | {name: p_value * SHARE / REST},
        ),
        lines=replace(test.lines, significant=lines, oscillation=name),
        without_lines=test.with_vibration(lines),
    )


def critical_delta_chi2(candidate: Candidate, tests: float) -> float:
    """The fall of chi-squared that a candidate has to exceed to be significant in the whole run.

    An unknown constant counts as one more degree of freedom. Where many of its values were tried as separate tests, it
    counts as that many tests instead.

    tests: effective number of independent tests in the run.
    """
    searched = candidate.effect.unknown is not None and candidate.tried == 1
    return threshold(candidate.dof + searched, tests * candidate.tried)


@functools.cache
def threshold(dof: int, tests: float) -> float:
    """The fall of chi-squared that noise exceeds in any of n independent tests with a probability of ``LEVEL``."""
    from scipy.special import chdtri

    return float(chdtri(dof, LEVEL / tests))


def independent_tests(scan: Scan, seed: int = 0) -> float:
    """The effective number of independent tests that the correlated tests of all candidates amount to.

    It is n = 0.01 / q, where q is the 1 % quantile of the smallest p-value of these tests in runs with noise alone.
    """
    visible = np.flatnonzero([each.dof for each in scan.candidates])
    if not len(visible):
        return 1.0
    return LEVEL / max(float(np.quantile(_smallest_p(scan, visible, seed), LEVEL)), 1e-12)


def _smallest_p(scan: Scan, visible: NDArray[np.intp], seed: int) -> Floats:
    """Draw the smallest p-value among all candidates in many runs in which no effect is missing.

    The draws use the symmetric root of the covariance of all scores. The bases of the candidates are defined up to a
    rotation that depends on rounding, and with another root the draws would differ from machine to machine.
    """
    from scipy.special import chdtrc

    scores = [scan.candidates[k].directions for k in visible]
    stacked, starts = np.concatenate(scores, axis=1), np.cumsum([0, *(own.shape[1] for own in scores[:-1])])
    values, vectors = np.linalg.eigh(stacked.T @ stacked)
    root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    draws = np.random.default_rng(seed).standard_normal((_DRAWS, len(root)))
    squares = np.add.reduceat((draws @ root) ** 2, starts, axis=1)
    dofs = np.array([scan.candidates[k].dof for k in visible])
    tallest = {dof: squares[:, dofs == dof].max(axis=1) for dof in np.unique(dofs).tolist()}  # has the smallest p-value
    return np.min([chdtrc(dof, square) for dof, square in tallest.items()], axis=0)


def _walk_to_test(fitted: Fit) -> str:
    """Return the name of the random walk of the biases, or "" where it is in the model or cannot be tested."""
    model = fitted.linearised.model
    if model.walks or len(fitted.dwells) < _FEWEST_WALKED or fitted.noise.walk.steps:
        return ""
    return walk_named(model.bench)


def overlap_matrix(test: CandidateTests, names: Sequence[str]) -> Floats:
    """The overlaps (n, n) of effects with each other: 1 with a random walk, which can take any path, and NaN with an
    effect that has no columns in the scan and is no walk."""
    overlaps, effects = np.ones((len(names), len(names))), test.effects
    for (j, one), (k, other) in itertools.product(enumerate(names), repeat=2):
        if one in effects.best and other in effects.best:
            overlaps[j, k] = effects.candidate(one).overlap(effects.candidate(other))
        elif not {one, other} <= {*effects.best, effects.walk}:
            overlaps[j, k] = np.nan
    return overlaps
