"""Which physical effect is missing: what the misfit says, and what it cannot say.

The candidates of the catalogue are projected off the model (``scan``) and tested together: the p-value of a suspect
is that of the run, the chance that any of them would look as good with nothing missing. A suspect is named only where
the model with it fits; where several fit equally well they are all named; where none does the answer is *unknown*.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike

import numpy as np
from threadpoolctl import threadpool_limits

from kf_calib import advice as advise
from kf_calib import averaging
from kf_calib.advice import Advice
from kf_calib.assessment import EQUAL, LEVEL, SHARE, Test, assessed, frame_of, price, run_level, threshold
from kf_calib.calibration import Calibration, Parameter, calibrate, format_p, refitted
from kf_calib.drivers import JUMP, Family, families, roughly
from kf_calib.effects import walk_named
from kf_calib.fitting import WALK, behind_within
from kf_calib.noise import mean_covariances
from kf_calib.odds import as_fall
from kf_calib.outlying import in_words
from kf_calib.pairs import (
    MOST,
    WALKS,
    Pair,
    Pairs,
    alike,
    as_good,
    exchanged,
    likeliest,
    names_of,
    pairs_of,
    paths_beside,
)
from kf_calib.samples import Floats, Source
from kf_calib.scan import scan
from kf_calib.scattering import (
    as_if_stated,
    as_scatter,
    beyond_any_path,
    beyond_scatter,
    is_stated,
    may_scatter,
    quietest,
)

_REFUSED = 0.002  # chance that what is really missing is turned down because noise beside it looks like something more
_ALIKE = 0.5  # overlap above which two suspects may be taken for each other
_NEARLY = 2.71  # of chi-squared, of one constant: 10 %
_SHOWN = 6  # suspects that are refitted and shown


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
    alone: a single effect that would do in the place of two. as_scatter: what is missing could as well be dwells that
    scatter by more than is stated, or, where nothing is named, what would fit is less likely than that; back_s: the
    walk that is missing could go to and fro with this time constant (None: not as well). judged: the run by whose noise
    effects were told from each other, where that was estimated (None: by that of ``before``).
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
    back_s: float | None = None
    judged: Calibration | None = None

    def __repr__(self) -> str:
        return f"<Diagnosis: {self.verdict}>"

    def __str__(self) -> str:
        from kf_calib.views.diagnosis import plain_report

        return plain_report(self)

    @property
    def residual_ratios(self) -> Floats:
        """Residuals of the dwells (D, 3) over the sigma of their means."""
        carried = self.before.carried
        spread = mean_covariances(self.before.noise.judging, carried.means, carried.state)
        return self.before.residuals_mps2 / np.sqrt(np.einsum("dii->di", spread))

    def refit_with(self, name: str) -> Calibration:
        """The run with this effect, too: of a suspect it is there already."""
        own = (suspect.refit for suspect in self.suspects if suspect.name == name)
        return next(own, None) or with_effects(self.before, (name,))


def diagnose(run: Calibration | Source | str | PathLike[str]) -> Diagnosis:
    """What is missing in the model of a calibration, from its dwell factors alone; a recording is calibrated first."""
    before = run if isinstance(run, Calibration) else calibrate(run)
    with threadpool_limits(1, user_api="blas"):  # small decompositions
        return _diagnosed(before)


def _diagnosed(before: Calibration) -> Diagnosis:
    if before.outlying:  # a dwell that is wrong is no effect, and looks like many
        test = assessed(before.fit, frames=before.frames)
        verdict = f"One dwell is wrong (p {format_p(test.p_value)}): {in_words(before.outlying)}"
        return Diagnosis(before, test, (), (), test.consistent is False, (), {}, None, verdict)
    test = _without_vibration(before, assessed(before.fit, frames=before.frames))
    found = _explained(before, test)
    if found.unknown and test.without_lines:  # of one phase all along and not of one amplitude
        test = test.without_lines
        found = _explained(before, test)
    if test.vibration and not before.fit.dwells[0].averaged and before.reread is not None:
        window_s = averaging.window_s(test.vibration)
        rested = before.reread(replace(before.settings, window_s=window_s))
        still = assessed(rested.fit, frames=rested.frames)
        still = still.without_lines or still  # what the windows let through is vibration, too
        found = _explained(rested, replace(still, vibration=test.vibration))
    found = replace(found, back_s=_back_s(found))
    return replace(found, verdict=_verdict(found))


def _explained(before: Calibration, test: Test) -> Diagnosis:
    """What explains the misfit, one effect or two, and what could as well; or nothing does."""
    found = _or_walk(_likeliest(before, test))
    if test.consistent is not False or is_stated(before):
        return found
    return _told_in_its_noise(found)


def _told_in_its_noise(found: Diagnosis) -> Diagnosis:
    """The same where noise from dwell to dwell was estimated: by the noise that is left beside what explains most.

    Estimated without it, or left out, the noise is another, and what is little in one is much in the other.
    """
    before, test = found.before, found.test
    fitting = [s.refit for s in found.suspects if s.fits and beyond_scatter(before, test, (s.name,), s.refit)]
    formulas = [with_effects(before, each.formulas) for _, each in _formulas(found)[:1]]
    refit = quietest([*([found.after] if found.after else []), *fitting, *formulas])
    if refit is None or not (found.missing or found.unknown or fitting):
        return found
    stated = as_if_stated(before, refit)
    again = _or_walk(_likeliest(stated, _without_vibration(stated, assessed(stated.fit, frames=stated.frames))))
    if not (again.missing or again.unknown):
        return found
    suspects = tuple(replace(each, refit=found.refit_with(each.name)) for each in again.suspects)
    after = with_effects(before, again.missing) if again.missing else None
    return replace(again, before=before, judged=stated, suspects=suspects, after=after)


def _likeliest(before: Calibration, test: Test) -> Diagnosis:
    """One effect or two that explain the misfit, and those that look like them."""
    nothing = Diagnosis(before, test, (), (), False, (), {}, None, "")
    if test.consistent is not False:
        return nothing
    suspects = _suspects(before, test)
    # what explains all of it explains most: one that fits far behind the first has only made the noise large enough,
    # but not one behind a walk that does not fit, which may take any path
    leading = [test.scores[each.name] for each in suspects if each.fits or each.name != test.walking]
    least = max(leading, default=0.0) - 2.0 * EQUAL
    fitting = [each for each in suspects if each.fits and test.scores[each.name] > least]
    explaining = [each for each in fitting if beyond_scatter(before, test, (each.name,), each.refit)]
    found = replace(nothing, suspects=suspects, as_scatter=bool(fitting) and not explaining)
    pairs = pairs_of(test) if not explaining or explaining[0].name in (*test.best, test.walking) else {}
    if explaining:
        first = explaining[0].name
        clearly = _clearly_better(found, pairs, first)
        walks = [each for each in explaining[1:] if each.name == test.walking]
        standing = (each for each in (explaining[0], *walks) if not _is_outdone(found, each))
        return _two(found, clearly, first) or _one(found, next(standing, None), pairs)
    several = _two(found, pairs | _pairs_with_walk(found, pairs)) or _beside_lines(found)
    return several or replace(found, unknown=not may_scatter(before))


def _clearly_better(found: Diagnosis, pairs: Pairs, first: str) -> Pairs:
    """Pairs that do clearly better than the one effect that explains the misfit alone; those with a walk of the biases
    where that is the one, or where two columns do."""
    test = found.test
    least = test.scores[first] + EQUAL
    if first == test.walking:  # two columns have more directions to choose, which a path has not
        columns = {pair: score for pair, score in pairs.items() if score > least + EQUAL}
        return columns | _pairs_with_walk(found, pairs, beyond=True)
    columns = {pair: score for pair, score in pairs.items() if score > least}
    walks = _pairs_with_walk(found, pairs) if columns else {}
    return columns | {pair: score for pair, score in walks.items() if score > least}


def _or_walk(found: Diagnosis) -> Diagnosis:
    """With a walk of the biases in the set, where the dwells are too few to tell its path from what was named."""
    model = found.before.fit.carried.model
    walk = walk_named(model.bench)
    if not walk or not found.missing or model.walks or walk in found.ambiguity:
        return found
    if beyond_any_path(found.before, found.test, found.missing):
        return found
    alone = walk if len(found.missing) > 1 else ""
    return replace(found, ambiguity=(*found.ambiguity, walk), overlaps={**found.overlaps, walk: 1.0}, alone=alone)


def _beside_lines(found: Diagnosis) -> Diagnosis | None:
    """What explains the misfit beside the oscillation that makes the lines: that has no column to be paired with."""
    test = found.test
    if not test.oscillating:
        return None
    known = found.refit_with(test.oscillating)
    rest = _explained(known, assessed(known.fit, test.effective_tests, frames=found.before.frames))
    if not rest.missing:
        return None
    both = (*rest.missing, test.oscillating)
    ambiguity = (*both, *(name for name in rest.ambiguity if name not in both))
    after = with_effects(found.before, both)  # alone, an oscillation may have been drawn to what the others explain
    return replace(
        rest, before=found.before, test=test, suspects=found.suspects, missing=both, ambiguity=ambiguity,
        after=after if _fits(after, test, len(both)) else rest.after,
    )  # fmt: skip


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


def _is_outdone(found: Diagnosis, suspect: Suspect) -> bool:
    """Whether a formula that is no known effect explains the misfit better."""
    if suspect.name in found.test.best:
        return _outdone(found, suspect.refit, (suspect.name,))
    return _walks_not(found, suspect)


def _one(found: Diagnosis, first: Suspect | None, pairs: Pairs) -> Diagnosis:
    """One effect explains the misfit; with it, all that explain it as well and look like it, alone or in pairs.

    None: a formula that is no known effect explains it better than any, and than a walk, which could take its path.
    """
    test = found.test
    if first is None:
        return replace(found, unknown=True)
    close = test.rivals(first.name)
    close += [name for name in test.holding(first.name) if name not in close]
    numbers = {name: test.best.get(name, WALKS) for name in (first.name, *close)}  # a walk, a line: no columns
    overlaps = {name: alike(test, numbers[first.name], numbers[name]) for name in close if name != first.name}
    overlaps = {name: overlap for name, overlap in overlaps.items() if overlap > _ALIKE}
    single = replace(found, missing=(first.name,), ambiguity=(first.name, *overlaps), overlaps=overlaps)
    single = replace(single, as_scatter=as_scatter(found.before, test, (first.name,), first.refit))
    together = as_good(test, pairs, test.scores[first.name], {first.name})
    return replace(_beside(single, [pair for pair in together if _both_fit(found, pair)]), after=first.refit)


def _both_fit(found: Diagnosis, names: tuple[str, str]) -> bool:
    return _fits(with_effects(found.before, names), found.test, len(names))


def _beside(found: Diagnosis, together: Sequence[tuple[str, str]]) -> Diagnosis:
    """With the pairs that explain as much in the ambiguity set."""
    added = dict.fromkeys(name for pair in together for name in pair if name not in found.ambiguity)
    return replace(found, together=tuple(together), ambiguity=(*found.ambiguity, *added))


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
        own += 2.0 * refit.fit.walk_gain - threshold(1, tests)
    better = [each for gain, each in _formulas(found) if gain > own + EQUAL]
    if not _refits_compare(found, names):
        return bool(better)
    least = _left(found, refit, names) - EQUAL
    return any(_left(found, with_effects(found.before, each.formulas), (), each.dof) < least for each in better[:MOST])


def _refits_compare(found: Diagnosis, names: Sequence[str]) -> bool:
    """Whether refits have one noise, so that it can be said what each leaves: what is large is not linear, and a scan
    that says what each would lower chi-squared by is off by many times what noise does."""
    return is_stated(found.before) and all(name in found.test.best for name in names)


def _clearly_less_left(found: Diagnosis, refit: Calibration, names: Sequence[str], alone: str) -> bool:
    """Whether effects leave clearly less than one of them alone, or another, as far as refits can say that."""
    if not _refits_compare(found, (*names, alone)):
        return True
    return _left(found, refit, names) < _left(found, found.refit_with(alone), (alone,)) - EQUAL


def _left(found: Diagnosis, refit: Calibration, names: Sequence[str], dof: int = 0) -> float:
    """Chi-squared that effects, and a formula of ``dof``, leave, and what chance would have lowered it by."""
    test = found.test
    prices = [price(test.candidate(name), test.effective_tests) for name in names]
    return refit.consistency.statistic + sum(prices) + (threshold(dof, test.effective_tests) if dof else 0.0)


def _formulas(found: Diagnosis) -> list[tuple[float, Family]]:
    """Formulas that are no known effects, each with its fall of chi-squared less what chance would give it, the best
    first."""
    test = found.test
    known = [test.candidate(name).effect for name in test.best]
    fitted = found.before.fit
    frame = frame_of(fitted, found.before.frames)
    tried = [each for each in families(fitted, known, frame) if each.dof and not each.known]
    out = [(each.fall - threshold(each.dof, test.effective_tests), each) for each in tried]
    return sorted(out, key=lambda each: -each[0])


def _walks_not(found: Diagnosis, first: Suspect) -> bool:
    """Whether what could be a walk of the biases is one jump, or follows what the platform does rather than time.

    A walk may take any path: what is simpler, likelier at whatever moment or of whatever shape it is, and leaves
    nothing goes before it.
    """
    if not first.refit.noise.walk_mps2_per_sqrt_s:
        return False
    tried, test = [each for _, each in _formulas(found)], found.test
    jumps, moved = ([each for each in tried if each.driver == JUMP], [each for each in tried if not each.of_time])
    walk = test.scores[first.name] - test.paths + threshold(1, test.effective_tests)
    for simpler in filter(None, (jumps, moved)):
        ranks, falls = np.array([each.rank for each in simpler]), np.array([each.fall for each in simpler])
        best = simpler[int(np.argmax(falls - ranks))]
        if as_fall(ranks, falls) > walk + EQUAL and _fits(with_effects(found.before, best.formulas), test):
            return True
    return False


def _two(found: Diagnosis, pairs: Pairs, alone: str = "") -> Diagnosis | None:
    """Two effects explain the misfit where no single one does: they may mask each other. The best few are refitted.

    alone: a single one that would do, if not as well; a walk can take any path, so it stays in the set.
    """
    test = found.test
    for pair in likeliest(test, pairs):
        both = names_of(test, pair)
        refit = with_effects(found.before, both)
        if alone and not _clearly_less_left(found, refit, both, alone):
            continue
        if not (beyond_scatter(found.before, test, both, refit) and _fits(refit, test, len(both))):
            continue
        if _outdone(found, refit, both):
            return None
        walks = bool(alone) and alone == test.walking and alone not in both
        overlaps = ({alone: 1.0} if walks else {}) | exchanged(test, pairs, pair, _ALIKE)
        named = replace(found, missing=both, ambiguity=(*both, *overlaps), overlaps=overlaps, after=refit)
        named = replace(named, alone=alone if walks else "", as_scatter=as_scatter(found.before, test, both, refit))
        return _beside(named, as_good(test, pairs, pairs[pair], both))
    return None


def _pairs_with_walk(found: Diagnosis, pairs: Pairs, beyond: bool = False) -> dict[Pair, float]:
    """Pairs of an effect and a walk of the biases, for those effects that are likeliest beside a walk, where both do
    better than the walk alone; ``beyond``: clearly so, and the effect is beyond chance beside the walk.

    The walk beside the effect is judged by its likelihood, after a refit with both, against the ``pairs`` of columns.
    """
    before, test = found.before, found.test
    if not test.walking:
        return {}
    candidates, tests, out = test.scan.candidates, test.effective_tests, dict[Pair, float]()
    beside = assessed(found.refit_with(test.walking).fit, tests, frames=found.before.frames)
    least = test.scores[test.walking] - test.paths + (EQUAL if beyond else 0.0)
    likely = [name for name in beside.ranked if name in test.best and (beside.scores[name] > 0.0 or not beyond)]
    for name in likely[:MOST]:
        k = test.best[name]
        own = float(test.scan.statistics[k]) - price(candidates[k], tests)
        walk = 2.0 * with_effects(before, (name, test.walking)).fit.walk_gain - threshold(1, tests)
        if walk > 0.0 and own + walk > least:
            out[k, WALKS] = own + walk + paths_beside(test, pairs, k)
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


def _fits(refit: Calibration, before: Test, added: int = 1) -> bool:
    """Whether nothing is left that noise would not leave, by means an effect of that kind has.

    A walk, or two effects ``added`` at once, can take up most of what is neither: what is left is judged more strictly.
    """
    misfit, walks = refit.consistency.p_value, bool(refit.noise.walk_mps2_per_sqrt_s)
    least = LEVEL if walks else _REFUSED
    if (misfit is not None and misfit < SHARE * least) or (walks and _no_walk(refit)) or _at_an_end(refit):
        return False
    left = assessed(refit.fit, before.effective_tests, frames=refit.frames)
    if left.trend and misfit is not None:
        free = walks or added > 1
        if _together(misfit, left.trend.p_value) < SHARE * (LEVEL if free else _REFUSED):
            return False
    return left.p_value is None or left.p_value >= least


def _together(*p_values: float) -> float:
    """The p-value of independent tests, none of which need be beyond chance alone (Fisher, 1932)."""
    from scipy.special import chdtrc

    return float(chdtrc(2 * len(p_values), -2.0 * sum(math.log(max(p, 1e-300)) for p in p_values)))


def _at_an_end(refit: Calibration) -> bool:
    """Whether a constant was looked for and ran to an end of its range, and none well within does nearly as well:
    another, simpler effect is meant then."""
    for effect in refit.model.effects:
        known = effect.unknown is None or effect.unknown.low * 1.01 < effect.value < effect.unknown.high * 0.99
        if not known and behind_within(refit.fit, effect) > _NEARLY:
            return True
    return False


def _no_walk(refit: Calibration) -> bool:
    """Whether walking biases take a step no walk would, as in one jump, or come back as none does: what goes to and fro
    between bounds is none."""
    from scipy.special import ndtr

    steps = np.array([visit.innovation_mps2 / visit.innovation_sigma_mps2 for visit in refit.visits])
    steps = np.abs(steps[np.isfinite(steps)])
    leaps = bool(steps.size and run_level(2.0 * float(ndtr(-steps.max())), steps.size) < LEVEL)
    return leaps or 2.0 * refit.fit.back_gain[0] > EQUAL


def _back_s(found: Diagnosis) -> float | None:
    """The time constant with which what is taken for a walk more likely comes back, s, where that is not too likely for
    a walk: of walks one in twenty looks so."""
    if found.after is None or not found.after.noise.walk_mps2_per_sqrt_s or found.test.walking not in found.missing:
        return None
    gain, back_s = found.after.fit.back_gain
    return back_s if 2.0 * gain > _NEARLY else None


def with_effects(before: Calibration, added: Sequence[str]) -> Calibration:
    """The same run with further effects in the model."""
    return refitted(before, (*before.settings.effects, *added))


def next_orientation(found: Diagnosis) -> tuple[Advice, str] | None:
    """Where to go next, and why: to tell equal suspects apart, to size the one there is, or to show what is hidden."""
    fitted, test = (found.judged or found.before).fit, found.test
    named = [name for name in found.ambiguity if name in test.best]
    if named and not found.unknown:
        first = test.candidate(named[0])
        rivals = [test.candidate(name).effect for name in named[1:5]] if len(found.missing) == 1 else []
        advice = advise.to_tell_apart(fitted, first.effect, test.scan.coefficients(first), rivals)
        if advice is None:
            return None
        words = f"tells {named[0]} from {', '.join(advice.told)}" if advice.told else f"shows {named[0]} best"
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
            if len(found.ambiguity) > 1 or found.as_scatter or found.back_s:
                named = f"Best: {first}{_size(found)}"
        instead = "" if len(found.missing) == 1 else "in the place of one of them, "
        told = [
            f"{name} alone" if name == found.alone else f"{name} ({instead}overlap {overlap:.2f})"
            for name, overlap in found.overlaps.items()
        ]
        told = [
            *told,
            *(f"{' and '.join(pair)} together" for pair in found.together),
            *([_scattering(found)] if found.as_scatter else []),
            *([f"biases that come back within about {roughly(found.back_s)}"] if found.back_s else []),
        ]
        if told:
            named += f". Cannot yet be told from {', '.join(told)}"
        return f"{start} {named}.{_held_out(found)}"
    if found.unknown:
        nearest = next((each.name for each in found.suspects if each.fits), None)
        if nearest and found.as_scatter:
            return (
                f"{start} {nearest} would fit, but {_scattering(found)} are likelier: unknown. "
                "Visit an orientation again to tell."
            )
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


def _scattering(found: Diagnosis) -> str:
    return f"dwells that scatter by more than is {'stated' if is_stated(found.before) else 'estimated'}"


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
