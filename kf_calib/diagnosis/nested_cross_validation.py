"""Nested cross-validation: the held-out error of stepwise selection itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import Floats, one_blas_thread
from kf_calib.diagnosis.stepwise_selection import improve
from kf_calib.errors import UnobservableError
from kf_calib.estimation.attitude import linearised_at
from kf_calib.estimation.calibration import evaluate
from kf_calib.estimation.cross_validation import orientations, told_of
from kf_calib.estimation.results import Calibration
from kf_calib.noise.noise_model import mean_covariances


@dataclass(frozen=True)
class NestedCrossValidation:
    """The held-out error with everything repeated without the held-out orientations, the choice of effects included.

    rms_mps2: rms held-out error, m/s^2. expected_mps2: what noise alone would give. folds: number of folds. chosen: in
    how many of the folds each effect was in the final model.
    """

    rms_mps2: float
    expected_mps2: float
    folds: int
    chosen: dict[str, int]


def nested_cross_validation(
    start: Calibration, folds: int = 6, on_fold: Callable[[float], None] | None = None
) -> NestedCrossValidation:
    """The held-out error of stepwise selection: each fold is predicted by a model selected on all others.

    A fold is every ``folds``-th orientation. Where no effect has 95 % probability, the likeliest is taken:
    they predict nearly the same, and a fold that stopped there would predict nothing.

    start: the calibration with the first model. folds: their number, at most the number of orientations. on_fold:
    called after each fold with the share that is done. Raises UnobservableError where the other orientations do not
    determine the model that was selected.
    """
    groups = orientations(start.fit.dwells)
    folds = min(folds, len(groups))
    errors, expected, counts = list[Floats](), list[Floats](), dict[str, int]()
    for number in range(folds):
        held_out = sorted(k for group in groups[number::folds] for k in group)
        with one_blas_thread():
            others = evaluate(start.fit.dwells.without(held_out), start.bench, start.settings, start.linearised.slews)
        result = improve(others, accept_first=True).result
        squares, variances = _prediction_errors(start, result, held_out)
        errors.append(squares)
        expected.append(variances)
        for effect in result.model.effects:
            counts[str(effect)] = counts.get(str(effect), 0) + 1
        if on_fold is not None:
            on_fold((number + 1) / folds)
    rms, floor = (float(np.sqrt(np.mean(np.concatenate(own)))) for own in (errors, expected))
    return NestedCrossValidation(rms, floor, folds, counts)


def _prediction_errors(start: Calibration, result: Calibration, held_out: list[int]) -> tuple[Floats, Floats]:
    """Return the squared errors of the held-out dwell means and the variances that noise gives; (3 len(left),) each, or
    (len(left),) of the size of f where no angles are used."""
    if result.estimate.undetermined.size:
        raise UnobservableError(
            "the orientations without those held out do not determine the model: the honest held-out error needs a "
            "run of more orientations."
        )
    noise, state = result.noise.for_goodness_of_fit, result.linearised.state
    means = linearised_at(start.fit.dwells, result.model, state, result.noise.weights).means[held_out]
    spread = means.design @ result.estimate.covariance @ np.swapaxes(means.design, 1, 2)
    spread = spread + mean_covariances(noise.of_readings, means, state)
    left = means.readings - means.design @ result.estimate.state
    errors = told_of(left, spread, means, state, noise.attitude_unknown)
    return (errors.errors_mps2**2).ravel(), np.einsum("dii->di", errors.covariance).ravel()
