"""Results of a calibration as text: Rich tables on a terminal, the same as plain text elsewhere."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

from kf_calib.bench import paper_parameters
from kf_calib.effects import Coefficient, Effect, as_text
from kf_calib.effects.effect import Grade
from kf_calib.estimation.cross_validation import orientations
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.remarks import beyond_stated
from kf_calib.estimation.results import Calibration, OutlyingDwell, Parameter, format_p
from kf_calib.noise.reml import FEWEST, degrees_of_freedom
from kf_calib.support.tail_probabilities import LEVEL
from kf_calib.support.text import printed
from kf_calib.support.units import rounded, shown, shown_whole
from kf_calib.views.notation import signed, symbol
from kf_calib.views.terminal import FOURS, VERDICT_STYLES, ConsoleTable, PlainConsole, note, table

if TYPE_CHECKING:
    from kf_calib.diagnosis.results import Difference, SideBySide
    from kf_calib.estimation.engine_comparison import Comparison

_WIDER = 2.0  # sigma; an interval of known noise is 1.96
_NOT_ESTIMATED, _NOT_USED = "not estimated", "not used"
GRADES: dict[Grade, str] = {"navigation": "navigation grade", "mems": "MEMS"}
"""Grades of sensors, and what they are called."""


def whole_value(parameter: Parameter) -> str:
    """The value of one of the twelve parameters to two digits of its sigma: angles in deg, scale factors as they are,
    biases in the unit of their sigmas."""
    assert parameter.value is not None and parameter.sigma is not None
    if parameter.unit == "1":
        return rounded(parameter.value, parameter.sigma)[0]
    unit = shown_whole("rad") if parameter.unit == "rad" else shown(parameter)
    return f"{unit.rounded(parameter.value, parameter.sigma)[0]} {unit.label}"


def parameter_row(parameter: Parameter, fixed_by: str = "") -> tuple[str, str, str, str, str]:
    """Return symbol, value, deviation from nominal, sigma and unit of a parameter, or what it is fixed by."""
    if parameter.value is None or parameter.sigma is None:
        return symbol(parameter.symbol), fixed_by or "not seen", "", "", ""
    deviation, sigma, unit = with_sigma(parameter, less=parameter.nominal)
    return symbol(parameter.symbol), whole_value(parameter), signed(deviation), sigma, unit


def parameter_table(result: Calibration) -> ConsoleTable:
    """The table of the twelve parameters: value, deviation from nominal and one sigma."""
    walking = "; the biases walk: those at the end of the run" if result.noise.walk.steps else ""
    twelve = list(result.parameters.values())[:12]
    return table_of_parameters(f"Parameters (1σ{walking})", twelve, result.fixed)


def table_of_parameters(title: str, parameters: Iterable[Parameter], fixed: Mapping[str, str]) -> ConsoleTable:
    """The table of some parameters, the twelve first; fixed: what fixes those that are not estimated."""
    rows = [parameter_row(each, fixed.get(each.symbol, "")) for each in parameters]
    return table(title, ("parameter", ">value", ">less nominal", ">sigma", "unit"), rows, FOURS)


def without_table(result: Calibration, outlying: OutlyingDwell) -> ConsoleTable:
    """The table of the parameters fitted without an outlying dwell, and of their differences from those with it."""
    rows = list[tuple[str, ...]]()
    for before, parameter in zip(result.parameters.values(), outlying.without.parameters.values(), strict=True):
        name, value, _, sigma, unit = parameter_row(parameter)
        known = parameter.value is not None and before.value is not None
        moved = signed(shown(parameter).number(parameter.value - before.value)) if known else ""  # type: ignore[operator]
        rows.append((name, value, sigma, unit, moved))
    headings = "parameter", ">value", ">sigma", "unit", ">less with it"
    return table(f"Without dwell {outlying.number} (1σ)", headings, rows, FOURS)


def effect_table(result: Calibration) -> ConsoleTable:
    """The table of the coefficients of the effects in the model, with sigmas and ratios to them."""
    rows = list[tuple[str, ...]]()
    for effect in result.model.effects:
        symbols = [each.symbol for each in (*effect.parameters, effect.unknown) if each is not None]
        for k, own in enumerate(symbols):
            parameter, name = result.parameters[own], as_text(effect) if k == 0 else ""
            seen = parameter.value is not None and parameter.sigma is not None
            ratio = f"{parameter.value / parameter.sigma:.1f}" if seen else ""  # type: ignore[operator]
            rows.append((name, symbol(parameter.symbol), *with_sigma(parameter), ratio))
    headings = "effect", "coefficient", ">value", ">sigma", "unit", ">value / sigma"
    return table("Effects in the model (1σ)", headings, rows)


def with_sigma(parameter: Parameter, less: float = 0.0) -> tuple[str, str, str]:
    """Value (less another one), sigma and unit of a parameter or coefficient in a table, or that it was not seen."""
    if parameter.value is None or parameter.sigma is None:
        return "not seen", "", ""
    value, sigma = shown(parameter).rounded(parameter.value - less, parameter.sigma)
    return value, f"± {sigma}", shown(parameter).label


def p_cell(p_value: float | None) -> str:
    """A p-value in a table; empty where there is none."""
    return "" if p_value is None else format_p(p_value).removeprefix("= ")


def clearest(parameters: Iterable[Parameter]) -> str:
    """The parameter that stands out most from its sigma, in words; "" where none is known."""
    sized = [p for p in parameters if p.value is not None and p.sigma]
    if not sized:
        return ""
    largest = max(sized, key=lambda p: abs(p.value or 0.0) / (p.sigma or 1.0))
    return f"{symbol(largest.symbol)} = {shown(largest).with_sigma(largest.value or 0.0, largest.sigma or 0.0)}"


def model_table(model: Model) -> ConsoleTable:
    """The table of a model: the twelve parameters and every effect with its symbols, units and prior scales."""
    symbols = f"{symbol(paper_parameters.SYMBOLS[0])} ... {paper_parameters.SYMBOLS[-1]}"
    about = "misalignments, scale factors and biases", symbols, "rad, 1, m/s^2", "as stated"
    rows: list[tuple[str, ...]] = [("twelve parameters", *about)]
    ends = {0}
    for effect in model.effects:
        for k, row in enumerate(effect_rows(effect) or [("", "", "")]):
            rows.append((*((str(effect), effect.title) if k == 0 else ("", "")), *row))
        ends.add(len(rows) - 1)
    return table("Model", ("effect", "what it is", "coefficient", "unit", "prior scale"), rows, ends)


def effect_rows(effect: Effect) -> list[tuple[str, str, str]]:
    """Symbol, SI unit and prior scale of each coefficient of an effect; its constant has a range and no scale."""
    rows = [(symbol(c.symbol), c.unit, shown(c).text(c.scale).removesuffix(" 1")) for c in effect.coefficients]
    if (u := effect.unknown) is not None:
        rows.append((symbol(u.symbol), u.unit, f"{shown(u).number(u.low)} to {shown(u).text(u.high)}"))
    return rows


def size_range(sizes: tuple[float, float], coefficient: Coefficient) -> str:
    """Sizes of a coefficient from ... to (SI), as they are shown: ``1 to 20 µg/g²``, or ``up to 100 µg/g²``."""
    unit = shown(coefficient)
    if sizes[0] == sizes[1]:
        return unit.text(sizes[1])
    return f"{'up to' if sizes[0] == 0.0 else f'{unit.number(sizes[0])} to'} {unit.text(sizes[1])}"


def noise_table(result: Calibration) -> ConsoleTable:
    """The table of the noise model, with one column for each accelerometer."""
    noise, reading, angle = result.noise, shown("m/s^2"), shown("rad")
    within = [reading.number(each, zeros=True) for each in noise.sigma_mps2] if noise.within_seen else ["-"] * 3
    rows = [
        ("within a dwell" + ", not known" * (not noise.within_seen), *within, reading.label),
        ("inflation by correlation", *(f"{value:.3g}" for value in noise.inflation), "of variance"),
    ]
    scatter, setting = noise_origins(result)
    for name, origin, values, unit in (
        ("dwell to dwell", scatter, noise.scatter_mps2, reading),
        ("setting of angles", setting, np.full(3, noise.setting_rad), angle),
    ):
        cells = [unit.number(value, zeros=origin != "stated") for value in values]
        cells = ["-"] * 3 if origin in (_NOT_ESTIMATED, _NOT_USED) else cells
        rows.append((f"{name}, {origin}", *cells, unit.label))
    return table("Noise (1σ)", ("", *(f">accelerometer {i}" for i in (1, 2, 3)), "unit"), rows)


def noise_origins(result: Calibration) -> tuple[str, str]:
    """Whether scatter and setting error were stated, estimated or not estimated, in words."""
    noise = result.noise
    if noise.attitude_unknown:
        freedom = len(result.visits) - len(paper_parameters.SYMBOLS) + len(result.fixed)
    else:
        freedom = degrees_of_freedom(result.linearised.means, not result.bench.angles)
    few = freedom < FEWEST
    is_estimated = noise.scatter_mps2.any() or not few
    scatter = "stated" if noise.scatter.stated else "estimated" if is_estimated else _NOT_ESTIMATED
    if noise.attitude_unknown:
        return scatter, _NOT_USED
    if not noise.setting.stated:
        return scatter, _NOT_ESTIMATED if few or noise.setting.considered else "estimated"
    return scatter, "with the angles' noise" if beyond_stated(noise, result.bench) else "stated"


def verdict(result: Calibration, diagnosed: bool = False) -> str:
    """One or two sentences: whether model and measurements agree, and the held-out error beside the noise floor.

    Where a diagnosis, which tests more, is told after it, whether they agree is left to that: a run has one p.
    """
    judged = result.consistency
    if diagnosed:
        text = ""
    elif judged.p_value is None:
        taken = "All noise was estimated from the misfit, so that the misfit itself cannot be judged."
        text = taken if judged.dof else "Nothing is left over to judge the model by."
    else:
        word = "agree" if judged.consistent else "DISAGREE"
        word += f" if {judged.condition} (estimated from their misfit)" if judged.condition else ""
        what = "readings that change so much within dwells" if judged.trend else "a misfit this large"
        text = (
            f"Model and measurements {word}: noise alone gives {what} with probability "
            f"p {format_p(judged.p_value)} (NIS/dof = {judged.nis_per_dof:.3g})."
        )
    if result.held_out_rms_mps2 is not None and result.held_out_floor_mps2 is not None:
        unit = shown("m/s^2")
        text += (
            f" Orientations left out are predicted to {unit.text(result.held_out_rms_mps2, 2)} rms; "
            f"noise alone gives {unit.number(result.held_out_floor_mps2, 2)}."
        )
    return text.lstrip()


def intervals_in_words(result: Calibration) -> list[Text]:
    """A sentence on intervals that are wider than those of known noise; none where they are not."""
    sigmas = result.interval_sigmas[: len(paper_parameters.SYMBOLS)][~result.estimate.unseen]
    if not sigmas.size or sigmas.max() < _WIDER:
        return []
    width = " to ".join(dict.fromkeys([f"{sigmas.min():.2f}", f"{sigmas.max():.2f}"]))
    told = f"{len(result.fit.dwells)} dwells tell roughly how large the noise is that was not stated"
    return [Text(f"Intervals of 95 % are ± {width} sigma: {told}.")]


def summary(result: Calibration, diagnosed: bool = False) -> RenderableType:
    """The report that ``replay`` prints; diagnosed: whether a diagnosis is told after it."""
    counts, dwells = result.counts, result.fit.dwells
    head = (
        f"{counts.used - counts.gated} of {counts.read} readings used, {len(dwells)} dwells in "
        f"{len(orientations(dwells))} orientations ({counts.moving} readings moving, {counts.settling} settling)"
    )
    parts: list[RenderableType] = [
        head, *([] if result.bench.input.is_plain else [Text(f"Input: {result.bench.input}.")]),
        parameter_table(result), *intervals_in_words(result),
        *([effect_table(result)] if result.model.effects else []), noise_table(result),
        Text(verdict(result, diagnosed), style=VERDICT_STYLES[bool(result.consistency.unconditional)]),
    ]  # fmt: skip
    parts += [note(warning) for warning in result.warnings]
    parts += [without_table(result, found) for found in result.outlying]
    return Group(*parts)


def comparison_table(compared: Comparison) -> RenderableType:
    """The table that ``compare`` prints: time, memory and difference from the block engine of each way of computing."""
    rows = [
        (name, f"{way.wall_s:.3f}", f"{way.peak_mb:.1f}", f"{way.max_difference_sigma:.1e}",
         f"{way.max_relative_variance:.1e}")
        for name, way in compared.ways.items()
    ]  # fmt: skip
    headings = "way", ">wall s", ">peak MB", ">largest difference, σ", ">of diag P"
    return Group(table("The same recording, three ways", headings, rows), *map(note, compared.remarks))


def difference_in_words(pair: SideBySide) -> str:
    """In a sentence, by how much the parameters differ."""
    far = pair.farthest
    if far is None:
        return "The two have no parameter in common that both determine."
    most = f"{symbol(far.symbol)} differs most, by {abs(far.sigmas or 0.0):.1f} σ"
    if pair.p_value is None:
        return f"Between the two models, {most}."
    word = "agree" if pair.p_value >= LEVEL else "DIFFER"
    chance = f"noise alone gives differences as large with probability p {format_p(pair.p_value)}"
    return f"The parameters of the two recordings {word}: {chance}; {most}."


def difference_table(differences: Sequence[Difference], first: str, second: str) -> ConsoleTable:
    """The table of the parameters in both, less nominal, and of their differences; first, second: what they are of."""
    rows = list[tuple[str, ...]]()
    for difference in differences:
        both = [cell for each in (difference.first, difference.second) for cell in with_sigma(each, each.nominal)[:2]]
        moved = "", ""
        if difference.value is not None and difference.sigma is not None and difference.sigmas is not None:
            moved = shown(difference.first).rounded(difference.value, difference.sigma)[0], f"{difference.sigmas:+.1f}"
        rows.append((symbol(difference.symbol), *both, shown(difference.first).label, *moved))
    headings = "parameter", f">{first}", ">sigma", f">{second}", ">sigma", "unit", ">difference", ">in σ"
    return table("Parameters less nominal (1σ)", headings, rows, FOURS)


def plain(renderable: RenderableType, width: int = 110) -> str:
    """A renderable as plain text without colour or control characters, in lines of at most ``width`` characters."""
    out = io.StringIO()
    PlainConsole(file=out, width=width, no_color=True).print(renderable)
    return "\n".join(line.rstrip() for line in out.getvalue().splitlines())


printed.register(Calibration, lambda result: plain(summary(result)))
printed.register(Model, lambda model: plain(model_table(model)))
