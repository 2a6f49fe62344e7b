"""The calibration of a source: twelve parameters with their covariance, the noise model and the misfit.

One pass folds the recording into sufficient statistics of each dwell (``folding.Folder``). Everything
after it (noise model, filter, leave-one-orientation-out) works on these. The estimate after each dwell is reported with
the noise model of the whole run, so that the curves of a replay do not jump when the noise becomes better known.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from os import PathLike
from typing import Literal, overload

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats, one_blas_thread
from kf_calib.bench.bench import Bench
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.bench.streams import Source
from kf_calib.dwells import window_average
from kf_calib.dwells.blocks import SampleCounts
from kf_calib.dwells.sufficient_statistics import Dwell, lines_of
from kf_calib.dwells.table import DwellTable
from kf_calib.effects import of_the_users
from kf_calib.errors import InputError, UnobservableError
from kf_calib.estimation import kalman_filterpy, square_root_information
from kf_calib.estimation.dwell_columns import LinearisedDwells
from kf_calib.estimation.dwell_pass import Pass, fitted_to, on_carrier, refuse_unusable
from kf_calib.estimation.estimate import Estimate, estimate_of, estimates
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.free_attitude import holding_frame
from kf_calib.estimation.iterated_fit import fit
from kf_calib.estimation.kalman_filterpy import Samples, samples_of
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.observability import visibility_of
from kf_calib.estimation.outlying_dwell import outlying_dwells, outlying_in_words
from kf_calib.estimation.remarks import is_gross, misfit_remark, remarks_on
from kf_calib.estimation.results import Calibration, Consistency, OutlyingDwell, Visit, judged_with_trend
from kf_calib.estimation.settings import Settings
from kf_calib.noise.noise_model import considered_information, mean_covariances
from kf_calib.noise.random_walk import predict, to_mean
from kf_calib.noise.reml import FEWEST, degrees_of_freedom
from kf_calib.sources.opening import opened
from kf_calib.support import stage
from kf_calib.support.tail_probabilities import LEVEL
from kf_calib.support.units import shown


def calibrate(
    source: Source | str | PathLike[str],
    settings: Settings | None = None,
    on_progress: Callable[[float], None] | None = None,
    plain: Fit | None = None,
    *,
    effects: str | Sequence[str] | None = None,
) -> Calibration:
    """Calibrate from a source or from the recording at a path: fold dwells, fit the noise, run the filter, judge the
    misfit.

    - settings: how to evaluate it.
    - effects: names of the effects in the model, or the name of one, in place of those of the settings.
    - on_progress: called with the share of the source that has been read.
    - plain: a fit of the same model to dwells without a carrier, if it is already known that they need one.

    Raises InputError if the source holds nothing usable, and UnobservableError if the orientations determine no
    parameter.
    """
    source, settings = opened(source), settings or Settings()
    if effects is not None:
        settings = replace(settings, effects=effects)
    with one_blas_thread():
        passed = Pass(source, settings)
        if passed.model.averages and not settings.window_s:
            stage.say("reading how it vibrates")
            passed = Pass(source, replace(settings, window_s=_window_s(source, settings, on_progress)))
            stage.say("reading")
        if plain is None:
            passed.fold(on_progress)
        return conclude(passed, source, on_progress, plain)


def _window_s(source: Source, settings: Settings, on_progress: Callable[[float], None] | None) -> float:
    """Return the length of windows that average out the vibration in a source, from a pass of its own."""
    plain = Pass(source, replace(settings, effects=()))
    return window_average.window_s(lines_of(plain.fold(on_progress)))


def conclude(
    passed: Pass,
    again: Source | None = None,
    on_progress: Callable[[float], None] | None = None,
    plain: Fit | None = None,
) -> Calibration:
    """The calibration of a completed pass.

    - again: the same samples, to be read once more by models that need them folded in another way; None if they are
      gone.
    - plain: a fit that is known not to suffice; the pass has then not begun.
    """
    settings, bench = passed.settings, passed.source.bench
    dwells = passed.dwells if plain is None else plain.dwells
    if plain is None:
        _refuse_absent(settings.left_out, passed.folded)
        refuse_unusable(dwells, passed.counts, bench)
    stage.say("estimating")
    if again is not None and passed.model.oscillates:
        passed, fitted = on_carrier(replace(passed, source=again), dwells, plain, on_progress)
    else:
        fitted = fitted_to(passed, dwells)
    result = _with_coarse_steps(evaluate_fit(fitted, settings), passed)
    refuse_unseen(result)
    _refuse_without_noise(result)
    if again is not None and settings.engine == "filterpy":
        stage.say("filterpy, reading by reading")
        result = replace(result, estimate=filterpy_estimate(again, result, on_progress=on_progress))
    return with_remarks(result, passed)


def _with_coarse_steps(result: Calibration, passed: Pass) -> Calibration:
    """The result with the error of means by steps of the readings that noise does not spread: as scatter from dwell to
    dwell, since averaging does not reduce it, nor does a pose that is visited again."""
    coarse_mps2 = passed.watch.judged(result.fit.dwells, result.noise).scatter_mps2
    if not coarse_mps2:
        return result
    means = np.round(result.linearised.means.readings / coarse_mps2)
    coarse_mps2 *= math.sqrt(len(means) / len(np.unique(means, axis=0)))
    scatter_mps2 = math.hypot(coarse_mps2, result.bench.scatter_sigma_mps2 or 0.0)
    model = replace(result.model, bench=replace(result.bench, scatter_sigma_mps2=scatter_mps2))
    walk_mps2_per_sqrt_s = result.settings.walk_mps2_per_sqrt_s
    fitted = fit(result.fit.dwells, model, walk_mps2_per_sqrt_s, result.linearised.slews, must_settle=False)
    return evaluate_fit(fitted, result.settings)


def with_remarks(result: Calibration, passed: Pass) -> Calibration:
    """The result with the counts and observations of its pass and a sentence on everything that a user must know."""
    outlying = outlying_dwells(result, lambda some: evaluate_fit(_fit_again(result, some), result.settings))
    of_users = [effect for effect in result.model.effects if of_the_users(effect)]
    notes = [f"{sight}." for sight in visibility_of(result.fit, of_users)]
    readings = passed.watch.judged(result.fit.dwells, result.noise)
    on_outlying = [outlying_in_words(outlying)] if outlying else []
    misfit = misfit_remark(result.consistency, result.residuals_mps2, result.bench, result.noise)
    remarks = [each for each in result.warnings if each != misfit or not (outlying or readings.saturation)]
    counted = [*passed.counts.sentences(), *passed.counts.unmet_settings(passed.settings.stillness)]
    notes += [f"{known.sentence}." for known in result.model.known]
    warnings = [*passed.source.warnings, *counted, *readings.warnings, *on_outlying, *remarks, *notes]
    agreement = result.consistency if not outlying else _with_outlying(result.consistency, outlying)
    return result.changed(
        counts=passed.counts, readings=readings, warnings=tuple(warnings), outlying=outlying, consistency=agreement
    )


def _with_outlying(judged: Consistency, outlying: Sequence[OutlyingDwell]) -> Consistency:
    """Return the test of the misfit where a dwell does not fit the others, which a setting error estimated from the
    misfit may hide."""
    clearest = min(dwell.p_value for dwell in outlying)
    p_value = min(1.0, 2.0 * min(clearest, judged.p_value if judged.p_value is not None else 1.0))
    return replace(judged, p_value=p_value, consistent=p_value >= LEVEL)


def _fit_again(result: Calibration, dwells: DwellTable) -> Fit:
    """Fit the same model to other dwells."""
    return fit(dwells, result.model, result.settings.walk_mps2_per_sqrt_s, result.linearised.slews)


def evaluate(dwells: DwellTable, bench: Bench, settings: Settings, slews: Sequence[Dwell] = ()) -> Calibration:
    """The calibration from sufficient statistics of dwells and, if effects show in them, of slews, without a pass over
    the data."""
    model = Model.of(bench, settings.effects, settings.bench_model)
    return evaluate_fit(fit(dwells, model, settings.walk_mps2_per_sqrt_s, slews), settings)


def evaluate_fit(fitted: Fit, settings: Settings) -> Calibration:
    """The calibration from a fit: the filter's steps with their innovations, and the test of the misfit."""
    linearised, noise, model = fitted.linearised, fitted.noise, fitted.linearised.model
    first = square_root_information.start(settings.prior, model)
    factor = square_root_information.accumulate(fitted.all_rows(), fitted.steps, first)[: model.count]
    extra = considered_information(noise, linearised.means, linearised.state)
    final = estimate_of(factor, model.nominal_state(), extra.sum(axis=0) + fitted.considered)
    residuals = linearised.means.readings - linearised.means.design @ final.state
    visits = Visits(fitted, settings, residuals)
    judged = judged_with_trend(fitted)
    return Calibration(
        model.bench, settings, fitted, visits, final, judged, float(np.sqrt(np.mean(residuals**2))),
        SampleCounts(), tuple(remarks_on(linearised, noise, final, judged, residuals)),
    )  # fmt: skip


def filterpy_estimate(
    source: Source,
    result: Calibration,
    form: Literal["square-root", "plain"] = "square-root",
    on_progress: Callable[[float], None] | None = None,
    at_most: float = math.inf,
    on_dwell: Callable[[Floats], None] | None = None,
) -> Estimate:
    """The same estimate from filterpy's filter, sample by sample, in a second pass over the source.

    ``on_progress`` is called with the share of the readings that are done; the pass stops after about ``at_most``
    readings. ``on_dwell`` is called with the state (p,) after each dwell.
    """
    prior, model = result.settings.prior, result.model
    scale = np.concatenate([np.tile([*[result.bench.gravity_mps2] * 3, 1.0], 3), result.linearised.sizes[STATE_COUNT:]])
    samples = samples_of(Pass(source, result.settings).rows(), result.linearised, result.noise.weights)
    samples = holding_frame(samples, result.linearised, result.noise.weights)
    posterior = kalman_filterpy.estimate(
        _counted(samples, result.linearised, on_progress, at_most),
        result.noise.weights,
        model.nominal_state(),
        None if prior.diffuse else square_root_information.prior_covariance(prior, model),
        scale,
        form,
        on_dwell,
    )
    return result.considering(posterior.state, posterior.covariance)


def _counted(
    samples: Iterable[Samples],
    linearised: LinearisedDwells,
    on_progress: Callable[[float], None] | None,
    at_most: float,
) -> Iterator[Samples]:
    """Yield the same samples, report the share that is done, and stop after a number of readings."""
    total, done = sum(dwell.count for dwell in [*linearised.dwells, *linearised.slews]), 0
    for piece in samples:
        yield piece
        done += len(piece.readings)
        if on_progress is not None:
            on_progress(done / total)
        if done >= at_most:
            return


def _refuse_absent(left_out: Sequence[int], dwells: DwellTable) -> None:
    """Raise InputError if a dwell that is to be left out does not exist, since another one was probably meant."""
    absent = sorted(set(left_out) - set(dwells.folded.numbers.tolist())) if left_out else []
    if absent and dwells:
        raise InputError(
            f"there is no dwell {absent[0]} to leave out (--leave-out): the run has dwells {dwells[0].number} to "
            f"{dwells[-1].number}."
        )


def refuse_unseen(result: Calibration) -> None:
    """Raise UnobservableError if the orientations determine none of the twelve parameters."""
    if result.estimate.unseen.all():
        if is_gross(result.noise, result.bench):
            raise UnobservableError(
                f"the {len(result.visits)} dwells disagree with every calibration, by about "
                f"{shown('m/s^2').text(float(result.noise.scatter_mps2.max()), 2)}, so that none of the parameters can "
                "be seen: a pose, a channel or a gimbal axis is not what it is taken for."
            )
        dwells = (
            "1 dwell of this run shows" if len(result.visits) == 1 else f"{len(result.visits)} dwells of this run show"
        )
        moving = result.counts.moving / max(result.counts.read, 1)
        restless = (
            f" {moving:.0%} of the readings count as moving: if the platform stood still in them, raise --still-deg."
            if moving > 0.5
            else ""
        )
        raise UnobservableError(
            f"the {dwells} too few different directions of gravity, so none "
            f"of the parameters can be seen ({', '.join(paper_parameters.SYMBOLS)}): visit at least four spread "
            f"orientations, or state a --prior.{restless}"
        )


def _refuse_without_noise(result: Calibration) -> None:
    """Raise InputError if nothing at all shows how large the noise is, so that no sigma can be given."""
    noise, free = result.noise, degrees_of_freedom(result.linearised.means, not result.bench.angles)
    setting_stated = noise.setting.stated and result.bench.angles
    if not (noise.within_seen or noise.scatter.stated or setting_stated) and free < FEWEST:
        raise InputError(
            f"{len(result.visits)} orientations without standard deviations leave {free} degrees of freedom, too few "
            f"to estimate the noise from ({FEWEST}): give standard deviation and number of readings in each row, "
            "state --scatter-sigma, or measure more orientations."
        )


class Visits(Sequence[Visit]):
    """The visits of all dwells of a fit; ``residuals_mps2`` (D, 3) are those about the final estimate.

    The estimates after 100 000 dwells take minutes and gigabytes, and most questions need the last one alone.
    """

    def __init__(self, fitted: Fit, settings: Settings, residuals_mps2: Floats) -> None:
        self._fit, self._settings, self._residuals_mps2 = fitted, settings, residuals_mps2

    def __len__(self) -> int:
        return len(self._residuals_mps2)

    @overload
    def __getitem__(self, index: int) -> Visit: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Visit, ...]: ...
    def __getitem__(self, index: int | slice) -> Visit | tuple[Visit, ...]:
        return self._visits[index]

    @cached_property
    def _visits(self) -> tuple[Visit, ...]:
        with one_blas_thread():
            return self._computed()

    def _computed(self) -> tuple[Visit, ...]:
        """Return for each dwell its innovation, its residual and the estimate after it."""
        fitted, linearised = self._fit, self._fit.linearised
        means, around, walked = linearised.means, linearised.model.nominal_state(), to_mean(fitted.steps)
        noise_covariances = mean_covariances(fitted.noise.of_readings, means, linearised.state)
        extra = considered_information(fitted.noise, means, linearised.state)
        extra = np.cumsum(np.concatenate([0.0 * extra[:1], extra]), axis=0)
        first = square_root_information.start(self._settings.prior, linearised.model)
        steps = square_root_information.run(first, fitted.rows(), fitted.steps, fitted.following)
        factors = np.array([first, *(step.factor for step in steps)])
        reached = estimates(factors, around, extra)
        known, visits = reached[:-1], list[Visit]()
        if walked.any():
            before = [predict(factor, step) for factor, step in zip(factors, walked, strict=False)]
            known = estimates(np.array(before), around, extra[:-1])
        for k, (dwell, step) in enumerate(zip(linearised.dwells, steps, strict=True)):
            innovation, sigma = np.full(3, np.nan), np.full(3, np.nan)
            if not known[k].undetermined.size:
                rows = means.design[k]
                innovation = means.readings[k] - rows @ known[k].state
                predicted_by = np.maximum(np.diag(rows @ known[k].covariance @ rows.T), 0.0)  # negative by rounding
                sigma = np.sqrt(predicted_by + np.diag(noise_covariances[k]))
            visits.append(Visit(dwell, reached[k + 1], step.nis, step.dof, innovation, sigma, self._residuals_mps2[k]))
        return tuple(visits)
