"""The verdict of a diagnosis in one sentence."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kf_calib.diagnosis.hypothesis_table import (
    IRREGULAR,
    LISTED,
    NOISE,
    NONE,
    NOTHING,
    SURE,
    Hypothesis,
    HypothesisTable,
)
from kf_calib.diagnosis.refits import dwell_noise_is_stated
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.effects import effect_named, kind_of
from kf_calib.estimation.dwell_pass import holds_its_oscillation
from kf_calib.estimation.results import Calibration, Parameter, format_p
from kf_calib.support.tail_probabilities import LEVEL
from kf_calib.support.text import counted, listing
from kf_calib.support.units import shown

_AS_LIKELY = 0.25  # share of the likeliest from which another explanation is told together with it
_TOLD, _WORTH_A_NAME = 4, 1e-3  # most other explanations that are told, and least probability of one
_LEFT = 2.0  # times the noise at rest, from which on it is said what readings of slews have beyond an effect
_UNUSUAL = 5.0  # times the greatest usual size, from which a coefficient is said to be too large for its name
_USUAL = {"angle_sigma_deg": " (a usual table: 0.0003 to 0.003 deg)", "scatter_sigma_mps2": ""}
_FAMILIES = {
    "bias in time": "The bias changes with time", "scale in time": "The scale factor changes with time",
    "temperature": "It goes with temperature", "nonlinearity": "The accelerometer is not linear",
    "cross-axis": "Acceleration across the input axis enters", "memory": "It depends on the orientation before",
    "gimbal and encoder": "The gimbals or their encoders err",
    "base and platform": "The base or platform moves or yields",
    "surroundings": "Something around the bench enters", "slews": "It shows while the platform turns",
}  # fmt: skip
"""What each family of effects means, in words."""


def verdict_in_words(diagnosis: Diagnosis) -> str:
    """The verdict of a diagnosis in one sentence, with what else it could be, after the dwells that do not fit."""
    first = diagnosis.likeliest
    apart = () if first is not None and first.dwells else diagnosis.apart
    return f"{dwells_apart(apart)}{_of_the_others(diagnosis)}"


def dwells_apart(numbers: Sequence[int]) -> str:
    """The beginning of a sentence: that dwells do not fit, whatever is missing; "" for none."""
    if not numbers:
        return ""
    do, its, it = ("do", "their poses and their", "them") if len(numbers) > 1 else ("does", "its pose and its", "it")
    return f"{_dwells(numbers)} {do} not fit, whatever is missing: look at {its} readings. Without {it}: "


def _dwells(numbers: Sequence[int]) -> str:
    """Return the numbers of dwells as the beginning of a sentence."""
    *many, last = map(str, sorted(numbers))
    return f"Dwells {', '.join(many)} and {last}" if many else f"Dwell {last}"


def _of_the_others(diagnosis: Diagnosis) -> str:
    """Return the verdict on the other dwells."""
    test = diagnosis.test
    if test.consistent is None:
        return "The model cannot be tested: there are no more measurements than parameters. Visit more orientations."
    if test.consistent:
        effects = test.effects
        blind = f" This run cannot show {len(effects.unseen)} of {effects.count} effects." if effects.unseen else ""
        if diagnosis.condition is not None:
            return (
                f"The model agrees with the measurements if {diagnosis.condition}: this was estimated from their "
                f"misfit (p {format_p(test.p_value)}), which no known effect explains beyond it."
                f"{_of_one(diagnosis)}{blind}"
            )
        lines = test.lines.vibration_in_words if diagnosis.before.fit.dwells.folded.averaged else ""
        averaged = f" once their vibration at {lines} is averaged out" if lines else ""
        agreed = f"The model agrees with the measurements{averaged} (p {format_p(test.p_value)})"
        return f"{agreed}: no effect is missing that this run could show.{blind}"
    first = diagnosis.likeliest
    start = f"{_what_fails(diagnosis)} (p {format_p(test.p_value)})."
    if first is None:
        return start
    if first.dwells:
        return _wrong_dwells(diagnosis, first)
    if first.effects and diagnosis.unearned:
        return f"{start} {_not_named(diagnosis, first)}."
    if first.effects:
        return f"{start} {_named(diagnosis, first)}.{_held_out(diagnosis)}{_unusual(diagnosis)}"
    said = _noise(diagnosis, first) if diagnosis.noise else _unknown(diagnosis, first)
    if not _may_be_chance(diagnosis, first):
        return f"{start} {said}"
    assert diagnosis.table is not None
    nothing = format_probability(diagnosis.table.families[NOTHING])
    return f"{start} It may be chance: nothing is missing ({nothing}). Otherwise: {said[0].lower()}{said[1:]}"


def _may_be_chance(diagnosis: Diagnosis, first: Hypothesis) -> bool:
    """Tell whether nothing missing is likelier than what the table has first, which is no known effect."""
    assert diagnosis.table is not None
    return not first.effects and diagnosis.table.families.get(NOTHING, 0.0) > first.probability


def _what_fails(diagnosis: Diagnosis) -> str:
    """Return what fails: the size of the residuals, or how they scatter, or what shows while the platform turns."""
    test, first = diagnosis.test, diagnosis.likeliest
    if first is not None and first.refit is not None and first.refit.model.dynamic:
        condition = diagnosis.before.consistency.condition
        at_rest = f"The model agrees at rest{f' if {condition}' if condition else ''}"
        return f"{at_rest}; while the platform turns the readings fail"
    scattering = test.noise_p is not None and test.noise_p == test.p_value
    return "The dwells do not scatter as noise does" if scattering else "Residuals fail"


def second_pass_in_words(diagnosis: Diagnosis) -> str:
    """A sentence on what only a second pass over the readings could judge; "" where nothing is left to it."""
    names = [suspect.name for suspect in diagnosis.suspects if not holds_its_oscillation(suspect.refit.fit)]
    before = diagnosis.before
    if diagnosis.test.lines.vibration and before.bench.angles and not before.fit.dwells.folded.averaged:
        names.append("the lines in their spectrum")
    if not names:
        return ""
    return f" A second pass over the readings is needed to judge {listing(names)}: diagnose the recording itself."


def _named(diagnosis: Diagnosis, first: Hypothesis) -> str:
    """Return the likeliest effects in words, with the other explanations and their probabilities."""
    assert diagnosis.table is not None
    share = diagnosis.table.probability_of_class(first.effects)
    rest = _beside(diagnosis, first) or _unexplained(diagnosis, first)
    named = f"{_effects_of(first)}{_size(diagnosis)} ({_share(diagnosis)}){_same(diagnosis.table)}"
    others = _others(diagnosis) + rest
    if share >= SURE:
        return f"{'Part of it' if rest else 'Missing'}: {named}{others}"
    family, of_family = next(each for each in diagnosis.table.families.items() if each[0] not in (NOTHING, NOISE, NONE))
    of_same = {effect_named(name, diagnosis.before.bench).family for name in diagnosis.table.same}
    if of_family >= SURE and {family, *of_same} == {*first.families}:
        return f"{_FAMILIES[family]} ({format_probability(of_family)}): {named}{others}"
    return f"Likeliest: {named}{others}"


def _same(table: HypothesisTable) -> str:
    """Return in words what explains just the same as the likeliest effect; "" for nothing."""
    if not table.same:
        return ""
    *many, last = table.same
    listed = f"{', '.join(many)} and {last}" if many else last
    together = format_probability(table.probability_of_class(table.first.effects))
    return f", or what is the same here: {listed} ({together} together)"


def _beside(diagnosis: Diagnosis, first: Hypothesis) -> str:
    """Return in words what goes on beside the effects that are named, and no known effect explains; "" for nothing."""
    if not first.driver:
        return ""
    words = [f", or is {names} {share}" for names, share in _known_beside(diagnosis, first)]
    rest = "changes irregularly" if first.driver == IRREGULAR else f"goes with {first.driver}"
    unknown = f"the rest {rest}, as no known effect does ({format_probability(first.probability)})"
    return f"; {unknown}{''.join(words)}"


def _known_beside(diagnosis: Diagnosis, first: Hypothesis) -> list[tuple[str, str]]:
    """Return the known effects that may be missing beside those that are named, with their probabilities."""
    assert diagnosis.table is not None
    rows = [row for row in diagnosis.table.listed if set(first.effects) < set(row.effects)]
    names = [listing(name for name in row.effects if name not in first.effects) for row in rows]
    return [(each, format_probability(row.probability)) for each, row in zip(names, rows[:_TOLD], strict=False)]


def _share(diagnosis: Diagnosis) -> str:
    """Return the probability of the likeliest row, as the table has it, and that of its effects, alone or with
    others."""
    assert diagnosis.table is not None
    first = diagnosis.table.first
    if first.driver or first.probability < LISTED:  # it is not alone
        return format_probability(diagnosis.table.probability(first.effects))
    return _share_of_row(diagnosis.table, first)


def _share_of_row(table: HypothesisTable, row: Hypothesis) -> str:
    """Return the probability of a row, and that of its causes, alone or with others."""
    alone, with_others = (format_probability(share) for share in (row.probability, table.probability_with(row)))
    return alone if alone == with_others else f"{alone} alone, {with_others} alone or with others"


def _not_named(diagnosis: Diagnosis, first: Hypothesis) -> str:
    """Return the likeliest effects, and why they have not earned their name."""
    assert diagnosis.table is not None
    share, same = format_probability(first.probability), _same(diagnosis.table)
    likeliest = f"{_effects_of(first)} ({share}{same}{_others(diagnosis)})"
    return f"No known effect is established. The likeliest is {likeliest}, but {diagnosis.unearned}"


def _unexplained(diagnosis: Diagnosis, first: Hypothesis) -> str:
    """Return in words what does not fit with the effects that are named, and what it may be; "" where all does."""
    assert diagnosis.after is not None
    consistency = diagnosis.after.consistency
    if consistency.consistent is not False:
        return ""
    if consistency.trend is not None:
        where = consistency.trend.most_in_words
        return f"; the readings change within dwells, too, {where} (p {format_p(consistency.p_value)})"
    known = [f"{names} {share}" for names, share in _known_beside(diagnosis, first)]
    likeliest = f", likeliest {', '.join(known)}" if known else ""
    times = (consistency.statistic / consistency.dof) ** 0.5
    return f"; what it leaves is still {times:.2g} times the noise{likeliest}"


def _unknown(diagnosis: Diagnosis, first: Hypothesis) -> str:
    """Return a sentence on a misfit that no known effect explains."""
    what = "it changes irregularly" if first.driver == IRREGULAR else f"it goes with {first.driver}"
    assert diagnosis.table is not None
    share, noise = first.probability, diagnosis.table.families.get(NOISE, 0.0)
    if first.driver == IRREGULAR and noise > _AS_LIKELY * share and dwell_noise_is_stated(diagnosis.before):
        return (
            "It cannot be told whether something unknown changes irregularly from dwell to dwell "
            f"({format_probability(share)}) or the dwells scatter more than was stated ({format_probability(noise)})"
            f"{_others(diagnosis, but=NOISE)}. To find out, repeat an orientation.{_of_one(diagnosis)}"
        )
    but = f", but {diagnosis.unearned}" if diagnosis.unearned else ""
    said = f"{what} ({_share_of_row(diagnosis.table, first)}){but}{_others(diagnosis)}"
    alone = f"{_of_one(diagnosis)}{_within(diagnosis)}" if first.driver == IRREGULAR else ""
    known = sum(row.probability for row in diagnosis.table.rows if row.effects)
    if known > diagnosis.table.probability_with(first):
        return f"It cannot be told whether a known effect explains it. Likeliest none does, and {said}.{alone}"
    return f"Unknown: no known effect explains it, {said}.{alone}"


def _wrong_dwells(diagnosis: Diagnosis, first: Hypothesis) -> str:
    """Return a sentence on dwells that are off; what a turn of a gimbal explains is told of one alone."""
    numbers = [*diagnosis.apart, *first.dwells]
    options = " ".join(f"--leave-out {number}" for number in sorted(numbers))
    p_value, share = format_p(diagnosis.test.p_value), format_probability(first.probability)
    if len(numbers) > 1:
        return (
            f"{_what_fails(diagnosis)} (p {p_value}). Several dwells are wrong: {_dwells(numbers).lower()} alone do "
            f"not fit ({share}{_others(diagnosis)}): look at their poses and their readings, or leave them out "
            f"({options})."
        )
    if first.probability < SURE:
        return (
            f"{_what_fails(diagnosis)} (p {p_value}). Likeliest one dwell is wrong: dwell {numbers[0]} ({share}"
            f"{_others(diagnosis)}): look at its pose and its readings, or leave it out ({options})."
        )
    told = f"dwell {numbers[0]} alone does not fit: look at its pose and its readings, or leave it out ({options})."
    return f"One dwell is wrong ({share}, p {p_value}): {diagnosis.wrong_dwell or told}"


def _within(diagnosis: Diagnosis) -> str:
    """Return a sentence on readings that change within dwells as noise does not; "" where they do not."""
    trend = diagnosis.test.trend
    if trend is None or trend.run_p >= LEVEL:
        return ""
    return f" The readings change within dwells, too, {trend.most_in_words}."


def _noise(diagnosis: Diagnosis, first: Hypothesis) -> str:
    """Return a sentence on noise from dwell to dwell that was not stated, and on how to be sure of it."""
    noise = diagnosis.before.noise
    stated = ("angle_sigma_deg", noise.setting.stated), ("scatter_sigma_mps2", noise.scatter.stated)
    keys = listing(f"{key}{_USUAL[key]}" for key, is_stated in stated if not is_stated)
    what = "more than was stated" if dwell_noise_is_stated(diagnosis.before) else "by an amount that was not stated"
    advice = f"state {keys} or repeat an orientation" if keys else "repeat an orientation"
    share = format_probability(first.probability)
    return f"The dwells scatter {what} ({share}){_others(diagnosis)}. To find out, {advice}.{_of_one(diagnosis)}"


def _of_one(diagnosis: Diagnosis) -> str:
    """Return a sentence on the accelerometer, or gimbal, that alone scatters; "" where others do, too."""
    name = diagnosis.table.scattering if diagnosis.table else ""
    parts = "its encoder and its brake" if name.startswith("gimbal") else "its contacts and its supply"
    return f" It is {name} alone: look at {parts}." if name else ""


def _others(diagnosis: Diagnosis, but: str = "") -> str:
    """Return the other explanations in words, but for those of one family."""
    assert diagnosis.table is not None
    least = 1.0 if _may_be_chance(diagnosis, diagnosis.table.first) else LISTED  # which has been told
    nothing = [row for row in diagnosis.table.rows if row.families == (NOTHING,) and row.probability > least]
    rows = [row for row in (*diagnosis.table.rivals, *nothing) if row.families != (but,)]
    rows.sort(key=lambda row: -row.probability)
    told = [row for row in rows[:_TOLD] if row.probability >= _WORTH_A_NAME]
    words = [f"{_in_words(diagnosis, row)} {format_probability(row.probability)}" for row in told]
    more = len(rows) - len(told)
    words += [counted(more, "other")] if more else []
    return f"; or {', '.join(words)}" if words else ""


def explanations_in_words(diagnosis: Diagnosis) -> str:
    """The likeliest explanations with their probabilities, for a line; "" where there are none."""
    first = diagnosis.likeliest
    if first is None or diagnosis.table is None:
        return ""
    if diagnosis.sure:
        return f"missing: {listing(diagnosis.missing)} {_share(diagnosis)}"
    rows = [first, *diagnosis.table.rivals[: _TOLD - 1]]
    text = ", ".join(f"{_in_words(diagnosis, row)} {format_probability(row.probability)}" for row in rows)
    return f"suspects {text}" if first.effects else text


def _in_words(diagnosis: Diagnosis, row: Hypothesis) -> str:
    """Return an explanation in words."""
    if row.effects:
        if row.driver == IRREGULAR:
            return f"{_effects_of(row)} beside irregular changes within dwells"
        return _effects_of(row) + (f" beside no known effect, which goes with {row.driver}" if row.driver else "")
    if row.families == (NOTHING,):
        return "nothing missing"
    if row.driver:
        return "no known effect, irregular" if row.driver == IRREGULAR else f"no known effect, goes with {row.driver}"
    return f"scatter from dwell to dwell{' larger than stated' if dwell_noise_is_stated(diagnosis.before) else ''}"


def _effects_of(row: Hypothesis) -> str:
    """Return the effects of a row in words; of an error of several gimbals the name once."""
    kinds = ["", *map(kind_of, row.effects)]
    names = [name.removeprefix(kind) if kind == before else name
             for name, before, kind in zip(row.effects, kinds, kinds[1:], strict=False)]  # fmt: skip
    return names[0] if len(names) == 1 else f"{listing(names)} together"


def format_probability(probability: float) -> str:
    """A probability in per cent as text, never rounded to certainty."""
    percent = 100.0 * probability
    if percent > 99.9 or percent < 0.1:
        return "over 99.9 %" if percent > 50.0 else "under 0.1 %"
    return f"{percent:.1f} %" if percent > 99.0 or percent < 1.0 else f"{percent:.0f} %"


def _size(diagnosis: Diagnosis) -> str:
    """Return, as text, the most significant coefficient of the missing effects and the constant of its effect, with
    sigmas; a constant that the run does not tell, as the time of a decay that is far longer than its dwells, is named
    so."""
    assert diagnosis.after is not None
    parameters = diagnosis.after.parameters
    missing = [each for each in diagnosis.after.model.effects if str(each) in diagnosis.missing]
    largest = _clearest([parameters[c.symbol] for each in missing for c in each.parameters])
    its_own = next(each for each in missing if largest.symbol in {c.symbol for c in each.parameters})
    constant = its_own.unknown
    parameters_named = [largest, *([parameters[constant.symbol]] if constant else [])]
    return "".join(
        f", {p.symbol} = {shown(p).with_sigma(p.value, p.sigma)}"
        if p.value is not None and p.sigma
        else f", {p.symbol} not determined"
        for p in parameters_named
    )


def _held_out(diagnosis: Diagnosis) -> str:
    """Return a sentence about the change of the held-out error, or "" where it is not known."""
    before, after = diagnosis.before, diagnosis.after
    assert after is not None
    if after.model.dynamic and not before.model.dynamic:
        return f" It changes no reading at rest{_left_in_slews(after)}."
    floor = diagnosis.floor_mps2
    if before.held_out_rms_mps2 is None or after.held_out_rms_mps2 is None or not floor:
        return ""
    added = "them" if len(diagnosis.missing) > 1 else "it"
    return (
        f" Adding {added} takes the error on orientations left out from {before.held_out_rms_mps2 / floor:.2f} to "
        f"{after.held_out_rms_mps2 / floor:.2f} times what noise gives."
    )


def _left_in_slews(after: Calibration) -> str:
    """Return in words what a model leaves of the readings of slews, over the noise at rest; "" where it is that."""
    slew_mps2 = after.noise.slew_sigma_mps2
    times = 0.0 if slew_mps2 is None else float(np.max(slew_mps2 / np.maximum(after.noise.sigma_mps2, 1e-300)))
    return f"; what it leaves while the platform turns is still {times:.2g} times the noise" if times > _LEFT else ""


def _unusual(diagnosis: Diagnosis) -> str:
    """Return a sentence on a coefficient that is far beyond all sizes that are usual, by two sigmas at least; "" where
    there is none, or where no usual size is known."""
    assert diagnosis.after is not None
    for effect in (each for each in diagnosis.after.model.effects if str(each) in diagnosis.missing):
        usual = effect.typical.of(diagnosis.grade)
        if usual is None or not effect.coefficients:
            continue
        p = _clearest([diagnosis.after.parameters[c.symbol] for c in effect.coefficients])
        if p.value is not None and abs(p.value) - 2.0 * (p.sigma or 0.0) > _UNUSUAL * usual[1]:
            return (
                f" {p.symbol} is {abs(p.value) / usual[1]:.0f} times the greatest that is usual "
                f"({shown(p).text(usual[1])}): something else that looks like {effect} may be behind it."
            )
    return ""


def _clearest(parameters: Sequence[Parameter]) -> Parameter:
    """Return the parameter that is the most sigmas from zero."""
    return max(parameters, key=lambda p: abs(p.value or 0.0) / (p.sigma or np.inf))
