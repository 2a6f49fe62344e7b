"""Options that commands share, and how they print."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import rich_click as click
from click import get_current_context  # rich_click declares that there may be none
from click.core import ParameterSource

from kf_calib.cli.command import INPUT, MODEL, NOT_NEGATIVE, NUMBER, OUTPUT, POSITIVE, NumberInRange
from kf_calib.cli.echo import complain
from kf_calib.cli.files import output_option
from kf_calib.errors import BenchError, InputError
from kf_calib.support.units import shown_in, si

if TYPE_CHECKING:
    from kf_calib.bench.raw_input import RawInput
    from kf_calib.estimation.bench_model import BenchModel
    from kf_calib.estimation.settings import Settings
    from kf_calib.sources.files.lines import Lines
    from kf_calib.sources.files.recording import Recording
    from kf_calib.sources.tables.table import Table
    from kf_calib.sources.units import Units

F = TypeVar("F", bound=Callable[..., Any])

BENCH_OPTIONS = {
    "axes": ("--axes", str, "AXES", 'Gimbal axes, outer to inner, for example "y z x".'),
    "joints": ("--joints", str, "NAMES", 'Names of the gimbals among the joints of a bag, outer to inner, as "outer '
               'middle inner".'),
    "up": ("--up", str, "AXIS", "Axis that points up when all angles are zero: y (the default; accelerometer 2 reads "
           "+g), z as in ROS, x, -x, -y or -z."),
    "channels": ("--channels", str, "N,N,N", "Which channel accelerometer 1, 2, 3 is, with a minus where its sign is "
                 "reversed: 1,-2,3; a calibration remembers it."),
    "gravity_mps2": ("--gravity", NUMBER, "M/S^2", "Local gravity, m/s^2."),
    "latitude_deg": ("--latitude", NUMBER, "DEG", "Latitude, deg; gives normal gravity where --gravity is not stated."),
    "height_m": ("--height", NUMBER, "M", "Height, m, for normal gravity; 0 where it is not stated."),
    "angle_sigma_deg": (
        "--angle-sigma", NOT_NEGATIVE, "DEG",
        "How well an orientation repeats, 1 sigma, deg (0: exactly); estimated where it is not stated.",
    ),
    "scatter_sigma_mps2": (
        "--scatter-sigma", NOT_NEGATIVE, "M/S^2",
        "Scatter of each sensor from dwell to dwell, 1 sigma, m/s^2; estimated where it is not stated.",
    ),
    "square_sigma_deg": (
        "--square-sigma", POSITIVE, "DEG",
        "How square the axes of the accelerometers are, 1 sigma, deg, where --no-angles cannot tell; 1 if not stated.",
    ),
    "reference": (
        "--reference", str, "WORD",
        "base: angles are relative to the bench (usual); inertial: stabilised platform.",
    ),
    "azimuth_deg": ("--azimuth", NUMBER, "DEG", "Azimuth of the bench's x axis from North toward East, deg."),
    "date": ("--date", str, "DATE", "When the run began, ISO 8601 (UTC), where its stamps are no dates or wrong ones."),
    "nominal": ("--nominal", str, "JSON", "Nominal parameters that differ, for example '{\"theta1\": 0}'."),
}  # fmt: skip
_ANGLE_UNITS, _ACCEL_UNITS = ("rad", "deg"), ("m/s2", "g", "mg", "ug")


def bench_options(command: F) -> F:
    """The keys of the bench's record, for recordings that lack them; ``--bench`` reads them from a TOML file."""
    for key, (name, kind, metavar, text) in reversed(BENCH_OPTIONS.items()):
        command = click.option(name, key, type=kind, metavar=metavar, default=None, help=text, panel=INPUT)(command)
    return click.option(
        "--bench", "bench_file", type=click.Path(path_type=Path), metavar="FILE.toml", panel=INPUT,
        help="Bench keys from this file; the options below go before them.",
    )(command)  # fmt: skip


columns_option = click.option(
    "--column", "columns", multiple=True, metavar="THEIRS=OURS", panel=INPUT,
    help='Name of a foreign column: --column "acc x [g]=ax_g"; repeatable.',
)  # fmt: skip


def pair(text: str) -> tuple[str, str]:
    """Theirs and ours of a ``--column``."""
    theirs, equals, ours = text.rpartition("=")
    if not (equals and theirs and ours):
        raise InputError(f"--column {text!r} names no pair: write --column THEIRS=OURS, for example acc_x=ax_g.")
    return theirs, ours


no_angles_option = click.option(
    "--no-angles", is_flag=True, panel=INPUT,
    help="Use no platform angles, only the size of gravity: nine parameters.",
)  # fmt: skip


def input_options(command: F) -> F:
    """What the device sends: the unit of its readings, the size of a count; ``--channels`` is of the bench's keys."""
    options = [
        click.option("--accel-unit", type=click.Choice(_ACCEL_UNITS), show_default="m/s2; in text, as the header or "
                     "the numbers tell", help="Unit of the readings; a calibration remembers it.", panel=INPUT),
        click.option("--accel-scale", type=POSITIVE, show_default="1", panel=INPUT,
                     help="Size of one count, in the unit of the readings; a calibration remembers it."),
        click.option("--restate-input", is_flag=True, panel=INPUT,
                     help="What is stated of channels, unit and count was wrong: the options go before it."),
    ]  # fmt: skip
    for option in reversed(options):
        command = option(command)
    return command


def recording_options(command: F) -> F:
    """How to read a recording: the bench, unit of the readings, and topics."""
    options = [
        input_options,
        click.option("--angle-unit", type=click.Choice(_ANGLE_UNITS), show_default="rad; in text, as the header or "
                     "the numbers tell", help="Unit of the gimbal angles.", panel=INPUT),
        no_angles_option,
        click.option("--g-unit", metavar="M/S^2", default="9.80665", show_default=True,
                     help="What 1 g stands for in a table or a log in lines; local: gravity of the bench.",
                     panel=INPUT),
        columns_option,
        click.option("--accel-topic", metavar="TOPIC", help="Topic of the accelerometer, where there are several.",
                     panel=INPUT),
        click.option("--pose-topic", metavar="TOPIC", help="Topic of the platform's angles or attitude.", panel=INPUT),
        click.option("--temperature-topic", metavar="TOPIC", help="Topic of the temperature.", panel=INPUT),
        click.option("--field", "fields", multiple=True, metavar="WHAT=TOPIC:PATHS", panel=INPUT,
                     help="Where numbers are in messages of another type, for example accel=/imu:acc.x,acc.y,acc.z; "
                     "repeatable, for angles, attitude and temperature too."),
        click.option("--max-chunk-mb", type=POSITIVE, default=256, show_default=True, metavar="MB", panel=INPUT,
                     help="Chunks of the file that unpack to more are passed over, and told."),
    ]  # fmt: skip
    for option in reversed(options):
        command = option(command)
    return bench_options(command)


save_model_option = output_option(
    "--save-model", metavar="FILE.toml", help="Save the model here, for --model to read.", panel=OUTPUT
)
save_option = output_option(
    "--save", metavar="CAL.json", panel=OUTPUT,
    help="Save the calibration here, whole: for apply, verify, history, and --model.",
)  # fmt: skip
overwrite_option = click.option("--overwrite", is_flag=True, help="Replace files that exist already.", panel=OUTPUT)
effects_from_option = click.option(
    "--effects-from", "effects_from", multiple=True, type=click.Path(path_type=Path), metavar="FILE.py", panel=MODEL,
    help="A Python file with effect classes of your own, for --with to name; repeatable. It is run.",
)  # fmt: skip
trust_option = click.option(
    "--trust", is_flag=True, panel=MODEL,
    help="Run the Python files that a model, a calibration or a journal names: they can do all that you can.",
)  # fmt: skip


def dwell_options(command: F) -> F:
    """Which readings of a run count."""
    options = [
        click.option("--leave-out", "left_out", type=click.IntRange(min=1), multiple=True, metavar="DWELL", panel=MODEL,
                     help="Number of a dwell that is not to be used; repeatable."),
        click.option("--settle-s", type=NOT_NEGATIVE, default=1.0, show_default=True, panel=MODEL,
                     help="Seconds left out after each arrival; of a short dwell no more than a third."),
        click.option("--still-deg", type=POSITIVE, default=0.05, show_default=True, panel=MODEL,
                     help="Motion within half a second that still counts as standing still, deg."),
        click.option("--gate/--no-gate", default=True, show_default=True, help="Reject outlying readings.",
                     panel=MODEL),
        click.option("--gate-sigma", type=NumberInRange(min=3), default=6.0, show_default=True, panel=MODEL,
                     help="Where the gate stands, robust sigma."),
    ]  # fmt: skip
    for option in reversed(options):
        command = option(command)
    return command


def filter_options(command: F) -> F:
    """How a run is evaluated."""
    options = [
        click.option("--with", "effects", multiple=True, metavar="EFFECT", panel=MODEL,
                     help="An effect to put in the model, for example second-order, or a formula of your own, "
                     "for example 'mine = fx*fy*T'; repeatable."),
        effects_from_option,
        trust_option,
        click.option("--model", "model_file", type=click.Path(path_type=Path), metavar="FILE", panel=MODEL,
                     help="A model file (--save-model) or a calibration (--save); its effects come before those of "
                     "--with."),
        dwell_options,
        click.option("--prior", type=click.Choice(["diffuse", "navigation", "mems"]), default="diffuse",
                     show_default=True, help="What is believed of the sensors before the run.", panel=MODEL),
        click.option("--bias-walk", type=NOT_NEGATIVE, default=0.0, show_default=True, panel=MODEL,
                     help="Random walk of the biases, m/s^2 per square root of a second (process noise)."),
        click.option("--engine", type=click.Choice(["block", "filterpy"]), default="block", show_default=True,
                     help="Block square-root filter, or filterpy sample by sample.", panel=MODEL),
    ]  # fmt: skip
    for option in reversed(options):
        command = option(command)
    return command


bench_model_option = click.option(
    "--bench-model", "bench_model", type=click.Path(path_type=Path), metavar="FILE.toml", panel=MODEL,
    help="Errors of the bench that many runs have shown: they are subtracted, and their sigma is considered.",
)  # fmt: skip

json_option = click.option(
    "--json", "as_json", is_flag=True, help="Print one JSON object, and nothing else.", panel=OUTPUT
)
strict_option = click.option(
    "--strict", is_flag=True, help="Exit with 1 where model and measurements disagree.", panel=OUTPUT
)


def _show_in(ctx: click.Context, param: click.Parameter, system: Literal["field", "si"]) -> None:
    ctx.with_resource(shown_in(system))


units_option = click.option(
    "--units", type=click.Choice(["field", "si"]), default="field", show_default=True, expose_value=False,
    callback=_show_in, panel=OUTPUT,
    help="Units that are printed and drawn: of the field (arcsec, ppm, µg) or SI.",
)  # fmt: skip
target_option = partial(
    click.option, "--target", "targets", multiple=True, metavar="NAME=SIGMA",
    help="The sigma wanted of a parameter (theta1, K2), of a kind (theta, phi, nu, K, b) or of all angles, with a unit "
    "(2ppm, 20ug, 0.1arcsec); repeatable.",
)  # fmt: skip


def overrides(options: Mapping[str, Any]) -> dict[str, str]:
    """Bench keys from the TOML file and, over them, from options."""
    keys: dict[str, str] = {}
    if options["bench_file"]:
        keys |= _bench_from_toml(options["bench_file"])
    keys |= {key: str(options[key]) for key in BENCH_OPTIONS if options[key] is not None}
    keys |= {key: str(options[key]) for key in ("accel_unit", "accel_scale") if options.get(key) is not None}
    return keys | ({"restate_input": "true"} if options.get("restate_input") else {})


def _bench_from_toml(path: Path) -> dict[str, str]:
    from kf_calib.bench.bench import metadata_of
    from kf_calib.bench.keys import checked_keys
    from kf_calib.support.toml_files import toml_table

    content = toml_table(path, "gravity_mps2 = 9.81, numbers with a point")
    table = content.get("bench", content) if isinstance(content.get("bench"), dict) else content
    try:
        keys = metadata_of(table)
        checked_keys(keys)
    except BenchError as error:
        raise BenchError(f"{path}: {error}") from None
    except (ValueError, RecursionError):
        raise BenchError(f"{path}: has a value that is too large for any key: write numbers and text.") from None
    return keys


def recording_of(path: Path, options: Mapping[str, Any], input: RawInput | None = None) -> Recording | Lines | Table:
    """The recording, log of samples or table at a path; input: what the device sends, where nothing else states it."""
    from kf_calib.sources.files.lines import Lines
    from kf_calib.sources.opening import FileKind, kind_of, no_recording
    from kf_calib.sources.tables.opening import open_table

    columns, angles = dict(map(pair, options["columns"])), not options["no_angles"]
    match kind_of(path, columns):
        case FileKind.TABLE:
            refuse_given(OF_MESSAGES + OF_DWELLS, f"{path} is a table of mean readings")
            stated = {name: options[name] for name in ("angle_unit", "g_unit")}
            return open_table(path, overrides(options), columns=columns, angles=angles, input=input, **stated)
        case FileKind.SAMPLES:
            refuse_given(OF_MESSAGES, f"{path} is a log in lines of text")
            return Lines(path, overrides(options), columns, units=units_of(options, input), angles=angles)
        case FileKind.RECORDING:
            refuse_given(_OF_TEXT, f"{path} is no table (.csv, .xlsx) and no log in lines of text")
            return messages_of(path, options, angles, input)
        case FileKind.CALIBRATION:
            raise no_recording(path)


_OF_TEXT = ("columns", "g_unit")
OF_MESSAGES = ("accel_topic", "pose_topic", "temperature_topic", "fields", "max_chunk_mb")
OF_DWELLS = ("joints", "settle_s", "still_deg", "gate", "gate_sigma")
"""Options that act on text and spreadsheets only, on files of messages only, and where dwells are to be found."""


def refuse_given(names: Sequence[str], what: str) -> None:
    """Raise InputError for the first of these options that the command line has.

    In a worker of a fleet there is no command line: of recordings of several kinds, an option acts on those it can.
    """
    ctx = get_current_context(silent=True)
    if ctx is None:
        return
    for param in ctx.command.params:
        if param.name in names and ctx.get_parameter_source(param.name) is ParameterSource.COMMANDLINE:
            name = [*param.opts, *param.secondary_opts][-1 if ctx.params[param.name] is False else 0]
            raise InputError(f"{what}, on which {name} has nothing to act: leave it out.")


def recording_kind(path: Path, options: Mapping[str, Any]) -> str:
    """What a file is: ``recording``, ``samples``, ``table`` or ``calibration``."""
    from kf_calib.sources.opening import kind_of

    return kind_of(path, dict(map(pair, options["columns"]))).value


def merged_for_table(path: Path, options: Mapping[str, Any], input: RawInput) -> tuple[dict[str, str], Units]:
    """Bench keys and units of a table of what the device of a calibration sends."""
    from kf_calib.bench.raw_input import merged_metadata

    keys = overrides(options)
    try:
        order = merged_metadata({}, keys, "", input).get("channels")
    except BenchError as error:
        raise BenchError(f"{path}: {error}") from None
    return keys if order is None else keys | {"channels": order}, units_of(options, input)


def units_of(options: Mapping[str, Any], input: RawInput | None = None) -> Units:
    """Units of a table or a log, as the options state them."""
    from kf_calib.sources.units import Units

    return Units.of(overrides(options), options["angle_unit"], options["g_unit"], input)


def messages_of(path: Path, options: Mapping[str, Any], angles: bool, input: RawInput | None = None) -> Recording:
    """The recording of samples at a path, as the options say it is to be read; angles: whether it must have angles."""
    from kf_calib.sources.files.recording import Recording

    return Recording(
        path,
        overrides(options),
        input=input,
        angle_scale=si(f"1 {options['angle_unit'] or 'rad'}"),
        accel_topic=options["accel_topic"],
        pose_topic=options["pose_topic"],
        temperature_topic=options["temperature_topic"],
        fields=options["fields"],
        max_chunk_mb=options["max_chunk_mb"],
        angles=angles,
    )


def settings_of(options: Mapping[str, Any]) -> Settings:
    from kf_calib.estimation.settings import PRIORS, Settings

    return Settings(
        engine=options["engine"],
        prior=PRIORS[options["prior"]],
        walk_mps2_per_sqrt_s=options["bias_walk"],
        effects=effects_of(options),
        bench_model=_bench_model_of(options),
        **used_of(options),
    )


def _bench_model_of(options: Mapping[str, Any]) -> BenchModel | None:
    if options.get("bench_model") is None:
        return None
    from kf_calib.estimation import bench_model

    return bench_model.read_bench_model(options["bench_model"])


def used_of(options: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of ``Settings`` by the options of ``dwell_options``: which readings count."""
    from kf_calib.dwells.stationarity import Stillness

    return {
        "stillness": Stillness(tolerance_deg=options["still_deg"], settle_s=options["settle_s"]),
        "gate_sigma": options["gate_sigma"] if options["gate"] else None,
        "left_out": tuple(options["left_out"]),
    }


def opened(path: Path, options: Mapping[str, Any]) -> tuple[Recording | Lines | Table, Settings]:
    """A recording, log or table, and how to evaluate it; an impossible model is refused before any reading is read."""
    from kf_calib.estimation.measurement_model import Model

    settings = settings_of(options)
    source = recording_of(path, options)
    Model.of(source.bench, settings.effects, settings.bench_model)
    return source, settings


def effects_of(options: Mapping[str, Any]) -> tuple[str, ...]:
    """Effects of the model file, then those of ``--with``; the model file is checked before a Python file is run."""
    from kf_calib.effects import load_file, merged, refuse_unknown

    model = None
    if options["model_file"] is not None:
        from kf_calib.exchange import calibration_file

        model = calibration_file.read_model(options["model_file"])
    for path in options["effects_from"]:
        load_file(path)
    for text in options["effects"]:
        refuse_unknown(text)  # at once, not after a long recording was read
    if model is None:
        return tuple(options["effects"])
    for change in model.load(options["effects_from"], options["trust"]):
        complain(f"{change}")
    return merged(model.effects, options["effects"])
