"""The loop: diagnose, add, refit, see the error fall, test what is in already; until there is a reason to stop.

All of it works on the dwell factors of one pass over the data. A model is refitted from nothing but these factors and
its list of effects, so that a journal of the steps, or the list alone, gives the same numbers bit for bit.

Unattended, an effect is added only where nothing else would do as well: where two explain the misfit equally well the
twelve parameters depend on which is taken, and that is a person's choice. Of several that are needed together, one is
added at a time, first one that is the only choice beside the others; the next diagnosis may then know better.
After every addition each effect of the model is tested for being taken out again; what the user put in stays.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from os import PathLike
from typing import Literal

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.streams import Source
from kf_calib.diagnosis.missing_effect import diagnose
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.effects import as_text, effect_named, merged, refuse_unknown
from kf_calib.errors import InputError
from kf_calib.estimation import square_root_information
from kf_calib.estimation.calibration import evaluate_fit, refitted
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.results import Calibration, Parameter, format_p

_NEEDED = 0.01  # an effect whose removal would raise chi-squared by no more than chance does in 99 of 100 runs is not
_NEAR_THRESHOLD = 8.0  # sigma; what is found only if it comes out large comes out too large on average

Because = Literal["consistent", "unknown", "ambiguous", "asked", "undetermined"]
By = Literal["diagnosis", "user"]


@dataclass(frozen=True)
class Removal:
    """What taking an effect out of a model would do: the rise of chi-squared, its degrees of freedom, its p-value."""

    name: str
    statistic: float
    dof: int
    p_value: float

    @property
    def needed(self) -> bool:
        return self.p_value < _NEEDED


@dataclass(frozen=True)
class SelectionStep:
    """One change of the model: what was added (as it was written; None: nothing) and taken out, and what is so then.

    found: the diagnosis of the model after the step. undone: the user took the step back.
    """

    added: str | None
    dropped: tuple[Removal, ...]
    by: By
    found: Diagnosis
    undone: bool = False

    @property
    def result(self) -> Calibration:
        return self.found.before

    @property
    def name(self) -> str | None:
        """Of the effect that was added."""
        return None if self.added is None else _name(self.added, self.result)

    @cached_property
    def removals(self) -> tuple[Removal, ...]:
        """The test of every effect that is in the model now."""
        return removals(self.result.fit)

    @cached_property
    def remarks(self) -> tuple[str, ...]:
        """What must be known of an addition before its size is relied on."""
        own = [each for each in self.removals if each.name == self.name]
        out = list[str]()
        for each in own:
            size = float(np.sqrt(max(each.statistic, 0.0)))
            if each.needed and size < _NEAR_THRESHOLD:
                out.append(
                    f"{each.name} is {size:.1f} sigma in size, near where it could just be found: such sizes come out "
                    "high on average; measure it on a run of its own before relying on it."
                )
            if not each.needed:
                out.append(f"{each.name} explains no more than chance would (p {format_p(each.p_value)}).")
        return tuple(out)


@dataclass(frozen=True)
class Alternative:
    """One of several effects that explain the misfit equally well, and the calibration with it."""

    name: str
    result: Calibration


@dataclass(frozen=True)
class Spread:
    """By how much one of the twelve parameters differs between equal explanations, and its largest sigma (SI)."""

    parameter: Parameter
    lowest: float
    highest: float

    @property
    def sigmas(self) -> float:
        return (self.highest - self.lowest) / (self.parameter.sigma or np.nan)


@dataclass(frozen=True)
class Improvement:
    """The steps from a first model to the last one, and why they ended there (``because``; None: still going on)."""

    start: Diagnosis
    history: tuple[SelectionStep, ...] = ()
    asked: bool = False

    def __repr__(self) -> str:
        return f"<Improvement: {self.result.model.sum}, {self.because}>"

    @property
    def steps(self) -> tuple[SelectionStep, ...]:
        """Those that hold."""
        return tuple(step for step in self.history if not step.undone)

    @property
    def found(self) -> Diagnosis:
        """The diagnosis of the model as it stands."""
        return self.steps[-1].found if self.steps else self.start

    @property
    def result(self) -> Calibration:
        return self.found.before

    @property
    def effects(self) -> tuple[str, ...]:
        """The effects of the model as it stands, as ``effect_named`` takes them."""
        return tuple(self.result.settings.effects)

    @property
    def kept(self) -> set[str]:
        """Effects that are never taken out unasked: the user's, and those that were out once and came back."""
        users = {step.name for step in self.steps if step.name and step.by == "user"}
        gone = {each.name for step in self.steps for each in step.dropped}
        return {str(effect) for effect in self.start.before.model.effects} | users | gone

    @cached_property
    def removals(self) -> tuple[Removal, ...]:
        return self.steps[-1].removals if self.steps else removals(self.result.fit)

    @cached_property
    def warnings(self) -> list[str]:
        """What was said of the recording, and of the last model."""
        first = self.start.before
        of_models = evaluate_fit(first.fit, first.settings).warnings
        said = [sentence for sentence in first.warnings if sentence not in of_models]
        return [*said, *self.result.warnings]

    @property
    def because(self) -> Because:
        """Why it stops here."""
        found = self.found
        if self.asked and found.test.consistent is False:
            return "asked"
        if found.test.consistent is None:
            return "undetermined"
        if found.test.consistent:
            return "consistent"
        return "unknown" if found.unknown else "ambiguous"

    @cached_property
    def reason(self) -> str:
        """The same in a sentence or two."""
        verdict, names = self.found.verdict, " and ".join(each.name for each in self.alternatives)
        far = max(self.spreads, key=lambda spread: spread.sigmas, default=None)
        differ = f"; the twelve differ by up to {far.sigmas:.1f} sigma ({far.parameter.symbol})" if far else ""
        rivals = _rivals(self.found)
        if rivals and self.because == "ambiguous":
            taken = "none was added (--accept-first takes the first)"
            return f"{names} explain what is left equally well: {taken}{differ}. {verdict}"
        equals = f" But {names} explain it equally well, and one was taken{differ}." if names and not rivals else ""
        if self.because == "asked":
            return f"Ended by you. {verdict}{equals}"
        if self.because == "consistent":
            p_value = format_p(self.found.test.p_value)
            return f"Nothing is left that noise would not leave (p {p_value}).{equals}"
        if self.found.missing and self.because == "ambiguous":
            return f"{verdict} Others would do as well: none was added (--accept-first takes the first).{equals}"
        return f"{verdict}{equals}"

    @cached_property
    def alternatives(self) -> tuple[Alternative, ...]:
        """The effects among which this run cannot choose, each refitted beside the model as it stands.

        Where one of them was taken: the model as it stands, then with each of the others in its place.
        """
        if _rivals(self.found):
            return tuple(Alternative(name, self.found.refit_with(name)) for name in self.found.ambiguity)
        out, inside = list[Alternative](), {str(effect): k for k, effect in enumerate(self.result.model.effects)}
        for before, step in zip([self.start, *(step.found for step in self.steps)], self.steps, strict=False):
            if step.name not in inside or step.name not in before.ambiguity:
                continue
            others = [name for name in before.ambiguity if name not in inside]
            own = [Alternative(name, self._with_instead(inside[step.name], name)) for name in others]
            own = [each for each in own if each.result.consistency.consistent is not False]
            out += [Alternative(step.name, self.result), *own] if own else []
        return tuple(out)

    def _with_instead(self, place: int, name: str) -> Calibration:
        effects = list(self.effects)
        effects[place] = name
        return refitted(self.result, tuple(effects))

    @cached_property
    def spreads(self) -> tuple[Spread, ...]:
        """Of each of the twelve that all alternatives determine."""
        out = list[Spread]()
        for symbol in paper_parameters.SYMBOLS if self.alternatives else ():
            own = [each.result.parameters[symbol] for each in self.alternatives]
            values = [p.value for p in own if p.value is not None]
            if len(values) == len(own):
                out.append(Spread(max(own, key=lambda p: p.sigma or 0.0), min(values), max(values)))
        return tuple(out)


def improve(
    run: Calibration | Source | str | PathLike[str],
    accept_first: bool = False,
    on_step: Callable[[Improvement], None] | None = None,
) -> Improvement:
    """Add what the diagnosis names, until nothing is missing or nothing can be named; a recording is calibrated first.

    accept_first: of effects that explain the misfit equally well, take the first instead of stopping.
    """
    state = begin(run)
    while (name := next_effect(state.found, accept_first)) is not None:
        state = take_step(state, name, None, "diagnosis")
        if on_step is not None:
            on_step(state)
    return state


def begin(run: Calibration | Source | str | PathLike[str]) -> Improvement:
    return Improvement(diagnose(run))


def next_effect(found: Diagnosis, accept_first: bool = False) -> str | None:
    """The effect to add next; None where nothing is missing, or where a person must choose."""
    if found.test.consistent is not False or not found.missing:
        return None
    if accept_first:
        return found.missing[0]
    if _rivals(found) or (found.as_scatter and found.test.walking not in found.missing):
        return None  # of a walk that may be scatter the noise is as large either way
    return found.missing[0] if len(found.missing) == 1 else _only_choice(found)


def _only_choice(found: Diagnosis) -> str | None:
    """Of effects that explain the misfit together, the first that nothing can stand for beside the others."""
    before = found.before
    for name in found.missing:
        rest = [other for other in found.missing if other != name]
        beside = diagnose(refitted(before, (*before.settings.effects, *rest)))
        if beside.missing == (name,) and not _rivals(beside):
            return name
    return None


def _rivals(found: Diagnosis) -> list[str]:
    """Effects that would do as well as those that are missing."""
    return [name for name in found.ambiguity if found.missing and name not in found.missing]


def extend(state: Improvement, names: Sequence[str], by: By) -> Improvement:
    """The effects added, a step each; after the last one whatever is not needed any more is taken out."""
    for name in names[:-1]:
        state = take_step(state, name, (), by)
    return take_step(state, names[-1], None, by)


def take_step(state: Improvement, added: str | None, dropped: Sequence[str] | None, by: By) -> Improvement:
    """One step: ``added`` goes in, then each of ``dropped`` out, by name; None: whatever is not needed.

    Raises InputError, in one sentence, where an effect cannot be added or is not there.
    """
    if added is not None:
        _refuse(state.result, added)
    result = state.result if added is None else refitted(state.result, (*state.effects, added))
    kept = state.kept | ({_name(added, result)} if added is not None else set[str]())
    out = list[Removal]()
    while (weak := _next_out(result, kept, dropped, len(out))) is not None:
        result = refitted(result, _less(result, weak.name))
        out.append(weak)
    return replace(state, history=(*state.history, SelectionStep(added, tuple(out), by, diagnose(result))))


def undone(state: Improvement) -> Improvement:
    """The last step that holds, taken back; it stays in the history."""
    last = max((k for k, step in enumerate(state.history) if not step.undone), default=None)
    if last is None:
        raise InputError("there is no step to undo.")
    history = list(state.history)
    history[last] = replace(history[last], undone=True)
    return replace(state, history=tuple(history))


def removals(fitted: Fit) -> tuple[Removal, ...]:
    """What taking each effect out would do: all others refitted, noise and linearisation as they are.

    Exact from one triangle where the effect is linear; a constant inside its columns counts as a coefficient.
    """
    from scipy.special import chdtrc

    carried = fitted.carried
    upper = square_root_information.accumulate(fitted.all_rows(), fitted.steps)
    rank, least, out = square_root_information.rank(upper[:-1]), upper[-1, -1] ** 2, list[Removal]()
    for effect in carried.model.effects:
        if effect.walks:
            gain = 2.0 * fitted.walk_gain
            out.append(Removal(str(effect), gain, 1, 0.5 * float(chdtrc(1, max(gain, 0.0)))))
            continue
        rest = np.delete(upper, carried.model.parts[str(effect)], axis=1)
        corner = square_root_information.accumulate([rest])
        rise, dof = float(max(corner[-1, -1] ** 2 - least, 0.0)), rank - square_root_information.rank(corner[:-1])
        out.append(Removal(str(effect), rise, dof, float(chdtrc(dof, rise)) if dof > 0 else 1.0))
    return tuple(out)


def _next_out(result: Calibration, kept: set[str], dropped: Sequence[str] | None, done: int) -> Removal | None:
    """The next effect to take out of a model: the ``dropped`` in turn, else the one that is needed least."""
    tests = {each.name: each for each in removals(result.fit)}
    if dropped is not None:
        return _there(tests, dropped[done]) if done < len(dropped) else None
    weak = [each for each in tests.values() if not each.needed and each.name not in kept]
    return max(weak, key=lambda each: each.p_value, default=None)


def _there(tests: dict[str, Removal], name: str) -> Removal:
    if name not in tests:
        inside = f"it has {', '.join(tests)}." if tests else "it has the twelve parameters only."
        raise InputError(f"{name!r} is not in the model, so it cannot be dropped: {inside}")
    return tests[name]


def _less(result: Calibration, name: str) -> tuple[str, ...]:
    both = zip(result.model.effects, result.settings.effects, strict=True)
    return tuple(text for effect, text in both if str(effect) != name)


def _name(text: str, result: Calibration) -> str:
    """What the effect of a text is called: for a formula, what stands before its equals sign."""
    return str(effect_named(text, result.bench))


def _refuse(result: Calibration, text: str) -> None:
    refuse_unknown(text)
    effect = effect_named(text, result.bench)
    if len(merged(result.settings.effects, [text])) == len(result.settings.effects):
        raise InputError(f"{effect} is in the model already: choose another, or drop it first.")
    if effect.dynamic and not result.carried.slews:
        raise InputError(f"{effect} shows in slews only, which were not read: start with --with '{as_text(effect)}'.")
