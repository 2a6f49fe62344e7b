"""The command that writes the page of a recording, and how other commands save one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import rich_click as click
from click import get_current_context  # rich_click declares that there may be none

from kf_calib.cli.command import INPUT, OUTPUT, argument, command, option
from kf_calib.cli.echo import print_json, progress, show
from kf_calib.cli.files import Delivery, claimed, commands_of, delivery, output_option
from kf_calib.cli.options import (
    EvaluationOptions,
    Json,
    Overwrite,
    ReadingOptions,
    ShownUnits,
    StatementFile,
    Strict,
    exit_if,
    opened,
)
from kf_calib.errors import need
from kf_calib.support.leaves import leaf

if TYPE_CHECKING:
    from kf_calib.bench.streams import Source
    from kf_calib.diagnosis.refits import Refits
    from kf_calib.diagnosis.results import Diagnosis
    from kf_calib.report.contents import Measured


@command(
    "report run.mcap",
    "report after.mcap --against before.mcap -o shift.html",
    "report run.mcap --model after.toml --against before.toml",
)
@click.pass_context
def report(
    ctx: click.Context, recording: Annotated[Path, argument()],
    against: Annotated[Path | None, option(
        "--against", metavar="PATH", panel=INPUT,
        help="Beside it: another recording, evaluated in the same way, or the same one with the model of a .toml file.",
    )],
    reading: ReadingOptions, evaluation: EvaluationOptions,
    output: Annotated[Path, output_option(
        "-o", "--out", metavar="FILE.html", default="report.html", show_default=True,
        help="Where the page is saved.",
    )],
    certificate: Annotated[Path | None, output_option(
        "--certificate", metavar="OUT.pdf",
        help="Save a calibration certificate here, too; kf-calib certificate makes one of a saved calibration.",
    )],
    statement: StatementFile,
    standard: Annotated[Literal["ieee1293"] | None, option(
        "--standard", panel=OUTPUT,
        help="With a data sheet: the coefficients of the model equation by the symbols of that standard.")],
    overwrite: Overwrite, units: ShownUnits, strict: Strict, as_json: Json,
) -> None:  # fmt: skip
    """A page for the engineer: verdict, figures, residuals to explore, tables, commands to get the numbers again."""
    from kf_calib.diagnosis.data_sheet import data_sheet
    from kf_calib.diagnosis.results import SideBySide
    from kf_calib.report.contents import page_of, with_data_sheet
    from kf_calib.report.data_sheet import data_sheet_object, data_sheet_report
    from kf_calib.report.page import save
    from kf_calib.views import console, diagnosis
    from kf_calib.views.json import side_by_side_object

    outputs, certificates = claimed(overwrite=overwrite), None
    if certificate is not None or statement is not None:
        certificates = leaf("certificate.command", "a certificate")
    stated = certificates.stated_in(certificate, statement) if certificates else None
    has_other_model = against is not None and against.suffix == ".toml"
    other_evaluation = replace(evaluation, model_file=against, effects=()) if has_other_model else evaluation
    if has_other_model:
        outputs.spare(_programs_of(against))
        other_evaluation.effects_of_model()  # refused, as that of --model, before any reading is read
    diagnosed, refits, measured = _diagnosed(recording, reading, evaluation, as_json)
    sheet = None if standard is None else data_sheet(diagnosed, refits)
    pair, sources = None, [measured]
    if against is not None:
        path = recording if has_other_model else against
        other, _, beside = _diagnosed(path, reading, other_evaluation, as_json)
        pair, sources = SideBySide(other, diagnosed, has_other_model), [beside, measured]
    verdict = diagnosis.verdict(diagnosed) if pair is None else console.difference_in_words(pair)
    if as_json:
        table: dict[str, Any] = {"report": output, "recording": measured.name, "sha256": measured.sha256,
                 "consistent": diagnosed.consistent, "p_value": diagnosed.test.p_value,
                 "verdict": diagnosis.verdict(diagnosed)}  # fmt: skip
        table["data_sheet"] = None if sheet is None else data_sheet_object(sheet)
        beside_it = {"against": None, "differences": [], "differences_p_value": None}
        print_json(table | (beside_it if pair is None else side_by_side_object(pair)))
    else:
        show(verdict)
        if sheet is not None:
            show(data_sheet_report(sheet))
    with delivery(outputs, as_json) as deliver, progress("drawing the page", as_json):
        page = page_of(diagnosed if pair is None else pair, sources, commands_of(ctx))
        page = page if sheet is None else with_data_sheet(page, sheet)
        deliver.file(output, lambda path: save(page, path))
    if certificates is not None:
        from kf_calib.exchange import calibration_file

        saved = calibration_file.saved(diagnosed.before, measured.name, measured.sha256, measured.began)
        certificates.write_certificate(outputs, certificate, stated, (saved, diagnosed.before.model))
        if not as_json:
            show(f"saved {certificate}")
    exit_if(strict and diagnosed.test.consistent is False)


def _diagnosed(
    recording: Path, reading: ReadingOptions, evaluation: EvaluationOptions, quiet: bool
) -> tuple[Diagnosis, Refits, Measured]:
    """Return the diagnosis of a recording with its refits, and what a page says of its file."""
    from kf_calib.diagnosis.missing_effect import diagnose
    from kf_calib.diagnosis.refits import Refits
    from kf_calib.estimation.calibration import calibrate

    measured = measured_of(recording, reading.opened(recording))
    source, settings = opened(recording, reading, evaluation)
    with progress(f"diagnosing {recording.name}", quiet) as tick:
        refits = Refits(source)
        return diagnose(calibrate(source, settings, tick), refits), refits, measured


def _programs_of(model: Path | None) -> list[Path]:
    from kf_calib.estimation import model_file

    return [] if model is None else [each.path for each in model_file.read_model_file(model).programs]


def save_report(
    deliver: Delivery, path: Path | None, result: object, measured: Measured, remarks: Sequence[str] = ()
) -> None:
    """Save the page of the result of the command that runs."""
    from kf_calib.report.contents import page_of
    from kf_calib.report.page import save

    commands = commands_of(get_current_context())
    deliver.file(path, lambda path: save(page_of(result, [measured], commands, remarks), path))


def need_page() -> None:
    """Raise MissingExtraError where a package is missing that a page needs."""
    need("jinja2", "report", "HTML")
    import kf_calib.views.figures  # noqa: F401  # which asks for matplotlib


def measured_of(recording: Path, source: Source) -> Measured:
    """What a page says of a recording's file, which ``source`` reads; raises MissingExtraError where no page can be
    made."""
    need_page()
    from kf_calib.report.contents import Measured
    from kf_calib.sources.files.record_files import END_RECORD, decision_records, fingerprint
    from kf_calib.sources.opening import run_date

    is_driven = recording.suffix == ".mcap" and recording.is_file()
    decided, ends = (decision_records(recording), decision_records(recording, END_RECORD)) if is_driven else ((), ())
    return Measured(recording.name, fingerprint(recording), run_date(source), decided, ends)
