"""Commands that evaluate a recording: replay, compare, effects, diagnose, report."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import rich_click as click

from kf_calib.cli.command import INPUT, OUTPUT, argument, command, option
from kf_calib.cli.echo import print_json, progress, show
from kf_calib.cli.files import (
    FigureFiles,
    Pictures,
    ReportFile,
    claimed,
    commands_of,
    delivery,
    measured_of,
    output_option,
    save_report,
    typed,
)
from kf_calib.cli.options import (
    BenchModelFile,
    EvaluationOptions,
    Json,
    Overwrite,
    ReadingOptions,
    Save,
    SaveModel,
    ShownUnits,
    StatementFile,
    Strict,
    exit_if,
    opened,
)

if TYPE_CHECKING:
    from kf_calib.diagnosis.refits import Refits
    from kf_calib.diagnosis.results import Diagnosis
    from kf_calib.views.report.contents import Measured

_OF_DIAGNOSE_ALONE = (
    "details",
    "rrd",
    "png",
    "svg",
    "pdf",
    "overwrite",
    "strict",
    "as_json",
    "bench_model",
)


@command("replay run.mcap", 'replay bag.mcap --axes "y z x" --gravity 9.8123 --with second-order --rrd run.rrd')
def replay(
    recording: Annotated[Path, argument()], reading: ReadingOptions, evaluation: EvaluationOptions,
    bench_model: BenchModelFile, pictures: Pictures, save: Save, save_model: SaveModel, overwrite: Overwrite,
    strict: Strict, units: ShownUnits, as_json: Json,
) -> None:  # fmt: skip
    """Run a recording through the filter: twelve parameters, their sigma, and whether the model fits."""
    from kf_calib.estimation.calibration import calibrate

    outputs = claimed(overwrite=overwrite)
    source, settings = opened(recording, reading, evaluation, bench_model)
    with progress(f"replaying {recording.name}", as_json) as tick:
        result = calibrate(source, settings, tick)
    if as_json:
        from kf_calib.views.json import replay_object

        print_json(replay_object(result))
    else:
        from kf_calib.views.console import summary

        show(summary(result))
    with delivery(outputs, as_json) as deliver:
        deliver.calibration(save, result, source)
        deliver.model(save_model, result)
        pictures.save(deliver, result)
    exit_if(strict and result.consistency.consistent is False)


@command("compare run.mcap")
def compare(
    recording: Annotated[Path, argument()], reading: ReadingOptions, evaluation: EvaluationOptions,
    figures: FigureFiles, report: ReportFile, overwrite: Overwrite, units: ShownUnits, as_json: Json,
) -> None:  # fmt: skip
    """Block engine, filterpy and batch least squares on the same recording: differences, time, memory."""
    from kf_calib.estimation.engine_comparison import compare as run

    outputs = claimed(overwrite=overwrite)
    source, settings = opened(recording, reading, evaluation)
    measured = measured_of(recording, reading.opened(recording)) if report else None
    with progress(f"comparing on {recording.name}", as_json) as tick:
        compared = run(source, settings, tick)
    if as_json:
        from kf_calib.views.json import compare_object

        print_json(compare_object(compared))
    else:
        from kf_calib.views.console import comparison_table

        show(comparison_table(compared))
    with delivery(outputs, as_json) as deliver:
        figures.save(deliver, compared)
        save_report(deliver, report, compared, measured)


@command("effects", "effects hysteresis", "effects 'mine = fx*fy*T' second-order --recording run.mcap", name="effects")
def list_effects(
    names: Annotated[tuple[str, ...], argument(metavar="[NAME]...")],
    recording: Annotated[Path | None, option(
        "--recording", metavar="REC", panel=INPUT,
        help="Say of each effect what this recording shows of it: visible, smallest size, confused with what.",
    )],
    reading: ReadingOptions, evaluation: EvaluationOptions, units: ShownUnits, as_json: Json,
) -> None:  # fmt: skip
    """The effects a model may have: all of the catalogue and your own, or those NAMEd (formulas too) in detail.

    Without --recording they are those of a bench with --axes "y z x" at --latitude 50, or as stated.
    """  # fmt: skip
    from kf_calib.bench.bench import Bench
    from kf_calib.effects import effect_named, refuse_unknown
    from kf_calib.effects import names as known
    from kf_calib.views import catalogue

    evaluation.effects_of_model()
    for name in names:
        refuse_unknown(name)
    if recording is not None:
        _list_visible(recording, names, as_json, reading, evaluation)
        return
    bench = Bench.from_metadata({"axes": "y z x", "latitude_deg": 50.0, **reading.keys})
    chosen = [effect_named(name, bench) for name in names or known(bench)]
    if as_json:
        print_json(catalogue.effects_object(chosen))
    else:
        show(catalogue.details(chosen) if names else catalogue.overview(chosen))


def _list_visible(
    recording: Path, names: tuple[str, ...], as_json: bool, reading: ReadingOptions, evaluation: EvaluationOptions
) -> None:
    """What a recording shows of effects, beside the model of the options."""
    from kf_calib.effects import effect_named
    from kf_calib.effects import names as known
    from kf_calib.estimation.calibration import calibrate
    from kf_calib.estimation.observability import visibility_of
    from kf_calib.views import catalogue
    from kf_calib.views.json import clean

    source, settings = opened(recording, reading, evaluation)
    chosen = [effect_named(name, source.bench) for name in names or known(source.bench)]
    with progress(f"reading {recording.name}", as_json) as tick:
        result = calibrate(source, settings, tick)
    seen = visibility_of(result.fit, chosen)
    if as_json:
        print_json(clean(catalogue.sights_object(seen, [str(effect) for effect in result.model.effects])))
    else:
        title = f"What {recording.name} shows of {len(seen)} effects beside {result.model.sum}"
        show(catalogue.sight_report(seen, title))


@command("diagnose run.mcap", "diagnose run.mcap --with hysteresis")
@click.pass_context
def diagnose(
    ctx: click.Context, recording: Annotated[Path, argument()], reading: ReadingOptions,
    evaluation: EvaluationOptions, bench_model: BenchModelFile,
    details: Annotated[bool, option(
        "--details", panel=OUTPUT,
        help="Print the evidence, too: all suspects, where it fails, what this run cannot show, smallest sizes.",
    )],
    pictures: Pictures, overwrite: Overwrite, strict: Strict, units: ShownUnits, as_json: Json,
) -> None:  # fmt: skip
    """Which physical effect is missing in the model: verdict, probabilities, the shape of it, and what to do next."""
    from kf_calib.diagnosis.missing_effect import diagnose as run
    from kf_calib.diagnosis.refits import Refits
    from kf_calib.estimation.calibration import calibrate
    from kf_calib.views import diagnosis as views

    outputs = claimed(overwrite=overwrite)
    source, settings = opened(recording, reading, evaluation, bench_model)
    with progress(f"diagnosing {recording.name}", as_json) as tick:
        diagnosis = run(calibrate(source, settings, tick), Refits(source))
    if as_json:
        print_json(views.diagnosis_object(diagnosis))
    else:
        show(views.diagnosis_report(diagnosis, typed(ctx, _OF_DIAGNOSE_ALONE), details))
    with delivery(outputs, as_json) as deliver:
        pictures.save(deliver, diagnosis)
    exit_if(strict and diagnosis.test.consistent is False)


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
    from kf_calib.cli.exchange import stated_in, write_certificate
    from kf_calib.diagnosis.data_sheet import data_sheet
    from kf_calib.diagnosis.results import SideBySide
    from kf_calib.views import console, diagnosis
    from kf_calib.views.data_sheet import data_sheet_object, data_sheet_report
    from kf_calib.views.json import clean, side_by_side_object
    from kf_calib.views.report.contents import page_of, with_data_sheet
    from kf_calib.views.report.page import save

    outputs, stated = claimed(overwrite=overwrite), stated_in(certificate, statement)
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
        table: dict[str, Any] = {"report": str(output), "recording": measured.name, "sha256": measured.sha256,
                 "consistent": diagnosed.consistent, "p_value": diagnosed.test.p_value,
                 "verdict": diagnosis.verdict(diagnosed)}  # fmt: skip
        table["data_sheet"] = None if sheet is None else data_sheet_object(sheet)
        beside_it = {"against": None, "differences": [], "differences_p_value": None}
        print_json(clean(table | (beside_it if pair is None else side_by_side_object(pair))))
    else:
        show(verdict)
        if sheet is not None:
            show(data_sheet_report(sheet))
    with delivery(outputs, as_json) as deliver, progress("drawing the page", as_json):
        page = page_of(diagnosed if pair is None else pair, sources, commands_of(ctx))
        page = page if sheet is None else with_data_sheet(page, sheet)
        deliver.file(output, lambda path: save(page, path))
    if certificate is not None and stated is not None:
        from kf_calib.exchange import calibration_file

        saved = calibration_file.saved(diagnosed.before, measured.name, measured.sha256, measured.began)
        write_certificate(outputs, certificate, stated, (saved, diagnosed.before.model))
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
