"""The filter's steps on the dwells of a run, which are computed when they are first asked for."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import overload

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.estimation import square_root_information
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.results import Visit, estimates
from kf_calib.estimation.settings import Settings
from kf_calib.noise.noise_model import considered_information, mean_covariances
from kf_calib.noise.random_walk import predict, to_mean
from kf_calib.support.threads import one_blas_thread


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
            before = [predict(factor, float(step)) for factor, step in zip(factors, walked, strict=False)]
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
