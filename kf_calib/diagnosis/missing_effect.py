"""Diagnosis of a calibration: which physical effect is missing in its model, and which others would explain as much.

The candidates of the catalogue are projected off the model (``score_test``) and tested together. The p-value of a
suspect is family-wise: the chance that any candidate would look as significant with nothing missing. A suspect is
named only if the model with it fits the run. All suspects that fit equally well are named as the ambiguity set; where
none fits, the effect is reported as *unknown*.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from os import PathLike

import numpy as np

from kf_calib.bench.streams import Source
from kf_calib.diagnosis.bayes_factor import as_fall
from kf_calib.diagnosis.candidate_tests import (
    EQUAL,
    CandidateTests,
    chance_fall,
    threshold,
)
from kf_calib.diagnosis.effect_pairs import (
    MOST,
    Pair,
    Pairs,
    candidate_overlap,
    candidate_pairs,
    equal_pairs,
    exchangeable_effects,
    likeliest_pairs,
    names_of,
    walk_path_margin_beside,
)
from kf_calib.diagnosis.refit_checks import fits_the_run, restoring_time_s
from kf_calib.diagnosis.refits import Refits, calibration_of
from kf_calib.diagnosis.results import Diagnosis, Suspect
from kf_calib.diagnosis.scatter_hypothesis import (
    could_be_scatter,
    dwell_noise_is_stated,
    explains_more_than_scatter,
    least_noisy,
    passes_f_test,
    scatter_is_possible,
    with_noise_as_stated,
)
from kf_calib.diagnosis.unknown_effect import JUMP, Family
from kf_calib.diagnosis.verdict import second_pass_in_words, verdict_in_words
from kf_calib.dwells import window_average
from kf_calib.effects import walk_named
from kf_calib.estimation.outlying_dwell import outlying_in_words
from kf_calib.estimation.results import Calibration, format_p
from kf_calib.estimation.score_test import scan
from kf_calib.support.threads import one_blas_thread

_ALIKE = 0.5  # overlap above which two suspects are look-alikes
_SHOWN = 6  # number of suspects that are refitted and shown


def diagnose(run: Calibration | Source | str | PathLike[str], refits: Refits | None = None) -> Diagnosis:
    """Diagnosis of a calibration, or of a recording or source, which is calibrated first.

    It works on the dwell factors. The readings are read again only where an oscillation or vibration requires it, which
    for a calibration is possible only with ``refits``.

    run: what is diagnosed. refits: those of the run, with its source (None: new ones, without the source of a
    calibration).
    """
    before, refits = calibration_of(run, refits)
    with one_blas_thread():
        return _diagnosed(refits, before)


def _diagnosed(refits: Refits, before: Calibration) -> Diagnosis:
    """Diagnose a calibration: look for an outlying dwell first, then for effects, with vibration averaged out."""
    if before.outlying:  # one wrong dwell is not an effect, but would make many effects significant
        test = refits.assess(before)
        verdict = f"One dwell is wrong (p {format_p(test.p_value)}): {outlying_in_words(before.outlying)}"
        return Diagnosis(before=before, test=test, verdict=verdict, unknown=test.consistent is False)
    test = _without_vibration(refits, before, refits.assess(before))
    found = _explained(refits, before, test)
    if found.unknown and test.without_lines:  # the lines keep their phase through the run, but not their amplitude
        test = test.without_lines
        found = _explained(refits, before, test)
    if test.vibration and not before.fit.dwells[0].averaged:
        rested = refits.averaged(before, window_average.window_s(test.vibration))
        if rested is not None:
            still = refits.assess(rested)
            still = still.without_lines or still  # lines that are left after averaging are vibration, too
            found = _explained(refits, rested, replace(still, vibration=test.vibration))
    found = replace(found, back_s=restoring_time_s(found))
    return replace(found, verdict=verdict_in_words(found) + second_pass_in_words(found))


def _explained(refits: Refits, before: Calibration, test: CandidateTests) -> Diagnosis:
    """Return the diagnosis by these tests: one effect or two with their look-alikes, unknown, or nothing missing."""
    found = _or_walk(_likeliest(refits, before, test))
    if test.consistent is not False or dwell_noise_is_stated(before):
        return found
    return _told_in_its_noise(refits, found)


def _told_in_its_noise(refits: Refits, found: Diagnosis) -> Diagnosis:
    """Return the diagnosis repeated with the noise that is left beside the best explanation, where noise is estimated.

    The noise from dwell to dwell is too large if it is estimated without the missing effect, and too small if it is
    left out of the tests (``Noise.judging``). How significant an effect is depends on it.
    """
    before, test = found.before, found.test
    fitting = [
        s.refit for s in found.suspects if s.fits and explains_more_than_scatter(before, test, (s.name,), s.refit)
    ]
    formulas = [refits.with_effects(before, each.formulas) for _, each in _formulas(refits, found)[:1]]
    refit = least_noisy([*([found.after] if found.after else []), *fitting, *formulas])
    if refit is None or not (found.missing or found.unknown or fitting):
        return found
    stated = with_noise_as_stated(refits, before, refit)
    again = _or_walk(_likeliest(refits, stated, _without_vibration(refits, stated, refits.assess(stated))))
    if not (again.missing or again.unknown):
        return found
    suspects = tuple(replace(each, refit=refits.with_effects(before, (each.name,))) for each in again.suspects)
    after = refits.with_effects(before, again.missing) if again.missing else None
    return replace(again, before=before, judged=stated, suspects=suspects, after=after)


def _likeliest(refits: Refits, before: Calibration, test: CandidateTests) -> Diagnosis:
    """Return the diagnosis with the one effect or the two that explain the misfit, and their look-alikes."""
    nothing = Diagnosis(before=before, test=test)
    if test.consistent is not False:
        return nothing
    suspects = _suspects(refits, before, test)
    # The effect that is missing has about the highest score. A suspect with a much lower score may still fit, because
    # the noise estimated with it is larger; it is dropped. The score of a random walk that does not fit sets no such
    # limit, since a walk can follow any misfit.
    leading = [test.scores[each.name] for each in suspects if each.fits or each.name != test.walking]
    least = max(leading, default=0.0) - 2.0 * EQUAL
    fitting = [each for each in suspects if each.fits and test.scores[each.name] > least]
    explaining = [each for each in fitting if explains_more_than_scatter(before, test, (each.name,), each.refit)]
    found = replace(nothing, suspects=suspects, as_scatter=bool(fitting) and not explaining)
    pairs = candidate_pairs(test) if not explaining or explaining[0].name in (*test.best, test.walking) else {}
    if explaining:
        first = explaining[0].name
        clearly = _clearly_better(refits, found, pairs, first)
        walks = [each for each in explaining[1:] if each.name == test.walking]
        standing = (each for each in (explaining[0], *walks) if not _is_outdone(refits, found, each))
        return _two(refits, found, clearly, first) or _one(refits, found, next(standing, None), pairs)
    several = _two(refits, found, pairs | _pairs_with_walk(refits, found, pairs)) or _beside_lines(refits, found)
    return several or replace(found, unknown=not scatter_is_possible(before))


def _clearly_better(refits: Refits, found: Diagnosis, pairs: Pairs, first: str) -> Pairs:
    """Return the pairs that explain clearly more than the one effect ``first``, pairs with a random walk included.

    Pairs with a walk are considered where ``first`` is the walk itself, or where two other effects do clearly better.
    """
    test = found.test
    least = test.scores[first] + EQUAL
    if first == test.walking:  # two effects are fitted in their best directions, a walk is averaged over its paths
        columns = {pair: score for pair, score in pairs.items() if score > least + EQUAL}
        return columns | _pairs_with_walk(refits, found, pairs, beyond=True)
    columns = {pair: score for pair, score in pairs.items() if score > least}
    walks = _pairs_with_walk(refits, found, pairs) if columns else {}
    return columns | {pair: score for pair, score in walks.items() if score > least}


def _or_walk(found: Diagnosis) -> Diagnosis:
    """Return the diagnosis with a random walk as a look-alike where the named effects fail the F-test."""
    model = found.before.fit.carried.model
    walk = walk_named(model.bench)
    if not walk or not found.missing or model.walks or walk in found.ambiguity:
        return found
    if passes_f_test(found.before, found.test, found.missing):
        return found
    alone = walk if len(found.missing) > 1 else ""
    return replace(found, ambiguity=(*found.ambiguity, walk), overlaps={**found.overlaps, walk: 1.0}, alone=alone)


def _beside_lines(refits: Refits, found: Diagnosis) -> Diagnosis | None:
    """Return a diagnosis of what is left beside the oscillation that makes the lines, or None where nothing is named.

    That oscillation has no columns in the scan, so that ``candidate_pairs`` cannot find it in a pair.
    """
    test = found.test
    if not test.oscillating:
        return None
    known = refits.with_effects(found.before, (test.oscillating,))
    rest = _explained(refits, known, refits.assess(known, test.effective_tests))
    if not rest.missing:
        return None
    both = (*rest.missing, test.oscillating)
    ambiguity = (*both, *(name for name in rest.ambiguity if name not in both))
    # both are fitted together: fitted alone, the oscillation may have taken up part of what the others explain
    after = refits.with_effects(found.before, both)
    return replace(
        rest, before=found.before, test=test, suspects=found.suspects, missing=both, ambiguity=ambiguity,
        after=after if fits_the_run(refits, after, test, len(both)) else rest.after,
    )  # fmt: skip


def _without_vibration(refits: Refits, before: Calibration, test: CandidateTests) -> CandidateTests:
    """Return the test as it is if an oscillation of constant amplitude explains its lines, else that with vibration."""
    if test.without_lines is None:
        return test
    refit = refits.with_effects(before, (test.oscillating,))
    # amplitude of the coherent fit over the whole run, over the amplitude seen in each stretch of readings
    share = np.linalg.norm(refit.estimate.state[refit.model.parts[test.oscillating]]) / np.linalg.norm(
        test.lines[0].amplitude_mps2
    )
    return test if share > 0.5 else test.without_lines


def _is_outdone(refits: Refits, found: Diagnosis, suspect: Suspect) -> bool:
    """Tell whether a formula that is not a known effect explains the misfit clearly better than the suspect."""
    if suspect.name in found.test.best:
        return _outdone(refits, found, suspect.refit, (suspect.name,))
    return _walks_not(refits, found, suspect)


def _one(refits: Refits, found: Diagnosis, first: Suspect | None, pairs: Pairs) -> Diagnosis:
    """Return the diagnosis with the effect ``first``, its look-alikes and equally good pairs; unknown if it is None."""
    test = found.test
    if first is None:
        return replace(found, unknown=True)
    close = test.rivals(first.name)
    close += [name for name in test.holding(first.name) if name not in close]
    numbers = {name: test.best.get(name, name) for name in (first.name, *close)}  # walks and lines have no columns
    overlaps = {
        name: candidate_overlap(test, numbers[first.name], numbers[name]) for name in close if name != first.name
    }
    overlaps = {name: overlap for name, overlap in overlaps.items() if overlap > _ALIKE}
    single = replace(found, missing=(first.name,), ambiguity=(first.name, *overlaps), overlaps=overlaps)
    single = replace(single, as_scatter=could_be_scatter(found.before, test, (first.name,), first.refit))
    together = equal_pairs(test, pairs, test.scores[first.name], {first.name})
    return replace(_beside(single, [pair for pair in together if _both_fit(refits, found, pair)]), after=first.refit)


def _both_fit(refits: Refits, found: Diagnosis, names: tuple[str, str]) -> bool:
    """Tell whether the model with both effects fits the run."""
    return fits_the_run(refits, refits.with_effects(found.before, names), found.test, len(names))


def _beside(found: Diagnosis, together: Sequence[tuple[str, str]]) -> Diagnosis:
    """Return the diagnosis with the pairs that explain as much, and their effects in the ambiguity set."""
    added = dict.fromkeys(name for pair in together for name in pair if name not in found.ambiguity)
    return replace(found, together=tuple(together), ambiguity=(*found.ambiguity, *added))


def _outdone(refits: Refits, found: Diagnosis, refit: Calibration, names: Sequence[str]) -> bool:
    """Tell whether a formula, other than a known effect, explains the misfit clearly better than these effects do."""
    fitted, tests = found.before.fit, found.test.effective_tests
    effects = [effect for effect in refit.model.effects if str(effect) in names and effect.coefficients]
    scanned = scan(fitted.carried, fitted.noise.judging, effects)
    own, _ = scanned.explained(np.concatenate([each.basis for each in scanned.candidates], axis=1))
    own -= sum(chance_fall(each, tests) for each in scanned.candidates)
    if found.test.walking in names:
        own += 2.0 * refit.fit.walk_gain - threshold(1, tests)
    better = [each for gain, each in _formulas(refits, found) if gain > own + EQUAL]
    if not _refits_compare(found, names):
        return bool(better)
    least = _left(found, refit, names) - EQUAL
    refit_by = ((refits.with_effects(found.before, each.formulas), each.dof) for each in better[:MOST])
    return any(_left(found, each, (), dof) < least for each, dof in refit_by)


def _refits_compare(found: Diagnosis, names: Sequence[str]) -> bool:
    """Tell whether all refits are judged by the same noise, so that their chi-squared may be compared.

    For large effects this is better than the scan, which is linear and may be wrong by much more than the noise.
    """
    return dwell_noise_is_stated(found.before) and all(name in found.test.best for name in names)


def _clearly_less_left(refits: Refits, found: Diagnosis, refit: Calibration, names: Sequence[str], alone: str) -> bool:
    """Tell whether the effects leave a clearly lower chi-squared than ``alone``; true if refits cannot be compared."""
    if not _refits_compare(found, (*names, alone)):
        return True
    single = refits.with_effects(found.before, (alone,))
    return _left(found, refit, names) < _left(found, single, (alone,)) - EQUAL


def _left(found: Diagnosis, refit: Calibration, names: Sequence[str], dof: int = 0) -> float:
    """Return the chi-squared of a refit plus the thresholds of its effects and of a formula of ``dof``."""
    test = found.test
    prices = [chance_fall(test.candidate(name), test.effective_tests) for name in names]
    return refit.consistency.statistic + sum(prices) + (threshold(dof, test.effective_tests) if dof else 0.0)


def _formulas(refits: Refits, found: Diagnosis) -> list[tuple[float, Family]]:
    """Return the formulas that are no known effects, each with its fall of chi-squared less its threshold, in order."""
    test = found.test
    known = [test.candidate(name).effect for name in test.best]
    tried = [each for each in refits.families(found.before.fit, known) if each.dof and not each.known]
    out = [(each.fall - threshold(each.dof, test.effective_tests), each) for each in tried]
    return sorted(out, key=lambda each: -each[0])


def _walks_not(refits: Refits, found: Diagnosis, first: Suspect) -> bool:
    """Tell whether a supposed random walk is rather one jump, or depends on something other than time.

    A walk can follow any path. A jump at any moment, or a family of formulas that are not of time, is preferred if it
    is clearly likelier, averaged over all of its kind (``as_fall``), and fits the run.
    """
    if not first.refit.noise.walk_mps2_per_sqrt_s:
        return False
    tried, test = [each for _, each in _formulas(refits, found)], found.test
    jumps, moved = ([each for each in tried if each.driver == JUMP], [each for each in tried if not each.of_time])
    walk = test.scores[first.name] - test.paths + threshold(1, test.effective_tests)
    for simpler in filter(None, (jumps, moved)):
        ranks, falls = np.array([each.rank for each in simpler]), np.array([each.fall for each in simpler])
        best = simpler[int(np.argmax(falls - ranks))]
        if as_fall(ranks, falls) > walk + EQUAL:
            refit = refits.with_effects(found.before, best.formulas)
            if fits_the_run(refits, refit, test):
                return True
    return False


def _two(refits: Refits, found: Diagnosis, pairs: Pairs, alone: str = "") -> Diagnosis | None:
    """Return the diagnosis with the likeliest pair of effects that fits the run, or None.

    It is None where no pair fits, or where a formula explains clearly more than the pair. alone: a single effect that
    also explains the misfit, if clearly less well. If it is a random walk, which can take any path, it stays in the
    ambiguity set.
    """
    test = found.test
    for pair in likeliest_pairs(test, pairs):
        both = names_of(test, pair)
        refit = refits.with_effects(found.before, both)
        if alone and not _clearly_less_left(refits, found, refit, both, alone):
            continue
        if not explains_more_than_scatter(found.before, test, both, refit):
            continue
        if not fits_the_run(refits, refit, test, len(both)):
            continue
        if _outdone(refits, found, refit, both):
            return None
        walks = bool(alone) and alone == test.walking and alone not in both
        overlaps = ({alone: 1.0} if walks else {}) | exchangeable_effects(test, pairs, pair, _ALIKE)
        named = replace(found, missing=both, ambiguity=(*both, *overlaps), overlaps=overlaps, after=refit)
        named = replace(
            named, alone=alone if walks else "", as_scatter=could_be_scatter(found.before, test, both, refit)
        )
        return _beside(named, equal_pairs(test, pairs, pairs[pair], both))
    return None


def _pairs_with_walk(refits: Refits, found: Diagnosis, pairs: Pairs, beyond: bool = False) -> dict[Pair, float]:
    """Return pairs of an effect and a random walk that explain more than the walk alone, with their scores.

    Both are refitted, and the walk is judged by its likelihood beside the effect, so that the score compares with those
    of the other ``pairs``. beyond: the pair has to be clearly better, and the effect significant beside the walk.
    """
    before, test = found.before, found.test
    if not test.walking:
        return {}
    candidates, tests, out = test.scan.candidates, test.effective_tests, dict[Pair, float]()
    beside = refits.assess(refits.with_effects(before, (test.walking,)), tests)
    least = test.scores[test.walking] - test.paths + (EQUAL if beyond else 0.0)
    likely = [name for name in beside.ranked if name in test.best and (beside.scores[name] > 0.0 or not beyond)]
    for name in likely[:MOST]:
        k = test.best[name]
        own = float(test.scan.statistics[k]) - chance_fall(candidates[k], tests)
        walk = 2.0 * refits.with_effects(before, (name, test.walking)).fit.walk_gain - threshold(1, tests)
        if walk > 0.0 and own + walk > least:
            out[k, test.walking] = own + walk + walk_path_margin_beside(test, pairs, k)
    return out


def _suspects(refits: Refits, before: Calibration, test: CandidateTests) -> tuple[Suspect, ...]:
    """Return the candidates with the highest scores, each refitted and tested for whether the model then fits."""
    out = list[Suspect]()
    for name in [name for name in test.ranked if test.scores[name] > 0][:_SHOWN]:
        refit = refits.with_effects(before, (name,))
        dof = 1 if name not in test.best else test.candidate(name).dof
        statistic = test.scores[name] if name not in test.best else float(test.scan.statistics[test.best[name]])
        known = tuple(before.parameters)[12:]
        out.append(Suspect(name, statistic, dof, test.p_values[name], fits_the_run(refits, refit, test), refit, known))
    return tuple(out)
