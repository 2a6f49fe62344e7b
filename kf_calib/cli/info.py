"""The command that says what is in a recording."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated

import rich_click as click

from kf_calib.cli.command import argument, command
from kf_calib.cli.echo import print_result, progress
from kf_calib.cli.files import given, words_of
from kf_calib.cli.options import OF_DWELLS, Json, ReadingOptions, not_of_text
from kf_calib.errors import BenchError, BlunderError, CountsError, KfCalibError
from kf_calib.support.units import STANDARD_GRAVITY_MPS2

if TYPE_CHECKING:
    from kf_calib.bench.keys import BenchKeys
    from kf_calib.bench.raw_input import RawInput, WrongUnit
    from kf_calib.bench.streams import Source
    from kf_calib.dwells.rest_in_readings import DwellSummary
    from kf_calib.sources.files.inventory import Inventory
    from kf_calib.sources.text.means import Survey
    from kf_calib.sources.text.units import Units
    from kf_calib.views.overview import Overview

Tick = Callable[[float], None]

_NAMED = {
    "axes": ('--axes "y z x"', "the gimbal axes, outer to inner: --axes, and what is up: --up (y if not stated)"),
    "gravity_mps2": ("--gravity 9.81", "local gravity: --gravity in m/s^2 (best), or --latitude in degrees"),
}
"""What a bench's description must have: how an option gives it, and what it is."""
_AXES = {1: '--axes "z"', 2: '--axes "z x"'}
"""The same of axes where there are so many angles."""
_BY_HAND = (
    "orientations: no column was taken for gimbal angles{or_else} (--column says which is one); the command does "
    "without"
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
    from kf_calib.views.overview import overview_object, overview_report

    if kind is FileKind.TABLE:
        overview = _with_counts(partial(_of_table, ctx, recording, reading))
    else:
        with progress(f"reading {recording.name}", as_json) as tick:
            if kind is FileKind.SAMPLES:
                overview = _with_counts(partial(_of_lines, ctx, recording, reading, tick))
            else:
                overview = _of_messages(ctx, recording, reading, tick)
    print_result(as_json, overview_object, overview_report, overview)


Stated = Mapping[str, str]


def _with_counts(show: Callable[[Stated, str], Overview]) -> Overview:
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


@dataclass
class _Proposal:
    """What a file lacks to be evaluated, by bench key, and the options of the command to try.

    lacking: keys whose values in these options are examples. is_hopeless: no option would do.
    """

    words: list[str]
    missing: dict[str, str] = field(default_factory=dict[str, str])
    lacking: list[str] = field(default_factory=list[str])
    is_hopeless: bool = False

    def ask(self, key: str, what: str, *options: str) -> None:
        """Ask for what an option states."""
        self.missing[key] = what
        self.words += options

    def ask_for_bench(self, bench: Mapping[str, str], has_angles: bool, gimbals: int = 0) -> None:
        """Ask for what a bench's description lacks; gimbals: their number, where it is known."""
        if has_angles and not bench.get("axes"):
            self.lacking.append("axes")
        if not bench.get("gravity_mps2") and not bench.get("latitude_deg"):
            self.lacking.append("gravity_mps2")
        for key in self.lacking:
            option, what = _NAMED[key]
            self.ask(key, what, _AXES.get(gimbals, option) if key == "axes" else option)

    def ask_for_unit(self, wrong: WrongUnit | None) -> None:
        """Ask for another unit in place of one that was given."""
        if wrong is not None:
            self.words = [word for word in self.words if word.split()[0] not in wrong.option.split()]
            self.ask("accel_unit", wrong.sentence + ".", wrong.option)

    def refuse(self, error: KfCalibError | str) -> None:
        """Put first why it cannot be evaluated."""
        self.missing = {"": str(error), **self.missing}

    def try_out(self, source: Source) -> None:
        """Evaluate the file; where that fails, say why, and what would help."""
        from kf_calib.estimation.calibration import calibrate

        try:
            calibrate(source)
        except BlunderError as error:
            if "axes" not in self.missing:  # else those that were tried are an example
                self.refuse(error)
                self.words.append(error.options)
                self.is_hopeless = not error.options
        except KfCalibError as error:
            self.refuse(error)
            self.is_hopeless = True

    def overview(
        self, path: Path, content: Inventory | Survey, bench: dict[str, str], warnings: list[str],
        dwells: list[DwellSummary] | None = None,
    ) -> Overview:  # fmt: skip
        """What is shown of the file; its dwells are those of a recording."""
        from kf_calib.views.overview import Overview

        if dwells is not None and not dwells:
            said = "a stretch in which the platform stands still: --still-deg says what counts as standing still"
            self.missing.setdefault("", said)
        command = "" if self.is_hopeless else " ".join(["kf-calib replay", _quoted(str(path)), *self.words])
        named = (_NAMED[key][0].split()[0] for key in self.lacking)
        examples = tuple(option for option in named if option in command)
        return Overview(content, bench, list(self.missing.values()), command, examples, warnings, dwells)


def _of_messages(ctx: click.Context, path: Path, reading: ReadingOptions, tick: Tick) -> Overview:
    """What is in files of messages."""
    from kf_calib.sources.files.inventory import inventory_of

    inventory = inventory_of(path, reading.fields)
    bench = inventory.bench | _in_words(reading.keys)
    fields = _fields(inventory)
    by_hand = inventory.has_readings and inventory.has_angles is None and not fields
    is_attitude = inventory.has_angles is False or any(" attitude=" in field for field in fields)
    proposal = _Proposal(_given(ctx, ("columns", "g_unit")) + fields)
    proposal.ask_for_bench(bench, not (is_attitude or by_hand or reading.no_angles))
    if by_hand and not reading.no_angles:
        proposal.words.append("--no-angles")
    dwells, warnings = None, list(inventory.warnings)
    try:
        dwells, warnings, wrong = _at_rest(reading.messages(path, not reading.no_angles), warnings, tick)
        proposal.ask_for_unit(wrong)
    except BenchError as error:
        proposal.missing = proposal.missing or {"": str(error)}
    except KfCalibError as error:
        proposal.refuse(error)
    return proposal.overview(inventory.path, inventory, bench, warnings, dwells)


def _of_lines(
    ctx: click.Context, path: Path, reading: ReadingOptions, tick: Tick, told: Stated, reason: str
) -> Overview:
    """What is in a log of samples; what is not stated of the bench does not matter for what stands still.

    told: bench keys that nobody states and the readings tell, with the ``reason``.
    """
    from kf_calib.bench.keys import checked_keys
    from kf_calib.sources.files.inventory import inventory_of_lines
    from kf_calib.sources.text.lines import Lines

    proposal = _Proposal(_given(ctx, not_of_text(path)) + _options(told))
    proposal.missing |= {"accel_scale": reason} if reason else {}
    units = _units(reading, told)
    inventory = inventory_of_lines(path, reading.renamed, units)
    bench = inventory.bench | _in_words({**reading.keys, **_bench_keys(told)})
    angles = not reading.no_angles
    if angles and inventory.has_angles is None:
        angles = False
        proposal.ask("angles", _BY_HAND.format(or_else=" or attitude"), "--no-angles")
    has_gimbals, gimbals = bool(inventory.has_angles) and angles, inventory.angles or 0
    proposal.ask_for_bench(bench, has_gimbals, gimbals)
    provisional = {"axes": _axes_of(gimbals)} if has_gimbals else {}
    if not bench.get("latitude_deg"):
        provisional["gravity_mps2"] = str(STANDARD_GRAVITY_MPS2)
    is_bare = inventory.is_bare and not {"accel_unit", "accel_scale"} & bench.keys()
    if is_bare:
        provisional["accel_unit"] = "m/s2"
    dwells, warnings, wrong, source = None, list(inventory.warnings), None, None
    try:
        source = Lines(path, checked_keys(provisional | bench), reading.renamed, units=units, angles=angles)
        dwells, warnings, wrong = _at_rest(source, warnings, tick, are_named=not is_bare)
    except CountsError:
        raise
    except KfCalibError as error:
        proposal.refuse(error)
    if is_bare:
        what = "the unit of the readings, which their names do not tell: --accel-unit or --accel-scale"
        proposal.ask("accel_unit", what, "--accel-unit m/s2" if wrong is None else wrong.option)
    else:
        proposal.ask_for_unit(wrong)
    if source is not None and dwells is not None and wrong is None:
        proposal.try_out(source)
    return proposal.overview(inventory.path, inventory, bench, warnings, dwells)


def _of_table(ctx: click.Context, path: Path, reading: ReadingOptions, told: Stated, reason: str) -> Overview:
    """What is in a table of orientations; told, reason: as of ``_of_lines``."""
    from kf_calib.sources.text.means import Survey

    stated: BenchKeys = {**reading.keys, **_bench_keys(told)}
    bench = _in_words(stated)
    table = Survey(path, stated, reading.renamed, _units(reading, told), angles=not reading.no_angles)
    proposal = _Proposal(_given(ctx, not_of_text(path) + OF_DWELLS) + _options(told))
    proposal.missing |= {"counts": reason} if reason else {}
    if not table.columns.orientation and not reading.no_angles:
        proposal.ask("angles", _BY_HAND.format(or_else=", attitude or face"), "--no-angles")
    gimbals = len(table.columns.angles)
    proposal.ask_for_bench(bench, table.orientation == "angles", gimbals)
    taken = table.evaluated.bench.input if table.evaluated else None
    wrong = taken and _wrong_unit([row["norm_mps2"] for row in table.described_rows], taken, are_named=True)
    proposal.ask_for_unit(wrong)
    if table.trouble:
        proposal.refuse(table.trouble)
        proposal.is_hopeless = True
    elif wrong is None:
        examples = {"axes": _axes_of(gimbals), "gravity_mps2": str(STANDARD_GRAVITY_MPS2)}
        keys = _bench_keys({**{key: examples[key] for key in proposal.lacking}, **told})
        proposal.try_out(reading.table(path, keys, bool(table.orientation)))
    return proposal.overview(path, table, bench, table.warnings)


def _axes_of(gimbals: int) -> str:
    """Axes that as many gimbals may have."""
    return shlex.split(_AXES.get(gimbals, _NAMED["axes"][0]))[1]


def _at_rest(
    source: Source, warnings: list[str], tick: Tick, *, are_named: bool = False
) -> tuple[list[DwellSummary], list[str], WrongUnit | None]:
    """The dwells of a source, all that was told with what it tells, and the unit that its readings rather have.

    are_named: whether names of columns tell the unit, too.
    """
    from kf_calib.dwells.rest_in_readings import dwell_summaries

    dwells = dwell_summaries(source, on_progress=tick)
    wrong = _wrong_unit([dwell.norm_mps2 for dwell in dwells], source.bench.input, are_named=are_named)
    return dwells, list(dict.fromkeys([*warnings, *source.warnings])), wrong


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


def _given(ctx: click.Context, less: Sequence[str]) -> list[str]:
    """The options of this command line, as they were written, but for those that the command to try does not take."""
    return [
        " ".join([option, *map(_quoted, value)])
        for param, values in given(ctx)
        if isinstance(param, click.Option) and param.name not in (*less, "as_json")
        for option, *value in words_of(param, values)
    ]


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
