"""Commands that evaluate a recording beside replay: compare, effects, diagnose."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import rich_click as click

from kf_calib.cli.command import INPUT, OUTPUT, argument, command, option
from kf_calib.cli.echo import print_result, progress
from kf_calib.cli.files import FigureFiles, Pictures, ReportFile, claimed, delivery, typed
from kf_calib.cli.options import (
    BenchModelFile,
    EvaluationOptions,
    Json,
    Overwrite,
    ReadingOptions,
    ShownUnits,
    Strict,
    exit_if,
    opened,
)
from kf_calib.support.leaves import leaf

_OF_DIAGNOSE_ALONE = "details", "rrd", "png", "svg", "pdf", "overwrite", "strict", "as_json", "bench_model"


@command("compare run.mcap")
def compare(
    recording: Annotated[Path, argument()], reading: ReadingOptions, evaluation: EvaluationOptions,
    figures: FigureFiles, report: ReportFile, overwrite: Overwrite, units: ShownUnits, as_json: Json,
) -> None:  # fmt: skip
    """Block engine, filterpy and batch least squares on the same recording: differences, time, memory."""
    from kf_calib.estimation.engine_comparison import compare as run
    from kf_calib.views.console import comparison_table
    from kf_calib.views.json import compare_object

    outputs = claimed(overwrite=overwrite)
    source, settings = opened(recording, reading, evaluation)
    reports = leaf("report.command", "--report") if report else None
    measured = reports.measured_of(recording, reading.opened(recording)) if reports else None
    with progress(f"comparing on {recording.name}", as_json) as tick:
        compared = run(source, settings, tick)
    print_result(as_json, compare_object, comparison_table, compared)
    with delivery(outputs, as_json) as deliver:
        figures.save(deliver, compared)
        if reports is not None:
            reports.save_report(deliver, report, compared, measured)


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
    print_result(as_json, catalogue.effects_object, catalogue.details if names else catalogue.overview, chosen)


def _list_visible(
    recording: Path, names: tuple[str, ...], as_json: bool, reading: ReadingOptions, evaluation: EvaluationOptions
) -> None:
    """What a recording shows of effects, beside the model of the options."""
    from kf_calib.effects import effect_named
    from kf_calib.effects import names as known
    from kf_calib.estimation.calibration import calibrate
    from kf_calib.estimation.observability import visibility_of
    from kf_calib.views import catalogue

    source, settings = opened(recording, reading, evaluation)
    chosen = [effect_named(name, source.bench) for name in names or known(source.bench)]
    with progress(f"reading {recording.name}", as_json) as tick:
        result = calibrate(source, settings, tick)
    seen = visibility_of(result.fit, chosen)
    print_result(as_json, catalogue.sights_object, catalogue.sight_report, seen, result.model, recording.name)


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
    report = partial(views.diagnosis_report, typed=typed(ctx, _OF_DIAGNOSE_ALONE), details=details)
    print_result(as_json, views.diagnosis_object, report, diagnosis)
    with delivery(outputs, as_json) as deliver:
        pictures.save(deliver, diagnosis)
    exit_if(strict and diagnosis.test.consistent is False)
