"""The command ``improve``: effects are added one after another, by itself or in a dialogue."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import rich_click as click

from kf_calib.bench.keys import StatedBench
from kf_calib.cli.command import argument, command, option, values_of
from kf_calib.cli.echo import print_json, progress, show
from kf_calib.cli.files import Pictures, ReportFile, claimed, delivery, output_option
from kf_calib.cli.options import (
    EvaluationOptions,
    Json,
    Overwrite,
    ProgramOptions,
    ReadingOptions,
    Save,
    ShownUnits,
    Strict,
    exit_if,
)
from kf_calib.errors import InputError
from kf_calib.support.leaves import leaf
from kf_calib.support.text import sentence

if TYPE_CHECKING:
    from kf_calib.diagnosis.refits import Refits
    from kf_calib.diagnosis.results import Diagnosis
    from kf_calib.diagnosis.selection_journal import Origin
    from kf_calib.diagnosis.stepwise_selection import Improvement

STEPS = "Steps"


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
def improve(
    recording: Annotated[Path, argument()], steps: StepOptions, reading: ReadingOptions,
    evaluation: EvaluationOptions, save: Save,
    save_model: Annotated[Path | None, output_option(
        "--save-model", "--out-model", metavar="FILE.toml", help="Save the last model here.")],
    journal_file: Annotated[Path | None, output_option(
        "--journal", metavar="FILE", help="Keep a journal of the steps here.")],
    pictures: Pictures, report: ReportFile, overwrite: Overwrite, strict: Strict, units: ShownUnits, as_json: Json,
) -> None:  # fmt: skip
    """Add the effects that are missing, one after another, and see the error fall, until there is a reason to stop."""
    from kf_calib.diagnosis import nested_cross_validation, selection_journal, stepwise_selection
    from kf_calib.diagnosis.refits import Refits
    from kf_calib.estimation.calibration import calibrate
    from kf_calib.views import improvement as views

    interactive, outputs = steps.asks(as_json), claimed(overwrite=overwrite)
    _refuse_engine(evaluation)
    settings = evaluation.settings()
    origin = _for_journal(recording, reading, evaluation, settings.effects)
    reports = leaf("report.command", "--report") if report else None
    measured = reports.measured_of(recording, reading.opened(recording)) if reports else None

    with delivery(outputs, as_json) as deliver:

        def keep(state: stepwise_selection.Improvement) -> None:
            deliver.keep(journal_file, lambda path: selection_journal.write_journal(path, state, origin))

        with progress(f"improving on {recording.name}", as_json) as tick:
            source = reading.opened(recording)
            start, refits = calibrate(source, settings, tick), Refits(source)
            if interactive:
                state = stepwise_selection.begin(start, refits)
            else:
                state = stepwise_selection.improve(start, steps.accept_first, keep, refits)
        if interactive:
            state = dialogue(state, refits, keep)
        with progress("holding out orientations", as_json or not steps.honest) as tick:
            checked = nested_cross_validation.nested_cross_validation(start, on_fold=tick) if steps.honest else None
        if as_json:
            files = {"saved_model": save_model, "journal": journal_file}
            print_json(views.improvement_object(state, checked, files))
        else:
            show(views.improvement_report(state, checked))
        deliver.calibration(save, state.result, source)
        deliver.model(save_model, state.result)
        deliver.file(journal_file, lambda path: selection_journal.write_journal(path, state, origin))
        pictures.save(deliver, state)
        if reports is not None:
            remarks = [views.honest_sentence(checked)] if checked else []
            reports.save_report(deliver, report, state, measured, remarks)
    exit_if(strict and state.diagnosis.test.consistent is False)


_BY_CONTENT = ("model_file", "bench_file", *StatedBench.__annotations__)
_LEAVE = tuple(field.name for field in fields(ProgramOptions))
"""Options by which a user allows Python files to be run: a journal cannot give them."""


def _refuse_engine(evaluation: EvaluationOptions) -> None:
    if evaluation.engine != "block":
        raise click.UsageError(
            "improve refits from folded dwells, as the block engine does: leave out --engine, and check what it finds "
            "with replay --model FILE --engine filterpy."
        )


def _for_journal(
    recording: Path, reading: ReadingOptions, evaluation: EvaluationOptions, effects: Sequence[str]
) -> Origin:
    """What the improvement is made from, with all that numbers depend on: options and programs; files of bench keys and
    of models by what they say."""
    from kf_calib.diagnosis.selection_journal import Origin
    from kf_calib.effects import loaded
    from kf_calib.exchange import calibration_file
    from kf_calib.sources.files.record_files import fingerprint

    programs = evaluation.programs
    files = [*programs.effects_from]
    if evaluation.model_file is not None:
        model = calibration_file.read_model(evaluation.model_file)
        files += model.allowed(programs.effects_from, programs.trust).files
    others = (*_BY_CONTENT, *_LEAVE)
    kept = {key: value for key, value in values_of(reading, evaluation) if value is not None and key not in others}
    options = kept | {**reading.keys} | {"effects": list(effects)}
    return Origin(recording.name, fingerprint(recording), options, tuple(loaded(files)))


HOW = "number: add it; a NAME, f FORMULA: add that; d NAME: drop; u: undo; q: finish"


def dialogue(state: Improvement, refits: Refits, on_step: Callable[[Improvement], None]) -> Improvement:
    """Ask the user what to do next until the user ends the improvement, and return it.

    state: the improvement at first. refits: those of the run. on_step: called after each step.
    """
    from rich.text import Text

    from kf_calib.views.improvement import choices_table

    shown: Improvement | None = None
    while True:
        choices = choices_of(state.diagnosis)
        if shown is not state:
            show(choices_table(state, choices))
            shown = state
        usual = "q" if not choices else "1" if state.diagnosis.missing else None
        answer = click.prompt(HOW, default=usual).strip()
        if answer == "q":
            return replace(state, asked=True)
        try:
            with progress("improving"):
                state = after_answer(state, refits, answer, choices)
            on_step(state)
        except InputError as error:
            show(Text(sentence(str(error)), style="red"))


def choices_of(diagnosed: Diagnosis) -> list[tuple[str, ...]]:
    """The effects that can be added by number: the missing effects together, then each suspect."""
    choices = [diagnosed.missing] if diagnosed.missing else []
    choices += [(suspect.name,) for suspect in diagnosed.suspects if (suspect.name,) != diagnosed.missing]
    return choices


def after_answer(state: Improvement, refits: Refits, answer: str, choices: Sequence[tuple[str, ...]]) -> Improvement:
    """The improvement after an answer of the user; raises InputError where the answer cannot be understood or done.

    choices: the effects that may be chosen by number.
    """
    from kf_calib.diagnosis.stepwise_selection import extend, take_step, undone

    word, _, rest = answer.partition(" ")
    rest = rest.strip()
    if answer == "u":
        return undone(state, refits)
    if word == "d" and rest:
        return take_step(state, refits, None, (rest,), "user")
    if word == "f" and rest:
        return extend(state, refits, (rest if "=" in rest else f"mine = {rest}",), "user")
    if word == "a" and rest:
        return extend(state, refits, (rest,), "user")
    if answer.isdigit() and 1 <= int(answer) <= len(choices):
        return extend(state, refits, choices[int(answer) - 1], "user")
    raise InputError(f"{answer!r} is no answer: {HOW}.")
