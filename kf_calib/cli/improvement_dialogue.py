"""The dialogue of ``improve --interactive``: what to do next is asked until the user ends it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import rich_click as click
from rich.text import Text

from kf_calib.cli.echo import progress, show
from kf_calib.diagnosis.refits import Refits
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.stepwise_selection import Improvement, extend, take_step, undone
from kf_calib.errors import InputError
from kf_calib.support.plain_text import sentence
from kf_calib.views.improvement import choices_table

HOW = "number: add it; a NAME, f FORMULA: add that; d NAME: drop; u: undo; q: finish"


def dialogue(state: Improvement, refits: Refits, on_step: Callable[[Improvement], None]) -> Improvement:
    """Ask the user what to do next until the user ends the improvement, and return it.

    state: the improvement at first. refits: those of the run. on_step: called after each step.
    """
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


def choices_of(found: Diagnosis) -> list[tuple[str, ...]]:
    """The effects that can be added by number: the missing effects together, then each suspect."""
    out = [found.missing] if found.missing else []
    out += [(suspect.name,) for suspect in found.suspects if (suspect.name,) != found.missing]
    return out


def after_answer(state: Improvement, refits: Refits, answer: str, choices: Sequence[tuple[str, ...]]) -> Improvement:
    """The improvement after an answer of the user; raises InputError where the answer cannot be understood or done.

    choices: the effects that may be chosen by number.
    """
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
