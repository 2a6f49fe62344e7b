"""Options that commands share, and how they print."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import rich_click as click
from click import get_current_context  # rich_click declares that there may be none

from kf_calib.bench.keys import UNSTATED, BenchKeys, StatedBench, StatedInput
from kf_calib.cli.command import INPUT, MODEL, NOT_NEGATIVE, OUTPUT, POSITIVE, NumberInRange, argument, option
from kf_calib.cli.echo import complain
from kf_calib.cli.files import given, output_option
from kf_calib.errors import BenchError, InputError
from kf_calib.support.units import shown_in, si

if TYPE_CHECKING:
    from kf_calib.bench.raw_input import RawInput
    from kf_calib.bench.streams import Table
    from kf_calib.estimation.settings import Settings
    from kf_calib.sources.file_kind import FileKind
    from kf_calib.sources.files.recording import Recording
    from kf_calib.sources.text.lines import Lines
    from kf_calib.sources.text.units import Units

_of_input, _of_model, _of_output = (partial(option, panel=panel) for panel in (INPUT, MODEL, OUTPUT))

# fmt: off
NoAngles = Annotated[bool, _of_input(
    "--no-angles", help="Use no platform angles, only the size of gravity: nine parameters.")]
ForeignColumns = Annotated[tuple[str, ...], _of_input(
    "--column", metavar="THEIRS=OURS", help='Name of a foreign column: --column "acc x [g]=ax_g"; repeatable.')]
Device = Annotated[StatedInput, INPUT]
BenchModelFile = Annotated[Path | None, _of_model(
    "--bench-model", metavar="FILE.toml",
    help="Errors of the bench that many runs have shown: they are subtracted, and their sigma is considered.")]
CalibrationFile = Annotated[Path, argument(metavar="CAL")]
StatementFile = Annotated[Path | None, _of_input(
    "--statement", metavar="LAB.toml", help="What the laboratory states: docs/certificate.md has the keys.")]
Save = Annotated[Path | None, output_option(
    "--save", metavar="CAL.json", panel=OUTPUT,
    help="Save the calibration here, whole: for apply, verify, history, and --model.")]
SaveModel = Annotated[Path | None, output_option(
    "--save-model", metavar="FILE.toml", panel=OUTPUT, help="Save the model here, for --model to read.")]
Overwrite = Annotated[bool, _of_output("--overwrite", help="Replace files that exist already.")]
Strict = Annotated[bool, _of_output("--strict", help="Exit with 1 where model and measurements disagree.")]
Json = Annotated[bool, _of_output("--json", help="Print one JSON object, and nothing else.")]
target_option = partial(
    option, "--target", metavar="NAME=SIGMA",
    help="The sigma wanted of a parameter (theta1, K2), of a kind (theta, phi, nu, K, b) or of all angles, with a unit "
    "(2ppm, 20ug, 0.1arcsec); repeatable.")


def _show_in(ctx: click.Context, param: click.Parameter, system: Literal["field", "si"]) -> Literal["field", "si"]:
    ctx.with_resource(shown_in(system))
    return system


ShownUnits = Annotated[Literal["field", "si"], _of_output(
    "--units", default="field", show_default=True, callback=_show_in,
    help="Units that are printed and drawn: of the field (arcsec, ppm, µg) or SI.")]
"""It acts by itself: a command that has it need not look at it."""


@dataclass(frozen=True)
class BenchOptions:
    """The keys of the bench's record, for recordings that lack them; ``--bench`` reads them from a TOML file."""

    bench_file: Annotated[Path | None, _of_input(
        "--bench", metavar="FILE.toml", help="Bench keys from this file; the options below go before them.")] = None
    stated: Annotated[StatedBench, INPUT] = field(default_factory=StatedBench)

    @property
    def keys(self) -> BenchKeys:
        """Bench keys from the TOML file and, over them, from options."""
        from kf_calib.bench.keys import checked_keys

        keys = checked_keys(self.stated)
        return {**_bench_from_toml(self.bench_file), **keys} if self.bench_file else keys


# fmt: off
@dataclass(frozen=True)
class ReadingOptions:
    """How to read a recording: the bench, unit of the readings, and topics."""

    bench: BenchOptions = BenchOptions()
    device: Device = field(default_factory=StatedInput)
    angle_unit: Annotated[Literal["rad", "deg"] | None, _of_input(
        "--angle-unit", show_default="rad; in text, as the header or the numbers tell",
        help="Unit of the gimbal angles.")] = None
    no_angles: NoAngles = False
    g_unit: Annotated[str, _of_input(
        "--g-unit", metavar="M/S^2",
        help="What 1 g stands for in a table or a log in lines; local: gravity of the bench.")] = "9.80665"
    columns: ForeignColumns = ()
    rate_hz: Annotated[float | None, _of_input(
        "--rate", type=POSITIVE, metavar="HZ",
        help="Rows a second of a log in lines that has no column of time.")] = None
    where: Annotated[str | None, _of_input(
        "--where", metavar="COLUMN=VALUE",
        help="The rows of a table or a log in lines that count, where it has several sensors: --where I=0.")] = None
    accel_topic: Annotated[str | None, _of_input(
        "--accel-topic", metavar="TOPIC", help="Topic of the accelerometer, where there "
        "are several; or dataset of a container.")] = None
    pose_topic: Annotated[str | None, _of_input(
        "--pose-topic", metavar="TOPIC", help="Topic of the platform's angles or attitude.")] = None
    temperature_topic: Annotated[str | None, _of_input(
        "--temperature-topic", metavar="TOPIC", help="Topic of the temperature.")] = None
    fields: Annotated[tuple[str, ...], _of_input(
        "--field", metavar="WHAT=TOPIC:PATHS", help="Where numbers are in messages of another type, for example "
        "accel=/imu:acc.x,acc.y,acc.z; repeatable, for angles, attitude and temperature too.")] = ()
    max_chunk_mb: Annotated[float, _of_input(
        "--max-chunk-mb", type=POSITIVE, metavar="MB",
        help="Chunks of the file that unpack to more are passed over, and told.")] = 256

    # fmt: on
    @property
    def keys(self) -> BenchKeys:
        """Keys of the bench, with what its device sends."""
        return {**self.bench.keys, **self.device}

    @property
    def renamed(self) -> dict[str, str]:
        """Ours of each foreign column."""
        return renamed(self.columns)

    @property
    def angles(self) -> bool | None:
        """Whether platform angles count; None: where there are any, as no gimbals are stated."""
        if self.no_angles:
            return False
        is_stated = self.pose_topic or self.angle_unit or self.bench.keys.keys() & _OF_GIMBALS
        return True if is_stated else None

    def kind(self, path: Path) -> FileKind:
        from kf_calib.sources.opening import kind_of

        dataset = self.accel_topic or ""
        return kind_of(path, self.renamed, has_rate=self.rate_hz is not None, dataset=dataset)

    def units(self, input: RawInput | None = None, told: BenchKeys = UNSTATED, where: str = "") -> Units:
        """Units of a table or a log; told, where: bench keys, and rows that count, beside those of the options."""
        from kf_calib.sources.text.units import Units

        return replace(Units.of({**self.keys, **told}, self.angle_unit, self.g_unit, input),
                       rate_hz=self.rate_hz, where=where or self.where or "",
                       dataset=self.accel_topic or "")  # fmt: skip

    def messages(self, path: Path, angles: bool | None, input: RawInput | None = None) -> Recording:
        """The recording of samples at a path; angles: whether it must have angles."""
        from kf_calib.sources.files.recording import Recording

        return Recording(
            path,
            self.keys,
            input=input,
            angle_scale=si(f"1 {self.angle_unit or 'rad'}"),
            accel_topic=self.accel_topic,
            pose_topic=self.pose_topic,
            temperature_topic=self.temperature_topic,
            fields=self.fields,
            max_chunk_mb=self.max_chunk_mb,
            angles=angles,
        )

    def table(self, path: Path, told: BenchKeys, angles: bool | None, input: RawInput | None = None) -> Table:
        """The table at a path; told: bench keys beside those of the options. angles: whether orientations count."""
        from kf_calib.sources.text.means import open_table

        return open_table(path, {**told, **self.keys}, columns=self.renamed, angles=angles, input=input,
                          angle_unit=self.angle_unit, g_unit=self.g_unit, where=self.where or "",
                          dataset=self.accel_topic or "")  # fmt: skip

    def opened(self, path: Path, input: RawInput | None = None) -> Recording | Lines | Table:
        """The recording, log or table at a path; input: what the device sends, where nothing else states it."""
        from kf_calib.sources.file_kind import FileKind
        from kf_calib.sources.opening import no_recording

        columns, angles = self.renamed, self.angles
        match self.kind(path):
            case FileKind.TABLE:
                refuse_given(not_of_text(path) + OF_DWELLS + _OF_LINES, f"{path} is a table of mean readings")
                return self.table(path, {}, angles, input)
            case FileKind.SAMPLES:
                from kf_calib.sources.text.lines import Lines

                refuse_given(not_of_text(path), f"{path} is a log in lines of text")
                return Lines(path, self.keys, columns, units=self.units(input), angles=angles)
            case FileKind.RECORDING:
                refuse_given(_OF_TEXT, f"{path} is no table (.csv, .xlsx) and no log in lines of text")
                return self.messages(path, angles, input)
            case FileKind.CALIBRATION:
                raise no_recording(path)


# fmt: off
@dataclass(frozen=True)
class ProgramOptions:
    """Python files that may be run."""

    effects_from: Annotated[tuple[Path, ...], _of_model(
        "--effects-from", metavar="FILE.py",
        help="A Python file with effect classes of your own, for --with to name; repeatable. It is run.")] = ()
    trust: Annotated[bool, _of_model("--trust", help="Run the Python files that a model or a calibration "
                                     "names: they can do all that you can.")] = False


@dataclass(frozen=True)
class DwellOptions:
    """Which readings of a run count."""

    left_out: Annotated[tuple[int, ...], _of_model(
        "--leave-out", type=click.IntRange(min=1), metavar="DWELL",
        help="Number of a dwell that is not to be used; repeatable.")] = ()
    settle_s: Annotated[float, _of_model(
        "--settle-s", type=NOT_NEGATIVE,
        help="Seconds left out after each arrival; of a short dwell no more than a third.")] = 1.0
    still_deg: Annotated[float, _of_model(
        "--still-deg", type=POSITIVE,
        help="Motion within half a second that counts as standing still, deg; noisy angles may scatter more.")] = 0.05
    gate: Annotated[bool, _of_model("--gate/--no-gate", help="Reject outlying readings.")] = True
    gate_sigma: Annotated[float, _of_model(
        "--gate-sigma", type=NumberInRange(min=3), help="Where the gate stands, robust sigma.")] = 6.0

    # fmt: on
    def settings(self) -> Settings:
        """How readings are chosen; all else as usual."""
        from kf_calib.dwells.stationarity import Stillness
        from kf_calib.estimation.settings import Settings

        return Settings(
            stillness=Stillness(tolerance_deg=self.still_deg, settle_s=self.settle_s),
            gate_sigma=self.gate_sigma if self.gate else None,
            left_out=self.left_out,
        )


# fmt: off
@dataclass(frozen=True)
class EvaluationOptions:
    """How a run is evaluated."""

    effects: Annotated[tuple[str, ...], _of_model(
        "--with", metavar="EFFECT", help="An effect to put in the model, for example second-order, or a formula of "
        "your own, for example 'mine = fx*fy*T'; repeatable.")] = ()
    programs: ProgramOptions = ProgramOptions()
    model_file: Annotated[Path | None, _of_model(
        "--model", metavar="FILE",
        help="A model file (--save-model) or a calibration (--save); its effects come before those of --with.")] = None
    dwells: DwellOptions = DwellOptions()
    prior: Annotated[Literal["diffuse", "navigation", "mems"], _of_model(
        "--prior", help="What is believed of the sensors before the run.")] = "diffuse"
    bias_walk: Annotated[float, _of_model(
        "--bias-walk", type=NOT_NEGATIVE,
        help="Random walk of the biases, m/s^2 per square root of a second (process noise).")] = 0.0
    engine: Annotated[Literal["block", "filterpy"], _of_model(
        "--engine", help="Block square-root filter, or filterpy sample by sample.")] = "block"

    # fmt: on
    def settings(self, bench_model: Path | None = None) -> Settings:
        """The same for the library; bench_model: a file with the errors of the bench."""
        from kf_calib.estimation.settings import PRIORS

        effects, errors = self.effects_of_model(), None
        if bench_model is not None:
            from kf_calib.estimation.bench_model import read_bench_model

            errors = read_bench_model(bench_model)
        return replace(
            self.dwells.settings(),
            engine=self.engine,
            prior=PRIORS[self.prior],
            walk_mps2_per_sqrt_s=self.bias_walk,
            effects=effects,
            bench_model=errors,
        )

    def effects_of_model(self) -> tuple[str, ...]:
        """Effects of the model file, which is checked before a Python file is run, then those of ``--with``."""
        from kf_calib.effects import load_file, merged, refuse_unknown

        model = None
        if self.model_file is not None:
            from kf_calib.exchange import calibration_file

            model = calibration_file.read_model(self.model_file)
        for path in self.programs.effects_from:
            load_file(path)
        for text in self.effects:
            refuse_unknown(text)  # at once, not after a long recording was read
        if model is None:
            return self.effects
        for change in model.load(self.programs.effects_from, self.programs.trust):
            complain(f"{change}")
        return merged(model.effects, self.effects)


def opened(
    path: Path, reading: ReadingOptions, evaluation: EvaluationOptions, bench_model: Path | None = None
) -> tuple[Recording | Lines | Table, Settings]:
    """A recording, log or table, and how to evaluate it; an impossible model is refused before any reading is read."""
    from kf_calib.estimation.measurement_model import Model

    settings = evaluation.settings(bench_model)
    source = reading.opened(path)
    Model.of(source.bench, settings.effects, settings.bench_model)
    return source, settings


def renamed(columns: Sequence[str]) -> dict[str, str]:
    """Ours of each foreign column, from the texts of ``--column``."""
    pairs = dict[str, str]()
    for text in columns:
        theirs, equals, ours = text.rpartition("=")
        if not (equals and theirs and ours):
            raise InputError(f"--column {text!r} names no pair: write --column THEIRS=OURS, for example acc_x=ax_g.")
        pairs[theirs] = ours
    return pairs


def _bench_from_toml(path: Path) -> BenchKeys:
    from kf_calib.bench.bench import metadata_of
    from kf_calib.bench.keys import checked_keys
    from kf_calib.support.toml_files import toml_table

    content = toml_table(path, "gravity_mps2 = 9.81, numbers with a point")
    table = content.get("bench", content) if isinstance(content.get("bench"), dict) else content
    try:
        return checked_keys(metadata_of(table))
    except BenchError as error:
        raise BenchError(f"{path}: {error}") from None
    except (ValueError, RecursionError):
        raise BenchError(f"{path}: has a value that is too large for any key: write numbers and text.") from None


_OF_TEXT = ("columns", "g_unit", "rate_hz", "where")
_OF_LINES = ("rate_hz",)
_OF_GIMBALS = {"axes", "joints", "up", "reference", "azimuth_deg", "angle_sigma_deg"}
"""Keys of a bench by which its orientations must be known."""
OF_MESSAGES = ("accel_topic", "pose_topic", "temperature_topic", "fields", "max_chunk_mb")
OF_DWELLS = ("joints", "settle_s", "still_deg", "gate", "gate_sigma")
"""Options that act on text and spreadsheets only, on logs in lines only, on files of messages only, and where dwells
are to be found."""


def not_of_text(path: Path) -> tuple[str, ...]:
    """Options of messages, but for that by which the dataset of a container is chosen."""
    from kf_calib.sources.containers.opening import kind_of_container

    return OF_MESSAGES[kind_of_container(path) is not None :]


def refuse_given(names: Sequence[str], what: str) -> None:
    """Raise InputError for the first of these options that the command line has.

    In a worker of a fleet there is no command line: of recordings of several kinds, an option acts on those it can.
    """
    ctx = get_current_context(silent=True)
    if ctx is None:
        return
    for param, value in given(ctx):
        if param.name in names:
            name = [*param.opts, *param.secondary_opts][-1 if value is False else 0]
            raise InputError(f"{what}, on which {name} has nothing to act: leave it out.")


def exit_if(inconsistent: bool) -> None:
    """End the command as ``--strict`` asks."""
    if inconsistent:
        get_current_context().exit(1)
