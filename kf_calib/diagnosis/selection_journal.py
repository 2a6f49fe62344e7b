"""Journals of improvement: every step with its figures as TOML, to keep beside a calibration and to replay.

    version = "0.1.0"
    stopped_because = "consistent"
    reason = "Nothing is left that noise would not leave (p = 0.31)."
    model = ["second-order"]

    [recording]                             # a replay of the journal refuses any other file
    name = "hidden.mcap"
    sha256 = "4f0e..."

    [options]                               # those given on the command line; a replay uses them again
    angle_sigma_deg = "0.002"

    [sha256]                                # of the Python files under effects_from; a replay asks before it runs them
    "/home/me/my_effects.py" = "9c1a..."

    [start]                                 # figures of the first model in SI, with all digits
    held_out_rms_mps2 = 1.4e-5

    [[steps]]
    added = "second-order"
    probability = 0.998                     # with which it was missing before the step
    by = "diagnosis"
    undone = false
    ...

Figures keep all their digits, so that a replay can tell whether it gave the same numbers to the last bit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NotRequired

from typing_extensions import TypedDict

from kf_calib.diagnosis.refits import Refits
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.stepwise_selection import By, Improvement, SelectionStep, begin, take_step
from kf_calib.effects import refuse_unfit
from kf_calib.effects.programs import Program
from kf_calib.errors import InputError
from kf_calib.estimation.results import Calibration
from kf_calib.sources.files.record_files import fingerprint
from kf_calib.support.output_files import write_whole
from kf_calib.support.toml_files import FINITE, TEXT, Misfit, converted, toml_table


@dataclass(frozen=True)
class Origin:
    """What an improvement was made from.

    name: of the recording. sha256: fingerprint of the recording. options: those of the command line. programs: Python
    files with effects.
    """

    name: str
    sha256: str
    options: Mapping[str, Any] = field(default_factory=dict[str, Any])
    programs: tuple[Program, ...] = ()

    @classmethod
    def of(cls, recording: Path) -> Origin:
        """The origin of an improvement of this recording; raises InputError where it cannot be read."""
        return cls(recording.name, fingerprint(recording))


@dataclass(frozen=True)
class Choice:
    """One step in a journal: the effect added, those dropped, who chose it, and the figures that resulted."""

    added: str | None
    dropped: tuple[str, ...]
    by: By
    figures: Mapping[str, float]


@dataclass(frozen=True)
class Journal:
    """The content of a journal, without steps that were undone.

    origin: what it was made from. version: of the program. start: figures of the first model. choices: the steps.
    asked: whether the user ended the improvement.
    """

    origin: Origin
    version: str
    start: Mapping[str, float]
    choices: tuple[Choice, ...]
    asked: bool

    def refuse_other(self, origin: Origin, path: Path | None) -> None:
        """Raise InputError where the recording is not the one from which the journal was made."""
        if origin.sha256 != self.origin.sha256:
            raise InputError(
                f"{path}: is the journal of another recording, {self.origin.name}: name that one, or put the same "
                "effects into this one with --model."
            )


def figures(diagnosis: Diagnosis) -> dict[str, float]:
    """The figures that are compared in a replay: the p-value, the errors, and every parameter with its sigma (SI)."""
    result, values = diagnosis.before, dict[str, float | None]()
    values |= {
        "p_value": diagnosis.test.p_value,
        "residual_rms_mps2": result.residual_rms_mps2,
        "held_out_rms_mps2": result.held_out_rms_mps2,
        "held_out_floor_mps2": result.held_out_floor_mps2,
    }
    for parameter in result.parameters.values():
        values |= {parameter.symbol: parameter.value, f"sigma {parameter.symbol}": parameter.sigma}
    return {key: value for key, value in values.items() if value is not None}


def write_journal(path: Path, state: Improvement, origin: Origin) -> None:
    """Write a journal of the steps so far.

    An existing file of that name is replaced as a whole; it is never left half written.
    """
    from importlib.metadata import version

    import tomli_w

    table: dict[str, Any] = {
        "version": version("kf_calib"),
        "stopped_because": state.because,
        "reason": state.reason,
        "model": list(state.effects),
        "recording": {"name": origin.name, "sha256": origin.sha256},
        "options": {**origin.options, "effects_from": [str(each.path) for each in origin.programs]},
        "sha256": {str(each.path): each.sha256 for each in origin.programs},
        "start": figures(state.start),
        "steps": [_entry(step) for step in state.history],
    }
    head = "# Journal of kf_calib: kf-calib improve RECORDING --from-journal THIS_FILE\n"
    write_whole(path, (head + tomli_w.dumps(table)).encode())


def _entry(step: SelectionStep) -> dict[str, Any]:
    """Return the table of one step."""
    entry: dict[str, Any] = {} if step.added is None else {"added": step.added}
    entry |= {} if step.probability is None else {"probability": step.probability}
    tests = [vars(each) for each in step.dropped]
    return entry | {"by": step.by, "undone": step.undone, "dropped": tests, "figures": figures(step.diagnosis)}


class _Recording(TypedDict):
    name: TEXT
    sha256: TEXT


class _Dropped(TypedDict):
    name: TEXT


class _Step(TypedDict):
    by: By
    undone: bool
    dropped: list[_Dropped]
    figures: dict[str, FINITE]
    added: NotRequired[TEXT]


class _Content(TypedDict):
    version: TEXT
    stopped_because: TEXT
    recording: _Recording
    options: dict[str, TEXT | bool | int | FINITE | list[TEXT | int | FINITE]]
    start: dict[str, FINITE]
    steps: list[_Step]
    sha256: NotRequired[dict[TEXT, TEXT]]


def read_journal(path: Path) -> Journal:
    """Read a journal and check all that can be checked before the Python files that it names have run.

    Raises InputError, with the path, where the file cannot be read or is no journal.
    """
    table = toml_table(path, "those of improve --journal")
    try:
        content: _Content = converted(table, _Content)
        options, sums = dict(content["options"]), content.get("sha256", {})
        files = converted(options.pop("effects_from", []), list[TEXT])
        programs = tuple(Program(Path(text), sums.get(text, "")) for text in files)
        choices = tuple(_choice(step) for step in content["steps"] if not step["undone"])
        given = converted(options.get("effects", []), list[TEXT])
        refuse_unfit([*given, *(choice.added for choice in choices if choice.added)], programs)
    except (Misfit, InputError) as error:
        raise InputError(f"{path}: is no journal of improve ({error}): write one with --journal.") from None
    origin = Origin(content["recording"]["name"], content["recording"]["sha256"], options, programs)
    return Journal(origin, content["version"], content["start"], choices, content["stopped_because"] == "asked")


def _choice(step: _Step) -> Choice:
    """Return the choice that an entry of a journal records."""
    return Choice(step.get("added"), tuple(each["name"] for each in step["dropped"]), step["by"], step["figures"])


def replay_journal(
    journal: Journal, start: Calibration, refits: Refits, on_step: Callable[[Improvement], None] | None = None
) -> tuple[Improvement, float]:
    """The steps of a journal repeated, and the largest relative difference from its figures (0: equal to the last bit).

    start: the calibration with the first model. refits: those of the run. on_step: called after each step.
    """
    state = begin(start, refits)
    differences = [_difference(journal.start, figures(state.diagnosis))]
    for choice in journal.choices:
        state = take_step(state, refits, choice.added, choice.dropped, choice.by)
        differences.append(_difference(choice.figures, figures(state.diagnosis)))
        if on_step is not None:
            on_step(state)
    return replace(state, asked=journal.asked), max(differences)


def _difference(one: Mapping[str, float], other: Mapping[str, float]) -> float:
    """Return the largest relative difference of two sets of figures; infinite where their keys differ."""
    if one.keys() != other.keys():
        return float("inf")
    return max(abs(one[key] - other[key]) / max(abs(one[key]), abs(other[key]), 1e-300) for key in one)
