"""A diagnosis as a report, with what to do next as a command to paste, and as a JSON object."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

from kf_calib.design.next_orientation import Advice
from kf_calib.diagnosis.candidate_tests import LEVEL
from kf_calib.diagnosis.coefficient_sizes import Detectable
from kf_calib.diagnosis.explanation import EffectShape
from kf_calib.diagnosis.hypothesis_table import Hypothesis, HypothesisTable
from kf_calib.diagnosis.residual_drivers import Driver
from kf_calib.diagnosis.results import Diagnosis, Suspect
from kf_calib.diagnosis.unknown_effect import Description
from kf_calib.diagnosis.verdict import format_probability
from kf_calib.estimation.remarks import MISSING_OR_NOISE
from kf_calib.estimation.results import Calibration, Condition, format_p
from kf_calib.support.text import angles_in_words, printed
from kf_calib.support.units import shown
from kf_calib.views.console import clearest, p_cell, plain, with_sigma
from kf_calib.views.json import members, outlying_object, readings_object
from kf_calib.views.notation import symbol
from kf_calib.views.terminal import VERDICT_STYLES, ConsoleTable, TextPlot, note, table

_OF_A_REPLICATION = "fall", "predicted", "p_value", "p_less", "halves"
_ANY = 1e-6  # probability of rows that are in the JSON object
_MOST = 5
"""Explanations in the table on one screen."""
_SIGNIFICANT, _SOME = 0.01, 0.005  # p-value and share above and below which a quantity explains nothing
_TELLS = 1.0  # sigma; an orientation that separates explanations by less tells nothing


def diagnosis_object(diagnosis: Diagnosis) -> dict[str, Any]:
    """The JSON object of ``diagnose``; its p-values are family-wise."""
    going = diagnosis.next_orientation
    return found_object(diagnosis) | {"next_orientation": None if going is None else orientation_object(*going)}


def shape_object(shape: EffectShape) -> dict[str, Any]:
    """The shape of an effect as a JSON object: lists with an item a dwell, each a list of an item an accelerometer, or
    of one for the platform."""
    named = {"effect": shape.effect, "axis": shape.words, "symbol": shape.symbol or None}
    means = {"quantity_unit": shape.quantity, **members(shape, "readings", "sigma", "component", "component_sigma")}
    return {**named, **members(shape, "unit", "values"), **means}


def found_object(diagnosis: Diagnosis) -> dict[str, Any]:
    """The same without the next orientation."""
    named = diagnosis.missing[0] if diagnosis.missing else "noise" if diagnosis.noise else None
    missing = "unknown" if diagnosis.unknown or diagnosis.unearned else named
    shapes = diagnosis.explanation.shapes if diagnosis.explanation else []
    trend = diagnosis.test.trend
    return {
        "consistent": diagnosis.consistent,
        "conditional_on": diagnosis.condition,
        "p_value": diagnosis.test.p_value,
        "verdict": verdict(diagnosis),
        "model": list(map(str, diagnosis.before.model.effects)),
        "missing": missing,
        "all_missing": diagnosis.missing,
        "hypotheses": _hypotheses_object(diagnosis.table),
        "families": [{"family": name, "probability": p} for name, p in diagnosis.table.families.items()]
        if diagnosis.table
        else [],
        "suspects": [_suspect_object(each, diagnosis.floor_mps2) for each in diagnosis.suspects],
        "ambiguity_set": diagnosis.ambiguity,
        "same_here": diagnosis.table.same if diagnosis.table and diagnosis.missing else [],
        "overlaps": diagnosis.overlaps,
        "replicates": diagnosis.replication.answer if diagnosis.replication else None,
        "replication": diagnosis.replication and members(diagnosis.replication, *_OF_A_REPLICATION),
        "shapes": [shape_object(shape) for shape in shapes],
        "together": diagnosis.together,
        "may_be_scatter": diagnosis.as_scatter,
        "invisible": diagnosis.test.invisible,
        "vibration_hz": [line.frequency_hz for line in diagnosis.test.lines.vibration],
        "trend": None
        if trend is None
        else {"ratio": trend.ratio, "p_value": trend.p_value, "dwell": trend.most[0], "channel": trend.most[1]},
        "disturbed_dwells": disturbed_dwells(diagnosis),
        "detectable": [
            {"effect": each.name, "minimum": each.minimum, "unit": each.unit} for each in diagnosis.detectable
        ],
        "unknown": description_object(diagnosis.description),
        "held_out_rms_mps2": diagnosis.before.held_out_rms_mps2,
        "held_out_floor_mps2": diagnosis.floor_mps2,
        "readings": readings_object(diagnosis.before.readings),
        "outlying_dwells": [outlying_object(each) for each in diagnosis.before.outlying],
        "warnings": diagnosis.before.warnings,
    }


def disturbed_dwells(diagnosis: Diagnosis) -> list[int]:
    """The numbers of the dwells that something disturbed, as any test has it."""
    before, first = diagnosis.before, diagnosis.likeliest
    return sorted({*before.readings.disturbed, *diagnosis.apart, *(first.dwells if first is not None else ())})


def _hypotheses_object(table: HypothesisTable | None) -> list[dict[str, Any]]:
    """Return the rows of the table of hypotheses that have any probability as JSON objects, the likeliest first."""
    rows = () if table is None else zip(table.rows, table.log10_odds, strict=True)
    return [
        {
            "effects": row.effects,
            "formula": row.formulas[0] if row.formulas else None,
            "formulas": row.formulas,
            "driver": row.driver or None,
            **members(row, "families", "probability"),
            "log10_odds_to_next": odds,
            **members(row, "statistic", "dof"),
        }
        for row, odds in rows
        if row.probability > _ANY
    ]


def orientation_object(advice: Advice, why: str) -> dict[str, Any]:
    """The advice where to go next as a JSON object.

    advice: the orientation. why: the reason in words. The key stay_s is the time to stay there where it should be
    longer than the dwells so far, in s.
    """
    return members(advice, "gimbal_deg", "stay_s") | {"why": why}


def advice_sentence(advice: Advice, why: str) -> str:
    """The same in a sentence."""
    return f"Next orientation: gimbals at {angles_in_words(advice.gimbal_deg)}: {why}."


def description_object(unknown: Description | None) -> dict[str, Any] | None:
    """The description of an unknown misfit as a JSON object, or None."""
    return None if unknown is None else {**vars(unknown), "formula": unknown.formula}


def description_sentence(unknown: Description, formulas: Sequence[str]) -> str:
    """Sentences on what an unknown misfit depends on, with the formulas to try."""
    where = "all accelerometers" if unknown.channel == "all" else f"accelerometer {unknown.channel}"
    to_try = " ".join(f"--with '{formula}'" for formula in formulas)
    return (
        f"The misfit depends on {unknown.driver} ({where}), which explains {unknown.share:.0%} of it. To try: {to_try}"
    )


def _suspect_object(suspect: Suspect, floor_mps2: float | None) -> dict[str, Any]:
    """Return one suspect as a JSON object."""
    return {
        "effect": suspect.name,
        **members(suspect, "statistic", "dof", "p_value", "probability", "probability_with_others", "fits"),
        "coefficients": [members(each, "symbol", "value", "sigma", "unit") for each in suspect.coefficients],
        "held_out_rms_mps2": suspect.refit.held_out_rms_mps2,
        "held_out_floor_mps2": floor_mps2,
    }


def verdict(diagnosis: Diagnosis) -> str:
    """The verdict in one or two sentences; what disturbed the run comes first and, if the model is rejected, faults of
    the readings that bias it."""
    readings = diagnosis.before.readings
    first = readings.biasing if diagnosis.test.consistent is False else []
    told = [*first, *readings.disturbances]
    return " ".join([*(sentence[0].upper() + sentence[1:] for sentence in told), diagnosis.verdict])


def replication_in_words(diagnosis: Diagnosis) -> str:
    """A sentence on how what is named predicts dwells that choosing it never saw; "" where nothing is named."""
    tried = diagnosis.replication
    if tried is None:
        return ""
    if not tried.halves:
        return (
            "Whether it replicates cannot be told: the dwells cannot be divided in two halves that predict each other."
        )
    if not tried.relevant:
        names = " and ".join(dict.fromkeys("+".join(half.named) for half in tried.halves))
        return f"Whether it replicates cannot be told: half of the dwells alone would name {names}."
    fall = (
        f"named from half of the dwells, it lowers χ² of the others by {tried.fall:.0f} ({tried.predicted:.0f} "
        f"predicted; p {format_p(tried.p_value)})"
    )
    if tried.fall < 0.0:
        fall = f"named from half of the dwells, it raises χ² of the others by {-tried.fall:.1f}"
    if tried.answer == "yes":
        return f"It replicates: {fall}."
    if tried.answer == "no":
        return f"It does not replicate: {fall}, less than its size predicts (p {format_p(tried.p_less)})."
    return f"Whether it replicates cannot be told: {fall}."


def diagnosis_report(diagnosis: Diagnosis, typed: str = "", details: bool = False) -> RenderableType:
    """What ``diagnose`` prints, on one screen: the verdict, what it may be, the shape of it, and what to do.

    typed: recording and options of the command, which the next ones have, too. details: with the evidence below.
    """
    parts: list[RenderableType] = [Text(verdict(diagnosis), style=VERDICT_STYLES[diagnosis.consistent])]
    if replicates := replication_in_words(diagnosis):
        parts.append(Text(replicates))
    if diagnosis.table and diagnosis.test.consistent is False and not details:
        parts.append(_hypothesis_table(diagnosis.table, diagnosis.floor_mps2, _MOST))
        if more := diagnosis.table.listed[_MOST:]:
            share = format_probability(sum(row.probability for row in more))
            parts.append(Text(f"{len(more)} more have {share} together: --details."))
    shapes = diagnosis.explanation.shapes if diagnosis.explanation else []
    parts += map(TextPlot, shapes[:1])
    for step in next_steps(diagnosis, typed):
        parts.append(Text(f"{step.why}:" if step.command else f"{step.why}."))
        parts += [Text(f"  {step.command}", style="bold", no_wrap=True, overflow="ignore")] if step.command else []
    told = diagnosis.missing or diagnosis.unknown or diagnosis.noise  # what a misfit may come from is said by then
    said = verdict(diagnosis)  # and warnings in it, without the first letter, which is a capital where one begins it
    notes = [each for each in diagnosis.before.warnings if each[1:] not in said]
    parts += [note(each) for each in notes if not (told and each.startswith(MISSING_OR_NOISE))]
    return Group(*parts, *(details_of(diagnosis) if details else []))


def details_of(diagnosis: Diagnosis) -> list[RenderableType]:
    """The evidence for the verdict, and what the run cannot show."""
    parts: list[RenderableType] = [*map(Text, of_what_p_is(diagnosis))]
    readings, trend = diagnosis.before.readings, diagnosis.test.trend
    if diagnosis.table and diagnosis.test.consistent is False:
        parts.append(_hypothesis_table(diagnosis.table, diagnosis.floor_mps2))
    if readings.findings:
        parts.append(Text(f"In the readings: {'; '.join(readings.findings)}."))
    if diagnosis.suspects:
        parts.append(_suspect_table(diagnosis))
    if diagnosis.test.consistent is False:
        parts.append(_dwell_table(diagnosis))
    if diagnosis.test.consistent is False and trend and trend.p_value < LEVEL:
        parts.append(
            Text(
                f"The readings also drift within dwells: their slopes and curvatures have {trend.ratio:.2f} times the "
                f"power of noise (p {format_p(trend.p_value)}), {trend.most_in_words}."
            )
        )
    unknown, going = diagnosis.description, diagnosis.next_orientation
    if unknown is not None:
        parts.append(Text(description_sentence(unknown, unknown.formulas)))
    if diagnosis.test.lines.vibration:
        averaged = diagnosis.before.fit.dwells.folded.averaged
        treated = "the tests use averages that suppress it" if averaged else "it counts as noise"
        lines = diagnosis.test.lines.vibration_in_words
        parts.append(Text(f"Vibration at {lines} changes its amplitude during the run, so {treated}."))
    if going is not None:
        parts.append(Text(advice_sentence(*going)))
    if diagnosis.test.invisible:
        parts.append(Text(f"Effects that this run cannot show: {', '.join(diagnosis.test.invisible)}."))
    parts.append(_detectable_table(diagnosis.detectable))
    return parts


def of_what_p_is(diagnosis: Diagnosis) -> list[str]:
    """Sentences on what the p-value of a run means, and on that of the misfit as a whole, which ``replay`` prints.

    Empty where nothing could be tested.
    """
    if diagnosis.test.p_value is None:
        return []
    alone = diagnosis.before.consistency.p_value
    overall = "" if alone is None else f" By the size of the misfit alone, as replay says, p {format_p(alone)}."
    return [f"p is the chance that pure noise would look this bad in any of our tests.{overall}"]


printed.register(Diagnosis, lambda diagnosis: plain(diagnosis_report(diagnosis)))


def _hypothesis_table(hypotheses: HypothesisTable, floor_mps2: float | None, most: int | None = None) -> ConsoleTable:
    """Return the table of the explanations that have 1 % of the probability or more, at most ``most`` of them, with
    what their refits say."""
    rows = [
        (name_of(row), ", ".join(row.families), format_probability(row.probability), _largest_coefficient(row),
         held_out_ratio(row.refit, floor_mps2))
        for row in hypotheses.listed[:most]
    ]  # fmt: skip
    headings = "explanation", "family", ">probability", ">largest coefficient (1σ)", ">held out / noise"
    return table("What it may be", headings, rows)


def _largest_coefficient(row: Hypothesis) -> str:
    """Return the coefficient of an explanation that stands out most from its sigma; "" where nothing was fitted."""
    names = [*row.effects, *(text.partition("=")[0].strip() for text in row.formulas)]
    added = [each for each in row.refit.model.effects if str(each) in names] if row.refit is not None else []
    known = [row.refit.parameters[c.symbol] for each in added for c in each.parameters] if row.refit else []
    return clearest(known)


def held_out_ratio(refit: Calibration | None, floor_mps2: float | None) -> str:
    """The held-out rms over the noise floor; "" where it is not known."""
    if refit is None or refit.held_out_rms_mps2 is None or not floor_mps2:
        return ""
    return f"{refit.held_out_rms_mps2 / floor_mps2:.2f}"


def explains(driver: Driver) -> bool:
    """Whether a quantity explains more of the misfit than noise would."""
    return driver.p_value <= _SIGNIFICANT and driver.share >= _SOME


def share_in_words(driver: Driver) -> str:
    """How much of the misfit goes with a quantity, in a few words."""
    if not explains(driver):
        return "no more than noise"
    return f"{100 * driver.share:.0f} % of the misfit (p {format_p(driver.p_value)})"


def name_of(row: Hypothesis) -> str:
    """An explanation in a few words, for a line of a table or figure."""
    unknown = f"formula of {row.driver}" if row.formulas else f"{row.driver} changes" if row.driver else ""
    return " + ".join([*row.effects, *([unknown] if unknown else [])]) or row.families[0]


def _suspect_table(diagnosis: Diagnosis) -> ConsoleTable:
    """Return the table of the suspects with their coefficients."""
    title = "Suspects (1σ; p: noise alone lets some effect explain as much; held out: rms over noise floor)"
    rows, ends = list[tuple[str, ...]](), set[int]()
    for suspect in diagnosis.suspects:
        ratio = held_out_ratio(suspect.refit, diagnosis.floor_mps2)
        head = [suspect.name, p_cell(suspect.p_value), f"{suspect.statistic:.1f} / {suspect.dof}",
                "yes" if suspect.fits else "no"]  # fmt: skip
        for k, p in enumerate(suspect.coefficients):
            first, last = (head, ratio) if k == 0 else ([""] * 4, "")
            rows.append((*first, symbol(p.symbol), *with_sigma(p), last))
        ends.add(len(rows) - 1)
    headings = "effect", ">p", ">χ² / dof", "fits", "symbol", ">value", ">sigma", "unit", ">held out"
    return table(title, headings, rows, ends, whole=("effect",))


def _dwell_table(diagnosis: Diagnosis) -> ConsoleTable:
    """Return the table of the dwells that disagree most: their residuals over the sigma of their means."""
    has_gimbals, ratios = bool(diagnosis.before.bench.axes), diagnosis.residual_ratios
    rows = list[tuple[str, ...]]()
    for k in np.argsort(-np.abs(ratios).max(axis=1))[:5].tolist():
        dwell = diagnosis.before.visits[k].dwell
        force = dwell.means[1:4] / np.linalg.norm(dwell.means[1:4])
        angles = ", ".join(f"{angle:.1f}" for angle in np.degrees(dwell.recorded_pose))
        orientation = angles if has_gimbals else ", ".join(f"{part:+.2f}" for part in force)
        rows.append((str(dwell.number), f"{dwell.start_s:.0f}", orientation, *(f"{ratio:+.1f}" for ratio in ratios[k])))
    pose = ">gimbals, deg" if has_gimbals else ">up, in its axes"
    title = "Where it fails: residual / σ of the dwell's mean"
    return table(title, (">dwell", ">at s", pose, ">1", ">2", ">3"), rows)


def _detectable_table(sizes: list[Detectable]) -> ConsoleTable:
    """Return the table of the smallest detectable sizes."""
    half = (len(sizes) + 1) // 2
    units = [shown(each.coefficient) for each in sizes]
    cells = [(each.name, unit.number(each.minimum), unit.label) for each, unit in zip(sizes, units, strict=True)]
    cells += [("", "", "")] * (2 * half - len(cells))
    rows = [(*left, *right) for left, right in zip(cells[:half], cells[half:], strict=True)]
    title = "Smallest coefficient that would be found in 9 of 10 such runs"
    return table(title, ("effect", ">size", "unit") * 2, rows)


@dataclass(frozen=True)
class NextStep:
    """why: a sentence without its full stop. command: what to paste; "" where there is none."""

    why: str
    command: str = ""


def next_steps(diagnosis: Diagnosis, typed: str) -> list[NextStep]:
    """What to do, the first thing first.

    typed: recording and options of the command that was given, as words of a shell; "" outside the command line, where
    no command can be told.
    """
    steps = list(_steps(diagnosis, f"{typed}{_leaving_out(diagnosis.apart)}"))
    if typed:
        return steps
    return [NextStep(each.why) for each in steps if not each.command or each.why.startswith("Measure")]


def _steps(diagnosis: Diagnosis, typed: str) -> Iterator[NextStep]:
    test, first = diagnosis.test, diagnosis.likeliest
    if test.consistent is None:
        yield NextStep("Find orientations that determine the model", f"kf-calib plan {typed} --count 24")
    elif diagnosis.condition is not None:
        yield from _of_condition(diagnosis.condition, typed)
    elif test.consistent:
        yield NextStep("Keep this calibration", f"kf-calib replay {typed} --save calibration.json")
    elif numbers := first.dwells if first else ():
        said = " and ".join(map(str, sorted([*diagnosis.apart, *numbers])))
        yield NextStep(f"Try the run without dwell {said}", f"kf-calib diagnose {typed}{_leaving_out(numbers)}")
    elif diagnosis.sure:
        yield NextStep("Add it and see the error fall", f"kf-calib improve {typed}")
    else:
        yield from _unsure(diagnosis, typed)


def _leaving_out(numbers: Sequence[int]) -> str:
    return "".join(f" --leave-out {number}" for number in numbers)


def _of_condition(condition: Condition, typed: str) -> Iterator[NextStep]:
    """Yield how to find out whether what the agreement rests on is true."""
    if condition.name == "angle_sigma_deg":
        yield NextStep("State what your table can do, from its data sheet, for example of 1 arcsec",
                       f"kf-calib diagnose {typed} --angle-sigma 0.00028")  # fmt: skip
    else:
        yield NextStep("State how your dwells scatter, for example by 0.001 m/s^2",
                       f"kf-calib diagnose {typed} --scatter-sigma 0.001")  # fmt: skip
    yield NextStep(
        "Or visit some orientations again: what differs between the visits is noise, what comes back is none"
    )


def _unsure(diagnosis: Diagnosis, typed: str) -> Iterator[NextStep]:
    """Yield what decides among several explanations, then what can be tried without it."""
    going = diagnosis.next_orientation
    if going is not None and going[0].told and going[0].after < _TELLS:
        yield NextStep("No single orientation tells them apart here: measure at more, or for longer")
    elif going is not None:
        yield NextStep(f"Measure with the gimbals at {angles_in_words(going[0].gimbal_deg)}: it {going[1]}")
    if diagnosis.description is not None:
        texts = " ".join(f"--with {shlex.quote(text)}" for text in diagnosis.description.formulas)
        yield NextStep("Try what describes it", f"kf-calib diagnose {typed} {texts}")
    elif diagnosis.missing:
        yield NextStep("Or take the likeliest", f"kf-calib improve {typed} --accept-first")
