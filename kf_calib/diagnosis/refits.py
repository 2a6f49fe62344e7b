"""Refits of one run: calibrations with other effects or other noise in the model, each computed once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from os import PathLike
from typing import Any, TypeVar

import numpy as np

from kf_calib.bench.arrays import Floats, one_blas_thread
from kf_calib.bench.streams import Source, Table
from kf_calib.diagnosis.candidate_tests import CandidateTests, assess_candidates
from kf_calib.effects import oscillation_of
from kf_calib.errors import InputError, UnobservableError
from kf_calib.estimation.calibration import calibrate, evaluate_fit, refuse_unseen
from kf_calib.estimation.dwell_columns import LinearisedDwells
from kf_calib.estimation.dwell_pass import holds_its_oscillation
from kf_calib.estimation.iterated_fit import fit
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.results import Calibration
from kf_calib.noise.noise_model import Noise
from kf_calib.sources.opening import opened
from kf_calib.support import stage

_Result = TypeVar("_Result")
_QUIETER = 0.25  # share of the noise that an oscillation leaves, of that which it was taken for


class Refits:
    """Calibrations of one run with other effects in the model, and the tests of these, each computed once.

    A refit is computed from the sufficient statistics of the dwells. A model with an oscillation, slews or averages may
    need other statistics, and for these another pass over the source. ``diagnose`` and ``improve`` share what they
    compute if both are given the same object.

    source: the recording or source of the run, or a path; None where its readings are gone, as those of a table.
    """

    def __init__(self, source: Source | str | PathLike[str] | None = None) -> None:
        source = None if source is None else opened(source)
        self.source = None if isinstance(source, Table) else source
        # with each value what its key is made of, since the id of an object that is gone may be used again
        self._refits = dict[tuple[int, tuple[str, ...]], tuple[Calibration, Calibration]]()
        self._diagnosed = dict[int, tuple[Calibration, Any]]()

    def once(self, before: Calibration, diagnosed: Callable[[], _Result]) -> _Result:
        """What is found of a calibration, computed if it was not yet."""
        if id(before) not in self._diagnosed:
            self._diagnosed[id(before)] = before, diagnosed()
        return self._diagnosed[id(before)][1]

    def of(self, before: Calibration, effects: Sequence[str]) -> Calibration:
        """The run of a calibration with these effects in the model instead of those it had."""
        key = id(before), tuple(effects)
        if key not in self._refits:
            self._refits[key] = before, self._refit(before, key[1])
        return self._refits[key][1]

    def with_effects(self, before: Calibration, added: Sequence[str]) -> Calibration:
        """The run of a calibration with further effects in the model."""
        return self.of(before, (*before.settings.effects, *added))

    def without_dwells(self, before: Calibration, numbers: Sequence[int]) -> Calibration | None:
        """The run of a calibration without some dwells; None where the others do not determine the model."""
        dwells, slews = before.fit.dwells, before.linearised.slews
        settings = replace(before.settings, left_out=(*before.settings.left_out, *numbers))
        others = dwells.without(np.flatnonzero(np.isin(dwells.folded.numbers, numbers)).tolist())
        try:
            fitted = fit(others, before.model, settings.walk_mps2_per_sqrt_s, slews)
            return replace(evaluate_fit(fitted, settings), counts=before.counts, readings=before.readings)
        except (InputError, UnobservableError):
            return None

    def averaged(self, before: Calibration, window_s: float) -> Calibration | None:
        """The run of a calibration with its readings averaged over windows; None where the readings are gone."""
        return None if self.source is None else calibrate(self.source, replace(before.settings, window_s=window_s))

    def assess(self, result: Calibration, tests: float | None = None) -> CandidateTests:
        """Score tests of all candidates against a calibration, see ``assess_candidates``."""
        return assess_candidates(result.fit, tests)

    def _refit(self, before: Calibration, effects: tuple[str, ...]) -> Calibration:
        """Fit the model with these effects, and read the source again where the statistics of the dwells do not
        suffice."""
        settings, dwells, slews = replace(before.settings, effects=effects), before.fit.dwells, before.linearised.slews
        model = Model.of(before.bench, effects, settings.bench_model)
        stage.say(f"refitting with {' + '.join(map(str, model.effects))}" if model.effects else "refitting the twelve")
        averages = model.averages and not dwells.folded.averaged
        if self.source is not None and (averages or (model.dynamic and not slews)):
            again = calibrate(self.source, settings)
            if _has_the_dwells(again, before):
                return again
        with one_blas_thread():
            beginning = before.fit.beginning
            fitted = fit(dwells, model, settings.walk_mps2_per_sqrt_s, slews, must_settle=False, beginning=beginning)
            if self.source is not None and not holds_its_oscillation(fitted):
                again = calibrate(self.source, settings, plain=None if dwells.folded.averaged else fitted)
                if _has_the_dwells(again, before):
                    return again
            refitted = replace(evaluate_fit(fitted, settings), counts=before.counts, readings=before.readings)
            refuse_unseen(refitted)
            known = {str(effect) for effect in before.model.effects}
            for effect in (each for each in fitted.linearised.model.effects if str(each) not in known):
                if not (effect.states or effect.walks or effect.unknown):
                    raise UnobservableError(f"{effect} does what others in the model do, in these orientations: leave "
                                            "it out, or one of these.")  # fmt: skip
            return refitted


def _has_the_dwells(again: Calibration, before: Calibration) -> bool:
    """Whether a run that was read again has the dwells it had: those too short for averages come or go with these, and
    likelihoods are compared of the same dwells."""
    return [*again.fit.dwells.folded.numbers] == [*before.fit.dwells.folded.numbers]


def calibration_of(
    run: Calibration | Source | str | PathLike[str], refits: Refits | None = None
) -> tuple[Calibration, Refits]:
    """A calibration, or that of a recording, source or path, and its refits: those given or new ones. Raises InputError
    for one that cannot be diagnosed."""
    if isinstance(run, Calibration):
        before, source = run, None
    else:
        source = opened(run)
        before = calibrate(source)
    noise = before.noise
    if not (before.bench.angles or noise.within_seen or noise.scatter.stated):
        raise InputError(
            "means without angles and without standard deviations leave one number a pose, from which the size of the "
            "noise is taken, so that no misfit can be diagnosed: give standard deviation and number of readings in "
            "each row, or state --scatter-sigma."
        )
    return before, refits or Refits(source)


def dwell_noise_is_stated(before: Calibration) -> bool:
    """Whether both scatter and setting error were stated rather than estimated."""
    return before.noise.scatter.stated and before.noise.setting.stated


def with_noise_as_stated(refits: Refits, before: Calibration, refit: Calibration) -> Calibration:
    """The run without the added effects, with the noise from dwell to dwell as it was estimated in their refit.

    Estimated without the effects, the noise would be too large, as it would contain what they explain.
    """
    noise, bench = refit.noise, before.bench
    if not noise.setting.stated:
        bench = replace(bench, angle_sigma_deg=float(np.degrees(noise.setting_rad)))
    if not noise.scatter.stated:
        bench = replace(bench, scatter_sigma_mps2=float(np.sqrt(np.mean(noise.scatter_mps2**2))))
    return refits.of(replace(before, bench=bench), before.settings.effects)


def with_noise_beside_oscillation(refits: Refits, before: Calibration) -> Calibration | None:
    """The run in the noise within dwells that an oscillation leaves; None where that is not much less.

    An oscillation of a cycle or two in each dwell looks like slow noise, in which the means of the dwells would differ
    by much more than they do.
    """
    oscillation = oscillation_of(before.bench)
    if oscillation is None or before.model.oscillates or not (before.consistency.quiet and before.noise.within_seen):
        return None
    try:
        beside = refits.with_effects(before, (str(oscillation),)).fit
    except UnobservableError:
        return None
    if not (_power(beside.noise) < _QUIETER * _power(before.noise)).any():
        return None
    noise = replace(before.noise, sigma_mps2=beside.noise.sigma_mps2, inflation=beside.noise.inflation)
    dwells = before.fit.dwells.weighted(before.fit.dwells.folded.weights, beside.dwells.folded.correlations)
    linearised = LinearisedDwells(dwells, before.model, before.linearised.state, before.linearised.slews)
    quieter = evaluate_fit(replace(before.fit, linearised=linearised, noise=noise), before.settings)
    return replace(quieter, counts=before.counts, readings=before.readings)


def _power(noise: Noise) -> Floats:
    """Return the variance (3,) of each accelerometer's noise within dwells, as if white, (m/s^2)^2 of a reading."""
    return noise.effective_sigma_mps2**2
