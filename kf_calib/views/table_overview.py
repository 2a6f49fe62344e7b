"""What is in a table of orientations, as tables and as a JSON object."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Group, RenderableType
from rich.text import Text

from kf_calib.sources.tables.survey import ColumnFound, Survey
from kf_calib.support.plain_text import cut
from kf_calib.views.json import clean
from kf_calib.views.overview import pose_text, up_text
from kf_calib.views.tables import ConsoleTable
from kf_calib.views.terminal import note

_SHOWN = 40  # orientations
_ORIENTATIONS = {"angles": "gimbal angles", "attitude": "attitude", "face": "axis up", "": "up by the readings"}
_QUANTITIES = {
    "a": "mean", "s": "standard deviation", "angle": "gimbal angle", "face": "axis that points up",
    "time": "time", "count": "number of readings", "temperature": "temperature", "q": "attitude",
}  # fmt: skip
_TOLD = {
    "name": "by its name", "content": "by what stands in it", "size": "by its name, the unit by its numbers",
    "content and size": "by what stands in it, the unit by its numbers", "--column": "by --column", "": "",
}  # fmt: skip
_UNITS = {"c": "°C", "k": "K", "f": "°F", "count": "counts", "m/s2": "m/s^2"}


@dataclass(frozen=True)
class TableOverview:
    """What is in a table, what it lacks to be evaluated, and the command that evaluates it then. bench: its keys as
    options state them."""

    survey: Survey
    bench: dict[str, str]
    missing: list[str]
    command: str


def table_object(overview: TableOverview) -> dict[str, Any]:
    """One JSON object."""
    survey = overview.survey
    return clean(
        {
            "recording": str(survey.path), "format": "table", "files": [str(survey.path)],
            "bytes": survey.path.stat().st_size, "topics": [], "columns": [vars(column) for column in survey.columns],
            "orientation": survey.orientation or None, "bench": overview.bench,
            "dwells": [vars(row) | {"pose": list(row.pose), "up": list(row.up)} for row in survey.rows],
            "missing": overview.missing,
            "command": overview.command, "warnings": survey.warnings,
        }
    )  # fmt: skip


def table_report(overview: TableOverview) -> RenderableType:
    """What ``info`` prints of a table."""
    survey = overview.survey
    parts: list[RenderableType] = [
        Text(f"{survey.path}: a table of orientations, {_counted(survey.count, 'row')}"),
        _column_table(survey.columns),
    ]
    bench = ", ".join(f"{key} = {value}" for key, value in overview.bench.items())
    parts.append(Text(f"Bench: {bench or 'nothing is said of it'}"))
    if survey.rows:
        parts += [Text(f"{_counted(len(survey.rows), 'orientation')}:"), _row_table(survey)]
        if len(survey.rows) > _SHOWN:
            parts.append(Text(f"and {len(survey.rows) - _SHOWN} more, all of them by --json"))
    parts += [note(said) for said in survey.warnings]
    if survey.rows and not survey.has_sigma:
        parts.append(
            note(
                "no standard deviation with a number of readings is given, so that the noise will be taken from the "
                "misfit, and the misfit cannot be judged."
            )
        )
    parts += [Text(f"Missing: {said}") for said in overview.missing]
    parts.append(Text(f"{'Then try' if overview.missing else 'Try'}: {overview.command}"))
    return Group(*parts)


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'s' * (count != 1)}"


def _column_table(columns: Sequence[ColumnFound]) -> ConsoleTable:
    table = ConsoleTable(box=SIMPLE_HEAD, pad_edge=False)
    for heading in ("column", "first cell", "taken for", "unit", "told"):
        table.add_column(heading, justify="left")
    for survey in columns:
        unit = _UNITS.get(survey.unit, survey.unit)
        table.add_row(
            cut(survey.header, 40), cut(survey.first, 24), _quantity(survey.meaning), unit, _TOLD[survey.told_by]
        )
    return table


def _quantity(meaning: str) -> str:
    """What ``words.Meaning`` and a number call a quantity, in words."""
    if not meaning:
        return "not used"
    if meaning[:1] in "asq" and len(meaning) == 2:
        name, component = _QUANTITIES[meaning[0]], meaning[1]
        if meaning[0] == "q":
            return f"{name} {component}"
        return name if component == "d" else f"accelerometer {'xyz'.index(component) + 1}, {name}"
    name, _, number = meaning.partition(" ")
    return f"{_QUANTITIES[name]}{' ' * bool(number)}{number}"


def _row_table(survey: Survey) -> ConsoleTable:
    table = ConsoleTable(box=SIMPLE_HEAD, pad_edge=False)
    for heading in ("dwell", "row", "at s", _ORIENTATIONS[survey.orientation], "norm m/s^2", "readings", "°C"):
        table.add_column(heading, justify="right")
    for row in survey.rows[:_SHOWN]:
        table.add_row(
            str(row.number), str(row.row), f"{row.at_s:g}", row.face or pose_text(row.pose) or up_text(row.up),
            f"{row.norm_mps2:.4f}",
            "" if row.readings is None else str(row.readings),
            "" if math.isnan(row.temperature_c) else f"{row.temperature_c:.2f}",
        )  # fmt: skip
    return table
