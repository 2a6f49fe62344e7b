"""The command that says what is in a recording."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence, Set
from functools import partial
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated, TypeVar

import rich_click as click
from click.core import ParameterSource

from kf_calib.cli.command import argument, command
from kf_calib.cli.echo import print_result, progress
from kf_calib.cli.options import OF_DWELLS, Json, ReadingOptions, not_of_text
from kf_calib.errors import BenchError, BlunderError, CountsError, KfCalibError
from kf_calib.support.units import STANDARD_GRAVITY_MPS2

if TYPE_CHECKING:
    from kf_calib.bench.keys import BenchKeys
    from kf_calib.bench.raw_input import RawInput, WrongUnit
    from kf_calib.bench.streams import Source
    from kf_calib.dwells.rest_in_readings import DwellSummary
    from kf_calib.sources.files.inventory import Inventory
    from kf_calib.sources.text.units import Units
    from kf_calib.views.overview import Overview, TableOverview

Tick = Callable[[float], None]

_NAMED = {
    "axes": ('--axes "y z x"', "the gimbal axes, outer to inner: --axes, and what is up: --up (y if not stated)"),
    "gravity_mps2": ("--gravity 9.81", "local gravity: --gravity in m/s^2 (best), or --latitude in degrees"),
}
"""What a bench's description must have: how an option gives it, and what it is."""
_AXES = {1: '--axes "z"', 2: '--axes "z x"'}
"""The same of axes where there are so many angles."""
_BY_HAND = (
    "--no-angles",
    "orientations: no column was taken for gimbal angles{or_else} (--column says which is one); the command does "
    "without",
)


@command("info run.mcap", "info rosbag2_2026_05_04", "info log.csv --json")
@click.pass_context
def info(
    ctx: click.Context, recording: Annotated[Path, argument(metavar="FILE")], reading: ReadingOptions, as_json: Json
) -> None:
    """What is in a recording: topics, rates, gaps, dwells, what is missing to evaluate it, and the command to try.

    FILE is an MCAP file, the folder of a ROS 2 bag, a .db3 file, lines of CSV or JSON, a table of orientations,
    or a calibration.
    """
    from kf_calib.sources.file_kind import FileKind

    kind = reading.kind(recording)
    if kind is FileKind.CALIBRATION:
        from kf_calib.exchange.calibration_file import open_calibration
        from kf_calib.views.exchange import calibration_object, calibration_report

        saved = open_calibration(recording)
        print_result(as_json, calibration_object, calibration_report, saved, recording)
        return
    if kind is FileKind.TABLE:
        _show_table(ctx, recording, reading, as_json)
        return
    with progress(f"reading {recording.name}", as_json) as tick:
        if kind is FileKind.SAMPLES:
            overview = _with_counts(partial(_of_lines, ctx, recording, reading, tick))
        else:
            overview = _of_messages(ctx, recording, reading, tick)
    from kf_calib.views.overview import overview_object, overview_report

    print_result(as_json, overview_object, overview_report, overview)


Stated = Mapping[str, str]
AnyOverview = TypeVar("AnyOverview")


def _with_counts(show: Callable[[Stated, str], AnyOverview]) -> AnyOverview:
    """What is shown of a file, with what its readings tell of their counts; that is missing then, and has a reason."""
    stated, reason = dict[str, str](), ""
    while True:
        try:
            return show(stated, reason)
        except CountsError as error:
            if not error.keys.keys() - stated.keys():
                raise
            kept = {} if "counts" in error.keys else stated  # by which their size is another one
            stated, reason = {**kept, **error.keys}, " ".join([reason, str(error)]).strip()


def _options(told: Stated) -> list[str]:
    """The options that state what the readings tell."""
    from kf_calib.bench.raw_input import OPTIONS

    return [f"{OPTIONS.get(key, f'--{key}')} {_quoted(value)}" for key, value in told.items()]


def _bench_keys(told: Stated) -> BenchKeys:
    """What of it is of the bench: not which rows count."""
    from kf_calib.bench.keys import checked_keys

    return checked_keys({key: value for key, value in told.items() if key != "where"})


def _units(reading: ReadingOptions, told: Stated) -> Units:
    return reading.units(told=_bench_keys(told), where=told.get("where", ""))


def _in_words(keys: BenchKeys) -> dict[str, str]:
    from kf_calib.bench.bench import metadata_of

    return metadata_of(keys)


def _of_messages(ctx: click.Context, path: Path, reading: ReadingOptions, tick: Tick) -> Overview:
    """What is in files of messages."""
    from kf_calib.sources.files.inventory import inventory_of

    inventory = inventory_of(path, reading.fields)
    bench = inventory.bench | _in_words(reading.keys)
    fields = _fields(inventory)
    by_hand = inventory.has_readings and inventory.has_angles is None and not fields
    is_attitude = inventory.has_angles is False or any(" attitude=" in field for field in fields)
    lacking = _lacks(bench, not (is_attitude or by_hand or reading.no_angles))
    missing = {key: _NAMED[key][1] for key in lacking}
    dwells, warnings, wrong = None, list(inventory.warnings), None
    try:
        source = reading.messages(path, not reading.no_angles)
        dwells = _dwells(source, tick)
        warnings = list(dict.fromkeys([*warnings, *source.warnings]))
        wrong = _wrong_unit([dwell.norm_mps2 for dwell in dwells], source.bench.input)
    except BenchError as error:
        missing = missing or {"": str(error)}
    except KfCalibError as error:
        missing = {"": str(error), **missing}
    words = _given(ctx, _not_of(ctx, ("columns", "g_unit"))) + fields + [_NAMED[key][0] for key in lacking]
    words += ["--no-angles"] if by_hand and not reading.no_angles else []
    missing, words = _with_unit(missing, words, wrong)
    return _overview(inventory, bench, dwells, missing, words, warnings, lacking)


def _of_lines(
    ctx: click.Context, path: Path, reading: ReadingOptions, tick: Tick, told: Stated, reason: str
) -> Overview:
    """What is in a log of samples; what is not stated of the bench does not matter for what stands still.

    told: bench keys that nobody states and the readings tell, with the ``reason``.
    """
    from kf_calib.bench.keys import checked_keys
    from kf_calib.sources.files.inventory import inventory_of_lines
    from kf_calib.sources.text.lines import Lines

    missing, words = {"accel_scale": reason} if reason else {}, _given(ctx, _not_of(ctx, not_of_text(path)))
    words += _options(told)
    units = _units(reading, told)
    inventory = inventory_of_lines(path, reading.renamed, units)
    bench = inventory.bench | _in_words({**reading.keys, **_bench_keys(told)})
    angles = not reading.no_angles
    if angles and inventory.has_angles is None:
        angles, missing["angles"] = False, _BY_HAND[1].format(or_else=" or attitude")
        words.append(_BY_HAND[0])
    axes = _AXES.get(inventory.angles or 0, _NAMED["axes"][0])
    lacking = _lacks(bench, bool(inventory.has_angles) and angles)
    for key in lacking:
        missing[key] = _NAMED[key][1]
        words.append(axes if key == "axes" else _NAMED[key][0])
    provisional = {"axes": shlex.split(axes)[1]} if angles and inventory.has_angles else {}
    if not bench.get("latitude_deg"):
        provisional["gravity_mps2"] = str(STANDARD_GRAVITY_MPS2)
    is_bare = inventory.is_bare and not {"accel_unit", "accel_scale"} & bench.keys()
    if is_bare:
        provisional["accel_unit"] = "m/s2"
    dwells, warnings, wrong, source = None, list(inventory.warnings), None, None
    try:
        source = Lines(path, checked_keys(provisional | bench), reading.renamed, units=units, angles=angles)
        dwells = _dwells(source, tick)
        warnings = list(dict.fromkeys([*warnings, *source.warnings]))
        wrong = _wrong_unit([dwell.norm_mps2 for dwell in dwells], source.bench.input, are_named=not is_bare)
    except CountsError:
        raise
    except KfCalibError as error:
        missing = {"": str(error), **missing}
    if is_bare:
        missing["accel_unit"] = "the unit of the readings, which their names do not tell: --accel-unit or --accel-scale"
        words.append("--accel-unit m/s2" if wrong is None else wrong.option)
    else:
        missing, words = _with_unit(missing, words, wrong)
    if source is not None and dwells is not None and wrong is None:
        missing, words = _tried(source, missing, words)
    return _overview(inventory, bench, dwells, missing, words, warnings, lacking)


def _tried(source: Source, missing: dict[str, str], words: list[str]) -> tuple[dict[str, str], list[str] | None]:
    """What is missing, and the words of the command to try, after it was tried; None where no option would do."""
    from kf_calib.estimation.calibration import calibrate

    try:
        calibrate(source)
    except BlunderError as error:
        if "axes" in missing:  # those that were tried are an example
            return missing, words
        return {"": str(error), **missing}, [*words, error.options] if error.options else None
    except KfCalibError as error:
        return {"": str(error), **missing}, None
    return missing, words


def _wrong_unit(norms_mps2: Sequence[float], taken: RawInput, *, are_named: bool = False) -> WrongUnit | None:
    """What shows that readings at rest are in another unit than they are taken for; None where nothing does.

    are_named: whether names of columns tell the unit, too.
    """
    from kf_calib.bench.raw_input import LEVELS, wrong_unit

    level = median(norms_mps2) / STANDARD_GRAVITY_MPS2 if norms_mps2 else 1.0
    if LEVELS[0] <= level <= LEVELS[1] or level == 0.0:
        return None
    wrong = wrong_unit(level, taken, STANDARD_GRAVITY_MPS2)
    is_named = are_named and "--accel-unit" in wrong.option and "--restate-input" not in wrong.option
    return wrong._replace(option=wrong.option + " --restate-input") if is_named else wrong


def _with_unit(missing: dict[str, str], words: list[str], wrong: WrongUnit | None) -> tuple[dict[str, str], list[str]]:
    """What is missing, and the words of the command to try, with another unit in place of one that was given."""
    if wrong is None:
        return missing, words
    kept = [word for word in words if word.split()[0] not in wrong.option.split()]
    return missing | {"accel_unit": wrong.sentence + "."}, [*kept, wrong.option]


def _overview(
    inventory: Inventory,
    bench: dict[str, str],
    dwells: list[DwellSummary] | None,
    missing: dict[str, str],
    words: list[str] | None,
    warnings: list[str],
    lacking: Sequence[str],
) -> Overview:
    from kf_calib.views.overview import Overview

    if dwells is not None and not dwells:
        said = "a stretch in which the platform stands still: --still-deg says what counts as standing still"
        missing.setdefault("", said)
    command = _replay(inventory.path, words)
    return Overview(inventory, bench, dwells, list(missing.values()), command, warnings, _examples(command, lacking))


def _examples(command: str, lacking: Sequence[str]) -> tuple[str, ...]:
    """Return the options of a command that have example values."""
    return tuple(option for key in lacking if (option := _NAMED[key][0].split()[0]) in command)


def _replay(path: Path, words: Sequence[str] | None) -> str:
    """The command to try with these options; empty where there is none."""
    return "" if words is None else " ".join(["kf-calib replay", _quoted(str(path)), *words])


def _show_table(ctx: click.Context, path: Path, reading: ReadingOptions, as_json: bool) -> None:
    """Print what is in a table of orientations."""
    from kf_calib.views.overview import table_object, table_report

    overview = _with_counts(partial(_of_table, ctx, path, reading))
    print_result(as_json, table_object, table_report, overview)


def _of_table(ctx: click.Context, path: Path, reading: ReadingOptions, told: Stated, reason: str) -> TableOverview:
    """What is in a table of orientations; told, reason: as of ``_of_lines``."""
    from kf_calib.sources.text.means import Survey
    from kf_calib.views.overview import TableOverview

    stated: BenchKeys = {**reading.keys, **_bench_keys(told)}
    bench = _in_words(stated)
    table = Survey(path, stated, reading.renamed, _units(reading, told), angles=not reading.no_angles)
    lacking = _lacks(bench, table.orientation == "angles")
    missing = {"counts": reason} if reason else {}
    words = _given(ctx, _not_of(ctx, not_of_text(path) + OF_DWELLS))
    words += _options(told)
    if not table.columns.orientation and not reading.no_angles:
        words.append(_BY_HAND[0])
        missing["angles"] = _BY_HAND[1].format(or_else=", attitude or face")
    missing |= {key: _NAMED[key][1] for key in lacking}
    axes = _AXES.get(len(table.columns.angles), _NAMED["axes"][0])
    words += [axes if key == "axes" else _NAMED[key][0] for key in lacking]
    taken = table.evaluated.bench.input if table.evaluated else None
    wrong = taken and _wrong_unit([row["norm_mps2"] for row in table.described_rows], taken, are_named=True)
    missing, words = _with_unit(missing, words, wrong)
    if table.trouble:
        missing, words = {"": table.trouble, **missing}, None
    elif wrong is None:
        examples = {"axes": shlex.split(axes)[1], "gravity_mps2": str(STANDARD_GRAVITY_MPS2)}
        keys = _bench_keys({**{key: examples[key] for key in lacking}, **told})
        missing, words = _tried(reading.table(path, keys, bool(table.orientation)), missing, words)
    command = _replay(path, words)
    return TableOverview(table, bench, list(missing.values()), command, _examples(command, lacking))


def _lacks(bench: Mapping[str, str], has_angles: bool) -> list[str]:
    """Keys that the bench's description lacks."""
    keys = {"axes": has_angles and not bench.get("axes"),
            "gravity_mps2": not bench.get("gravity_mps2") and not bench.get("latitude_deg")}  # fmt: skip
    return [key for key, lacks in keys.items() if lacks]


def _dwells(source: Source, tick: Tick) -> list[DwellSummary]:
    from kf_calib.dwells.rest_in_readings import dwell_summaries

    return dwell_summaries(source, on_progress=tick)


def _not_of(ctx: click.Context, names: Sequence[str]) -> set[str]:
    """Names of the options but for these, and but for the form of what is printed."""
    return {param.name for param in ctx.command.params if param.name} - {*names, "as_json"}


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
    """How the numbers would be named that are in messages which tell what they have, but not what it is; a quaternion
    in them is taken for the attitude."""
    from kf_calib.sources.files.fields import attitude_in, has_time, known_fields
    from kf_calib.sources.text.names import meaning_of

    if not any(topic.paths for topic in inventory.topics):
        return []
    accel = [] if inventory.has_readings else ["--field accel=TOPIC:X,Y,Z@TIME"]
    if inventory.has_angles is not None:
        return accel
    unknown = [topic for topic in inventory.topics if known_fields(topic.schema) is None]  # an Imu has its own attitude
    quaternions = [(topic.name, path, has_time(topic.paths)) for topic in unknown if (path := attitude_in(topic.paths))]
    if not quaternions:
        may_be_angles = accel or any(meaning_of(path).ours == "angle" for each in unknown for path in each.paths)
        return [*accel, *(["--field angles=TOPIC:OUTER,MIDDLE,INNER@TIME"] if may_be_angles else [])]
    name, path, is_timed = max(quaternions, key=lambda each: each[2])
    return [*accel, f"--field attitude={name}:{path}{'' if is_timed else '@TIME'}"]
