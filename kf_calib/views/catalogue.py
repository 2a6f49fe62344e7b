"""The catalogue of effects as a table, in detail, and as JSON objects."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from typing import Any

from rich.console import Group, RenderableType
from rich.text import Text

from kf_calib.effects import Bearer, Effect, as_text, remarks_of
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.observability import Visibility
from kf_calib.support.units import shown
from kf_calib.views.console import GRADES, effect_rows, size_range
from kf_calib.views.json import members
from kf_calib.views.notation import symbol
from kf_calib.views.terminal import BARE, LINED, table

_BEARERS = {
    Bearer.BENCH: "the bench, never sensors",
    Bearer.SENSORS: "sensors, never the bench",
    Bearer.EITHER: "the bench or sensors",
}


def overview(effects: Sequence[Effect]) -> RenderableType:
    """The table that ``effects`` prints, with one line for each effect.

    A line has the name of the effect, what it is, its coefficients and their unit, and the effects it is confused with.
    """
    rows = [
        (str(effect), effect.title, _symbols(effect), ", ".join(dict.fromkeys(c.unit for c in effect.coefficients)),
         effect.confused_with)
        for effect in effects
    ]  # fmt: skip
    headings = "effect", "what it is", "coefficients", "unit", "confused with"
    whole = "effect", "coefficients", "unit"
    return Group(
        table(f"{len(effects)} effects", headings, rows, whole=whole, **LINED),
        Text("kf-calib effects NAME shows one in detail; kf-calib replay RECORDING --with NAME adds it."),
    )


def _symbols(effect: Effect) -> str:
    """Return the symbols of the coefficients of an effect, shortened where there are more than three."""
    symbols = [symbol(coefficient.symbol) for coefficient in effect.coefficients]
    stem = symbols[0][:-1] if symbols else ""
    if symbols == [f"{stem}{i}" for i in (1, 2, 3)]:
        symbols = [f"{symbols[0]}..3"]
    symbols = symbols if len(symbols) <= 3 else [symbols[0], "...", symbols[-1]]
    return " ".join([*symbols, *([symbol(effect.unknown.symbol)] if effect.unknown is not None else [])])


def details(effects: Sequence[Effect]) -> RenderableType:
    """The report that ``effects NAME`` prints: formula, coefficients, prior scales, source and remarks of effects."""
    return Group(*(part for effect in effects for part in _detail(effect)))


def _detail(effect: Effect) -> list[RenderableType]:
    """Return the report of one effect, part by part."""
    coefficients = table("", ("coefficient", "unit", "prior scale"), effect_rows(effect), **BARE, header_style="")
    lines = [f"reading i is larger by: {formula_of(effect)}", f"source: {effect.source}"]
    lines.append(f"borne by: {_BEARERS[effect.borne_by]}")
    if effect.confused_with:
        lines.append(f"confused with: {effect.confused_with}")
    known = [(words, effect.typical.of(grade)) for grade, words in GRADES.items()]
    sizes = [f"{size_range(own, effect.coefficients[0])} ({words})" for words, own in known if own is not None]
    lines += [f"typical size: {', '.join(sizes)}"] if sizes else []
    lines += [f"note: {remark}" for remark in remarks_of(effect)]
    head = Text(f"{effect}: {effect.title}", style="bold")
    return [head, *map(Text, lines), *([coefficients] if coefficients.rows else []), Text()]


def formula_of(effect: Effect) -> str:
    """What an effect adds to a reading: the user's formula, or the first paragraph of the docstring of its class."""
    text = as_text(effect)
    if "=" in text:
        return f"{effect.coefficients[0].symbol[:-1]}i * ({text.partition('=')[2].strip()})"
    own = inspect.cleandoc(type(effect).__doc__ or "not said")
    return " ".join(own.split("\n\n")[0].split()).rstrip(".")


def sight_report(sights: Sequence[Visibility], model: Model, name: str) -> RenderableType:
    """The report that ``effects --recording`` prints: how well a run shows each effect, and notes below the table.

    sights: one for each effect. model: of the run. name: of the recording.
    """
    about = f"What {name} shows of {len(sights)} effects beside {model.sum}"
    headings = "effect", "visible", ">left of it", "smallest size", "confused with (overlap)"
    seen = table(about, headings, map(_sight_cells, sights), whole=("effect", "left of it"), **LINED)
    notes = [f"{sight.effect}: {words}." for sight in sights for words in (sight.why, sight.degeneracy) if words]
    notes += [f"{sight.effect}: not determined: {' '.join(sight.unseen)}." for sight in sights if sight.unseen]
    explained = "Smallest sizes would be found in 9 of 10 such runs. Overlap 1: this run cannot tell the two apart."
    return Group(seen, Text(explained), *map(Text, notes))


def _sight_cells(sight: Visibility) -> list[str]:
    """Return the cells of one effect in that table."""
    visible = {True: "yes", False: "no", None: "-"}[sight.visible]
    cells = [str(sight.effect), visible, "" if sight.share is None else f"{sight.share:.2g}"]
    if sight.smallest is None:
        cells.append("")
    else:
        own, size = sight.smallest
        cells.append(f"{shown(own).text(size)}{sight.at}")
    return [*cells, ", ".join(f"{name} ({overlap:.2f})" for name, overlap in sight.rivals)]


def sights_object(sights: Sequence[Visibility], model: Model, name: str) -> dict[str, Any]:
    """The JSON object of ``effects --recording``: each effect of the catalogue and how well the run shows it; arguments
    as for ``sight_report``."""
    effects = [{**_object(each.effect), **_seen_object(each)} for each in sights]
    return {"model": list(map(str, model.effects)), "effects": effects}


def _seen_object(sight: Visibility) -> dict[str, Any]:
    """Return how well a run shows one effect, as a JSON object."""
    smallest = None
    if sight.smallest is not None:
        own, size = sight.smallest
        smallest = {"symbol": own.symbol, "size": size, "unit": own.unit, "at": sight.at_value}
    return {
        "visible": sight.visible,
        "share_left": sight.share,
        "not_determined": sight.unseen,
        "smallest": smallest,
        "overlaps": dict(sight.rivals),
        **members(sight, "degeneracy", "why"),
    }


def effects_object(effects: Sequence[Effect]) -> dict[str, Any]:
    """The JSON object of ``effects``."""
    return {"effects": [_object(effect) for effect in effects]}


def _object(effect: Effect) -> dict[str, Any]:
    """Return one effect of the catalogue as a JSON object."""
    unknown = effect.unknown
    return {
        "effect": str(effect),
        "title": effect.title,
        "formula": formula_of(effect),
        "coefficients": [
            members(each, "symbol", "unit", "scale", "shown_unit", "per_si") for each in effect.coefficients
        ],
        "unknown": None if unknown is None else members(unknown, "symbol", "unit", "low", "high"),
        "typical": effect.typical,
        "borne_by": effect.borne_by.value,
        **members(effect, "confused_with", "source"),
        "remarks": remarks_of(effect),
    }
