"""Stepwise improvement as a report, as a JSON object and as a table to choose from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Group, RenderableType
from rich.text import Text

from kf_calib.diagnosis.nested_cross_validation import NestedCrossValidation
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.stepwise_selection import Improvement, Removal, SelectionStep
from kf_calib.diagnosis.verdict import format_probability
from kf_calib.estimation.results import Calibration, format_p
from kf_calib.support.units import shown
from kf_calib.views.console import clearest, effect_table, p_cell, parameter_table
from kf_calib.views.diagnosis import (
    advice_sentence,
    description_object,
    description_sentence,
    held_out_ratio,
    orientation_object,
)
from kf_calib.views.json import members, parameters_object
from kf_calib.views.notation import symbol
from kf_calib.views.terminal import BARE, FOURS, VERDICT_STYLES, Bar, ConsoleTable, note, table

_WIDTH = 30  # length of the longest bar in characters
_EIGHTHS = " ▏▎▍▌▋▊▉"


def improvement_object(
    state: Improvement, honest: NestedCrossValidation | None, files: Mapping[str, Path | None]
) -> dict[str, Any]:
    """The JSON object of ``improve``.

    The errors of a step are those after it, and p-values are family-wise.

    state: the improvement. honest: its nested cross-validation (None: not made). files: paths written, by their keys.
    """
    unknown, going = state.diagnosis.description, state.diagnosis.next_orientation
    return {
        "start": _figures(state.start, state.floor_mps2),
        "steps": [
            _step_object(step, before, state.floor_mps2)
            for step, before in zip(state.steps, [state.start, *(step.diagnosis for step in state.steps)], strict=False)
        ],
        "model": list(map(str, state.result.model.effects)),
        "stopped_because": state.because,
        "reason": state.reason,
        "verdict": state.diagnosis.verdict,
        **_figures(state.diagnosis, state.floor_mps2),
        "parameters": _parameters(state.result),
        "tests": [_removal_object(each) for each in state.removals],
        "ambiguity_set": [each.name for each in state.alternatives],
        "alternatives": [
            {
                "effect": alternative.name,
                **members(alternative.result, "residual_rms_mps2", "held_out_rms_mps2"),
                "held_out_floor_mps2": state.floor_mps2,
                "parameters": _parameters(alternative.result),
            }
            for alternative in state.alternatives
        ],
        "spread": [
            {
                "symbol": spread.parameter.symbol,
                **members(spread, "lowest", "highest"),
                **members(spread.parameter, "sigma", "unit"),
                "sigmas": spread.sigmas,
            }
            for spread in state.spreads
        ],
        "unknown": description_object(unknown),
        "next_orientation": None if going is None else orientation_object(*going),
        "honest": honest,
        **files,
        "warnings": state.warnings,
    }


def _figures(diagnosis: Diagnosis, floor_mps2: float | None) -> dict[str, Any]:
    """Return the p-value and the errors of a diagnosed model."""
    result = diagnosis.before
    return {
        "p_value": diagnosis.test.p_value,
        "consistent": diagnosis.consistent,
        "conditional_on": diagnosis.condition,
        **members(result, "residual_rms_mps2", "held_out_rms_mps2"),
        "held_out_floor_mps2": floor_mps2,
    }


def _step_object(step: SelectionStep, before: Diagnosis, floor_mps2: float | None) -> dict[str, Any]:
    """Return one step as a JSON object.

    The keys probability and p_value are those of the added effect in the diagnosis before the step; p_value_after is
    that of the model after it.
    """
    return {
        **members(step, "added", "by", "probability"),
        **_figures(step.diagnosis, floor_mps2),
        "p_value": None if step.name is None else before.test.effects.p_values.get(step.name),
        "p_value_after": step.diagnosis.test.p_value,
        "dropped": [_removal_object(each) for each in step.dropped],
        "model": list(map(str, step.result.model.effects)),
        "coefficients": _parameters(step.result)[12:],
        "remarks": step.remarks,
    }


def _removal_object(removal: Removal) -> dict[str, Any]:
    """Return the test of removing an effect as a JSON object."""
    return {"effect": removal.name, **members(removal, "statistic", "dof", "p_value", "needed")}


def _parameters(result: Calibration) -> list[dict[str, Any]]:
    """Return all parameters of a calibration with their sigmas and intervals as JSON objects."""
    return [{key: own[key] for key in own if key != "nominal"} for own in parameters_object(result)]


def improvement_report(state: Improvement, honest: NestedCrossValidation | None) -> RenderableType:
    """The report that ``improve`` prints: the fall of the errors, why it stopped, what would help, and the parameters.

    state: the improvement. honest: its nested cross-validation (None: not made).
    """
    style = VERDICT_STYLES[state.because == "consistent"]
    parts: list[RenderableType] = [
        *(Text(told) for told in story(state)[:-1]),
        progress(state), Text(f"Stopped, {state.because}: {state.reason}", style=style),
    ]  # fmt: skip
    parts += map(Text, _settling(state))
    parts.append(last_parameters(state))
    if honest is not None:
        parts.append(Text(honest_sentence(honest)))
    parts += map(note, state.warnings)
    return Group(*parts)


def last_parameters(state: Improvement) -> RenderableType:
    """The tables of the last model: its parameters, their range where the run cannot decide, and its effects."""
    parts: list[RenderableType] = []
    if not state.spreads or state.because != "ambiguous":
        parts.append(parameter_table(state.result))
    if state.spreads:
        parts.append(_spread_table(state))
    if state.result.model.effects:
        parts.append(effect_table(state.result))
    return Group(*parts)


def story(state: Improvement) -> list[str]:
    """What was wrong, what was added, how far the error fell where it was left out of the fit, and what is left."""
    start, floor = state.start, state.floor_mps2
    if start.test.consistent is not False:
        return [state.reason]
    errors = [_errors(each, floor)[0] for each in (start.before, state.result)]
    times = "" if errors[0] is None else f". Orientations left out of the fit were off by {errors[0]:.2f} × noise"
    p_value = format_p(start.test.p_value) if start.test.p_value is not None else "unknown"
    said = [f"What was wrong: {start.before.model.sum} do not describe this run (p {p_value}){times}."]
    if state.steps:
        said.append(f"What was added: {'; '.join(_told(step, state.result) for step in state.steps)}.")
    if state.steps and None not in errors:
        said.append(
            f"What it brought: the error on orientations left out of the fit went from {errors[0]:.2f} to "
            f"{errors[1]:.2f} times what noise alone gives."
        )
    return [*said, f"What is left: {state.reason}"]


def _told(step: SelectionStep, final: Calibration) -> str:
    """Return what a step added, with its clearest coefficient as the final model has it, and what it took out."""
    told = [f"{each.name} was taken out" for each in step.dropped]
    if step.name is None:
        return ", ".join(told)
    result = final if step.name in map(str, final.model.effects) else step.result
    (own,) = (effect.parameters for effect in result.model.effects if str(effect) == step.name)
    size = clearest(result.parameters[each.symbol] for each in own)
    share = "" if step.probability is None else f" (probability {format_probability(step.probability)})"
    return ", ".join([f"{step.name}{', ' * bool(size)}{size}{share}", *told])


def progress(state: Improvement) -> RenderableType:
    """The steps as a table: held-out and in-sample rms over the noise floor as numbers and bars, with remarks below."""
    floor = state.floor_mps2
    rows = [("start", state.start.before, None, state.start.test.p_value)]
    rows += [(changes(step), step.result, step.probability, step.diagnosis.test.p_value) for step in state.steps]
    rows += [(f"({name})", each, None, None) for name, each in equally_good(state)]
    errors = [_errors(result, floor) for _, result, _, _ in rows]
    longest = max(error for both in errors for error in both if error is not None)
    unit, alone = shown("m/s^2"), "without any one orientation the model is not determined"
    head = "over the noise floor" if floor else f"{unit.label} ({alone})"
    bars = list[tuple[RenderableType, ...]]()
    for (label, _, probability, p_value), (held_out, fitted) in zip(rows, errors, strict=True):
        p_text = p_cell(p_value)
        below = "" if probability is None else f"  probability {format_probability(probability)}"
        if held_out is not None:
            bars.append((label, p_text, "held out", f"{held_out:.2f}", Bar(bar(held_out, longest), style="cyan")))
            label, p_text, below = below, "", ""
        number = f"{fitted:.2f}" if floor else unit.number(fitted, 2)
        bars.append((f"{label}{below}", p_text, "fitted", number, Bar(bar(fitted, longest), style="dim")))
    said = list[RenderableType]()
    for step in state.steps:
        said += [Text(f"{each.name} was taken out: {_test(each)}.") for each in step.dropped]
        said += map(Text, step.remarks)
    tests = [Text(f"Tested: {_test(each)}.") for each in state.removals]
    headings = "step", "p", "", "", ""
    return Group(table(f"Rms error, {head}", headings, bars, whole=headings, **BARE), *said, *tests)


def _errors(result: Calibration, floor: float | None) -> tuple[float | None, float]:
    """Return held-out and in-sample rms over the noise floor; without a floor, the in-sample rms alone in m/s^2."""
    if not floor:
        return None, result.residual_rms_mps2
    held_out = result.held_out_rms_mps2
    return None if held_out is None else held_out / floor, result.residual_rms_mps2 / floor


def bar(value: float, longest: float) -> str:
    """A bar of block characters to an eighth of a character; that of the value ``longest`` has 30 characters."""
    eighths = max(1, round(8 * _WIDTH * value / longest)) if longest > 0 else 1
    return "█" * (eighths // 8) + _EIGHTHS[eighths % 8].strip()


def changes(step: SelectionStep) -> str:
    """The effects added and dropped in a step as a label."""
    said = [f"+ {step.added}"] if step.added else []
    return ", ".join([*said, *(f"- {each.name}" for each in step.dropped)])


def equally_good(state: Improvement) -> list[tuple[str, Calibration]]:
    """Models that are as good as the last, by what each adds to it (+) or has in place of what was taken (or)."""
    others = [each for each in state.alternatives if each.result is not state.result]
    word = "+" if len(others) == len(state.alternatives) else "or"
    return [(f"{word} {each.name}", each.result) for each in others]


def _test(removal: Removal) -> str:
    """Return the test of removing an effect in words."""
    word = "needed" if removal.needed else "not needed"
    p_value = format_p(removal.p_value)
    return f"without {removal.name} χ² rises by {removal.statistic:.1f}, {removal.dof} dof (p {p_value}): {word}"


def _spread_table(state: Improvement) -> ConsoleTable:
    """Return the table of the range of each parameter over the equally good explanations."""
    names = ", ".join(each.name for each in state.alternatives)
    rows = list[tuple[str, ...]]()
    for spread in state.spreads:
        parameter, unit = spread.parameter, shown(spread.parameter)
        low, high = (
            unit.rounded(value - parameter.nominal, parameter.sigma or 0.0) for value in (spread.lowest, spread.highest)
        )
        rows.append((symbol(parameter.symbol), low[0], high[0], f"± {low[1]}", unit.label, f"{spread.sigmas:.1f}"))
    headings = "parameter", ">lowest", ">highest", ">sigma", "unit", ">differ by, σ"
    return table(f"Parameters less nominal, over the explanations {names}", headings, rows, FOURS)


def _settling(state: Improvement) -> list[str]:
    """Return sentences on what would settle an inconsistent run: a formula to try, an orientation to visit."""
    if state.diagnosis.test.consistent is not False:
        return []
    unknown, going, sentences = state.diagnosis.description, state.diagnosis.next_orientation, list[str]()
    if unknown is not None:
        sentences.append(description_sentence(unknown, [unknown.formula]))
    if going is not None:
        sentences.append(advice_sentence(*going))
    return sentences


def honest_sentence(honest: NestedCrossValidation) -> str:
    """The result of nested cross-validation in a sentence."""
    times = ", ".join(f"{name} in {count}" for name, count in honest.chosen.items()) or "no effect in any"
    rms = shown("m/s^2").text(honest.rms_mps2)
    return (
        f"With the choice of effects repeated without what is held out ({honest.folds} folds): "
        f"{rms} rms, {honest.rms_mps2 / honest.expected_mps2:.2f} of what noise gives; "
        f"chosen: {times}."
    )


def choices_table(state: Improvement, choices: Sequence[tuple[str, ...]]) -> RenderableType:
    """The steps so far, the verdict, and the effects that a user may choose by number."""
    return Group(progress(state), Text(state.diagnosis.verdict, style="bold"), *_numbered(state.diagnosis, choices))


def _numbered(diagnosis: Diagnosis, choices: Sequence[tuple[str, ...]]) -> list[RenderableType]:
    """Return the table of the choices, or nothing where there are none."""
    if not choices:
        return []
    refits = {suspect.name: suspect for suspect in diagnosis.suspects}
    rows = list[tuple[str, ...]]()
    for number, names in enumerate(choices, start=1):
        suspect = refits.get(names[0]) if len(names) == 1 else None
        result = suspect.refit if suspect is not None else diagnosis.after
        p_value = "" if suspect is None else p_cell(suspect.p_value)
        fits = "yes" if suspect is None or suspect.fits else "no"
        share = "" if diagnosis.table is None else format_probability(diagnosis.table.probability_of_just(names))
        ratio = held_out_ratio(result, diagnosis.floor_mps2)
        rows.append((str(number), " + ".join(names), share, p_value, fits, ratio))
    return [table("", (">", "suspect", ">probability", "p", "fits", ">held out"), rows, **BARE)]
