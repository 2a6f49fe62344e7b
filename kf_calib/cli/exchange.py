"""Commands that use calibrations: apply, verify, history, export."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import rich_click as click

from kf_calib.cli.command import INPUT, OUTPUT, command
from kf_calib.cli.echo import complain, print_json, progress, show
from kf_calib.cli.files import claimed, delivery, output_option
from kf_calib.cli.options import (
    BENCH_OPTIONS,
    OF_MESSAGES,
    dwell_options,
    effects_from_option,
    json_option,
    merged_for_table,
    messages_of,
    overrides,
    overwrite_option,
    pair,
    recording_kind,
    recording_of,
    recording_options,
    refuse_given,
    strict_option,
    trust_option,
    units_of,
    units_option,
    used_of,
)
from kf_calib.cli.pictures import Pictures, figure_options
from kf_calib.errors import InputError, KfCalibError
from kf_calib.support.output_files import whole

if TYPE_CHECKING:
    from kf_calib.estimation.correction import Correction
    from kf_calib.exchange.calibration_file import SavedCalibration
    from kf_calib.exchange.corrected_file import Applied
    from kf_calib.exchange.corrected_lines import CorrectedLines
    from kf_calib.sources.files.text_file import TextFile


_BLOCK_BYTES = 1 << 16
_file = partial(click.argument, type=click.Path(path_type=Path))


@command(
    "apply cal.json flight.mcap -o flight_calibrated.mcap",
    "apply cal.json log.csv -o log_calibrated.csv",
    "apply cal.json - < lines.csv > out.csv",
)
@_file("calibration", metavar="CAL")
@_file("recording", metavar="REC")
@output_option("-o", "--out", "output", metavar="OUT", panel=OUTPUT,
               help="The copy: of a recording with /accelerometer/calibrated beside the raw topic, of a log or a table "
               "with specific force in the place of the readings.")  # fmt: skip
@click.option("--unchecked", is_flag=True, panel=INPUT,
              help="Correct the readings though their norm at rest does not fit the calibration.")  # fmt: skip
@recording_options
@effects_from_option
@trust_option
@overwrite_option
@units_option
@json_option
def apply(
    calibration: Path, recording: Path, output: Path | None, unchecked: bool, overwrite: bool, as_json: bool,
    **options: Any,
) -> None:  # fmt: skip
    """Correct the readings of a recording: specific force in the frame of the block, in a copy.

    REC may be any recording, log or table of the block, of what its device sends: the calibration knows order, signs
    and size of its channels. It needs no platform angles. Of - (standard input), lines of JSON or CSV are corrected as
    they come, and written to standard output. Effects that depend on more than specific force and temperature cannot be
    corrected so; they are left out and named.
    """  # fmt: skip
    from kf_calib.views import exchange as views

    if recording == Path("-"):
        if output is not None or as_json:
            raise click.UsageError("lines of standard input are corrected to standard output: leave out -o and --json.")
        refuse_given(_OF_FILES, "lines of standard input are read as they come")
        return _apply_to_lines(_correction(calibration, options)[1], options, unchecked)
    if output is None:
        raise click.UsageError("a recording is corrected to a copy: name it by -o OUT (standard input by -).")
    kind = recording_kind(recording, options)
    if kind != "recording" and output.suffix == ".mcap":
        raise InputError(
            f"{recording} holds lines of text or a table, and its copy, too: name {output} as such a file."
        )
    outputs = claimed(overwrite=overwrite)
    saved, correction = _correction(calibration, options)
    options["gravity_mps2"] = options["gravity_mps2"] or saved.bench.gravity_mps2
    done = list[Any]()
    with progress(f"correcting {recording.name}", as_json) as tick:
        outputs.write(output, lambda path: done.append(_applied(correction, recording, path, options, unchecked, tick)))
    (applied, warnings), topic = done[0], kind == "recording"
    if as_json:
        print_json(views.applied_object(correction, applied, output, warnings, topic))
    else:
        show(views.applied_report(correction, applied, output, warnings, topic))


_OF_FILES = (*OF_MESSAGES, *(key for key in BENCH_OPTIONS if key != "channels"), "angle_unit", "no_angles")
"""Options on which lines of standard input have nothing to act."""


def _applied(
    correction: Correction, path: Path, copy: Path, options: Mapping[str, Any], unchecked: bool,
    tick: Callable[[float], None],
) -> tuple[Applied, list[str]]:  # fmt: skip
    """Write the copy of a file; what was corrected, and what is to be told."""
    from kf_calib.exchange.corrected_file import Applied, apply_to_file, apply_to_table

    columns = dict(map(pair, options["columns"]))
    match recording_kind(path, options):
        case "samples":
            lines = _lines(correction, options, str(path), unchecked)
            with whole(copy) as part, part.open("wb") as file, _bytes_of(path) as source:
                while block := source.read(_BLOCK_BYTES):
                    file.write(lines.push(block))
                file.write(lines.rest())
            return Applied(lines.readings, 0, None), lines.warnings
        case "table":
            keys, units = merged_for_table(path, options, correction.input)
            return apply_to_table(correction, path, copy, keys, columns, units, unchecked=unchecked), []
        case _:
            if columns:
                raise InputError(f"{path} is no log and no table, on which --column has nothing to act: leave it out.")
            source = messages_of(path, options, angles=False, input=correction.input)
            applied = apply_to_file(correction, source, copy, tick, unchecked=unchecked)
            return applied, source.warnings


def _bytes_of(path: Path) -> BinaryIO | TextFile:
    """A log as it is, byte for byte; one that is packed, or written in UTF-16, in UTF-8."""
    from kf_calib.sources.files.text_file import TextFile

    try:
        with path.open("rb") as file:
            start = file.read(2)
        return TextFile(path) if start in (b"\x1f\x8b", b"\xff\xfe", b"\xfe\xff") else path.open("rb")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}).") from None


def _lines(correction: Correction, options: Mapping[str, Any], name: str, unchecked: bool) -> CorrectedLines:
    """What corrects lines."""
    from kf_calib.exchange.corrected_lines import CorrectedLines

    stated, columns = overrides(options), dict(map(pair, options["columns"]))
    units = units_of(options, correction.input)
    return CorrectedLines(correction, columns, stated, name=name, units=units, unchecked=unchecked)


def _apply_to_lines(correction: Correction, options: Mapping[str, Any], unchecked: bool) -> None:
    """Correct lines of standard input as they come."""
    for name, why in correction.left_out.items():
        complain(f"{name} is not corrected: {why}")
    lines = _lines(correction, options, "standard input", unchecked)
    read = getattr(sys.stdin.buffer, "read1", sys.stdin.buffer.read)  # read1 does not wait for a whole block
    while block := read(_BLOCK_BYTES):
        _write_out(lines.push(block))
    _write_out(lines.rest())
    for said in lines.warnings:
        complain(said)


def _write_out(lines: bytes) -> None:
    """Write to standard output at once."""
    try:
        sys.stdout.buffer.write(lines)
        sys.stdout.buffer.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        raise KfCalibError(f"standard output cannot be written to ({error.strerror}): send it elsewhere.") from None


def _read(path: Path, options: Mapping[str, Any]) -> SavedCalibration:
    """The calibration of a file; the Python files that it needs are run where they may be."""
    from kf_calib.exchange import calibration_file

    saved = calibration_file.open_calibration(path)
    for change in saved.model_file(path).load(options["effects_from"], options["trust"]):
        complain(change)
    return saved


def _correction(path: Path, options: Mapping[str, Any]) -> tuple[SavedCalibration, Correction]:
    """The calibration of a file, and what it corrects."""
    saved = _read(path, options)
    return saved, saved.correction(path, options["effects_from"], options["trust"])


@command("verify cal.json check.mcap", "verify cal.json check.mcap --strict --json")
@_file("calibration", metavar="CAL")
@_file("recording", metavar="REC")
@recording_options
@dwell_options
@effects_from_option
@trust_option
@strict_option
@units_option
@json_option
@click.pass_context
def verify(ctx: click.Context, calibration: Path, recording: Path, strict: bool, as_json: bool, **options: Any) -> None:
    """Does an old calibration still hold for a new recording of the block? Which parameters have moved, and how much?

    A few orientations are enough to test it as a whole; parameters are compared that the new ones determine.
    """  # fmt: skip
    from kf_calib.estimation.settings import Settings
    from kf_calib.exchange import verification
    from kf_calib.views import exchange as views

    saved = _read(calibration, options)
    verification.refuse_incomplete(saved)
    source = recording_of(recording, options, saved.bench.input)
    model = saved.model(calibration, options["effects_from"], options["trust"], source.bench)
    with progress(f"verifying with {recording.name}", as_json) as tick:
        result = verification.verify(saved, model, source, Settings(**used_of(options)), tick)
    if as_json:
        print_json(views.verification_object(result))
    else:
        show(views.verification_report(result))
    if strict and not result.holds:
        ctx.exit(1)


@command("history cal_*.json --tolerance K=20ppm --tolerance b=100ug")
@click.argument("calibrations", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="CAL...")
@click.option(
    "--tolerance",
    "tolerances",
    multiple=True,
    metavar="NAME=SIZE",
    help="By how much a parameter (theta1, K2), a kind (theta, phi, nu, K, b) or all angles may be wrong, "
    "with a unit (20ppm, 100ug, 5arcsec) or in SI; repeatable. The date of the next calibration follows.",
)
@figure_options
@overwrite_option
@units_option
@json_option
def history(
    calibrations: tuple[Path, ...], tolerances: tuple[str, ...], overwrite: bool, as_json: bool, **options: Any
) -> None:
    """The calibrations of one block over time: drift, repeatability, and when to calibrate again."""
    from kf_calib.bench.paper_parameters import targets_of
    from kf_calib.exchange import calibration_file
    from kf_calib.exchange.history import history as found_in
    from kf_calib.views import exchange as views

    outputs, pictures = claimed(overwrite=overwrite), Pictures.taken_from(options)
    wanted = targets_of(tolerances)
    drifts = found_in([calibration_file.open_calibration(path) for path in calibrations], wanted)
    if as_json:
        print_json(views.history_object(drifts))
    else:
        show(views.history_report(drifts))
    with delivery(outputs, as_json) as deliver:
        pictures.save(deliver, drifts)


_NAMES = ["px4", "ardupilot", "imucal", "imu_calib", "kalibr", "openvins", "imu_tk", "vectornav", "csv", "c"]


@command(
    "export cal.json --to c -o kf_calib_correct.h", "export cal.json --to ardupilot --lossy -o accelerometer.param"
)
@click.argument("calibration", type=click.Path(path_type=Path), metavar="CAL")
@click.option("--to", required=True, type=click.Choice(_NAMES), help="The program that is to take it.", panel=OUTPUT)
@output_option("-o", "--out", "output", required=True, metavar="FILE", panel=OUTPUT, help="The file for that program.")
@click.option(
    "--lossy", is_flag=True, panel=OUTPUT,
    help="Export though the program cannot hold all; what is lost, and the error left, are told.",
)  # fmt: skip
@effects_from_option
@trust_option
@overwrite_option
@units_option
@json_option
def export(
    calibration: Path, to: str, output: Path, lossy: bool, effects_from: tuple[Path, ...], trust: bool, overwrite: bool,
    as_json: bool,
) -> None:  # fmt: skip
    """Write a calibration as the file of an autopilot, of another calibration tool, or as a function in C.

    Where the program cannot hold the alignment or an effect, the numbers are those with the least rms error, over all
    directions of gravity and the temperatures of the run; how large it is is said, and --lossy is needed.
    """
    from kf_calib.exchange import calibration_file
    from kf_calib.exchange.exports import exported
    from kf_calib.support.output_files import write_whole
    from kf_calib.views import exchange as views

    outputs = claimed(overwrite=overwrite)
    saved = calibration_file.open_calibration(calibration)
    target = exported(saved, saved.correction(calibration, effects_from, trust), to, lossy)
    content = target.text().encode()
    outputs.write(output, lambda path: write_whole(path, content))
    if as_json:
        print_json(views.exported_object(target, to, output))
    else:
        show(views.exported_report(target, output))
