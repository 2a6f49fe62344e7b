"""Commands that evaluate a recording: replay, compare, effects, diagnose, improve."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich_click as click

from kf_calib.cli.command import INPUT, OUTPUT, command
from kf_calib.cli.echo import complain, print_json, progress, show
from kf_calib.cli.files import claimed, delivery, output_option
from kf_calib.cli.options import (
    BENCH_OPTIONS,
    bench_model_option,
    effects_of,
    filter_options,
    json_option,
    opened,
    overrides,
    overwrite_option,
    recording_of,
    recording_options,
    save_model_option,
    save_option,
    settings_of,
    strict_option,
    units_option,
)
from kf_calib.cli.pictures import Pictures, figure_options, picture_options
from kf_calib.cli.report import measured_of, report_option, save_report, typed
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
@click.argument("recording", type=click.Path(path_type=Path))
@recording_options
@filter_options
@bench_model_option
@picture_options
@save_option
@save_model_option
@overwrite_option
@strict_option
@units_option
@json_option
@click.pass_context
def replay(
    ctx: click.Context,
    recording: Path,
    save: Path | None,
    save_model: Path | None,
    overwrite: bool,
    strict: bool,
    as_json: bool,
    **options: Any,
) -> None:
    """Run a recording through the filter: twelve parameters, their sigma, and whether the model fits."""
    from kf_calib.estimation.calibration import calibrate

    outputs, pictures = claimed(overwrite=overwrite), Pictures.taken_from(options)
    source, settings = opened(recording, options)
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
    if strict and result.consistency.consistent is False:
        ctx.exit(1)


@command("compare run.mcap")
@click.argument("recording", type=click.Path(path_type=Path))
@recording_options
@filter_options
@figure_options
@report_option
@overwrite_option
@units_option
@json_option
def compare(recording: Path, report: Path | None, overwrite: bool, as_json: bool, **options: Any) -> None:
    """Block engine, filterpy and batch least squares on the same recording: differences, time, memory."""
    from kf_calib.estimation.engine_comparison import compare as run

    outputs, pictures = claimed(overwrite=overwrite), Pictures.taken_from(options)
    source, settings = opened(recording, options)
    measured = measured_of(recording, options) if report else None
    with progress(f"comparing on {recording.name}", as_json) as tick:
        compared = run(source, settings, tick)
    if as_json:
        from kf_calib.views.json import compare_object

        print_json(compare_object(compared))
    else:
        from kf_calib.views.console import comparison_table

        show(comparison_table(compared))
    with delivery(outputs, as_json) as deliver:
        pictures.save(deliver, compared)
        save_report(deliver, report, compared, measured)


@command("effects", "effects hysteresis", "effects 'mine = fx*fy*T' second-order --recording run.mcap", name="effects")
@click.argument("names", nargs=-1, metavar="[NAME]...")
@click.option(
    "--recording",
    type=click.Path(path_type=Path),
    metavar="REC",
    panel=INPUT,
    help="Say of each effect what this recording shows of it: visible, smallest size, confused with what.",
)
@recording_options
@filter_options
@units_option
@json_option
def list_effects(names: tuple[str, ...], recording: Path | None, as_json: bool, **options: Any) -> None:
    """The effects a model may have: all of the catalogue and your own, or those NAMEd (formulas too) in detail.

    Without --recording they are those of a bench with --axes "y z x" at --latitude 50, or as stated.
    """  # fmt: skip
    from kf_calib.bench.bench import Bench
    from kf_calib.effects import effect_named, refuse_unknown
    from kf_calib.effects import names as known
    from kf_calib.views import catalogue

    effects_of(options)
    for name in names:
        refuse_unknown(name)
    if recording is not None:
        _list_visible(recording, names, as_json, options)
        return
    bench = Bench.from_metadata({"axes": "y z x", "latitude_deg": "50"} | overrides(options))
    chosen = [effect_named(name, bench) for name in names or known(bench)]
    if as_json:
        print_json(catalogue.effects_object(chosen))
    else:
        show(catalogue.details(chosen) if names else catalogue.overview(chosen))


def _list_visible(recording: Path, names: tuple[str, ...], as_json: bool, options: Mapping[str, Any]) -> None:
    """What a recording shows of effects, beside the model of the options."""
    from kf_calib.effects import effect_named
    from kf_calib.effects import names as known
    from kf_calib.estimation.calibration import calibrate
    from kf_calib.estimation.observability import visibility_of
    from kf_calib.views import catalogue
    from kf_calib.views.json import clean

    source, settings = opened(recording, options)
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
@click.argument("recording", type=click.Path(path_type=Path))
@recording_options
@filter_options
@bench_model_option
@click.option(
    "--details", is_flag=True, panel=OUTPUT,
    help="Print the evidence, too: all suspects, where it fails, what this run cannot show, smallest sizes.",
)  # fmt: skip
@picture_options
@overwrite_option
@strict_option
@units_option
@json_option
@click.pass_context
def diagnose(
    ctx: click.Context, recording: Path, details: bool, overwrite: bool, strict: bool, as_json: bool, **options: Any
) -> None:
    """Which physical effect is missing in the model: verdict, probabilities, the shape of it, and what to do next."""
    from kf_calib.diagnosis.missing_effect import diagnose as run
    from kf_calib.diagnosis.refits import Refits
    from kf_calib.estimation.calibration import calibrate
    from kf_calib.views import diagnosis as views

    outputs, pictures = claimed(overwrite=overwrite), Pictures.taken_from(options)
    source, settings = opened(recording, options)
    with progress(f"diagnosing {recording.name}", as_json) as tick:
        diagnosis = run(calibrate(source, settings, tick), Refits(source))
    if as_json:
        print_json(views.diagnosis_object(diagnosis))
    else:
        show(views.diagnosis_report(diagnosis, typed(ctx, _OF_DIAGNOSE_ALONE), details))
    with delivery(outputs, as_json) as deliver:
        pictures.save(deliver, diagnosis)
    if strict and diagnosis.test.consistent is False:
        ctx.exit(1)


@command(
    "improve run.mcap --unattended --save-model found.toml",
    "improve run.mcap --interactive",
    seldom=("accel_unit", "angle_unit", "columns", "left_out"),
)
@click.argument("recording", type=click.Path(path_type=Path))
@click.option("--interactive", is_flag=True, panel=STEPS, help="Ask at every step; usual on a terminal.")
@click.option("--unattended", is_flag=True, panel=STEPS, help="Never ask; usual where there is no terminal.")
@click.option(
    "--accept-first", is_flag=True, panel=STEPS, help="Where no effect has 95 % probability, take the likeliest."
)
@click.option(
    "--honest",
    is_flag=True,
    panel=STEPS,
    help="Held-out error with the choice of effects repeated without what is held out, in 6 folds.",
)
@click.option("--from-journal", type=click.Path(path_type=Path), metavar="FILE", panel=STEPS,
              help="First take the steps of this journal again.")  # fmt: skip
@recording_options
@filter_options
@save_option
@output_option("--save-model", "--out-model", metavar="FILE.toml", help="Save the last model here.", panel=OUTPUT)
@output_option("--journal", "journal_file", metavar="FILE", help="Keep a journal of the steps here.", panel=OUTPUT)
@picture_options
@report_option
@overwrite_option
@strict_option
@units_option
@json_option
@click.pass_context
def improve(
    ctx: click.Context,
    recording: Path,
    interactive: bool,
    unattended: bool,
    accept_first: bool,
    honest: bool,
    save: Path | None,
    save_model: Path | None,
    journal_file: Path | None,
    from_journal: Path | None,
    report: Path | None,
    overwrite: bool,
    strict: bool,
    as_json: bool,
    **options: Any,
) -> None:  # fmt: skip
    """Add the effects that are missing, one after another, and see the error fall, until there is a reason to stop."""
    from kf_calib.cli.improvement_dialogue import dialogue
    from kf_calib.diagnosis import nested_cross_validation, selection_journal, stepwise_selection
    from kf_calib.diagnosis.refits import Refits
    from kf_calib.estimation.calibration import calibrate
    from kf_calib.views import improvement as views

    interactive = _asks(interactive, unattended, as_json)
    outputs, pictures = claimed(overwrite=overwrite), Pictures.taken_from(options)
    earlier = selection_journal.read_journal(from_journal) if from_journal else None
    origin = selection_journal.Origin.of(recording)
    if earlier is not None and from_journal is not None:
        earlier.refuse_other(origin, from_journal)
        options |= _of_journal(ctx, options, earlier.origin, from_journal)
        outputs.spare(options["effects_from"])
    _refuse_engine(options)
    settings = settings_of(options)
    origin = replace(origin, **_for_journal(options, settings.effects))
    measured = measured_of(recording, options) if report else None

    with delivery(outputs, as_json) as deliver:

        def keep(state: stepwise_selection.Improvement) -> None:
            deliver.keep(journal_file, lambda path: selection_journal.write_journal(path, state, origin))

        difference = None
        with progress(f"improving on {recording.name}", as_json) as tick:
            source = recording_of(recording, options)
            start, refits = calibrate(source, settings, tick), Refits(source)
            if earlier is not None:
                state, difference = selection_journal.replay_journal(earlier, start, refits)
            elif interactive:
                state = stepwise_selection.begin(start, refits)
            else:
                state = stepwise_selection.improve(start, accept_first, keep, refits)
        if interactive:
            state = dialogue(state, refits, keep)
        with progress("holding out orientations", as_json or not honest) as tick:
            checked = nested_cross_validation.nested_cross_validation(start, on_fold=tick) if honest else None
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
    if strict and state.diagnosis.test.consistent is False:
        ctx.exit(1)


def _asks(interactive: bool, unattended: bool, as_json: bool) -> bool:
    """Whether to ask at every step; raises UsageError where the options say both."""
    if interactive and unattended:
        raise click.UsageError("--interactive asks at every step, --unattended never does: choose one.")
    if interactive and as_json:
        raise click.UsageError("--interactive asks questions, --json prints one object and nothing else: choose one.")
    return interactive or (not (unattended or as_json) and sys.stdin.isatty() and sys.stdout.isatty())


_BY_CONTENT = ("bench_file", "model_file", *BENCH_OPTIONS)
_LEAVE = ("effects_from", "trust")
"""Options by which a user allows Python files to be run: a journal cannot give them."""


def _refuse_engine(options: Mapping[str, Any]) -> None:
    if options["engine"] != "block":
        raise click.UsageError(
            "improve refits from folded dwells, as the block engine does: leave out --engine, and check what it finds "
            "with replay --model FILE --engine filterpy."
        )


def _for_journal(options: Mapping[str, Any], effects: Sequence[str]) -> dict[str, Any]:
    """Options and programs of an ``Origin``: all that numbers depend on; files of bench keys and of models by what they
    say."""
    from kf_calib.effects import loaded
    from kf_calib.exchange import calibration_file

    files = [*options["effects_from"]]
    if options["model_file"] is not None:
        files += (
            calibration_file.read_model(options["model_file"]).allowed(options["effects_from"], options["trust"]).files
        )
    others = (*_BY_CONTENT, *_LEAVE)
    kept = {key: value for key, value in options.items() if value is not None and key not in others}
    return {"options": kept | overrides(options) | {"effects": list(effects)}, "programs": tuple(loaded(files))}


def _of_journal(ctx: click.Context, options: Mapping[str, Any], origin: Origin, path: Path) -> dict[str, Any]:
    """The options of a journal, as if they had been given, with the Python files that may be run for it.

    Raises UsageError where some are given as well, and InputError where the journal's make no sense.
    """
    from click.core import ParameterSource

    from kf_calib.effects.programs import allowed

    params = [param for param in ctx.command.params if param.name in options and param.name not in _LEAVE]
    given = [
        param.opts[0] for param in params if ctx.get_parameter_source(param.name or "") is ParameterSource.COMMANDLINE
    ]
    if given:
        raise click.UsageError(f"--from-journal has its options from the journal: leave out {', '.join(given)}.")
    journalled = {key: value for key, value in origin.options.items() if key not in ("bench_file", "model_file")}
    values: dict[str, Any] = {key: None for key in _BY_CONTENT if key not in journalled}
    for param in params:
        if (name := param.name or "") in journalled:
            try:
                if isinstance(journalled[name], list | tuple) != bool(getattr(param, "multiple", False)):
                    raise TypeError
                values[name] = param.type_cast_value(ctx, journalled[name])
            except (click.BadParameter, TypeError, ValueError) as error:
                why = error.message if isinstance(error, click.BadParameter) else f"{journalled[name]!r}"
                raise InputError(f"{path}: is no journal of improve (option {name}: {why}).") from None
    programs = allowed(path, origin.programs, options["effects_from"], options["trust"])
    for change in programs.changes:
        complain(f"{change}")
    return values | {"effects_from": (*options["effects_from"], *programs.files)}
