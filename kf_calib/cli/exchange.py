"""Commands that use calibrations: apply, verify, history, export, certificate."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, BinaryIO, Literal

import rich_click as click

from kf_calib.bench.keys import BenchKeys, StatedBench
from kf_calib.cli.command import INPUT, OUTPUT, argument, command, option
from kf_calib.cli.echo import complain, print_json, print_result, progress, show
from kf_calib.cli.files import FigureFiles, claimed, delivery, output_option
from kf_calib.cli.options import (
    OF_MESSAGES,
    DwellOptions,
    Json,
    Overwrite,
    ProgramOptions,
    ReadingOptions,
    ShownUnits,
    StatementFile,
    Strict,
    exit_if,
    refuse_given,
)
from kf_calib.errors import BenchError, InputError, KfCalibError, need
from kf_calib.support.output_files import whole

if TYPE_CHECKING:
    from kf_calib.bench.raw_input import RawInput
    from kf_calib.estimation.correction import Correction
    from kf_calib.estimation.measurement_model import Model
    from kf_calib.exchange.calibration_file import SavedCalibration
    from kf_calib.exchange.certificate.budget import Certificate
    from kf_calib.exchange.certificate.statement import Statement
    from kf_calib.exchange.corrected_file import Applied
    from kf_calib.exchange.corrected_lines import CorrectedLines
    from kf_calib.exchange.exports.noise_keys import NoiseExport
    from kf_calib.sources.text.encoding import TextFile
    from kf_calib.support.output_files import Outputs

_BLOCK_BYTES = 1 << 16
CalibrationFile = Annotated[Path, argument(metavar="CAL")]


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
    from kf_calib.sources.opening import FileKind
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
    from kf_calib.sources.opening import FileKind

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


def _bytes_of(path: Path, dataset: str) -> BinaryIO | TextFile:
    """A log as it is, byte for byte; one that is packed, or written in another encoding, in UTF-8; of a container the
    lines of a dataset."""
    from kf_calib.sources.containers.opening import kind_of_container
    from kf_calib.sources.text.encoding import GZIP, TextFile, encoding_of

    try:
        with path.open("rb") as file:
            start = file.read(_BLOCK_BYTES)
        is_plain = not kind_of_container(path) and start[:2] != GZIP and encoding_of(start) == "utf-8"
        return path.open("rb") if is_plain else TextFile(path, dataset)
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


ExportKind = Literal[
    "px4", "ardupilot", "imucal", "imu_calib", "kalibr", "openvins", "imu_tk", "vectornav", "csv", "c",
    "robot_localization",
]  # fmt: skip


@command(
    "export cal.json --to c -o kf_calib_correct.h", "export cal.json --to ardupilot --lossy -o accelerometer.param",
    "export cal.json --noise noise.json --to kalibr --lossy -o imu.yaml", "export noise.json --to px4 -o noise.params",
)  # fmt: skip
def export(
    calibration: CalibrationFile,
    to: Annotated[ExportKind, option("--to", required=True, help="The program that is to take it.", panel=OUTPUT)],
    output: Annotated[Path, output_option(
        "-o", "--out", required=True, metavar="FILE", help="The file for that program.")],
    lossy: Annotated[bool, option(
        "--lossy", panel=OUTPUT,
        help="Export though the program cannot hold all; what is lost, and the error left, are told.",
    )],
    noise: Annotated[Path | None, option(
        "--noise", metavar="NOISE.json", panel=INPUT, help="The noise, too, as kf-calib noise --save has written it: "
        "for Kalibr, OpenVINS and PX4.")],
    programs: ProgramOptions, overwrite: Overwrite, units: ShownUnits, as_json: Json,
) -> None:  # fmt: skip
    """Write a calibration as the file of an autopilot, of another calibration tool, or as a function in C.

    Where the program cannot hold the alignment or an effect, the numbers are those with the least rms error, over all
    directions of gravity and the temperatures of the run; how large it is is said, and --lossy is needed. CAL may be
    what kf-calib noise --save has written: then the file has the noise alone.
    """
    from kf_calib.exchange import calibration_file
    from kf_calib.exchange.exports import exported
    from kf_calib.support.output_files import write_whole
    from kf_calib.views import exchange as views

    outputs = claimed(overwrite=overwrite)
    if _is_noise_alone(calibration, to, noise):
        _export_noise(outputs, calibration if noise is None else noise, to, output, as_json)
        return
    saved = calibration_file.open_calibration(calibration)
    target = exported(saved, saved.correction(calibration, programs.effects_from, programs.trust), to, lossy)
    if noise is not None:
        target.noise = _noise_for(noise, to)
    content = target.text().encode()
    outputs.write(output, lambda path: write_whole(path, content))
    if as_json:
        print_json(views.exported_object(target, to, output))
    else:
        show(views.exported_report(target, output))


def _is_noise_alone(path: Path, to: str, noise: Path | None) -> bool:
    """Whether noise is exported and no calibration. Raises UsageError where robot_localization lacks one."""
    from kf_calib.exchange.noise_file import is_noise_file

    if is_noise_file(path):
        if noise is not None:
            raise click.UsageError(f"{path} is noise already: leave out --noise, or give a calibration before it.")
        return True
    if to == "robot_localization" and noise is None:
        raise click.UsageError("robot_localization takes the noise, no calibration: name it with --noise NOISE.json.")
    return to == "robot_localization"


def _noise_for(path: Path, to: str) -> NoiseExport:
    """The noise of a file for a program. Raises InputError where that has no keys for it."""
    from kf_calib.exchange.exports.noise_keys import NoiseExport
    from kf_calib.exchange.noise_file import open_noise

    for program in NoiseExport.titles:
        if program == to:
            return NoiseExport(open_noise(path), program)
    raise InputError(f"{to} takes no noise: leave out --noise, or export to {', '.join(NoiseExport.titles)}.")


def _export_noise(outputs: Outputs, path: Path, to: str, output: Path, as_json: bool) -> None:
    """Write noise alone in the keys of a program."""
    from kf_calib.support.output_files import write_whole
    from kf_calib.views import noise as views

    export = _noise_for(path, to)
    content = export.text().encode()
    outputs.write(output, lambda path: write_whole(path, content))
    print_result(as_json, views.noise_export_object, views.noise_export_report, export, output)


@command("certificate cal.json --statement lab.toml -o certificate.pdf")
def certificate(
    calibration: CalibrationFile,
    output: Annotated[Path, output_option("-o", "--out", required=True, metavar="OUT.pdf",
                                          help="The certificate: PDF/A-3b with the XML attached.")],
    xml: Annotated[Path | None, output_option(
        "--xml", metavar="OUT.xml", help="Save the XML as a file of its own, too.")],
    statement: StatementFile,
    schema: Annotated[Path | None, option("--schema", metavar="DCC.xsd", panel=INPUT,
                                          help="Validate the XML against this copy of the DCC's schema.")],
    draws: Annotated[int | None, option(
        "--monte-carlo", metavar="DRAWS", type=click.IntRange(min=10_000, max=10_000_000), panel=OUTPUT,
        help="Check the expanded uncertainties by so many draws, 1000000 for example (JCGM 101).")],
    programs: ProgramOptions, overwrite: Overwrite, as_json: Json,
) -> None:  # fmt: skip
    """A calibration certificate as ISO/IEC 17025 asks: results, expanded uncertainties, budget, traceability.

    What is neither in the calibration nor in the statement is left blank. It never claims accreditation.
    """
    from kf_calib.exchange import calibration_file
    from kf_calib.exchange.certificate import statement as statements
    from kf_calib.exchange.certificate.monte_carlo import monte_carlo
    from kf_calib.views import exchange as views

    stated = statements.read_statement(statement)
    outputs = claimed([] if stated.before is None else [stated.before], overwrite=overwrite)
    calibrations = []
    for path in (calibration, stated.before):
        if path is not None:
            saved = calibration_file.open_calibration(path)
            calibrations.append((saved, saved.model(path, programs.effects_from, programs.trust)))
    written, standing = write_certificate(outputs, output, stated, *calibrations, xml=xml, schema=schema)
    check = None if draws is None else monte_carlo(written.budget, draws)
    print_result(as_json, views.certificate_object, views.certificate_report, written, standing, check, output, xml)


def stated_in(certificate: Path | None, statement: Path | None) -> Statement | None:
    """What a certificate states, checked before the work; None where there is to be none."""
    if certificate is None:
        if statement is not None:
            raise click.UsageError("--statement is for a certificate: name one with --certificate OUT.pdf.")
        return None
    from kf_calib.exchange.certificate import statement as statements

    need("typst", "report", "a certificate")
    return statements.read_statement(statement)


def write_certificate(
    outputs: Outputs, pdf: Path, stated: Statement, calibrated: tuple[SavedCalibration, Model],
    before: tuple[SavedCalibration, Model] | None = None, xml: Path | None = None, schema: Path | None = None,
) -> tuple[Certificate, str]:  # fmt: skip
    """Write the certificate of a calibration with its model as ``out``; what it says, and what the check of its XML
    found. before: the same from before an adjustment.

    Raises InputError for a calibration, statement or schema that cannot be used, MissingExtraError without typst.
    """
    from kf_calib.exchange.certificate import budget, dcc, document
    from kf_calib.support.output_files import write_whole

    certificate_ = budget.certificate(*calibrated, stated, before)
    encoded = dcc.xml(certificate_)
    standing = dcc.check_dcc(encoded, schema)
    printed = document.pdf(certificate_, encoded, standing)
    outputs.write(pdf, lambda path: write_whole(path, printed))
    if xml is not None:
        outputs.write(xml, lambda path: write_whole(path, encoded))
    return certificate_, standing
