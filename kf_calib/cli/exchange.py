"""Commands that use calibrations: apply, verify, history."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich_click as click

from kf_calib.cli.acquire import pair
from kf_calib.cli.echo import complain
from kf_calib.cli.files import claimed, delivery, output_option
from kf_calib.cli.options import (
    OUTPUT,
    dwell_options,
    effects_from_option,
    examples,
    json_option,
    messages_of,
    overwrite_option,
    print_json,
    progress,
    recording_of,
    recording_options,
    show,
    strict_option,
    trust_option,
    units_option,
    used_of,
)
from kf_calib.cli.pictures import Pictures, figure_options, figures_of
from kf_calib.errors import InputError, KfCalibError

if TYPE_CHECKING:
    from kf_calib.estimation.correction import Correction
    from kf_calib.exchange.calibration_file import SavedCalibration

_BLOCK_BYTES = 1 << 16
_file = partial(click.argument, type=click.Path(path_type=Path))


@click.command(
    epilog=examples("apply cal.json flight.mcap -o flight_calibrated.mcap", "apply cal.json - < lines.csv > out.csv")
)
@_file("calibration", metavar="CAL")
@_file("recording", metavar="REC")
@output_option("-o", "--out", metavar="OUT.mcap", panel=OUTPUT,
               help="The copy, with /accelerometer/calibrated beside the raw topic.")  # fmt: skip
@recording_options
@effects_from_option
@trust_option
@overwrite_option
@units_option
@json_option
def apply(calibration: Path, recording: Path, out: Path | None, overwrite: bool, as_json: bool, **options: Any) -> None:
    """Correct the readings of a recording: specific force in the frame of the block, as one more topic of a copy.

    REC may be any recording of the block; it needs no platform angles. Of - (standard input), lines of JSON or CSV are
    corrected as they come, and written to standard output. Effects that depend on more than specific force and
    temperature cannot be corrected so; they are left out and named.
    """  # fmt: skip
    columns = dict(map(pair, options.pop("columns")))
    if recording == Path("-"):
        if out is not None or as_json:
            raise click.UsageError("lines of standard input are corrected to standard output: leave out -o and --json.")
        return _apply_to_lines(_correction(calibration, options)[1], columns)
    if out is None or columns:
        raise click.UsageError("a recording is corrected to a copy: name it by -o OUT.mcap, and leave out --column.")
    from kf_calib.exchange.corrected_file import apply_to_file
    from kf_calib.sources.opening import Kind, kind_of
    from kf_calib.views import exchange as views

    if (kind := kind_of(recording)) is Kind.SAMPLES:
        raise InputError(
            f"{recording} holds lines of text: correct them to standard output, by kf-calib apply {calibration} - < "
            f"{recording}, or record them first (kf-calib record)."
        )
    if kind is Kind.TABLE:
        raise InputError(
            f"{recording} is no recording of samples: apply corrects MCAP files, bags, and lines of samples from "
            "standard input (apply CAL - < LINES); mean readings are corrected in Python, by "
            "kf_calib.open_calibration(CAL).correction()(readings)."
        )
    outputs = claimed(overwrite=overwrite)
    saved, correction = _correction(calibration, options)
    options["gravity_mps2"] = options["gravity_mps2"] or saved.bench.gravity_mps2
    source = messages_of(recording, options, angles=False)
    found = []
    with progress(f"correcting {recording.name}", as_json) as tick:
        outputs.write(out, lambda path: found.append(apply_to_file(correction, source, path, tick)))
    if as_json:
        print_json(views.applied_object(correction, found[0], out, source.warnings))
    else:
        show(views.applied_report(correction, found[0], out, source.warnings))


def _apply_to_lines(correction: Correction, columns: Mapping[str, str]) -> None:
    """Correct lines of standard input as they come."""
    from kf_calib.exchange.corrected_lines import CorrectedLines

    for name, why in correction.left_out.items():
        complain(f"{name} is not corrected: {why}")
    lines = CorrectedLines(correction, columns)
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

    saved = calibration_file.read(path)
    for change in saved.model_file(path).load(options["effects_from"], options["trust"]):
        complain(change)
    return saved


def _correction(path: Path, options: Mapping[str, Any]) -> tuple[SavedCalibration, Correction]:
    """The calibration of a file, and what it corrects."""
    saved = _read(path, options)
    return saved, saved.correction(path, options["effects_from"], options["trust"])


@click.command(epilog=examples("verify cal.json check.mcap", "verify cal.json check.mcap --strict --json"))
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
    source = recording_of(recording, options)
    model = saved.model(calibration, options["effects_from"], options["trust"], source.bench)
    with progress(f"verifying with {recording.name}", as_json) as tick:
        found = verification.verify(saved, model, source, Settings(**used_of(options)), tick)
    if as_json:
        print_json(views.verification_object(found))
    else:
        show(views.verification_report(found))
    if strict and not found.holds:
        ctx.exit(1)


@click.command(epilog=examples("history cal_*.json --tolerance K=20ppm --tolerance b=100ug"))
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
    from kf_calib.bench.targets import targets_of
    from kf_calib.exchange import calibration_file
    from kf_calib.exchange.history import history as found_in
    from kf_calib.views import exchange as views

    outputs, pictures = claimed(overwrite=overwrite), Pictures.taken_from(options)
    wanted = targets_of(tolerances)
    found = found_in([calibration_file.read(path) for path in calibrations], wanted)
    if as_json:
        print_json(views.history_object(found))
    else:
        show(views.history_report(found))
    with delivery(outputs, as_json) as deliver:
        pictures.save_figures(deliver, figures_of(found))
