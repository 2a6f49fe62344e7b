"""Diagnosis of a calibration: which physical effect is missing in its model, and which others explain it, too.

Whether anything is missing is decided by ``candidate_tests``, with a false-alarm rate that holds for the run. What it
is, is decided by the ``posterior`` over all explanations: the likeliest row gives the verdict, and the rows that have
99 % of the probability together are the set that is named. Effects that make the error of orientations left out larger
are not named.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from os import PathLike

import numpy as np

from kf_calib.bench.arrays import one_blas_thread
from kf_calib.bench.streams import Source
from kf_calib.diagnosis.candidate_tests import CandidateTests, overlap_matrix
from kf_calib.diagnosis.hypothesis_table import (
    ALIKE,
    LISTED,
    NOISE,
    NOTHING,
    SURE,
    Hypothesis,
    HypothesisTable,
    noise_p,
    table_of,
)
from kf_calib.diagnosis.posterior import RunPosterior
from kf_calib.diagnosis.refits import (
    Refits,
    calibration_of,
    dwell_noise_is_stated,
    with_noise_as_stated,
    with_noise_beside_oscillation,
)
from kf_calib.diagnosis.replication import Replication, replication
from kf_calib.diagnosis.results import Diagnosis, Suspect
from kf_calib.diagnosis.slew_effects import of_slews
from kf_calib.diagnosis.verdict import format_probability, second_pass_in_words, verdict_in_words
from kf_calib.dwells import window_average
from kf_calib.effects import effect_named
from kf_calib.errors import UnobservableError
from kf_calib.estimation.filter_history import readings_of
from kf_calib.estimation.outlying_dwell import wrong_dwell
from kf_calib.estimation.results import Calibration
from kf_calib.support.tail_probabilities import LEVEL, NO_CHANCE, chi_squared_tail, log_odds_of

_SHOWN = 6  # number of suspects that are shown


def diagnose(
    run: Calibration | Source | str | PathLike[str], refits: Refits | None = None, *, replicate: bool = True
) -> Diagnosis:
    """Diagnosis of a calibration, or of a recording or source, which is calibrated first.

    It works on the dwell factors. The readings are read again only where an oscillation or vibration requires it, which
    for a calibration is possible only with ``refits``.

    run: what is diagnosed. refits: those of the run, with its source (None: new ones, without the source of a
    calibration). replicate: whether to try what is named on dwells that choosing it never saw (``replication``).
    """
    before, refits = calibration_of(run, refits)
    with one_blas_thread():
        diagnosis = refits.once(before, lambda: _with_readings(refits, before, _diagnosed(refits, before)))
        return replace(diagnosis, replication=_replication(diagnosis)) if replicate else diagnosis


def _with_readings(refits: Refits, before: Calibration, diagnosis: Diagnosis) -> Diagnosis:
    """Return a diagnosis with the readings of the dwell that it calls disturbed, which are read again."""
    number = diagnosis.disturbed_dwell
    if not number or refits.source is None or not before.noise.within_seen:
        return diagnosis
    return replace(diagnosis, disturbed_readings=readings_of(refits.source, before, number, left_out=True))


def _replication(diagnosis: Diagnosis) -> Replication | None:
    """Return the replication of what a diagnosis names; None where it names nothing."""
    if not diagnosis.missing or diagnosis.after is None or diagnosis.after.model.dynamic:
        return None
    before = diagnosis.before_in_noise_left or diagnosis.before
    count = len({*diagnosis.missing} & {*diagnosis.test.effects.best})
    return replication(before, diagnosis.ambiguity, max(count, 1), diagnosis.after.consistency)


def _diagnosed(refits: Refits, before: Calibration) -> Diagnosis:
    """Diagnose a calibration: a dwell that alone is off is a term beside all others, which takes all that it says, so
    that what else is missing is told by the other dwells, where these are fitted."""
    diagnosis = _of_all_dwells(refits, before)
    number = diagnosis.likeliest.dwells[0] if diagnosis.likeliest and diagnosis.likeliest.dwells else 0
    rest = refits.without_dwells(before, (number,)) if number else None
    beside = None if rest is None else _diagnosed(refits, rest)
    if beside is None or diagnosis.table is None:
        return diagnosis
    if beside.test.consistent is False:
        return _in_words(replace(beside, apart=(number, *beside.apart)))
    at = [dwell.number for dwell in before.fit.dwells].index(number)
    wrong = wrong_dwell(before, at, beside.before) if before.bench.angles else None
    return _in_words(replace(diagnosis, table=diagnosis.table.with_dwell_alone(number), wrong_dwell=wrong))


def _of_all_dwells(refits: Refits, before: Calibration) -> Diagnosis:
    """Diagnose a calibration by all of its dwells, with vibration averaged out."""
    test = _without_vibration(refits, before, refits.assess(before))
    oscillating = None if test.lines.vibration else _oscillating(refits, before)
    if oscillating is not None:
        return _in_words(oscillating)
    diagnosis = _explained(refits, before, test)
    if diagnosis.unknown and test.without_lines:  # the lines keep their phase through the run, but not their amplitude
        test = test.without_lines
        diagnosis = _explained(refits, before, test)
    if test.lines.vibration and before.bench.angles and not before.fit.dwells.folded.averaged:
        averaged = refits.averaged(before, window_average.window_s(test.lines.vibration))
        if averaged is not None:
            retest = refits.assess(averaged)
            retest = retest.without_lines or retest  # lines that are left after averaging are vibration, too
            diagnosis = _explained(refits, averaged, retest.with_vibration(test.lines.vibration))
    return _in_words(diagnosis)


def _oscillating(refits: Refits, before: Calibration) -> Diagnosis | None:
    """Return the diagnosis of a run in which an oscillation was taken for slow noise; None for any other."""
    quieter = with_noise_beside_oscillation(refits, before)
    if quieter is None:
        return None
    diagnosis = _explained(refits, quieter, _without_vibration(refits, quieter, refits.assess(quieter)))
    named = any(effect_named(name, before.bench).oscillates for name in diagnosis.missing)
    return replace(diagnosis, before=before, before_in_noise_left=quieter) if named else None


def _in_words(diagnosis: Diagnosis) -> Diagnosis:
    """Return a diagnosis with its verdict."""
    words = verdict_in_words(diagnosis) + second_pass_in_words(diagnosis)
    return replace(diagnosis, verdict=words)


def _without_vibration(refits: Refits, before: Calibration, test: CandidateTests) -> CandidateTests:
    """Return the test as it is if an oscillation of constant amplitude explains its lines, else that with vibration."""
    if test.without_lines is None:
        return test
    refit = refits.with_effects(before, (test.lines.oscillation,))
    # amplitude of the coherent fit over the whole run, over the amplitude seen in each stretch of readings
    whole = np.linalg.norm(refit.estimate.state[refit.model.parts[test.lines.oscillation]])
    seen = np.linalg.norm(test.lines.significant[0].amplitude_mps2)
    return test if whole > 0.5 * seen and _leaves_noise(refit, before) else test.without_lines


def _leaves_noise(refit: Calibration, before: Calibration) -> bool:
    """Tell whether a fitted oscillation leaves noise in what is kept of the readings within dwells for its sake."""
    with_oscillation, without = refit.consistency, before.consistency
    rows = with_oscillation.dof - without.dof
    return rows <= 0 or chi_squared_tail(rows, max(with_oscillation.statistic - without.statistic, 0.0)) > NO_CHANCE


def _explained(refits: Refits, before: Calibration, test: CandidateTests) -> Diagnosis:
    """Return the diagnosis by these tests."""
    diagnosis = Diagnosis(before=before, test=test)
    if test.consistent is None:
        return diagnosis
    if test.consistent:  # noise that is estimated from all of the misfit explains as much of it as an effect does
        posterior, stated = RunPosterior(refits, before, test), dwell_noise_is_stated(before)
        table = posterior.table(refitted=not stated)
        if not (stated and noise_p(table) >= LEVEL):
            table = posterior.table() if stated else table
            diagnosis = replace(diagnosis, test=replace(test, noise_p=noise_p(table)))
        diagnosis = replace(diagnosis, table=table)
        if not diagnosis.test.consistent:
            return _decided(refits, diagnosis)
        turning = of_slews(refits, before)
        if turning is None:
            return diagnosis
        table, p_value = turning
        return _decided(refits, replace(diagnosis, test=replace(test, noise_p=p_value), table=table))
    if test.lines.oscillation:
        return _decided(refits, replace(diagnosis, table=_beside_lines(refits, before, test)))
    return _decided(refits, replace(diagnosis, table=RunPosterior(refits, before, test).table()))


def _beside_lines(refits: Refits, before: Calibration, test: CandidateTests) -> HypothesisTable:
    """Return the table where an oscillation makes lines within dwells, which nothing else could.

    Every known explanation has it, too; with noise from dwell to dwell it is the oscillation that is missing.
    """
    name, with_oscillation = test.lines.oscillation, refits.with_effects(before, (test.lines.oscillation,))
    test_beside = refits.assess(with_oscillation, test.effects.independent_tests)
    log_odds = log_odds_of(test.effects.p_values[test.lines.oscillation])
    family = with_oscillation.model.effects[-1].family
    posterior = RunPosterior(refits, with_oscillation, test_beside)
    table = posterior.table() if test_beside.consistent is False else posterior.table(refitted=False)
    rows = [row for row in table.rows if row.driver != ALIKE]
    logs_without = [row.log_evidence for row in rows if not row.effects and not row.driver]
    both = [
        _with(refits, before, row, name, family) if row.effects else row for row in rows if row.effects or row.driver
    ]
    log_alone = float(np.logaddexp.reduce(logs_without))
    alone = Hypothesis((name,), families=(family,), log_evidence=log_alone, refit=with_oscillation)
    nothing = Hypothesis(families=(NOTHING,), log_evidence=max(row.log_evidence for row in [*both, alone]) - log_odds)
    return table_of([*both, alone, nothing])


def _with(refits: Refits, before: Calibration, row: Hypothesis, name: str, family: str) -> Hypothesis:
    """Return a row with one effect more, fitted together with the others if it is likely enough to be told; nothing
    speaks for one that does nothing beside the others."""
    effects, families = (*row.effects, name), tuple(dict.fromkeys([*row.families, family]))
    row = replace(row, effects=effects, families=families)
    if row.probability < LISTED:
        return replace(row, refit=None)
    try:
        return replace(row, refit=refits.with_effects(before, (*effects, *row.formulas)))
    except UnobservableError:
        return replace(row, log_evidence=-math.inf, refit=None)


def _decided(refits: Refits, diagnosis: Diagnosis) -> Diagnosis:
    """Return the diagnosis with what its table says: the likeliest row, and the set that holds most probability."""
    before, table = diagnosis.before, diagnosis.table
    assert table is not None
    first, test = table.first, diagnosis.test
    if first.dwells:  # what else is missing is told by the others
        scatter = table.families.get(NOISE, 0.0) >= LISTED
        return replace(diagnosis, unknown=True, as_scatter=scatter, suspects=_suspects(diagnosis, table))
    if not dwell_noise_is_stated(before) and first.refit is not None:
        before_in_noise_left = with_noise_as_stated(refits, before, first.refit)
        retest = refits.assess(before_in_noise_left)
        retest = retest if test.lines.oscillation else retest.without_lines or retest
        if retest.consistent is False:
            final_test = retest.with_vibration(test.lines.vibration)
            diagnosis, test = replace(diagnosis, before_in_noise_left=before_in_noise_left, test=final_test), retest
    after = _after(refits, before, first) if first.effects else None
    why_not = _grown(before, first.effects, after) or behind_nothing(first, table)
    certain = _certain_part(first, table, before)
    if certain is not None:
        table, first, why_not = replace(table, certain=certain), certain, ""
        diagnosis = replace(diagnosis, table=table)
    credible = (first, *table.rivals) if first.effects else ()
    named = first if first.effects and not why_not else None
    same = table.same if first.effects else ()
    names = tuple(dict.fromkeys([*(name for row in credible for name in row.effects), *same]))
    pairs = [row.effects for row in credible[1:] if len(row.effects) > 1 and not set(first.effects) & set(row.effects)]
    return replace(
        diagnosis,
        missing=named.effects if named else (),
        unearned=why_not,
        unknown=first.unknown,
        noise=first.families == (NOISE,),
        ambiguity=names,
        overlaps=_overlaps(diagnosis.test, first.effects, names),
        together=tuple(pairs),
        as_scatter=table.families.get(NOISE, 0.0) >= LISTED,
        after=_after(refits, before, named) if named else None,
        suspects=_suspects(diagnosis, table),
    )


def _certain_part(first: Hypothesis, table: HypothesisTable, before: Calibration) -> Hypothesis | None:
    """Return the row of some of the effects of the likeliest row that are missing with 95 % probability, alone or with
    others, where all of them are not; None where there is none, or where all of them are likelier than not, and it is
    sure that one more is a known one."""
    is_sure = table.probability(first.effects) >= SURE and not first.formulas
    if is_sure and not _grown(before, first.effects, first.refit):
        return None
    parts = [row for row in table.rows if row.refit is not None and row.effects and not row.formulas]
    parts = [row for row in parts if set(row.effects) < set(first.effects) and table.probability(row.effects) >= SURE]
    if first.probability > 0.5:
        parts = [row for row in parts if table.probability_of_just_known(row.effects) > 1.0 - SURE]
    return next((row for row in parts if not _grown(before, row.effects, row.refit)), None)


def behind_nothing(first: Hypothesis, table: HypothesisTable) -> str:
    """Why the effects of the likeliest row must not be named where none missing at all is likelier; "" elsewhere."""
    nothing = table.families.get(NOTHING, 0.0)
    likelier = first.effects and nothing > first.probability
    return f"that nothing is missing is likelier ({format_probability(nothing)})" if likelier else ""


def _after(refits: Refits, before: Calibration, named: Hypothesis) -> Calibration | None:
    """Return the calibration with the effects of a row, without the formula beside them."""
    return refits.with_effects(before, named.effects) if named.formulas else named.refit


def _overlaps(test: CandidateTests, first: tuple[str, ...], names: tuple[str, ...]) -> dict[str, float]:
    """Return the overlap of each other effect with the one of the first row that it overlaps most."""
    matrix, rank = overlap_matrix(test, names), {name: k for k, name in enumerate(names)}
    return {
        name: float(np.nanmax([0.0, *(matrix[rank[name], rank[effect]] for effect in first)]))
        for name in names
        if name not in first
    }


def _suspects(diagnosis: Diagnosis, table: HypothesisTable) -> tuple[Suspect, ...]:
    """Return the single effects of the table, the likeliest first, each with its test and its refit."""
    effects, suspects = diagnosis.test.effects, list[Suspect]()
    symbols_before = tuple(diagnosis.before.parameters)[12:]
    for row in table.rows:
        if len(row.effects) != 1 or row.formulas or row.refit is None or len(suspects) == _SHOWN:
            continue
        (name,) = row.effects
        if name in effects.best:
            statistic, dof = float(effects.scan.statistics[effects.best[name]]), effects.candidate(name).dof
        else:
            statistic, dof = effects.scores.get(name, 0.0), 1
        p_value = effects.p_values.get(name, 1.0)
        shares = row.probability, table.probability(row.effects)
        suspects.append(Suspect(name, statistic, dof, p_value, row.refit, symbols_before, *shares))
    return tuple(suspects)


_GROWN = 1.05  # the held-out error with effects over that without them; what shows only within dwells changes little


def _grown(before: Calibration, effects: Sequence[str], after: Calibration | None) -> str:
    """In words that follow "but": that the error of orientations left out grows with effects; "" where it does not, or
    where no fit was made."""
    if after is None or not effects:
        return ""
    errors = before.held_out_rms_mps2, after.held_out_rms_mps2
    if errors[0] is None or errors[1] is None or errors[1] <= _GROWN * errors[0]:
        return ""
    what = "they make" if len(effects) > 1 else "it makes"
    return f"{what} the held-out error {errors[1] / errors[0]:.3g} times as large"
