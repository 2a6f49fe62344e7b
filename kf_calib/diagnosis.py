"""Which physical effect is missing: what the misfit says, and what it cannot say.

The candidates of the catalogue are projected off the model (``scan``) and tested together: the p-value of a suspect
is that of the run, the chance that any of them would look as good with nothing missing. A suspect is named only where
the model with it fits; where several fit equally well they are all named; where none does the answer is *unknown*.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from kf_calib import advice as advise
from kf_calib import averaging
from kf_calib.advice import Advice
from kf_calib.calibration import Calibration, Parameter, consistency, format_p, refitted
from kf_calib.drivers import JUMP, Family, families
from kf_calib.effects import Effect, effect_named, names, walk_named
from kf_calib.fitting import WALK, Fit, walk_gain
from kf_calib.folding import DwellFactor, lines_of, stimulus_of
from kf_calib.likelihood import FEWEST
from kf_calib.model import Model
from kf_calib.noise import mean_covariances
from kf_calib.samples import Floats
from kf_calib.scan import Candidate, Scan, falls, scan
from kf_calib.spectrum import Line, lowest_hz
from kf_calib.trace import band_hz

LEVEL = 0.01
"""Chance of a false alarm a run."""
_REFUSED = 0.002  # chance that what is really missing is turned down because noise beside it looks like something more

_DRAWS = 4000
_SHARE = 0.4  # of the chance of a false alarm: the misfit's and the scan's; lines have the rest
_LINES = 1.0 - 2.0 * _SHARE
_EQUAL = 6.63  # suspects whose chi-squared is this close to the best cannot be told from it (1 %, 1 dof)
_ALIKE = 0.5  # overlap above which two suspects may be taken for each other
_PAIRS = 3  # pairs that are refitted
_WALK = -1  # in a pair, in the place of a candidate's number: a walk has no columns
_SHOWN = 6  # suspects that are refitted and shown
_POWER = 0.9
_FEWEST_WALKED = 8  # dwells: a walk of the biases is looked for in that many


@dataclass(frozen=True)
class Test:
    """All candidates against one fit: a candidate an effect, the best of the values where it has an unknown.

    scores: chi-squared falls less the threshold of their degrees of freedom: above zero is beyond chance.
    p_values: of the run. misfit_p: of the sum of squares as a whole (None: nothing left over to judge by).
    lines: in the spectrum of the readings within dwells, and the name of the effect they speak for. vibration: those
    that are no oscillation of one amplitude, and count as noise. without_lines: the test with its lines as vibration.
    between: in words, of an oscillation what is too fast for the scan and too slow for a line. as_scatter: what could
    be a walk of the biases could as well be scatter from dwell to dwell, of more than is stated.
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
    without_lines: Test | None = None
    between: str = ""
    as_scatter: bool = False

    @property
    def p_value(self) -> float | None:
        """Of the run: the smallest of the misfit's, the best suspect's and the best line's, each at its share."""
        found = [*self.p_values.values(), *([self.misfit_p] if self.misfit_p is not None else [])]
        return min(1.0, min(found) / _SHARE) if found else None

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
        """The score without what many values of a constant cost: that speaks against chance, not for a rival.

        A walk is judged over all its paths: an effect that happens to look like the one it took has gained on it.
        """
        if name not in self.best:
            return self.scores[name] + (_EQUAL if name == self.walking else 0.0)
        own, tests = self.candidate(name), self.effective_tests
        return self.scores[name] + price(own, tests) - price(replace(own, tried=1), tests)

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


def assessed(fitted: Fit, tests: float | None = None, seed: int = 0) -> Test:
    """Score tests of all candidates, calibrated on their own columns by drawing residuals as noise alone makes them.

    tests: as how many independent ones they count, where that is known from nearly the same columns.
    """
    from scipy.special import chdtrc

    model, misfit_p = fitted.carried.model, consistency(fitted).p_value
    found = _scanned(fitted)
    statistics = found.statistics
    tests = tests or independent_tests(found, seed)
    best, scores, p_values = dict[str, int](), dict[str, float](), dict[str, float]()
    for k, candidate in enumerate(found.candidates):
        name = str(candidate.effect)
        score = float(statistics[k]) - price(candidate, tests) if candidate.dof else -np.inf
        if name not in best or score > scores.get(name, -np.inf):
            best[name] = k
            if candidate.dof:
                own = run_level(float(chdtrc(candidate.dof, statistics[k])), candidate.tried)
                scores[name], p_values[name] = score, run_level(own, tests)
    name, as_scatter = _walking(fitted), False
    if name:
        fall, as_scatter = _walk_fall(fitted, tests)
        p_values[name] = run_level(0.5 * float(chdtrc(1, max(fall, 0.0))), tests)
        scores[name] = fall - _threshold(1, tests)
    slewing = tuple(name for name in names(model.bench) if effect_named(name, model.bench).dynamic)
    test = Test(found, best, scores, p_values, misfit_p, name, tests, slewing, (), as_scatter=as_scatter)
    return _with_lines(test, fitted)


def _scanned(fitted: Fit) -> Scan:
    """The scan of all candidates, and of an oscillation at the frequency, below those of lines, that explains most."""
    carried, noise = fitted.carried, fitted.noise.judging
    effect = _oscillation(carried.model)
    if effect is None or carried.model.oscillates:
        return scan(carried, noise, candidates(carried.model))
    values = _slow(fitted, effect)
    if not len(values):
        return scan(carried, noise, candidates(carried.model))
    coarse = falls(carried, noise, [effect.at(value) for value in values])
    near = values[np.argmax(coarse)] + 0.125 * values[0] * np.arange(-3, 4)
    slow = [effect.at(value) for value in near]
    swinging = slow[int(np.argmax(falls(carried, noise, slow)))]
    found = scan(carried, noise, [*candidates(carried.model), swinging])
    *others, last = found.candidates
    return replace(found, candidates=(*others, replace(last, tried=len(values))))


def _oscillation(model: Model) -> Effect | None:
    every = (effect_named(name, model.bench) for name in names(model.bench))
    return next((effect for effect in every if effect.oscillates), None)


def _slow(fitted: Fit, effect: Effect) -> Floats:
    """Frequencies of oscillations too slow to show within dwells, in halves of 1/run: from a cycle a run up."""
    stimulus = stimulus_of(fitted.dwells, fitted.carried.model.bench, fitted.carried.state)
    values = effect.grid(stimulus)[2::2]
    return values[values < min(_searched_hz(fitted.dwells))]


def _searched_hz(dwells: Sequence[DwellFactor]) -> tuple[float, float, float]:
    """From which frequency to which a steady oscillation is looked for, and from which on lines; infinite: not."""
    steady, first = band_hz([dwell.trace for dwell in dwells]), lowest_hz(dwell.spectrum for dwell in dwells)
    return *steady, first


def _with_lines(test: Test, fitted: Fit) -> Test:
    """The test with the lines of the spectrum: they speak for an oscillation, whatever of it is slow."""
    from scipy.special import chdtri

    effect = _oscillation(fitted.carried.model)
    if effect is None or fitted.carried.model.oscillates:
        return test
    name, slow, (low, high, first) = str(effect), _slow(fitted, effect), _searched_hz(fitted.dwells)
    top = float(slow[-1]) if len(slow) else low
    gaps = [(top, low), (high, first)] if np.isfinite(low) else [(top, first)]
    bands = [f"of {a:.2g} to {b:.2g} Hz" if np.isfinite(b) else f"above {a:.2g} Hz" for a, b in gaps if b > 1.5 * a]
    if bands:
        test = replace(test, between=f"{name} {' and '.join(bands)}")
    seen = lines_of(fitted.dwells, LEVEL * _LINES)
    if not seen:
        return test
    p_value = seen[0].p_value
    return replace(
        test,
        best={key: k for key, k in test.best.items() if key != name},
        scores=test.scores | {name: float(chdtri(1, max(p_value, 1e-300))) - _threshold(1, 1.0)},
        p_values=test.p_values | {name: p_value * _SHARE / _LINES},
        lines=seen,
        oscillating=name,
        without_lines=replace(test, vibration=seen),
    )


def price(candidate: Candidate, tests: float) -> float:
    """The fall of chi-squared that chance gives one of so many candidates.

    A constant looked for counts as one degree of freedom more, or, where it takes many tests, as these.
    """
    looked_for = candidate.effect.unknown is not None and candidate.tried == 1
    return _threshold(candidate.dof + looked_for, tests * candidate.tried)


@functools.cache
def _threshold(dof: int, tests: float) -> float:
    from scipy.special import chdtri

    return float(chdtri(dof, LEVEL / tests))


def independent_tests(found: Scan, seed: int = 0) -> float:
    """As many independent tests would reach the smallest p-value that one run in 100 reaches."""
    seen = np.flatnonzero([each.dof for each in found.candidates])
    if not len(seen):
        return 1.0
    return LEVEL / max(float(np.quantile(_smallest_p(found, seen, seed), LEVEL)), 1e-12)


def run_level(p_value: float, tests: float) -> float:
    """The chance that any of ``tests`` independent tests shows a p-value as small: 1 - (1 - p)^n."""
    return float(-np.expm1(tests * np.log1p(-min(p_value, 1.0 - 1e-16))))


def _smallest_p(found: Scan, seen: NDArray[np.intp], seed: int) -> Floats:
    """The smallest p-value among all candidates in each of many runs in which nothing is missing."""
    from scipy.special import chdtrc

    draws = np.random.default_rng(seed).standard_normal((_DRAWS, len(found.residual)))
    bases = [found.candidates[k].basis for k in seen]
    starts = np.cumsum([0, *(basis.shape[1] for basis in bases[:-1])])
    squares = np.add.reduceat((draws @ np.concatenate(bases, axis=1)) ** 2, starts, axis=1)
    return chdtrc(np.array([basis.shape[1] for basis in bases], float), squares).min(axis=1)


def _walking(fitted: Fit) -> str:
    """The name of the effect that lets the biases walk; empty where it is in the model, or cannot be looked for."""
    model = fitted.carried.model
    if model.walks or len(fitted.dwells) < _FEWEST_WALKED or fitted.noise.walk_mps2_per_sqrt_s:
        return ""
    return walk_named(model.bench)


def _walk_fall(fitted: Fit, tests: float) -> tuple[float, bool]:
    """By how much a walk of the biases lowers -2 log-likelihood; whether it could as well be more scatter than stated.

    Of two that explain as much, more scatter than was stated is less likely than a walk.
    """
    (fall, ratio), least = (2.0 * gain for gain in walk_gain(fitted)), _threshold(1, tests)
    return fall if ratio > (0.0 if fitted.noise.scatter_stated else least) else ratio, ratio < least


@dataclass(frozen=True)
class Suspect:
    """An effect that would explain something: p-value of the run, whether the model fits with it, its refit.

    known: symbols of the effects that were in the model already.
    """

    name: str
    statistic: float
    dof: int
    p_value: float
    fits: bool
    refit: Calibration
    known: tuple[str, ...]

    @property
    def coefficients(self) -> list[Parameter]:
        """Of this effect in its refit."""
        return [p for p in list(self.refit.parameters.values())[12:] if p.symbol not in self.known]


@dataclass(frozen=True)
class Diagnosis:
    """missing: the names that make the model fit (empty: nothing is missing, or none of the known ones does).

    ambiguity: every single effect that fits as well as the first, and those that do together; overlaps: of each with
    it. together: the pairs among them that explain as much, and are no exchange of one effect for one that is alike.
    alone: a single effect that would do in the place of two. as_scatter: the walk that is missing could as well be
    dwells that scatter by more than is stated.
    """

    before: Calibration
    test: Test
    suspects: tuple[Suspect, ...]
    missing: tuple[str, ...]
    unknown: bool
    ambiguity: tuple[str, ...]
    overlaps: dict[str, float]
    after: Calibration | None
    verdict: str
    together: tuple[tuple[str, str], ...] = ()
    alone: str = ""
    as_scatter: bool = False

    @property
    def residual_ratios(self) -> Floats:
        """Residuals of the dwells (D, 3) over the sigma of their means."""
        carried = self.before.carried
        spread = mean_covariances(self.before.noise.judging, carried.means, carried.state)
        residuals = np.array([visit.residual_mps2 for visit in self.before.visits])
        return residuals / np.sqrt(np.einsum("dii->di", spread))


def diagnose(before: Calibration) -> Diagnosis:
    """What is missing in the model of a calibration, from its dwell factors alone."""
    with threadpool_limits(1, user_api="blas"):  # small decompositions
        return _diagnosed(before)


def _diagnosed(before: Calibration) -> Diagnosis:
    test = _without_vibration(before, assessed(before.fit))
    found = _explained(before, test)
    if found.unknown and test.without_lines:  # of one phase all along and not of one amplitude
        test = test.without_lines
        found = _explained(before, test)
    if test.vibration and not before.fit.dwells[0].averaged and before.reread is not None:
        window_s = averaging.window_s(test.vibration)
        rested = before.reread(replace(before.settings, window_s=window_s))
        still = assessed(rested.fit)
        still = still.without_lines or still  # what the windows let through is vibration, too
        found = _explained(rested, replace(still, vibration=test.vibration))
    return replace(found, verdict=_verdict(found))


def _explained(before: Calibration, test: Test) -> Diagnosis:
    """What explains the misfit, one effect or two, and what could as well; or nothing does."""
    return _or_walk(_likeliest(before, test))


def _likeliest(before: Calibration, test: Test) -> Diagnosis:
    """One effect or two that explain the misfit, and those that look like them."""
    nothing = Diagnosis(before, test, (), (), False, (), {}, None, "")
    if test.consistent is not False:
        return nothing
    suspects = _suspects(before, test)
    # what explains all of it explains most: one that fits far behind the first has only made the noise large enough
    least = test.scores[test.ranked[0]] - 2.0 * _EQUAL if test.ranked else 0.0
    explaining = [each for each in suspects if each.fits and test.scores[each.name] > least]
    explaining = [each for each in explaining if _beyond_scatter(before, test, (each.name,))]
    found = replace(nothing, suspects=suspects)
    pairs = _pairs(test) if not explaining or explaining[0].name in (*test.best, test.walking) else {}
    if explaining:
        first = explaining[0].name
        least = test.scores[first] + (2.0 if first == test.walking else 1.0) * _EQUAL
        clearly = {pair: score for pair, score in pairs.items() if score > least}
        return _two(found, clearly, explaining[0].name) or _one(found, explaining[0], pairs)
    several = _two(found, pairs | _pairs_with_walk(before, test)) or _beside_lines(found)
    return several or replace(found, unknown=not _may_scatter(before))


def _or_walk(found: Diagnosis) -> Diagnosis:
    """With a walk of the biases in the set, where the dwells are too few to tell its path from what was named."""
    model = found.before.fit.carried.model
    walk = walk_named(model.bench)
    if not walk or not found.missing or model.walks or walk in found.ambiguity:
        return found
    if _beyond_any_path(found.before, found.test, found.missing):
        return found
    alone = walk if len(found.missing) > 1 else ""
    return replace(found, ambiguity=(*found.ambiguity, walk), overlaps={**found.overlaps, walk: 1.0}, alone=alone)


def _beside_lines(found: Diagnosis) -> Diagnosis | None:
    """What explains the misfit beside the oscillation that makes the lines: that has no column to be paired with."""
    test = found.test
    if not test.oscillating:
        return None
    known = with_effects(found.before, (test.oscillating,))
    rest = _explained(known, assessed(known.fit, test.effective_tests))
    if not rest.missing:
        return None
    both = (*rest.missing, test.oscillating)
    ambiguity = (*both, *(name for name in rest.ambiguity if name not in both))
    return replace(
        found, missing=both, ambiguity=ambiguity, overlaps=rest.overlaps, together=rest.together, after=rest.after
    )


def _may_scatter(before: Calibration) -> bool:
    """Whether dwells may scatter by more than was stated: it was found that they do, or so few cannot show it."""
    noise, few = before.noise, before.consistency.dof < FEWEST
    return (not noise.scatter_stated and (few or bool(noise.scatter_mps2.any()))) or (not noise.setting_stated and few)


def _beyond_scatter(before: Calibration, test: Test, names: Sequence[str]) -> bool:
    """Whether effects explain more than they would of scatter from dwell to dwell, where that was not all stated.

    F = (fall / q) / (rest / (dof - q)), q coefficients: a scatter as large as it needs to be is in fall and rest alike.
    What shows within dwells is no matter of scatter between them.
    """
    return (before.noise.scatter_stated and before.noise.setting_stated) or _beyond_any_path(before, test, names)


def _beyond_any_path(before: Calibration, test: Test, names: Sequence[str]) -> bool:
    """The same of whatever may be from dwell to dwell, a walk of the biases too: few dwells cannot show it."""
    from scipy.special import fdtrc

    misfit = before.consistency
    if any(name not in test.best for name in names):
        return True
    fall, dof = test.scan.explained(np.concatenate([test.candidate(name).basis for name in names], axis=1))
    freedom = misfit.dof - dof
    if freedom <= 0:
        return False
    rest = max(misfit.statistic - fall, 1e-9 * misfit.statistic)
    return run_level(float(fdtrc(dof, freedom, fall / dof / (rest / freedom))), test.effective_tests) < LEVEL


def _without_vibration(before: Calibration, test: Test) -> Test:
    """The test as it is where an oscillation of one amplitude explains its lines; else they are vibration."""
    if test.without_lines is None:
        return test
    refit = with_effects(before, (test.oscillating,))
    # what the coherent fit over the whole run finds of the amplitude that each stretch of readings shows
    share = np.linalg.norm(refit.estimate.state[refit.model.parts[test.oscillating]]) / np.linalg.norm(
        test.lines[0].amplitude_mps2
    )
    return test if share > 0.5 else test.without_lines


def _one(found: Diagnosis, first: Suspect, pairs: dict[tuple[int, int], float]) -> Diagnosis:
    """One effect explains the misfit; with it, all that explain it as well and look like it, alone or in pairs.

    Unless a formula that is no known effect explains it better: then the effect is not the one that is missing.
    """
    test = found.test
    outdone = _outdone(found, first.refit, (first.name,)) if first.name in test.best else _walks_not(found, first)
    if outdone:
        return replace(found, unknown=True)
    close = [name for name in test.ranked if test.nearness(name) > test.scores[first.name] - _EQUAL]
    overlaps = {name: _overlap(test, first.name, name) for name in close if name != first.name}
    overlaps = {name: overlap for name, overlap in overlaps.items() if overlap > _ALIKE}
    single = replace(found, missing=(first.name,), ambiguity=(first.name, *overlaps), overlaps=overlaps)
    single = replace(single, as_scatter=first.name == test.walking and test.as_scatter)
    together = _as_good(test, pairs, test.scores[first.name], {first.name})
    return replace(_beside(single, [pair for pair in together if _both_fit(found, pair)]), after=first.refit)


def _both_fit(found: Diagnosis, names: tuple[str, str]) -> bool:
    return _fits(with_effects(found.before, names), found.test)


def _beside(found: Diagnosis, together: Sequence[tuple[str, str]]) -> Diagnosis:
    """With the pairs that explain as much in the ambiguity set."""
    added = dict.fromkeys(name for pair in together for name in pair if name not in found.ambiguity)
    return replace(found, together=tuple(together), ambiguity=(*found.ambiguity, *added))


def _as_good(
    test: Test, pairs: dict[tuple[int, int], float], score: float, but: Collection[str]
) -> list[tuple[str, str]]:
    """Names of the best few pairs that explain as much as what scores so much, none of them in ``but``."""
    near = sorted((pair for pair in pairs if _nearness(pairs, pair) > score - _EQUAL), key=lambda pair: -pairs[pair])
    named = dict.fromkeys(_names_of(test, pair) for pair in near)
    return [pair for pair in named if not set(pair) & set(but)][:_PAIRS]


def _nearness(pairs: dict[tuple[int, int], float], pair: tuple[int, int]) -> float:
    """The score of a pair; one of a walk is near a pair of something that looks like the path it took."""
    return pairs[pair] + (_EQUAL if _WALK in pair else 0.0)


def _names_of(test: Test, pair: tuple[int, int]) -> tuple[str, str]:
    one, two = (_name_of(test, k) for k in pair)
    return one, two


def _name_of(test: Test, k: int) -> str:
    return test.walking if k == _WALK else str(test.scan.candidates[k].effect)


def _outdone(found: Diagnosis, refit: Calibration, names: Sequence[str]) -> bool:
    """Whether some formula explains the misfit better than the effects at the constants that were found for them.

    Formulas that are known effects themselves do not count: together they are no effect that is unknown.
    """
    fitted, tests = found.before.fit, found.test.effective_tests
    effects = [effect for effect in refit.model.effects if str(effect) in names and not effect.walks]
    scanned = scan(fitted.carried, fitted.noise.judging, effects)
    own, _ = scanned.explained(np.concatenate([each.basis for each in scanned.candidates], axis=1))
    own -= sum(price(each, tests) for each in scanned.candidates)
    if found.test.walking in names:
        own += _walk_fall(refit.fit, tests)[0] - _threshold(1, tests)
    return any(gain > own + _EQUAL for gain, _ in _formulas(found))


def _formulas(found: Diagnosis) -> list[tuple[float, Family]]:
    """Formulas that are no known effects, each with its fall of chi-squared less what chance would give it."""
    test = found.test
    known = [test.candidate(name).effect for name in test.best]
    tried = [each for each in families(found.before.fit, known)[0] if each.dof and not each.known]
    return [(each.fall - _threshold(each.dof, test.effective_tests), each) for each in tried]


def _walks_not(found: Diagnosis, first: Suspect) -> bool:
    """Whether what could be a walk of the biases is one jump, or follows what the platform does rather than time.

    A walk may take any path: what is simpler, explains more and leaves nothing goes before it.
    """
    if not first.refit.noise.walk_mps2_per_sqrt_s:
        return False
    simpler = [each for each in _formulas(found) if each[1].driver == JUMP or not each[1].driver.startswith("time")]
    gain, formula = max(simpler, key=lambda each: each[0], default=(-np.inf, None))
    if formula is None or gain < found.test.nearness(first.name) + _EQUAL:
        return False
    return _fits(with_effects(found.before, formula.formulas), found.test)


def _two(found: Diagnosis, pairs: dict[tuple[int, int], float], alone: str = "") -> Diagnosis | None:
    """Two effects explain the misfit where no single one does: they may mask each other. The best few are refitted.

    alone: a single one that would do, if not as well; a walk can take any path, so it stays in the set.
    """
    test = found.test
    likeliest = dict[tuple[str, str], tuple[int, int]]()  # of the values of their constants
    for pair in sorted(pairs, key=lambda pair: -pairs[pair]):
        likeliest.setdefault(_names_of(test, pair), pair)
    for both, pair in list(likeliest.items())[:_PAIRS]:
        if not _beyond_scatter(found.before, test, both):
            continue
        refit = with_effects(found.before, both)
        if not _fits(refit, test):
            continue
        if _outdone(found, refit, both):
            return None
        walks = alone and alone == test.walking
        overlaps = {alone: 1.0} if walks else dict[str, float]()
        for other in pairs:
            shared = set(pair) & set(other)
            if _nearness(pairs, other) > pairs[pair] - _EQUAL and len(shared) == 1:
                (lost,), (new,) = set(pair) - shared, set(other) - shared
                name, alike = _name_of(test, new), _alike(test, lost, new)
                if alike > max(_ALIKE, overlaps.get(name, 0.0)) and name not in both:
                    overlaps[name] = alike
        named = replace(found, missing=both, ambiguity=(*both, *overlaps), overlaps=overlaps, after=refit)
        named = replace(named, alone=alone if walks else "")
        if _WALK in pair:
            named = replace(named, as_scatter=_walk_fall(refit.fit, test.effective_tests)[1])
        return _beside(named, _as_good(test, pairs, pairs[pair], both))
    return None


def _pairs(test: Test) -> dict[tuple[int, int], float]:
    """Pairs of which each is beyond chance beside the other: the fall of chi-squared less the prices of both."""
    candidates, falls = test.scan.candidates, test.scan.statistics
    prices = [price(each, test.effective_tests) if each.dof else 0.0 for each in candidates]
    out = dict[tuple[int, int], float]()
    for j, k in itertools.combinations([k for k, each in enumerate(candidates) if each.dof], 2):
        one, two = candidates[j], candidates[k]
        if str(one.effect) == str(two.effect):
            continue
        fall = falls[j] + test.scan.explained(two.basis - one.basis @ (one.basis.T @ two.basis))[0]
        if fall - falls[j] > prices[k] and fall - falls[k] > prices[j]:
            out[j, k] = float(fall - prices[j] - prices[k])
    return out


def _pairs_with_walk(before: Calibration, test: Test) -> dict[tuple[int, int], float]:
    """The same of an effect and a walk of the biases, for those effects that are likeliest beside a walk.

    The walk beside the effect is judged by its likelihood, after a refit with both.
    """
    if not test.walking:
        return {}
    candidates, tests, out = test.scan.candidates, test.effective_tests, dict[tuple[int, int], float]()
    beside = assessed(with_effects(before, (test.walking,)).fit, tests)
    for name in [name for name in beside.ranked if name in test.best][:_PAIRS]:
        k = test.best[name]
        own = float(test.scan.statistics[k]) - price(candidates[k], tests)
        walk = _walk_fall(with_effects(before, (name, test.walking)).fit, tests)[0] - _threshold(1, tests)
        if walk > 0.0 and own + walk > test.scores[test.walking]:
            out[k, _WALK] = own + walk
    return out


def _suspects(before: Calibration, test: Test) -> tuple[Suspect, ...]:
    """The likeliest candidates, each refitted and judged anew."""
    out = list[Suspect]()
    for name in [name for name in test.ranked if test.scores[name] > 0][:_SHOWN]:
        refit = with_effects(before, (name,))
        dof = 1 if name not in test.best else test.candidate(name).dof
        statistic = test.scores[name] if name not in test.best else float(test.scan.statistics[test.best[name]])
        known = tuple(before.parameters)[12:]
        out.append(Suspect(name, statistic, dof, test.p_values[name], _fits(refit, test), refit, known))
    return tuple(out)


def _fits(refit: Calibration, before: Test) -> bool:
    """Whether nothing is left that noise would not leave, by means an effect of that kind has."""
    misfit = refit.consistency.p_value
    least = LEVEL if refit.noise.walk_mps2_per_sqrt_s else _REFUSED  # a walk explains much that is none
    if (misfit is not None and misfit < _SHARE * least) or _leaps(refit) or _at_an_end(refit):
        return False
    left = assessed(refit.fit, before.effective_tests).p_value
    return left is None or left >= least


def _at_an_end(refit: Calibration) -> bool:
    """Whether a constant was looked for and ran to an end of its range: another, simpler effect is meant then."""
    ranges = [(effect.value, effect.unknown) for effect in refit.model.effects if effect.unknown is not None]
    return any(not unknown.low * 1.01 < value < unknown.high * 0.99 for value, unknown in ranges)


def _leaps(refit: Calibration) -> bool:
    """Whether walking biases take a step no walk would: one jump is not a walk."""
    from scipy.special import ndtr

    if not refit.noise.walk_mps2_per_sqrt_s:
        return False
    steps = np.array([visit.innovation_mps2 / visit.innovation_sigma_mps2 for visit in refit.visits])
    steps = np.abs(steps[np.isfinite(steps)])
    return bool(steps.size and run_level(2.0 * float(ndtr(-steps.max())), steps.size) < LEVEL)


def with_effects(before: Calibration, added: Sequence[str]) -> Calibration:
    """The same run with further effects in the model."""
    return refitted(before, (*before.settings.effects, *added))


def _overlap(test: Test, one: str, other: str) -> float:
    return _alike(test, test.best.get(one, _WALK), test.best.get(other, _WALK))


def _alike(test: Test, one: int, other: int) -> float:
    """The overlap of two candidates; 1 with a walk, which can take any path."""
    candidates = test.scan.candidates
    return 1.0 if _WALK in (one, other) else candidates[one].overlap(candidates[other])


@dataclass(frozen=True)
class Detectable:
    """The size of one coefficient at which an effect is found in 90 of 100 runs, the largest over its coefficients."""

    name: str
    minimum: float
    unit: str
    shown_minimum: float
    shown_unit: str


def detectable(test: Test) -> list[Detectable]:
    """Of every visible effect, from the columns alone."""
    from scipy.special import chdtri, chndtrinc

    out = list[Detectable]()
    for name, k in test.best.items():
        candidate = test.scan.candidates[k]
        if not candidate.dof or name in test.invisible:
            continue
        threshold = float(chdtri(candidate.dof, _SHARE * LEVEL / test.effective_tests))
        needed = float(np.sqrt(chndtrinc(threshold, candidate.dof, 1.0 - _POWER)))
        sizes = np.linalg.norm(candidate.columns, axis=0)
        seen = ~candidate.hidden & (sizes > 0)
        if not seen.any():
            continue
        worst = int(np.argmax(np.where(seen, needed / np.where(seen, sizes, 1.0), 0.0)))
        minimum, own = needed / float(sizes[worst]), candidate.effect.coefficients[worst]
        out.append(Detectable(name, minimum, own.unit, minimum * own.per_si, own.shown_unit))
    return out


def next_orientation(found: Diagnosis) -> tuple[Advice, str] | None:
    """Where to go next, and why: to tell equal suspects apart, to size the one there is, or to show what is hidden."""
    fitted, test = found.before.fit, found.test
    named = [name for name in found.ambiguity if name in test.best]
    if named and not found.unknown:
        first = test.candidate(named[0])
        rivals = [test.candidate(name).effect for name in named[1:5]] if len(found.missing) == 1 else []
        advice = advise.to_tell_apart(fitted, first.effect, test.scan.coefficients(first), rivals)
        if advice is None:
            return None
        words = f"tells {named[0]} from {', '.join(named[1:5])}" if rivals else f"shows {named[0]} best"
        stay = "" if advice.stay_s is None else f" in {advice.stay_s / 60.0:.0f} min there"
        return advice, f"{words}: separation {advice.before:.1f} -> {advice.after:.1f} sigma{stay}"
    hidden = [test.candidate(name).effect for name in test.invisible if name in test.best]
    shown = advise.to_show(fitted, hidden)
    if shown is None or not shown[1]:
        return None
    return shown[0], f"would show {shown[1]} of {len(hidden)} effects that these orientations cannot"


def _verdict(found: Diagnosis) -> str:
    """One sentence on top."""
    test = found.test
    if test.consistent is None:
        return "Nothing is left over to judge the model by: visit more orientations."
    if test.consistent:
        blind = f" It cannot see {len(test.unseen)} of {test.count} effects." if test.unseen else ""
        agreed = f"The model agrees with the measurements (p {format_p(test.p_value)})"
        return f"{agreed}: no effect is missing that this run could show.{blind}"
    start = f"Residuals fail (p {format_p(test.p_value)})."
    if found.missing and found.after is not None:
        first = found.missing[0]
        if len(found.missing) > 1:
            named = f"{' and '.join(found.missing)} together explain it; no single known effect does as well"
        else:
            named = f"Missing: {first}{_size(found)}"
            if len(found.ambiguity) > 1 or found.as_scatter:
                named = f"Best: {first}{_size(found)}"
        instead = "" if len(found.missing) == 1 else "in the place of one of them, "
        told = [
            f"{name} alone" if name == found.alone else f"{name} ({instead}overlap {overlap:.2f})"
            for name, overlap in found.overlaps.items()
        ]
        told = [
            *told,
            *(f"{' and '.join(pair)} together" for pair in found.together),
            *(["dwells that scatter by more than is stated"] if found.as_scatter else []),
        ]
        if told:
            named += f". Cannot yet be told from {', '.join(told)}"
        return f"{start} {named}.{_held_out(found)}"
    if found.unknown:
        nearest = next((each.name for each in found.suspects if each.fits), None)
        if nearest:
            return f"{start} {nearest} would fit, but what no known effect is explains it better: unknown."
        return f"{start} No known effect explains it, alone or in pairs: unknown."
    nearest = next((each.name for each in found.suspects if each.fits), None)
    noise = found.before.noise
    stated = ("angle_sigma_deg", noise.setting_stated), ("scatter_sigma_mps2", noise.scatter_stated)
    keys = " and ".join(key for key, known in stated if not known)
    missing = f"is missing ({nearest} would fit)" if nearest else "is missing that is none of the known ones"
    return (
        f"{start} Either dwells scatter by what was not stated or an effect {missing}: state {keys}, or visit an "
        "orientation again to tell."
    )


def _size(found: Diagnosis) -> str:
    """The largest coefficient of the first name, in sigma, with its unit; and the constant it has."""
    assert found.after is not None
    parameters = found.after.parameters
    first = next(each for each in found.after.model.effects if str(each) == found.missing[0])
    sized = [parameters[c.symbol] for c in ([WALK] if first.walks else first.coefficients)]
    shown = [max(sized, key=lambda p: abs(p.value or 0.0) / (p.sigma or np.inf))]
    shown += [parameters[first.unknown.symbol]] if first.unknown else []
    return "".join(
        f", {p.symbol} = {p.value * p.per_si:.3g} ± {p.sigma * p.per_si:.2g} {p.shown_unit}"
        for p in shown
        if p.value is not None and p.sigma
    )


def _held_out(found: Diagnosis) -> str:
    before, after = found.before, found.after
    assert after is not None
    if before.held_out_rms_mps2 is None or after.held_out_rms_mps2 is None or not after.held_out_floor_mps2:
        return ""
    floor = after.held_out_floor_mps2
    return (
        f" Adding it changes the held-out rms from {before.held_out_rms_mps2 / floor:.2f} to "
        f"{after.held_out_rms_mps2 / floor:.2f} of the noise floor."
    )
