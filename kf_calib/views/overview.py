"""What is in a recording, or in a table of orientations, as tables and as a JSON object."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Group, RenderableType
from rich.text import Text

from kf_calib.dwells.rest_in_readings import DwellSummary
from kf_calib.sources.containers.opening import ContainerKind
from kf_calib.sources.files.inventory import Inventory, Topic
from kf_calib.sources.text.means import Survey
from kf_calib.support.text import counted, cut
from kf_calib.views.json import members
from kf_calib.views.terminal import LINED, ConsoleTable, note, table

_FORMATS = {"mcap": "MCAP", "db3": "SQLite of ROS 2", "lines": "lines of text", "mcap+db3": "MCAP and SQLite of ROS 2"}
_FORMATS |= {"bag": "bag of ROS 1"} | {kind.name.lower(): f"a file of {kind.value}" for kind in ContainerKind}
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
_SHOWN = 40  # dwells
_PATHS = 12  # of a message


@dataclass(frozen=True)
class Overview:
    """What is in a recording or a table, what it lacks to be evaluated, and the command that evaluates it then.

    bench: keys of the file's record with those of options. examples: options of the command whose values nobody stated.
    dwells: of a recording; None where it cannot be said which there are.
    """

    content: Inventory | Survey
    bench: dict[str, str]
    missing: list[str]
    command: str
    examples: tuple[str, ...] = ()
    warnings: list[str] = field(default_factory=list[str])
    dwells: list[DwellSummary] | None = None


def overview_object(overview: Overview) -> dict[str, Any]:
    """One JSON object."""
    content = overview.content
    if isinstance(content, Inventory):
        dwells = overview.dwells
        keys = {
            "recording": content.path, "format": content.format,
            "files": content.files, "bytes": content.size,
            "topics": [_topic_object(topic) for topic in content.topics],
        }  # fmt: skip
    else:
        dwells = content.described_rows
        keys = {
            "recording": content.name, "format": "table", "files": [content.name],
            "bytes": Path(content.name).stat().st_size, "topics": [],
            "columns": content.described_columns, "orientation": content.orientation or None,
        }  # fmt: skip
    keys |= {"bench": overview.bench, "dwells": dwells}
    return keys | members(overview, "missing", "command", "examples", "warnings")


def _topic_object(topic: Topic) -> dict[str, Any]:
    return {
        "topic": topic.name,
        **members(topic, "schema", "encoding"),
        "messages": topic.count,
        **members(topic, "rate_hz", "first_ns", "last_ns", "gaps", "longest_gap_s", "longest_gap_at_s", "backward"),
        "fields": topic.paths,
    }


def overview_report(overview: Overview) -> RenderableType:
    """What ``info`` prints."""
    content, bench = overview.content, ", ".join(f"{key} = {value}" for key, value in overview.bench.items())
    is_recording = isinstance(content, Inventory)
    parts = _recording_parts(content) if is_recording else _table_parts(content)
    parts.append(Text(f"Bench: {bench or 'not described'}"))
    parts += _dwell_parts(overview.dwells) if is_recording else _orientation_parts(content)
    parts += [note(said) for said in overview.warnings]
    if not is_recording and content.described_rows and content.described_rows[0]["readings"] is None:
        parts.append(
            note(
                "no standard deviation with a number of readings is given, so that the noise will be taken from the "
                "misfit, and the misfit cannot be judged."
            )
        )
    parts += [Text(f"Missing: {said}") for said in overview.missing]
    return Group(*parts, *([Text(_proposal(overview))] if overview.command else []))


def _recording_parts(inventory: Inventory) -> list[RenderableType]:
    """Return kind, topics and messages."""
    kind = _FORMATS.get(inventory.format, inventory.format)
    files = f"{len(inventory.files)} files, " if len(inventory.files) > 1 else ""
    head = Text(f"{inventory.path}: {kind}, {files}{inventory.size / 1e6:.3g} MB")
    with_paths = [topic for topic in inventory.topics if topic.paths]
    messages = [
        Text(f"A message of {topic.name} has {', '.join(topic.paths[:_PATHS])}{' ...' * (len(topic.paths) > _PATHS)}")
        for topic in with_paths
    ]
    return [head, _topic_table(inventory.topics), *messages]


def _table_parts(survey: Survey) -> list[RenderableType]:
    """Return how many rows there are, and the columns."""
    head = f"{survey.name}: a table of orientations, {counted(len(survey.rows), 'row')}"
    rows = [(cut(each["header"], 40), cut(each["first"], 24), _quantity(each["meaning"]),
             _UNITS.get(each["unit"], each["unit"]), _TOLD[each["told_by"]])
            for each in survey.described_columns]  # fmt: skip
    return [Text(head), table("", ("column", "first cell", "taken for", "unit", "told"), rows, **LINED)]


def _proposal(overview: Overview) -> str:
    """Return the command to try, with what in it is only an example."""
    if not overview.examples:
        return f"{'Then try' if overview.missing else 'Try'}: {overview.command}"
    return f"Then try, with your own {' and '.join(overview.examples)}:\n{overview.command}"


def _topic_table(topics: Sequence[Topic]) -> ConsoleTable:
    rows = list[tuple[str, ...]]()
    begin = min((topic.first_ns for topic in topics if topic.first_ns is not None), default=0)
    for topic in topics:
        times = ["" if each is None else f"{(each - begin) / 1e9:.2f}" for each in (topic.first_ns, topic.last_ns)]
        rate = "" if topic.rate_hz is None else f"{topic.rate_hz:.4g}"
        kind = f"{topic.schema or 'no schema'} ({topic.encoding})" if topic.encoding else ""
        rows.append((topic.name, kind, str(topic.count), rate, *times, _gaps(topic)))
    return table("", ("topic", "type", ">messages", ">Hz", ">from s", ">to s", "gaps"), rows, **LINED)


def _gaps(topic: Topic) -> str:
    said = ["none"] if topic.count and not topic.gaps and not topic.backward else []
    if topic.gaps:
        said.append(f"{topic.gaps}, the longest {topic.longest_gap_s:.3g} s at {topic.longest_gap_at_s:.2f} s")
    if topic.backward:
        said.append(f"{topic.backward} times back")
    return ", ".join(said)


def _dwell_parts(dwells: Sequence[DwellSummary] | None) -> list[RenderableType]:
    """Return the dwells of a recording; nothing where it cannot be said which there are."""
    if not dwells:
        return [] if dwells is None else [Text("No dwell was found.")]
    lasts = [dwell.lasts_s for dwell in dwells]
    rows = [
        (str(dwell.number), f"{dwell.arrival_s:.2f}", f"{dwell.lasts_s:.2f}", str(dwell.readings),
         pose_text(dwell.pose) or up_text(dwell.up), f"{dwell.norm_mps2:.4f}")
        for dwell in dwells
    ]  # fmt: skip
    platform = ">platform" if dwells[0].pose else ">up by the readings"
    headings = ">dwell", ">at s", ">lasts s", ">readings", platform, ">norm m/s^2"
    return _first_rows(f"{len(dwells)} dwells of {min(lasts):.3g} to {max(lasts):.3g} s", headings, rows)


def _orientation_parts(survey: Survey) -> list[RenderableType]:
    """Return the orientations of a table; nothing where it cannot be evaluated."""
    rows = [
        (str(row["number"]), str(row["row"]), f"{row['at_s']:g}",
         row["face"] or pose_text(row["pose"]) or up_text(row["up"]), f"{row['norm_mps2']:.4f}",
         "" if row["readings"] is None else str(row["readings"]),
         "" if math.isnan(row["temperature_c"]) else f"{row['temperature_c']:.2f}")
        for row in survey.described_rows
    ]  # fmt: skip
    headings = ">dwell", ">row", ">at s", f">{_ORIENTATIONS[survey.orientation]}", ">norm m/s^2", ">readings", ">°C"
    return _first_rows(counted(len(rows), "orientation"), headings, rows) if rows else []


def _first_rows(title: str, headings: Sequence[str], rows: Sequence[tuple[str, ...]]) -> list[RenderableType]:
    """Return a table of the first rows with its title, and how many more there are."""
    more = [Text(f"and {len(rows) - _SHOWN} more, all of them by --json")] if len(rows) > _SHOWN else []
    return [Text(f"{title}:"), table("", headings, rows[:_SHOWN], **LINED), *more]


def up_text(up: Sequence[float]) -> str:
    """The direction that is up, in the axes of the accelerometers."""
    return " ".join(f"{part:+.2f}" for part in up)


def pose_text(pose: Sequence[float]) -> str:
    """Gimbal angles in degrees; an attitude as it is."""
    if len(pose) == 4:
        return " ".join(f"{each:.4f}" for each in pose)
    return " ".join(f"{round(math.degrees(each), 2) + 0.0:.2f}°" for each in pose)


def _quantity(meaning: str) -> str:
    """What ``names.Meaning`` and a number call a quantity, in words."""
    if not meaning:
        return "not used"
    if meaning[:1] in "asq" and len(meaning) == 2:
        name, component = _QUANTITIES[meaning[0]], meaning[1]
        if meaning[0] == "q":
            return f"{name} {component}"
        return name if component == "d" else f"accelerometer {'xyz'.index(component) + 1}, {name}"
    name, _, number = meaning.partition(" ")
    return f"{_QUANTITIES[name]}{' ' * bool(number)}{number}"
