"""Description of a misfit that no known effect explains: where it shows, what it depends on, and formulas to try.

It may depend on two quantities at once, as temperature times force: each pair of drivers has a sparse basis. The
evidence of a pair is the mean over all its subsets of one or two terms, as of a prior by which few terms of the basis
are there (spike and slab). So its price is that of what it needs, and not that of the whole basis.
"""

from __future__ import annotations

import contextlib
import itertools
import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench
from kf_calib.diagnosis.within_dwell_trend import Trend
from kf_calib.diagnosis.within_dwell_trend import trend as trend_of
from kf_calib.dwells.sufficient_statistics import DwellFactor
from kf_calib.effects import Effect, effect_named, walk_named
from kf_calib.effects.formula import formula
from kf_calib.errors import InputError
from kf_calib.estimation.candidate_scan import Scan
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.iterated_fit import fit
from kf_calib.estimation.results import consistency
from kf_calib.estimation.score_test import Frame, FurtherEffects
from kf_calib.support import stage

_CHANCE = 1e-4  # significance level of one family, of which there are about a hundred
_EQUAL = 6.63  # chi-squared that one constant more has to gain (1 %)
_WITHIN = 0.01  # significance level of trends within dwells
_SAME = 0.99  # cosine of the angle between a formula and a known effect above which they count as the same
_DECAYS_S = (3, 10, 30, 100, 300)
_CREEPS_S = (3, 10, 30)  # of a platform after its arrival
_JUMPS = 100  # largest number of moments at which a jump is tried
_BETWEEN = 50  # the same of one that comes between two dwells

JUMP = "time (a jump)"
TILT_JUMP = "time (a jump of the tilt of the base)"
SCALE_JUMP = "time (a jump of the scale factors)"
ALIGNMENT_JUMP = "time (a jump of the alignment)"
DECAY = "time (a decay)"
ARRIVAL = "time since arrival"
PERIODIC = "time (periodic)"
PERIODIC_TILT = "time (a periodic tilt of the base)"
_SEARCHED = "time (a jump", DECAY, ARRIVAL, PERIODIC, PERIODIC_TILT
"""How the drivers begin of which a moment, a time constant or a period is searched."""
BETWEEN_DWELLS = "nothing that was recorded (irregular from dwell to dwell)"
WITHIN_DWELLS = "time (irregular, within dwells too)"


_CLASSES = (
    (ARRIVAL, "memory"), ("previous orientation", "memory"), (SCALE_JUMP, "scale in time"),
    (ALIGNMENT_JUMP, "base and platform"), ("time", "bias in time"), ("temperature", "temperature"),
    ("rate of temperature", "temperature"),
)  # fmt: skip
"""How the drivers of formulas begin, and the physical class of effects to which these belong."""


@dataclass(frozen=True)
class Description:
    """What an unknown misfit looks like.

    channel: axis of the accelerometer in which it shows most (x, y, z, or all). driver: in words, what it depends on.
    share: share of the chi-squared beyond noise that is explained. formulas: effects to add to the model as they stand.
    """

    channel: str
    driver: str
    share: float
    formulas: tuple[str, ...]

    @property
    def formula(self) -> str:
        """The first of the formulas."""
        return self.formulas[0]


@dataclass(frozen=True)
class FormulaFamily:
    """Formulas of one driver, tested together as one candidate.

    driver: in words, what the misfit would depend on. texts: the formulas. delta_chi2: fall of chi-squared with all of
    them. rank: number of their columns that can be told from the model. each_delta_chi2: fall of chi-squared with each
    of them alone. known: whether each of them equals a known effect, or nearly so.
    """

    driver: str
    texts: tuple[str, ...]
    delta_chi2: float
    rank: int
    each_delta_chi2: tuple[float, ...]
    known: bool = False

    @property
    def formulas(self) -> tuple[str, ...]:
        """The formulas as they can be added to a model, each with a name."""
        return self.formulas_beside(())

    def formulas_beside(self, names_in_model: Collection[str]) -> tuple[str, ...]:
        """The formulas with names that are not taken, as those of the effects of a model are."""
        first = next(k for k in itertools.count() if not {*_names(k, len(self.texts))} & {*names_in_model})
        return tuple(_named(text, first + number) for number, text in enumerate(self.texts))

    @property
    def dof(self) -> int:
        """Degrees of freedom: the rank, and one more where a moment, a time constant or a period is searched."""
        return self.rank + (self.rank > 0 and self.driver.startswith(_SEARCHED))

    @property
    def family(self) -> str:
        """The physical class of effects to which such formulas belong; "" where there is none."""
        if self.driver.startswith(f"{ARRIVAL} and last move"):
            return "gimbal and encoder"
        if self.driver.startswith("angle") and " and " in self.driver:
            return ""
        if self.driver.startswith("angle"):
            return "gimbal and encoder" if all(text[0] == ":" for text in self.texts) else ""
        if self.driver.startswith("specific force"):
            across = any(re.search(r"\b[po]\b", text) for text in self.texts)
            return "cross-axis" if across else "nonlinearity"
        if self.texts[0].startswith((":base", ":platform")) and self.driver.startswith("time"):
            return "base and platform"
        return next(family for start, family in _CLASSES if self.driver.startswith(start))

    @property
    def score(self) -> float:
        """The fall of chi-squared less its threshold at the level of one family."""
        from scipy.special import chdtri

        return self.delta_chi2 - float(chdtri(self.dof, _CHANCE)) if self.dof else 0.0


def describe(fitted: Fit, residuals: Floats, trend: Trend | None = None) -> Description | None:
    """Description of the misfit by the family of formulas that explains most of it; None where none is significant.

    Where a random walk of the biases or scatter from dwell to dwell is likelier, or where the misfit also changes
    within dwells and no family explains that, the misfit is described as irregular, and the formula to try is the walk.

    fitted: the fit whose misfit is described. residuals: of the dwell means, (D, 3). trend: its test within dwells.
    """
    from scipy.special import chdtri

    tested, misfit = families(fitted), consistency(fitted)
    excess = misfit.statistic - misfit.dof
    best = max(tested, key=lambda family: family.score)
    walk, scatter = fitted.walk_gain, fitted.scatter_gain
    irregular = 2.0 * max(walk, scatter)
    name = "" if fitted.linearised.model.walks else walk_named(fitted.linearised.model.bench)
    within = name and _within_dwells(trend) and (best.score <= 0.0 or _within_dwells(_trend_beside(fitted, best)))
    if name and (within or irregular - float(chdtri(1, _CHANCE)) > max(best.score, 0.0)):
        share = irregular / max(excess, irregular, 1.0)
        restoring_time_s = _restoring_time_s(fitted, name) if 2.0 * (walk - scatter) > _EQUAL else None
        driver = WITHIN_DWELLS if within else BETWEEN_DWELLS
        if restoring_time_s:
            driver = f"time (irregular, back within about {one_digit_seconds(restoring_time_s)})"
        return Description(channel_of(residuals), driver, share, (name,))
    if best.score <= 0.0:
        return None
    ranked = np.argsort(best.each_delta_chi2)[::-1]
    count = 1 if best.each_delta_chi2[ranked[0]] > 0.7 * best.delta_chi2 else len(ranked)
    formulas = tuple(_named(best.texts[k], number) for number, k in enumerate(ranked[:count]))
    share = min((best.delta_chi2 - best.dof) / excess, 1.0) if excess > 0.0 else 1.0
    return Description(channel_of(residuals), best.driver, share, formulas)


def one_digit_seconds(duration_s: float) -> str:
    """A duration as text to one significant digit, as 30 s."""
    return f"{float(f'{duration_s:.1g}'):g} s"


def _restoring_time_s(fitted: Fit, walk: str) -> float | None:
    """Return the time constant, s, with which an irregular drift returns, or None if it is no different from a walk."""
    model = fitted.linearised.model
    with_walk = fit(
        fitted.dwells, model + effect_named(walk, model.bench), 0.0, fitted.linearised.slews, must_settle=False
    )
    if not with_walk.noise.walk_mps2_per_sqrt_s:
        return None
    gain, restoring_time_s = with_walk.gauss_markov_gain
    return restoring_time_s if 2.0 * gain > _EQUAL else None


def _within_dwells(trend: Trend | None) -> bool:
    """Tell whether the trends within dwells are significant."""
    return trend is not None and trend.p_value < _WITHIN


def _trend_beside(fitted: Fit, family: FormulaFamily) -> Trend | None:
    """Return the test of trends within dwells with the formulas of a family in the model."""
    model = fitted.linearised.model
    for text in family.formulas:
        model += effect_named(text, model.bench)
    walk = fitted.noise.walk_mps2_per_sqrt_s
    return trend_of(fit(fitted.dwells, model, walk, fitted.linearised.slews, must_settle=False))


def families(fitted: Fit, known: Sequence[Effect] = (), frame: Frame | None = None) -> list[FormulaFamily]:
    """All families of formulas, each tested on what the model leaves.

    fitted: the fit. known: effects with which the formulas are compared. frame: with the columns of most of these
    effects.
    """
    frame = frame or Frame(fitted.linearised, fitted.noise.for_goodness_of_fit, known)
    return _tested(fitted, FurtherEffects(frame, fitted.linearised, known, _SAME))


def _tested(fitted: Fit, tests: FurtherEffects) -> list[FormulaFamily]:
    """Return the families with their falls of chi-squared."""
    bench, groups = fitted.linearised.model.bench, list[tuple[str, list[str], list[Effect]]]()
    of_two = dict(bases_of_pairs(len(bench.axes)))
    for driver, texts in itertools.chain(_families(bench, fitted.dwells), of_two.items()):
        with contextlib.suppress(InputError):  # a very late jump or fast decay does not show when a formula is checked
            effects_of_texts = [formula(_named(text), bench.axes, bench.gravity_mps2, checked=False) for text in texts]
            groups.append((driver, texts, [*effects_of_texts]))
    stage.say(f"trying {sum(len(texts) for _, texts, _ in groups)} formulas")
    tested, scans = list[FormulaFamily](), tests.scans([effects for _, _, effects in groups])
    for (driver, texts, _), (scan, known) in zip(groups, scans, strict=True):
        if driver in of_two:
            tested += _subsets(driver, texts, scan, known)
            continue
        delta_chi2, rank = scan.explained(np.concatenate([each.basis for each in scan.candidates], axis=1))
        tested.append(
            FormulaFamily(driver, tuple(texts), delta_chi2, rank, tuple(scan.statistics.tolist()), all(known))
        )
    return tested


def _subsets(driver: str, texts: Sequence[str], scan: Scan, known: Sequence[bool]) -> Iterator[FormulaFamily]:
    """Yield the subsets of the terms of two drivers that are no known effects, each as a family."""
    for chosen, delta_chi2, rank in sparse_subsets(scan):
        each = tuple(float(scan.statistics[k]) for k in chosen)
        yield FormulaFamily(
            driver, tuple(texts[k] for k in chosen), delta_chi2, rank, each, all(known[k] for k in chosen)
        )


def _names(first: int, count: int) -> list[str]:
    """Return names for so many formulas: mine, mine2, mine3 ..."""
    return [f"mine{number + 1}" if number else "mine" for number in range(first, first + count)]


def _named(text: str, number: int = 0) -> str:
    """Return a formula with a name in front, from ``:z = sin(q1)`` or ``sin(q1)``."""
    (name,) = _names(number, 1)
    return f"{name}{text}" if text.startswith(":") else f"{name} = {text}"


def explained_share(fitted: Fit, refit: Fit) -> float:
    """Share of the chi-squared beyond noise that a refit with further effects explains."""
    before, after = consistency(fitted), consistency(refit)
    excess = before.statistic - before.dof
    return (
        min(max(before.statistic - after.statistic - (before.dof - after.dof), 0.0) / excess, 1.0)
        if excess > 0
        else 1.0
    )


def channel_of(residuals: Floats) -> str:
    """The axis of the accelerometer with most of the squared residuals (D, 3); "all" where none stands out."""
    squares = np.sum(residuals**2, axis=0)
    return "xyz"[int(np.argmax(squares))] if squares.max() > 0.7 * squares.sum() else "all"


def _families(bench: Bench, dwells: Sequence[DwellFactor]) -> Iterator[tuple[str, list[str]]]:
    """Yield the drivers in words, each with formulas; ``:place = ...`` stands for a rotation of a gimbal or base."""
    yield from _of_force()
    yield from _of_gimbals(len(bench.axes))
    yield from _of_time(dwells, bench.angles)
    yield from _of_jumps(bench, dwells)
    yield from _of_creep(len(bench.axes), dwells)
    yield from _of_surroundings(bench)


def _of_force() -> Iterator[tuple[str, list[str]]]:
    """Yield the formulas of the specific force."""
    yield "specific force (degree 2)", ["a*a", "a*p", "a*o", "p*o", "p*p"]
    for terms in (["a**3"], ["a*a*p"], ["a*a*o"], ["a*p*o"], ["p**3"], ["o**3"], ["a**3", "a*p*p", "p**3", "a*a*p"]):
        yield "specific force (degree 3)", terms
    for terms in (["a**4"], ["a**4", "a*a"], ["p**4", "p*p"], ["a**2*p**2"]):
        yield "specific force (degree 4)", terms
    for terms in (["a**5"], ["a**5", "a**3"], ["p**5", "p**3"]):
        yield "specific force (degree 5)", terms


def _of_gimbals(count: int) -> Iterator[tuple[str, list[str]]]:
    """Yield the formulas of the gimbal angles."""
    for k in range(1, count + 1):
        for n in (1, 2, 3, 4, 6):
            both = [f"{wave}({n}*q{k})" for wave in ("sin", "cos")]
            yield f"angle of gimbal {k}, {n} a turn", both
            if n > 2:
                yield f"angle of gimbal {k}, {n} a turn", [f":{k} = {text}" for text in both]
                yield f"angle of gimbal {k}, {n} a turn", [f"{text}*{axis}" for text in both for axis in ("p", "o")]
        for n in (1, 2):
            tilts = [f":base = {wave}({n}*q{k})" for wave in ("sin", "cos")]
            yield f"angle of gimbal {k}, {n} a turn (a tilt of the base)", tilts
        yield f"previous orientation (angle of gimbal {k})", [f"sin(q{k}_before)", f"cos(q{k}_before)"]


def _of_time(dwells: Sequence[DwellFactor], tilts: bool = False) -> Iterator[tuple[str, list[str]]]:
    """Yield the formulas of time: drift, decays and oscillations. tilts: whether the base can be seen to tilt."""
    yield "time", ["t"]
    yield "time", ["t", "t*t"]
    duration_s, longest_s = dwells[-1].end_s, max(dwell.end_s - dwell.start_s for dwell in dwells)
    for decay_s in _DECAYS_S:
        if decay_s == _DECAYS_S[0] or 10 * decay_s <= duration_s:
            yield DECAY, [f"exp(-t/({10 * decay_s}*s))"]
        if decay_s <= 2.0 * longest_s:  # a slower one is hardly more than a constant in each dwell
            yield ARRIVAL, [f"exp(-tau/({decay_s}*s))"]
            yield ARRIVAL, [f"{axis}*exp(-tau/({decay_s}*s))" for axis in ("fx", "fy", "fz")]
    for turns in (0.5, 1, 1.5, 2, 3, 4, 6, 8):
        waves = [f"{wave}({turns}*2*pi*t/({duration_s:.0f}*s))" for wave in ("sin", "cos")]
        yield PERIODIC, waves
        if tilts:
            yield PERIODIC_TILT, [f":base = {wave}" for wave in waves]


def _of_creep(gimbals: int, dwells: Sequence[DwellFactor]) -> Iterator[tuple[str, list[str]]]:
    """Yield the formulas of a platform that comes to rest after its encoder: by its last move, or the sense of it."""
    longest_s = max(dwell.end_s - dwell.start_s for dwell in dwells)
    for k in range(1, gimbals + 1):
        for decay_s in (each for each in _CREEPS_S if each <= 2.0 * longest_s):
            for size in (f"q{k}_move", f"sign(q{k}_move)"):
                yield f"{ARRIVAL} and last move of gimbal {k}", [f":{k} = {size}*exp(-tau/({decay_s}*s))"]


def _of_jumps(bench: Bench, dwells: Sequence[DwellFactor]) -> Iterator[tuple[str, list[str]]]:
    """Yield the formulas of jumps: of biases at any time; of scale factors, alignment and base between dwells.

    A jump between two dwells is in the middle of the way: at the arrival it would be within a dwell for some of it.
    """
    within_s = [0.5 * (dwell.start_s + dwell.end_s) for dwell in dwells]
    between_s = [0.5 * (before.end_s + dwell.start_s) for before, dwell in itertools.pairwise(dwells)]
    moments_s = sorted(within_s + between_s)
    for moment_s in moments_s[:: len(moments_s) // _JUMPS + 1]:
        yield JUMP, [f"t > {moment_s:.6g}*s"]
    for moment_s in between_s[:: len(between_s) // _BETWEEN + 1]:
        yield SCALE_JUMP, [f"a*(t > {moment_s:.6g}*s)"]
        yield ALIGNMENT_JUMP, [f"{axis}*(t > {moment_s:.6g}*s)" for axis in ("p", "o")]
        if bench.angles:
            yield ALIGNMENT_JUMP, [f":platform = t > {moment_s:.6g}*s"]
            yield TILT_JUMP, [f":base = t > {moment_s:.6g}*s"]


def _of_surroundings(bench: Bench) -> Iterator[tuple[str, list[str]]]:
    """Yield the formulas of the temperature and of the previous orientation."""
    for terms in (["T"], ["T*T"], ["T", "T*T", "T**3"], ["a*T"], ["a*T*T"], ["a*T", "a*T*T"], ["p*T", "o*T"]):
        yield "temperature", terms
    if bench.angles:
        yield from (("temperature", [f":{place} = T"]) for place in ("base", "platform"))
        yield "time", [":base = t"]
    yield "rate of temperature", ["dT"]
    yield "rate of temperature", ["a*dT"]
    plays = ([f"play{width}"] for width in (3, 6))  # one of 1 m/s^2 is hysteresis
    for terms in (["da"], ["da*abs(da)"], ["tanh(da/(5*m/s**2))"], ["a-da"], ["(a-da)**2"], *plays):
        yield "previous orientation", terms


_FORCES = ("a", "p", "o", "a*a", "p*p", "a*p", "a*o", "p*o")
_LINEAR = _FORCES[:3]


def bases_of_pairs(gimbals: int) -> Iterator[tuple[str, list[str]]]:
    """Yield the pairs of drivers in words, each with the terms of its basis.

    gimbals: number of gimbal axes.
    """
    for words, symbol in (("temperature", "T"), ("time", "t")):
        terms = [f"{symbol}*{force}" for force in _FORCES]
        yield f"{words} and specific force", [*terms, *(f"{symbol}*{symbol}*{force}" for force in _LINEAR)]
    for k in range(1, gimbals + 1):
        waves = [f"{wave}({times}q{k})" for times in ("", "2*") for wave in ("sin", "cos")]
        yield f"angle of gimbal {k} and specific force", [f"{wave}*{force}" for wave in waves for force in _LINEAR]
        yield f"angle of gimbal {k} and temperature", [f"{wave}*T" for wave in waves[:2]]
    steps = [f"{step}*{force}" for step in ("da", "abs(da)") for force in _LINEAR]
    yield "previous orientation and specific force", steps


def sparse_subsets(scan: Scan) -> Iterator[tuple[tuple[int, ...], float, int]]:
    """Yield all subsets of one or two candidates of a scan, with their falls of chi-squared and ranks."""
    alone = scan.statistics
    for k, candidate in enumerate(scan.candidates):
        yield (k,), float(alone[k]), candidate.dof
    for k, other in itertools.combinations(range(len(scan.candidates)), 2):
        if scan.candidates[k].dof and scan.candidates[other].dof:
            basis = np.concatenate([scan.candidates[k].basis, scan.candidates[other].basis], axis=1)
            yield (k, other), *scan.explained(basis)
