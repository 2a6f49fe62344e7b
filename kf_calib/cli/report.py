"""The command ``report``, and the option ``--report`` of others: a result as one HTML page."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import rich_click as click
from click import get_current_context  # rich_click declares that there may be none
from click.core import ParameterSource

from kf_calib.cli.certificate import StatementFile, stated_in, write_certificate
from kf_calib.cli.command import INPUT, argument, command, option
from kf_calib.cli.echo import print_json, progress, show
from kf_calib.cli.files import Delivery, claimed, delivery, output_option
from kf_calib.cli.options import EvaluationOptions, Json, Overwrite, ReadingOptions, ShownUnits, Strict, exit_if, opened

if TYPE_CHECKING:
    from kf_calib.diagnosis.results import Diagnosis
    from kf_calib.views.report.contents import Measured

ReportFile = Annotated[Path | None, output_option(
    "--report", metavar="FILE.html", help="Save a page with figures and tables here; it needs no network.",
)]  # fmt: skip


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
    statement: StatementFile, overwrite: Overwrite, units: ShownUnits, strict: Strict, as_json: Json,
) -> None:  # fmt: skip
    """A page for the engineer: verdict, figures, residuals to explore, tables, commands to get the numbers again."""
    from kf_calib.diagnosis.side_by_side import SideBySide
    from kf_calib.views import diagnosis, side_by_side
    from kf_calib.views.json import clean
    from kf_calib.views.report.contents import page_of
    from kf_calib.views.report.page import save

    outputs, stated = claimed(overwrite=overwrite), stated_in(certificate, statement)
    has_other_model = against is not None and against.suffix == ".toml"
    other_evaluation = replace(evaluation, model_file=against, effects=()) if has_other_model else evaluation
    if has_other_model:
        outputs.spare(_programs_of(against))
        other_evaluation.effects_of_model()  # refused, as that of --model, before any reading is read
    diagnosed, measured = _diagnosed(recording, reading, evaluation, as_json)
    pair, sources = None, [measured]
    if against is not None:
        path = recording if has_other_model else against
        other, beside = _diagnosed(path, reading, other_evaluation, as_json)
        pair, sources = SideBySide(other, diagnosed, has_other_model), [beside, measured]
    verdict = diagnosis.verdict(diagnosed) if pair is None else side_by_side.verdict(pair)
    if as_json:
        table = {"report": str(output), "recording": measured.name, "sha256": measured.sha256,
                 "consistent": diagnosed.test.consistent, "p_value": diagnosed.test.p_value,
                 "verdict": diagnosis.verdict(diagnosed)}  # fmt: skip
        beside_it = {"against": None, "differences": [], "differences_p_value": None}
        print_json(clean(table | (beside_it if pair is None else side_by_side.side_by_side_object(pair))))
    else:
        show(verdict)
    with delivery(outputs, as_json) as deliver, progress("drawing the page", as_json):
        result = diagnosed if pair is None else pair
        deliver.file(output, lambda path: save(page_of(result, sources, commands_of(ctx)), path))
    if certificate is not None and stated is not None:
        from kf_calib.exchange import calibration_file

        saved = calibration_file.saved(diagnosed.before, measured.name, measured.sha256, measured.began)
        write_certificate(outputs, certificate, stated, (saved, diagnosed.before.model))
        if not as_json:
            show(f"saved {certificate}")
    exit_if(strict and diagnosed.test.consistent is False)


def save_report(
    deliver: Delivery, path: Path | None, result: object, measured: Measured | None, remarks: Sequence[str] = ()
) -> None:
    """Save the page of a command's result, if ``--report`` asks for one."""
    if path is not None and measured is not None:
        from kf_calib.views.report.contents import page_of
        from kf_calib.views.report.page import save

        commands = commands_of(get_current_context())
        deliver.file(path, lambda path: save(page_of(result, [measured], commands, remarks), path))


def measured_of(recording: Path, reading: ReadingOptions) -> Measured:
    """What a page says of a recording's file; raises MissingExtraError, before the work, where no page can be made."""
    import kf_calib.views.figures  # noqa: F401  # which a page needs
    from kf_calib.diagnosis.selection_journal import Origin
    from kf_calib.sources.files.record_files import END_RECORD, decision_records
    from kf_calib.sources.opening import run_date
    from kf_calib.views.report.contents import Measured

    fingerprint, began = Origin.of(recording).sha256, run_date(reading.opened(recording))
    is_driven = recording.suffix == ".mcap" and recording.is_file()
    decided, ends = (decision_records(recording), decision_records(recording, END_RECORD)) if is_driven else ((), ())
    return Measured(recording.name, fingerprint, began, decided, ends)


def _diagnosed(
    recording: Path, reading: ReadingOptions, evaluation: EvaluationOptions, quiet: bool
) -> tuple[Diagnosis, Measured]:
    """Return the diagnosis of a recording, and what a page says of its file."""
    from kf_calib.diagnosis.missing_effect import diagnose
    from kf_calib.diagnosis.refits import Refits
    from kf_calib.estimation.calibration import calibrate

    measured, (source, settings) = measured_of(recording, reading), opened(recording, reading, evaluation)
    with progress(f"diagnosing {recording.name}", quiet) as tick:
        return diagnose(calibrate(source, settings, tick), Refits(source)), measured


def _programs_of(model: Path | None) -> list[Path]:
    from kf_calib.estimation import model_file

    return [] if model is None else [each.path for each in model_file.read_model_file(model).programs]


_HOW_IT_ENDS = ("overwrite", "strict", "as_json")
"""Options that change no number and no page."""


def commands_of(ctx: click.Context) -> list[str]:
    """The command that runs, as it could be typed again, and what prints its tables alone."""
    commands = [f"kf-calib {ctx.info_name} {typed(ctx, _HOW_IT_ENDS)}"]
    if ctx.info_name == "report" and ctx.params.get("against") is None:
        shared = typed(ctx, ("output", *_HOW_IT_ENDS))
        commands += [f"kf-calib {name} {shared}" for name in ("replay", "diagnose")]
    return [*commands, *(f"sha256sum {shlex.quote(str(path))}" for path in _recordings(ctx))]


def _recordings(ctx: click.Context) -> list[Path]:
    against = ctx.params.get("against")
    others = [against] if against is not None and against.suffix != ".toml" else []
    named = [ctx.params["recording"]] if "recording" in ctx.params else []
    return [path for path in [*named, *others] if path.is_file()]


def typed(ctx: click.Context, less: Sequence[str]) -> str:
    """Return the arguments and options that were given, but for some, as words of a shell."""
    words = list[str]()
    for param in ctx.command.params:
        name = param.name or ""
        given = ctx.get_parameter_source(name) is ParameterSource.COMMANDLINE
        if name in (*less, "units") or not given:
            continue
        value = ctx.params[name]
        if isinstance(param, click.Argument):
            words.insert(0, str(value))
        elif isinstance(param, click.Option) and param.is_flag:
            words.append(param.opts[-1] if value else param.secondary_opts[-1])
        else:
            words += [word for each in (value if isinstance(value, tuple) else [value])
                      for word in (param.opts[-1], str(each))]  # fmt: skip
    return shlex.join(words)
