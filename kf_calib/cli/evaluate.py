"""Commands that evaluate a recording: replay, compare, effects, diagnose, improve."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import rich_click as click

from kf_calib.cli.command import INPUT, OUTPUT, argument, command, grouped, option, values_of
from kf_calib.cli.echo import complain, print_json, progress, show
from kf_calib.cli.files import claimed, delivery, output_option
from kf_calib.cli.options import (
    BenchModelFile,
    BenchOptions,
    EvaluationOptions,
    Json,
    Overwrite,
    ProgramOptions,
    ReadingOptions,
    Save,
    SaveModel,
    ShownUnits,
    Strict,
    exit_if,
    opened,
)
from kf_calib.cli.pictures import FigureFiles, Pictures
from kf_calib.cli.report import ReportFile, measured_of, save_report, typed
from kf_calib.errors import InputError

if TYPE_CHECKING:
    from kf_calib.diagnosis.selection_journal import Origin

STEPS = "Steps"
_OF_DIAGNOSE_ALONE = (
    "details",
    "rrd",
    "screenshot",
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
    measured = measured_of(recording, reading) if report else None
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
    bench = Bench.from_metadata({"axes": "y z x", "latitude_deg": "50"} | reading.keys)
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


@dataclass(frozen=True)
class StepOptions:
    """How the effects are chosen."""

    # fmt: off
    interactive: Annotated[bool, option(
        "--interactive", panel=STEPS, help="Ask at every step; usual on a terminal.")] = False
    unattended: Annotated[bool, option(
        "--unattended", panel=STEPS, help="Never ask; usual where there is no terminal.")] = False
    accept_first: Annotated[bool, option(
        "--accept-first", panel=STEPS, help="Where no effect has 95 % probability, take the likeliest.")] = False
    honest: Annotated[bool, option("--honest", panel=STEPS, help="Held-out error with the choice of effects repeated "
                                   "without what is held out, in 6 folds.")] = False
    from_journal: Annotated[Path | None, option(
        "--from-journal", metavar="FILE", panel=STEPS, help="First take the steps of this journal again.")] = None
    # fmt: on

    def asks(self, as_json: bool) -> bool:
        """Whether to ask at every step; raises UsageError where the options say both."""
        if self.interactive and self.unattended:
            raise click.UsageError("--interactive asks at every step, --unattended never does: choose one.")
        if self.interactive and as_json:
            raise click.UsageError(
                "--interactive asks questions, --json prints one object and nothing else: choose one."
            )
        return self.interactive or (not (self.unattended or as_json) and sys.stdin.isatty() and sys.stdout.isatty())


@command(
    "improve run.mcap --unattended --save-model found.toml",
    "improve run.mcap --interactive",
    seldom=("accel_unit", "angle_unit", "columns", "left_out"),
)
@click.pass_context
def improve(
    ctx: click.Context, recording: Annotated[Path, argument()], steps: StepOptions, reading: ReadingOptions,
    evaluation: EvaluationOptions, save: Save,
    save_model: Annotated[Path | None, output_option(
        "--save-model", "--out-model", metavar="FILE.toml", help="Save the last model here.")],
    journal_file: Annotated[Path | None, output_option(
        "--journal", metavar="FILE", help="Keep a journal of the steps here.")],
    pictures: Pictures, report: ReportFile, overwrite: Overwrite, strict: Strict, units: ShownUnits, as_json: Json,
) -> None:  # fmt: skip
    """Add the effects that are missing, one after another, and see the error fall, until there is a reason to stop."""
    from kf_calib.cli.improvement_dialogue import dialogue
    from kf_calib.diagnosis import nested_cross_validation, selection_journal, stepwise_selection
    from kf_calib.diagnosis.refits import Refits
    from kf_calib.estimation.calibration import calibrate
    from kf_calib.views import improvement as views

    interactive, outputs = steps.asks(as_json), claimed(overwrite=overwrite)
    earlier = selection_journal.read_journal(steps.from_journal) if steps.from_journal else None
    origin = selection_journal.Origin.of(recording)
    if earlier is not None and steps.from_journal is not None:
        earlier.refuse_other(origin, steps.from_journal)
        reading, evaluation = _of_journal(ctx, earlier.origin, steps.from_journal)
        outputs.spare(evaluation.programs.effects_from)
    _refuse_engine(evaluation)
    settings = evaluation.settings()
    origin = _for_journal(origin, reading, evaluation, settings.effects)
    measured = measured_of(recording, reading) if report else None

    with delivery(outputs, as_json) as deliver:

        def keep(state: stepwise_selection.Improvement) -> None:
            deliver.keep(journal_file, lambda path: selection_journal.write_journal(path, state, origin))

        difference = None
        with progress(f"improving on {recording.name}", as_json) as tick:
            source = reading.opened(recording)
            start, refits = calibrate(source, settings, tick), Refits(source)
            if earlier is not None:
                state, difference = selection_journal.replay_journal(earlier, start, refits)
            elif interactive:
                state = stepwise_selection.begin(start, refits)
            else:
                state = stepwise_selection.improve(start, steps.accept_first, keep, refits)
        if interactive:
            state = dialogue(state, refits, keep)
        with progress("holding out orientations", as_json or not steps.honest) as tick:
            checked = nested_cross_validation.nested_cross_validation(start, on_fold=tick) if steps.honest else None
        if as_json:
            files = {"saved_model": save_model, "journal": journal_file}
            print_json(views.improvement_object(state, checked, difference, files))
        else:
            show(views.improvement_report(state, checked, difference))
        deliver.calibration(save, state.result, source)
        deliver.model(save_model, state.result)
        deliver.file(journal_file, lambda path: selection_journal.write_journal(path, state, origin))
        pictures.save(deliver, state)
        save_report(deliver, report, state, measured, [views.honest_sentence(checked)] if checked else [])
    exit_if(strict and state.diagnosis.test.consistent is False)


_BY_CONTENT = ("model_file", *(field.name for field in fields(BenchOptions)))
_LEAVE = tuple(field.name for field in fields(ProgramOptions))
"""Options by which a user allows Python files to be run: a journal cannot give them."""


def _refuse_engine(evaluation: EvaluationOptions) -> None:
    if evaluation.engine != "block":
        raise click.UsageError(
            "improve refits from folded dwells, as the block engine does: leave out --engine, and check what it finds "
            "with replay --model FILE --engine filterpy."
        )


def _for_journal(
    origin: Origin, reading: ReadingOptions, evaluation: EvaluationOptions, effects: Sequence[str]
) -> Origin:
    """An origin with all that numbers depend on: options and programs; files of bench keys and of models by what they
    say."""
    from kf_calib.effects import loaded
    from kf_calib.exchange import calibration_file

    programs = evaluation.programs
    files = [*programs.effects_from]
    if evaluation.model_file is not None:
        model = calibration_file.read_model(evaluation.model_file)
        files += model.allowed(programs.effects_from, programs.trust).files
    others = (*_BY_CONTENT, *_LEAVE)
    kept = {key: value for key, value in values_of(reading, evaluation) if value is not None and key not in others}
    options = kept | reading.keys | {"effects": list(effects)}
    return replace(origin, options=options, programs=tuple(loaded(files)))


def _of_journal(ctx: click.Context, origin: Origin, path: Path) -> tuple[ReadingOptions, EvaluationOptions]:
    """The options of a journal, as if they had been given, with the Python files that may be run for it.

    Raises UsageError where some are given as well, and InputError where the journal's make no sense.
    """
    from click.core import ParameterSource

    from kf_calib.effects.user import allowed

    names = {name for name, _ in values_of(ReadingOptions(), EvaluationOptions())} - {*_LEAVE}
    params = [param for param in ctx.command.params if param.name in names]
    given = [
        param.opts[0] for param in params if ctx.get_parameter_source(param.name or "") is ParameterSource.COMMANDLINE
    ]
    if given:
        raise click.UsageError(f"--from-journal has its options from the journal: leave out {', '.join(given)}.")
    journalled = {key: value for key, value in origin.options.items() if key not in ("bench_file", "model_file")}
    values = ctx.params.copy()
    values.update(dict.fromkeys(key for key in _BY_CONTENT if key not in journalled))
    for param in params:
        if (name := param.name or "") in journalled:
            try:
                if isinstance(journalled[name], list | tuple) != bool(getattr(param, "multiple", False)):
                    raise TypeError
                values[name] = param.type_cast_value(ctx, journalled[name])
            except (click.BadParameter, TypeError, ValueError) as error:
                why = error.message if isinstance(error, click.BadParameter) else f"{journalled[name]!r}"
                raise InputError(f"{path}: is no journal of improve (option {name}: {why}).") from None
    programs = allowed(path, origin.programs, values["effects_from"], values["trust"])
    for change in programs.changes:
        complain(f"{change}")
    values["effects_from"] = (*values["effects_from"], *programs.files)
    return grouped(ReadingOptions, values), grouped(EvaluationOptions, values)
