"""Commands that use calibrations: apply, verify, history."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import rich_click as click

from kf_calib.bench.keys import BenchKeys, StatedBench
from kf_calib.cli.command import INPUT, argument, command, option
from kf_calib.cli.echo import complain, print_result, progress
from kf_calib.cli.files import FigureFiles, claimed, delivery, output_option
from kf_calib.cli.options import (
    OF_MESSAGES,
    CalibrationFile,
    DwellOptions,
    Json,
    Overwrite,
    ProgramOptions,
    ReadingOptions,
    ShownUnits,
    Strict,
    exit_if,
    refuse_given,
)
from kf_calib.errors import BenchError, InputError, KfCalibError
from kf_calib.support.output_files import whole

if TYPE_CHECKING:
    from kf_calib.bench.raw_input import RawInput
    from kf_calib.estimation.correction import Correction
    from kf_calib.exchange.calibration_file import SavedCalibration
    from kf_calib.exchange.corrected_file import Applied
    from kf_calib.exchange.corrected_lines import CorrectedLines
    from kf_calib.sources.text.encoding import TextFile

_BLOCK_BYTES = 1 << 16


@command(
    "apply cal.json flight.mcap -o flight_calibrated.mcap",
    "apply cal.json log.csv -o log_calibrated.csv",
    "apply cal.json - < lines.csv > out.csv",
)
def apply(
    calibration: CalibrationFile,
    recording: Annotated[Path, argument(metavar="REC")],
    output: Annotated[Path | None, output_option(
        "-o", "--out", metavar="OUT",
        help="The copy: of a recording with /accelerometer/calibrated beside the raw topic, of a log or a table "
        "with specific force in the place of the readings.",
    )],
    unchecked: Annotated[bool, option(
        "--unchecked", panel=INPUT,
        help="Correct the readings though their norm at rest does not fit the calibration.",
    )],
    reading: ReadingOptions, programs: ProgramOptions, overwrite: Overwrite, units: ShownUnits, as_json: Json,
) -> None:  # fmt: skip
    """Correct the readings of a recording: specific force in the frame of the block, in a copy.

    REC may be any recording, log or table of the block, of what its device sends: the calibration knows order, signs
    and size of its channels. It needs no platform angles. Of - (standard input), lines of JSON or CSV are corrected as
    they come, and written to standard output. Effects that depend on more than specific force and temperature cannot be
    corrected so; they are left out and named.
    """  # fmt: skip
    from kf_calib.sources.file_kind import FileKind
    from kf_calib.views import exchange as views

    if recording == Path("-"):
        if output is not None or as_json:
            raise click.UsageError("lines of standard input are corrected to standard output: leave out -o and --json.")
        refuse_given(_OF_FILES, "lines of standard input are read as they come")
        return _apply_to_lines(_correction(calibration, programs)[1], reading, unchecked)
    if output is None:
        raise click.UsageError("a recording is corrected to a copy: name it by -o OUT (standard input by -).")
    is_recording = reading.kind(recording) is FileKind.RECORDING
    if not is_recording and output.suffix == ".mcap":
        raise InputError(
            f"{recording} holds lines of text or a table, and its copy, too: name {output} as such a file."
        )
    outputs = claimed(overwrite=overwrite)
    saved, correction = _correction(calibration, programs)
    stated: StatedBench = {"gravity_mps2": saved.bench.gravity_mps2, **reading.bench.stated}
    reading = replace(reading, bench=replace(reading.bench, stated=stated))
    done: list[tuple[Applied, list[str]]] = []
    with progress(f"correcting {recording.name}", as_json) as tick:
        outputs.write(output, lambda path: done.append(_applied(correction, recording, path, reading, unchecked, tick)))
    ((applied, warnings),) = done
    print_result(
        as_json, views.applied_object, views.applied_report, correction, applied, output, warnings, is_recording
    )


_BENCH_KEYS = StatedBench.__annotations__.keys() - {"channels"}
_OF_FILES = (*OF_MESSAGES, *_BENCH_KEYS, "angle_unit", "no_angles")
"""Options on which lines of standard input have nothing to act."""


def _applied(
    correction: Correction, path: Path, copy: Path, reading: ReadingOptions, unchecked: bool,
    tick: Callable[[float], None],
) -> tuple[Applied, list[str]]:  # fmt: skip
    """Write the copy of a file; what was corrected, and what is to be told."""
    from kf_calib.exchange.corrected_file import Applied, apply_to_file, apply_to_table
    from kf_calib.sources.file_kind import FileKind

    match reading.kind(path):
        case FileKind.SAMPLES:
            lines = _lines(correction, reading, str(path), unchecked)
            with whole(copy) as part, part.open("wb") as file, _bytes_of(path, reading.accel_topic or "") as source:
                while block := source.read(_BLOCK_BYTES):
                    file.write(lines.push(block))
                file.write(lines.rest())
            return Applied(lines.readings, 0, None), lines.warnings
        case FileKind.TABLE:
            keys, units = _table_keys(reading.keys, path, correction.input), reading.units(correction.input)
            return apply_to_table(correction, path, copy, keys, reading.renamed, units, unchecked=unchecked), []
        case _:
            if reading.columns:
                raise InputError(f"{path} is no log and no table, on which --column has nothing to act: leave it out.")
            source = reading.messages(path, angles=False, input=correction.input)
            applied = apply_to_file(correction, source, copy, tick, unchecked=unchecked)
            return applied, source.warnings


def _table_keys(keys: BenchKeys, path: Path, input: RawInput) -> BenchKeys:
    """Bench keys of a table of what the device of a calibration sends."""
    from kf_calib.bench.raw_input import merged_metadata

    try:
        order = merged_metadata({}, keys, "", input).get("channels")
    except BenchError as error:
        raise BenchError(f"{path}: {error}") from None
    return keys if order is None else {**keys, "channels": order}


def _bytes_of(path: Path, dataset: str) -> TextFile:
    """A log as it is, byte for byte; one that is packed, or written in another encoding, in UTF-8; of a container the
    lines of a dataset."""
    from kf_calib.sources.text.encoding import TextFile

    try:
        return TextFile(path, dataset)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}).") from None


def _lines(correction: Correction, reading: ReadingOptions, name: str, unchecked: bool) -> CorrectedLines:
    """What corrects lines."""
    from kf_calib.exchange.corrected_lines import CorrectedLines

    units = reading.units(correction.input)
    return CorrectedLines(correction, reading.renamed, reading.keys, name=name, units=units, unchecked=unchecked)


def _apply_to_lines(correction: Correction, reading: ReadingOptions, unchecked: bool) -> None:
    """Correct lines of standard input as they come."""
    for name, why in correction.left_out.items():
        complain(f"{name} is not corrected: {why}")
    lines = _lines(correction, reading, "standard input", unchecked)
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


def _read(path: Path, programs: ProgramOptions) -> SavedCalibration:
    """The calibration of a file; the Python files that it needs are run where they may be."""
    from kf_calib.exchange import calibration_file

    saved = calibration_file.open_calibration(path)
    for change in saved.model_file(path).load(programs.effects_from, programs.trust):
        complain(change)
    return saved


def _correction(path: Path, programs: ProgramOptions) -> tuple[SavedCalibration, Correction]:
    """The calibration of a file, and what it corrects."""
    saved = _read(path, programs)
    return saved, saved.correction(path, programs.effects_from, programs.trust)


@command("verify cal.json check.mcap", "verify cal.json check.mcap --strict --json")
def verify(
    calibration: CalibrationFile, recording: Annotated[Path, argument(metavar="REC")], reading: ReadingOptions,
    dwells: DwellOptions, programs: ProgramOptions, strict: Strict, units: ShownUnits, as_json: Json,
) -> None:  # fmt: skip
    """Does an old calibration still hold for a new recording of the block? Which parameters have moved, and how much?

    A few orientations are enough to test it as a whole; parameters are compared that the new ones determine.
    """  # fmt: skip
    from kf_calib.exchange import verification
    from kf_calib.views import exchange as views

    saved = _read(calibration, programs)
    verification.refuse_incomplete(saved)
    source = reading.opened(recording, saved.bench.input)
    model = saved.model(calibration, programs.effects_from, programs.trust, source.bench)
    with progress(f"verifying with {recording.name}", as_json) as tick:
        result = verification.verify(saved, model, source, dwells.settings(), tick)
    print_result(as_json, views.verification_object, views.verification_report, result)
    exit_if(strict and not result.holds)


@command("history cal_*.json --tolerance K=20ppm --tolerance b=100ug")
def history(
    calibrations: Annotated[tuple[Path, ...], argument(required=True, metavar="CAL...")],
    tolerances: Annotated[tuple[str, ...], option(
        "--tolerance", metavar="NAME=SIZE",
        help="By how much a parameter (theta1, K2), a kind (theta, phi, nu, K, b) or all angles may be wrong, with a "
        "unit (20ppm, 100ug, 5arcsec) or in SI; repeatable. The date of the next calibration follows.",
    )],
    figures: FigureFiles, overwrite: Overwrite, units: ShownUnits, as_json: Json,
) -> None:  # fmt: skip
    """The calibrations of one block over time: drift, repeatability, and when to calibrate again."""
    from kf_calib.bench.paper_parameters import targets_of
    from kf_calib.exchange import calibration_file
    from kf_calib.exchange.history import history as found_in
    from kf_calib.views import exchange as views

    outputs, wanted = claimed(overwrite=overwrite), targets_of(tolerances)
    drifts = found_in([calibration_file.open_calibration(path) for path in calibrations], wanted)
    print_result(as_json, views.history_object, views.history_report, drifts)
    with delivery(outputs, as_json) as deliver:
        figures.save(deliver, drifts)
