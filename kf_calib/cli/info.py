"""The command that says what is in a recording."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Set
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

import rich_click as click
from click.core import ParameterSource

from kf_calib.cli.options import (
    BENCH_OPTIONS,
    examples,
    json_option,
    messages_of,
    overrides,
    pair,
    print_json,
    progress,
    recording_options,
    show,
    units_of,
)
from kf_calib.errors import BenchError, InputError, KfCalibError
from kf_calib.support.units import STANDARD_GRAVITY_MPS2

if TYPE_CHECKING:
    from kf_calib.bench.streams import Source
    from kf_calib.dwells.overview import DwellFound
    from kf_calib.sources.files.inventory import Inventory
    from kf_calib.sources.tables.survey import Survey
    from kf_calib.views.overview import Overview

_NAMED = {
    "axes": ('--axes "y z x"', "the gimbal axes, outer to inner: --axes"),
    "gravity_mps2": ("--gravity 9.81", "local gravity: --gravity in m/s^2 (best), or --latitude in degrees"),
}
"""What a bench's description must have: how an option gives it, and what it is."""


@click.command(epilog=examples("info run.mcap", "info rosbag2_2026_05_04", "info log.csv --json"))
@click.argument("recording", type=click.Path(path_type=Path), metavar="FILE")
@recording_options
@json_option
@click.pass_context
def info(ctx: click.Context, recording: Path, columns: tuple[str, ...], as_json: bool, **options: Any) -> None:
    """What is in a recording: topics, rates, gaps, dwells, what is missing to evaluate it, and the command to try.

    FILE is an MCAP file, the folder of a ROS 2 bag, a .db3 file, lines of CSV or JSON, or a table of orientations.
    """
    renamed = dict(map(pair, columns))
    table = _surveyed(recording, renamed, options)
    if table is not None:
        _show_table(ctx, table, options, as_json)
        return
    found = _overview(ctx, recording, renamed, as_json, options)
    from kf_calib.views.overview import overview_object, overview_report

    if as_json:
        print_json(overview_object(found))
    else:
        show(overview_report(found))


def _overview(
    ctx: click.Context, recording: Path, renamed: Mapping[str, str], as_json: bool, options: Mapping[str, Any]
) -> Overview:
    """What is in a recording of samples."""
    from kf_calib.sources.files.inventory import inventory_of
    from kf_calib.views.overview import Overview

    with progress(f"reading {recording.name}", as_json) as tick:
        inventory = inventory_of(recording, renamed, options["fields"])
        bench = {**inventory.bench, **overrides(options)}
        missing = _lacking(inventory, bench)
        dwells, warnings = None, list(inventory.warnings)
        try:
            source = _opened(inventory, renamed, options)
            dwells = _dwells(source, tick)
            warnings = list(dict.fromkeys([*warnings, *source.warnings]))
        except BenchError as error:
            missing = missing or {"": str(error)}
        except KfCalibError as error:
            missing = {"": str(error), **missing}
    if dwells is not None and not dwells:
        missing[""] = "a stretch in which the platform stands still: --still-deg says what counts as standing still"
    of_lines = {"bench_file", "columns", *BENCH_OPTIONS}
    taken = of_lines if inventory.is_lines else {name for name in ctx.params if name not in ("columns", "as_json")}
    words = [*_given(ctx, taken), *_fields(inventory), *(_NAMED[key][0] for key in missing if key in _NAMED)]
    words += ["--no-angles"] if _by_hand(inventory) and not options["no_angles"] else []
    return Overview(inventory, bench, dwells, list(missing.values()), _command(inventory, words), warnings)


def _surveyed(path: Path, columns: Mapping[str, str], options: Mapping[str, Any]) -> Survey | None:
    """What is in a table of orientations; None of any other file."""
    from kf_calib.sources.tables.opening import is_table, is_text
    from kf_calib.sources.tables.survey import survey

    if not is_table(path):
        return None
    try:
        return survey(path, overrides(options), columns, units_of(options))
    except InputError:
        if is_text(path) and _has_samples(path, columns):
            return None
        raise


def _has_samples(path: Path, columns: Mapping[str, str]) -> bool:
    """Whether a file that is no table has a header of samples."""
    from kf_calib.sources.files.inventory import inventory_of

    try:
        inventory_of(path, columns)
    except InputError:
        return False
    return True


def _show_table(ctx: click.Context, table: Survey, options: Mapping[str, Any], as_json: bool) -> None:
    """Print what is in a table of orientations."""
    from kf_calib.sources.tables.survey import LEAST, LEAST_WITHOUT_SIGMA
    from kf_calib.views.table_overview import TableOverview, table_object, table_report

    bench = overrides(options)
    lacking = _lacks(bench, table.orientation == "angles")
    least = LEAST if table.has_sigma else LEAST_WITHOUT_SIGMA
    missing = [*([table.trouble] if table.trouble else []), *(_NAMED[key][1] for key in lacking)]
    if table.count < least:
        missing.append(f"orientations: {table.count} rows are there, and {least} are the least")
    scale = list[str]()
    if table.rows and not table.has_unit:
        missing.append("the size of one count of the readings: --accel-scale, in m/s^2 or what --accel-unit says")
        level = median(row.norm_mps2 for row in table.rows)
        scale.append(f"--accel-scale {STANDARD_GRAVITY_MPS2 / level:.3g}")
    words = [*_given(ctx, {name for name in options if name != "as_json"} | {"columns"}),
             *(_NAMED[key][0] for key in lacking), *scale]  # fmt: skip
    command = " ".join(["kf-calib replay", _quoted(str(table.path)), *words])
    found = TableOverview(table, bench, missing, command)
    if as_json:
        print_json(table_object(found))
    else:
        show(table_report(found))


def _lacking(inventory: Inventory, bench: Mapping[str, str]) -> dict[str, str]:
    """What the bench's description lacks, by the key."""
    return {key: _NAMED[key][1] for key in _lacks(bench, inventory.has_angles is not False and not _by_hand(inventory))}


def _lacks(bench: Mapping[str, str], has_angles: bool) -> list[str]:
    """Keys that the bench's description lacks."""
    keys = {"axes": has_angles and not bench.get("axes"),
            "gravity_mps2": not bench.get("gravity_mps2") and not bench.get("latitude_deg")}  # fmt: skip
    return [key for key, lacks in keys.items() if lacks]


def _opened(inventory: Inventory, columns: Mapping[str, str], options: Mapping[str, Any]) -> Source:
    if not inventory.is_lines:
        return messages_of(inventory.path, options, not options["no_angles"])
    from kf_calib.sources.files.lines import Lines

    return Lines(inventory.path, overrides(options), columns)


def _dwells(source: Source, tick: Any) -> list[DwellFound]:
    from kf_calib.dwells.overview import dwells_found

    return dwells_found(source, on_progress=tick)


def _given(ctx: click.Context, taken: Set[str]) -> list[str]:
    """The options of this command line, as they were written, of those that the command to try takes."""
    words = list[str]()
    for param in ctx.command.params:
        name = param.name or ""
        is_given = ctx.get_parameter_source(name) is ParameterSource.COMMANDLINE
        if name in taken and is_given and isinstance(param, click.Option):
            value = ctx.params[name]
            if param.is_flag:
                words += [param.opts[0]]
                continue
            words += [f"{param.opts[0]} {_quoted(str(each))}" for each in
                      (value if isinstance(value, tuple) else [value])]  # fmt: skip
    return words


def _quoted(text: str) -> str:
    """As a word of a shell, in double quotes where these do: other shells know no single ones."""
    plain = shlex.quote(text)
    return plain if plain == text or any(each in text for each in '"$`\\!%') else f'"{text}"'


def _fields(inventory: Inventory) -> list[str]:
    """How the numbers would be named that are in messages which tell what they have, but not what it is."""
    if not any(topic.paths for topic in inventory.topics):
        return []
    accel = [] if inventory.has_readings else ["--field accel=TOPIC:X,Y,Z@TIME"]
    angles = [] if inventory.has_angles is not None else ["--field angles=TOPIC:OUTER,MIDDLE,INNER@TIME"]
    return accel + angles


def _by_hand(inventory: Inventory) -> bool:
    """Whether a recording has readings and nothing that could be angles, as that of a board turned by hand."""
    angles = inventory.has_angles is not None or any(topic.paths for topic in inventory.topics)
    return inventory.has_readings and not (inventory.is_lines or angles)


def _command(inventory: Inventory, words: list[str]) -> str:
    """The command that evaluates the recording; for lines the one that records them, which goes before."""
    path = _quoted(str(inventory.path))
    if not inventory.is_lines:
        return " ".join(["kf-calib replay", path, *words])
    made = _quoted(str(inventory.path.with_suffix(".mcap")))
    return f"{' '.join(['kf-calib record', made, path, *words])} && kf-calib replay {made}"
