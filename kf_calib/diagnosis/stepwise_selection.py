"""Stepwise selection: diagnose, add an effect, refit, test the effects already added, until there is a reason to stop.

Every step works on the dwell factors of one pass over the data. A refit depends on these factors and on the list of
effects alone, so that a journal of the steps, or the list by itself, gives the same numbers bit for bit.

Without a user, an effect is added only where it is missing with 95 % probability, alone or with others. Elsewhere the
twelve parameters depend on the choice, which is left to a person. Where several effects are missing together, one is
added at a time, the most probable first; the next diagnosis may then say more.
After each addition every effect of the model is tested for removal, except those that the user put in.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from os import PathLike
from typing import Literal

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.bench.streams import Source
from kf_calib.diagnosis.hypothesis_table import SURE, HypothesisTable
from kf_calib.diagnosis.missing_effect import diagnose
from kf_calib.diagnosis.refits import Refits, calibration_of
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.verdict import dwells_apart
from kf_calib.effects import as_text, effect_named, kind_of, merged, refuse_unknown
from kf_calib.errors import InputError, UnobservableError
from kf_calib.estimation import square_root_information
from kf_calib.estimation.calibration import evaluate_fit
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.results import Calibration, Parameter, format_p
from kf_calib.support.tail_probabilities import LEVEL
from kf_calib.support.text import as_html, listing
from kf_calib.support.units import si

_NEAR_THRESHOLD = 8.0  # sigma; an effect near the threshold is found only if noise enlarges it: estimates are too large
_TURNS = 0.5  # sigma of an angle, by which explanations turn the frame where that is said

Because = Literal["consistent", "unknown", "ambiguous", "asked", "undetermined"]
By = Literal["diagnosis", "user"]


@dataclass(frozen=True)
class Removal:
    """The test of removing an effect from a model: rise of chi-squared, its degrees of freedom and its p-value."""

    name: str
    statistic: float
    dof: int
    p_value: float

    @property
    def needed(self) -> bool:
        """Whether the removal would raise chi-squared significantly."""
        return self.p_value < LEVEL


@dataclass(frozen=True)
class SelectionStep:
    """One change of the model.

    added: the effect that was added, as it was written (None: no effect). dropped: effects that were taken out. by: who
    chose the step. diagnosis: that of the model after the step. undone: whether the user took the step back.
    probability: that with which the added effect was missing before the step (None: it was not weighed).
    """

    added: str | None
    dropped: tuple[Removal, ...]
    by: By
    diagnosis: Diagnosis
    undone: bool = False
    probability: float | None = None

    @property
    def result(self) -> Calibration:
        """The calibration after the step."""
        return self.diagnosis.before

    @property
    def name(self) -> str | None:
        """Name of the effect that was added, or None."""
        return None if self.added is None else _name(self.added, self.result)

    @cached_property
    def removals(self) -> tuple[Removal, ...]:
        """The test of removing each effect that is in the model after the step."""
        return removals(self.result.fit)

    @cached_property
    def remarks(self) -> tuple[str, ...]:
        """Sentences of caution about the size or the significance of the effect that was added."""
        sentences = list[str]()
        for test in (removal for removal in self.removals if removal.name == self.name):
            size = float(np.sqrt(max(test.statistic, 0.0)))
            if test.needed and size < _NEAR_THRESHOLD:
                sentences.append(
                    f"{test.name} is {size:.1f} sigma in size, near where it could just be found: such sizes come out "
                    "high on average; measure it on a run of its own before relying on it."
                )
            if not test.needed:
                sentences.append(f"{test.name} explains no more than chance would (p {format_p(test.p_value)}).")
        return tuple(sentences)


@dataclass(frozen=True)
class Alternative:
    """One of several effects among which a run cannot decide, and the calibration with it."""

    name: str
    result: Calibration


@dataclass(frozen=True)
class Spread:
    """The range of one of the twelve parameters over equally good explanations (SI), all in one frame of the platform.

    parameter: the one with the largest sigma among them. lowest, highest: its extreme values.
    """

    parameter: Parameter
    lowest: float
    highest: float

    @property
    def sigmas(self) -> float:
        """The range in units of the largest sigma."""
        return (self.highest - self.lowest) / (self.parameter.sigma or np.nan)


@dataclass(frozen=True)
class Improvement:
    """The steps from a first model to the current one.

    start: the diagnosis of the first model. history: all steps, those that were undone included. asked: whether the
    user ended the improvement. alternatives: the effects among which this run cannot decide, each with its refit; if
    one of them was added already: the current model, then one with each of the others in its place.
    """

    start: Diagnosis
    history: tuple[SelectionStep, ...] = ()
    asked: bool = False
    alternatives: tuple[Alternative, ...] = ()

    def __repr__(self) -> str:
        return f"<Improvement: {self.result.model.sum}, {self.because}>"

    def _repr_html_(self) -> str | None:
        return as_html(self)

    @property
    def steps(self) -> tuple[SelectionStep, ...]:
        """The steps that were not undone."""
        return tuple(step for step in self.history if not step.undone)

    @property
    def diagnosis(self) -> Diagnosis:
        """The diagnosis of the current model."""
        return self.steps[-1].diagnosis if self.steps else self.start

    @property
    def result(self) -> Calibration:
        """The calibration with the current model."""
        return self.diagnosis.before

    @property
    def floor_mps2(self) -> float | None:
        """What noise alone gives as held-out error, by the diagnosis of the current model: one for all steps."""
        return self.diagnosis.floor_mps2

    @property
    def effects(self) -> tuple[str, ...]:
        """The effects of the current model, as text that ``effect_named`` accepts."""
        return tuple(self.result.settings.effects)

    @property
    def protected(self) -> set[str]:
        """Effects that are never taken out automatically: those of the user, and those added again after a removal."""
        users = {step.name for step in self.steps if step.name and step.by == "user"}
        dropped = {removal.name for step in self.steps for removal in step.dropped}
        return {str(effect) for effect in self.start.before.model.effects} | users | dropped

    @cached_property
    def removals(self) -> tuple[Removal, ...]:
        """The test of removing each effect of the current model."""
        return self.steps[-1].removals if self.steps else removals(self.result.fit)

    @cached_property
    def warnings(self) -> list[str]:
        """What was said of the recording, and of the last model."""
        first = self.start.before
        of_models = evaluate_fit(first.fit, first.settings).warnings
        of_recording = [sentence for sentence in first.warnings if sentence not in of_models]
        return list(dict.fromkeys([*of_recording, *self.result.warnings]))

    @property
    def because(self) -> Because:
        """Why the improvement stops with the current model."""
        diagnosis = self.diagnosis
        if self.asked and diagnosis.test.consistent is False:
            return "asked"
        if diagnosis.test.consistent is None:
            return "undetermined"
        if diagnosis.test.consistent:
            return "consistent"
        return "unknown" if diagnosis.unknown else "ambiguous"

    @cached_property
    def reason(self) -> str:
        """The same in one or two sentences."""
        verdict, names = self.diagnosis.verdict, listing(each.name for each in self.alternatives)
        differ = self._difference
        rivals = _rivals(self.diagnosis)
        if rivals and self.because == "ambiguous":
            addition = "none was added (--accept-first takes the likeliest)"
            return f"This run cannot decide among {names}: {addition}{differ}. {verdict}"
        equals = f" But this run cannot decide among {names}; one was taken{differ}." if names and not rivals else ""
        if self.because == "asked":
            return f"Ended by you. {verdict}{equals}"
        if self.because == "consistent":
            diagnoses = self.start, *(step.diagnosis for step in self.steps)
            apart = dwells_apart([number for each in diagnoses for number in each.apart])
            left = f"Nothing is left that noise would not leave (p {format_p(self.diagnosis.test.p_value)})"
            return f"{apart}{left[0].lower() + left[1:] if apart else left}.{equals}"
        if self.diagnosis.missing and self.because == "ambiguous":
            return f"{verdict} No effect is sure: none was added (--accept-first takes the likeliest).{equals}"
        return f"{verdict}{equals}"

    @property
    def _difference(self) -> str:
        """Return how far the equally good explanations are apart in the twelve, as the end of a sentence."""
        widest = max(self.spreads, key=lambda spread: spread.sigmas, default=None)
        if widest is None:
            return ""
        differ = f"the twelve differ by up to {widest.sigmas:.1f} sigma ({widest.parameter.symbol})"
        sigmas = [each.parameter.sigma or 0.0 for each in self.spreads if each.parameter.unit == "rad"]
        turn_rad = max((float(np.linalg.norm(turn)) for turn in self._frame_turns), default=0.0)
        if turn_rad < _TURNS * max(sigmas, default=np.inf):
            return f"; {differ}"
        turn_arcsec = turn_rad / si("1 arcsec")
        return f"; they turn the platform's frame by {turn_arcsec:.2g} arcsec, a choice, and beyond that {differ}"

    @cached_property
    def _states(self) -> list[Floats]:
        """Return the affine states (12,) of the alternatives; none where not all of the twelve are determined."""
        parameters = [[each.result.parameters[symbol].value for symbol in paper_parameters.SYMBOLS]
                      for each in self.alternatives]  # fmt: skip
        if any(value is None for values in parameters for value in values):
            return []
        return [paper_parameters.state_of(np.array(values, float)) for values in parameters]

    @cached_property
    def _frame_turns(self) -> list[Floats]:
        """Return how far the platform's frame of each alternative is turned to that of the first, rad."""
        return [paper_parameters.frame_turn(state, self._states[0]) for state in self._states]

    @cached_property
    def spreads(self) -> tuple[Spread, ...]:
        """The range over all alternatives of each of the twelve parameters that all of them determine; in the frame of
        the first."""
        spreads = list[Spread]()
        turned = [paper_parameters.parameters_of(paper_parameters.turned(state, turn))
                  for state, turn in zip(self._states, self._frame_turns, strict=True)]  # fmt: skip
        for k, symbol in enumerate(paper_parameters.SYMBOLS if self.alternatives else ()):
            parameters = [each.result.parameters[symbol] for each in self.alternatives]
            values = [float(own[k]) for own in turned] or [p.value for p in parameters if p.value is not None]
            if len(values) == len(parameters):
                spreads.append(Spread(max(parameters, key=lambda p: p.sigma or 0.0), min(values), max(values)))
        return tuple(spreads)


def improve(
    run: Calibration | Source | str | PathLike[str],
    accept_first: bool = False,
    on_step: Callable[[Improvement], None] | None = None,
    refits: Refits | None = None,
) -> Improvement:
    """Stepwise selection: add the effects that the diagnosis names until none is missing or none can be chosen.

    run: a calibration, or a recording or source, which is calibrated first. accept_first: where none has 95 %
    probability, take the likeliest instead of stopping. on_step: called after each step. refits: those of the run,
    with its source, as for ``diagnose``.
    """
    start, refits = calibration_of(run, refits)
    state = begin(start, refits)
    while names := next_effects(state.diagnosis, accept_first):
        table = state.diagnosis.table
        for name in names:
            state = take_step(state, refits, name, None if name == names[-1] else (), "diagnosis", table)
            if on_step is not None:
                on_step(state)
    return state


def begin(start: Calibration, refits: Refits) -> Improvement:
    """An improvement without steps, from the diagnosis of a calibration."""
    return _with_alternatives(Improvement(diagnose(start, refits)), refits)


def _with_alternatives(state: Improvement, refits: Refits) -> Improvement:
    """Return the improvement with the effects among which its run cannot decide: those of its diagnosis, or those of an
    earlier one."""
    diagnosis, result = state.diagnosis, state.result
    if _rivals(diagnosis) and diagnosis.table is not None:
        rows = [row for row in (diagnosis.table.first, *diagnosis.table.rivals) if row.effects and not row.driver]
        equal = [Alternative(" + ".join(row.effects), row.refit) for row in rows if row.refit is not None]
        return replace(state, alternatives=tuple(equal))
    alternatives, effects = list[Alternative](), list(result.settings.effects)
    index = {str(effect): k for k, effect in enumerate(result.model.effects)}
    for before, step in zip([state.start, *(step.diagnosis for step in state.steps)], state.steps, strict=False):
        if step.name not in index or step.name not in before.ambiguity:
            continue
        k, others = index[step.name], [name for name in before.ambiguity if name not in index]
        replacements = list[Alternative]()
        for name in others:
            try:
                refit = refits.of(result, [*effects[:k], name, *effects[k + 1 :]])
            except UnobservableError:  # beside the others it does nothing of its own
                continue
            if refit.consistency.consistent is not False:
                replacements.append(Alternative(name, refit))
        alternatives += [Alternative(step.name, result), *replacements] if replacements else []
    return replace(state, alternatives=tuple(alternatives))


def next_effects(diagnosis: Diagnosis, accept_first: bool = False) -> tuple[str, ...]:
    """The effect to add next: of those that are missing with 95 % probability, whether alone or with others, the one
    that explains most; an error of a gimbal with that of the others, which they have for the same reason.

    Empty where nothing is missing, or where the choice is left to a person. accept_first: take the likeliest anyway.
    """
    if diagnosis.test.consistent is not False or not diagnosis.missing or diagnosis.table is None:
        return ()
    probabilities = {name: diagnosis.table.probability((name,)) for name in diagnosis.missing}
    sure = [name for name, probability in probabilities.items() if probability >= SURE]
    if not sure:
        return (max(probabilities, key=lambda name: probabilities[name]),) if accept_first else ()
    falls = {suspect.name: suspect.statistic for suspect in diagnosis.suspects}
    first = max(sure, key=lambda name: falls.get(name, 0.0))
    return first, *(name for name in sure if name != first and kind_of(name) == kind_of(first))


def _rivals(diagnosis: Diagnosis) -> list[str]:
    """Return the effects that could be missing in place of those that are named, where these are not sure."""
    return [] if diagnosis.sure else [name for name in diagnosis.ambiguity if name not in diagnosis.missing]


def extend(state: Improvement, refits: Refits, names: Sequence[str], by: By) -> Improvement:
    """The improvement after adding several effects, one step each; after the last, those not needed are removed."""
    for name in names[:-1]:
        state = take_step(state, refits, name, (), by)
    return take_step(state, refits, names[-1], None, by)


def take_step(
    state: Improvement, refits: Refits, added: str | None, dropped: Sequence[str] | None, by: By,
    table: HypothesisTable | None = None,
) -> Improvement:  # fmt: skip
    """The improvement after one step: ``added`` goes into the model, then effects are taken out.

    state: the improvement before. refits: those of the run. added: name or formula of an effect (None: no effect).
    dropped: names of effects to take out (None: each that is not needed). by: who chose the step. table: by which it
    was chosen, together with others that stay; None: that of the state. Raises InputError where the effect cannot be
    added, or where one to be dropped is not in the model.
    """
    if added is not None:
        _refuse(state.result, added, can_read=refits.source is not None)
    result = state.result if added is None else refits.with_effects(state.result, (added,))
    protected = state.protected | ({_name(added, result)} if added is not None else set[str]())
    protected |= set[str]() if table is None else {*table.first.effects}
    removed = list[Removal]()
    while (removal := _next_removal(result, protected, dropped, len(removed))) is not None:
        both = zip(result.model.effects, result.settings.effects, strict=True)
        result = refits.of(result, tuple(text for effect, text in both if str(effect) != removal.name))
        removed.append(removal)
    table = table or state.diagnosis.table
    probability = None if added is None or table is None else table.probability_of_added(added, _name(added, result))
    step = SelectionStep(added, tuple(removed), by, diagnose(result, refits), probability=probability)
    return _with_alternatives(replace(state, history=(*state.history, step)), refits)


def undone(state: Improvement, refits: Refits) -> Improvement:
    """The improvement with its last step undone, which stays in the history.

    Raises InputError where there is no step to undo.
    """
    last = max((k for k, step in enumerate(state.history) if not step.undone), default=None)
    if last is None:
        raise InputError("there is no step to undo.")
    history = list(state.history)
    history[last] = replace(history[last], undone=True)
    return _with_alternatives(replace(state, history=tuple(history)), refits)


def removals(fitted: Fit) -> tuple[Removal, ...]:
    """The test of removing each effect from a fit: the others are refitted, noise and linearisation are kept.

    For linear effects the test is exact and needs only one triangular factor. A constant inside the columns of an
    effect counts as one of its coefficients.
    """
    from scipy.special import chdtrc

    linearised = fitted.linearised
    upper = square_root_information.accumulate(fitted.all_rows(), fitted.steps)
    rank, misfit, tests = square_root_information.rank(upper[:-1]), upper[-1, -1] ** 2, list[Removal]()
    for effect in linearised.model.effects:
        if effect.walks:  # it is noise, which is judged by its likelihood
            gain = 2.0 * fitted.walk_gain
            tests.append(Removal(str(effect), gain, 1, 0.5 * float(chdtrc(1, max(gain, 0.0)))))
            continue
        rest = np.delete(upper, linearised.model.parts[str(effect)], axis=1)
        reduced = square_root_information.accumulate([rest])
        rise, dof = float(max(reduced[-1, -1] ** 2 - misfit, 0.0)), rank - square_root_information.rank(reduced[:-1])
        tests.append(Removal(str(effect), rise, dof, float(chdtrc(dof, rise)) if dof > 0 else 1.0))
    return tuple(tests)


def _next_removal(
    result: Calibration, protected: set[str], dropped: Sequence[str] | None, count: int
) -> Removal | None:
    """Return the next effect to take out after ``count``: that of ``dropped``, or else the one that is needed least."""
    tests = {each.name: each for each in removals(result.fit)}
    if dropped is not None:
        return _removal_of(tests, dropped[count]) if count < len(dropped) else None
    unneeded = [each for each in tests.values() if not each.needed and each.name not in protected]
    return max(unneeded, key=lambda each: each.p_value, default=None)


def _removal_of(tests: dict[str, Removal], name: str) -> Removal:
    """Return the test of an effect of the model by name."""
    if name not in tests:
        what_it_has = f"it has {', '.join(tests)}." if tests else "it has the twelve parameters only."
        raise InputError(f"{name!r} is not in the model, so it cannot be dropped: {what_it_has}")
    return tests[name]


def _name(text: str, result: Calibration) -> str:
    """Return the name of the effect that a text stands for; of a formula, what stands before its equals sign."""
    return str(effect_named(text, result.bench))


def _refuse(result: Calibration, text: str, can_read: bool) -> None:
    """Raise InputError where an effect cannot be added to the model; can_read: whether slews can still be read."""
    refuse_unknown(text)
    effect = effect_named(text, result.bench)
    if len(merged(result.settings.effects, [text])) == len(result.settings.effects):
        raise InputError(f"{effect} is in the model already: choose another, or drop it first.")
    if Model(result.bench, (effect,)).dynamic and not (result.linearised.slews or can_read):
        raise InputError(f"{effect} shows in slews only, which were not read: start with --with '{as_text(effect)}'.")
