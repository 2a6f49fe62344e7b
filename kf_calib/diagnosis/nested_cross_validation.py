"""The error of stepwise selection itself on orientations that it has not seen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.stepwise_selection import improve
from kf_calib.dwells.sufficient_statistics import dwells_without
from kf_calib.errors import UnobservableError
from kf_calib.estimation.calibration import evaluate
from kf_calib.estimation.cross_validation import orientations
from kf_calib.estimation.dwell_columns import Carried
from kf_calib.estimation.noise_model import mean_covariances
from kf_calib.estimation.results import Calibration


@dataclass(frozen=True)
class NestedCrossValidation:
    """The held-out error with everything done anew without what is held out, the choice of the effects too.

    expected_mps2: what noise alone would give. chosen: in how many of the ``folds`` each effect was in the last model.
    """

    rms_mps2: float
    expected_mps2: float
    folds: int
    chosen: dict[str, int]


def nested_cross_validation(
    start: Calibration, folds: int = 6, on_fold: Callable[[float], None] | None = None
) -> NestedCrossValidation:
    """Leave out every ``folds``-th orientation, improve on the others, predict it; each is left out once.

    Of equal explanations the first is taken: they predict alike, and a fold that stopped to ask would predict nothing.
    Raises UnobservableError where the orientations of some fold do not determine the model it chose.
    """
    groups = orientations(start.fit.dwells)
    folds = min(folds, len(groups))
    errors, expected, counts = list[Floats](), list[Floats](), dict[str, int]()
    for number in range(folds):
        left = sorted(k for group in groups[number::folds] for k in group)
        with threadpool_limits(1, user_api="blas"):
            kept = evaluate(dwells_without(start.fit.dwells, left), start.bench, start.settings, start.carried.slews)
        result = improve(kept, accept_first=True).result
        squares, variances = _predicted(start, result, left)
        errors.append(squares)
        expected.append(variances)
        for effect in result.model.effects:
            counts[str(effect)] = counts.get(str(effect), 0) + 1
        if on_fold is not None:
            on_fold((number + 1) / folds)
    rms, floor = (float(np.sqrt(np.mean(np.concatenate(own)))) for own in (errors, expected))
    return NestedCrossValidation(rms, floor, folds, counts)


def _predicted(start: Calibration, result: Calibration, left: list[int]) -> tuple[Floats, Floats]:
    """Squared errors of the dwell means left out, and their variances if noise is all there is, (3 len(left),) each."""
    if result.estimate.undetermined.size:
        raise UnobservableError(
            "the orientations without those held out do not determine the model: the honest held-out error needs a "
            "run of more orientations."
        )
    means = Carried(start.fit.dwells, result.model, result.carried.state).means[left]
    spread = means.design @ result.estimate.covariance @ np.swapaxes(means.design, 1, 2)
    spread = spread + mean_covariances(result.noise.judging, means, result.carried.state)
    residuals = means.readings - means.design @ result.estimate.state
    return (residuals**2).ravel(), np.einsum("dii->di", spread).ravel()
