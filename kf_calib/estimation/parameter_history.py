"""The parameters along a run: estimate and sigma after each dwell, and what each dwell brought of the information about
each.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.estimation import square_root_information
from kf_calib.estimation.estimate import Estimate, estimate_of
from kf_calib.estimation.results import Calibration, Parameter


@dataclass(frozen=True)
class ParameterHistory:
    """The twelve parameters and the coefficients of effects after each dwell, in SI; NaN while not determined.

    - parameters: what they are, in the order of the columns.
    - numbers (n,): of the dwells; a stated prior comes first and has the number 0.
    - values (n, p), sigmas (n, p): estimate and sigma after that dwell.
    """

    parameters: tuple[Parameter, ...]
    numbers: NDArray[np.int64]
    values: Floats
    sigmas: Floats

    @cached_property
    def deviations(self) -> Floats:
        """Estimates less the final one, over the final sigma (n, p)."""
        return (self.values - self.values[-1]) / self.sigmas[-1]

    @cached_property
    def shares(self) -> Floats:
        """Share of the final information 1/sigma^2 about each parameter by which it rose with each dwell, (n, p).

        A column sums to 1, and is NaN for a parameter that is not determined. A share is negative where information
        is lost, as about biases that walk.
        """
        return shares_of(np.vstack([np.full((1, self.sigmas.shape[1]), np.nan), self.sigmas]))

    @cached_property
    def shares_of_accelerometers(self) -> Floats:
        """Mean shares (n, 3) over the parameters of each accelerometer that are determined; NaN where none is."""
        twelve = self.shares[:, :STATE_COUNT].reshape(-1, 3, 4)
        known = np.isfinite(twelve).sum(axis=2)
        return np.nansum(twelve, axis=2) / np.where(known > 0, known, np.nan)


def history_of(result: Calibration) -> ParameterHistory:
    """The parameters along a run, as the filter estimated them after each dwell."""
    model, prior = result.model, result.settings.prior
    estimates, numbers = [visit.estimate for visit in result.visits], [visit.dwell.number for visit in result.visits]
    if not prior.diffuse:
        factor = square_root_information.start(prior, model)
        nothing = np.zeros((model.count, model.count))
        estimates, numbers = [estimate_of(factor, model.nominal_state(), nothing), *estimates], [0, *numbers]
    values, sigmas = np.array([_shown(result, each) for each in estimates]).swapaxes(0, 1)
    symbols = (*paper_parameters.SYMBOLS, *(each.symbol for each in model.coefficients))
    return ParameterHistory(tuple(result.parameters[symbol] for symbol in symbols), np.array(numbers), values, sigmas)


def _shown(result: Calibration, estimate: Estimate) -> tuple[Floats, Floats]:
    """Return values and sigmas (p,) of an estimate, the states of unknown constants as these constants."""
    coefficients, gains = result.model.natural(estimate.state)
    values = np.append(estimate.parameters, coefficients)
    sigmas = np.append(estimate.sigma, gains * estimate.effect_sigma)
    return np.where(np.isfinite(sigmas), values, np.nan), sigmas


def prior_estimate(result: Calibration) -> Estimate:
    """The estimate before the first dwell; nothing is determined in it where the prior is diffuse."""
    factor = square_root_information.start(result.settings.prior, result.model)
    return Estimate(*square_root_information.solve(factor, result.model.nominal_state()))


def shares_of(sigmas: Floats) -> Floats:
    """Shares (n, k): by how much each dwell raised 1 / sigma^2 of each parameter, over its final value.

    sigmas (n + 1, k): before the first dwell and after each, NaN where not determined. The shares are those of the
    dwells in their order, beside what was known before each: a parameter that is not yet determined has no information,
    and the dwell that determines it brings all there then is. With what a stated prior brings they sum to 1. A share is
    negative where biases that walk were lost faster than a dwell found them; a parameter that the run does not
    determine, or that the prior holds exact, has none (NaN).
    """
    known = np.where(sigmas[-1] > 0.0, sigmas, np.nan)
    return np.diff(np.nan_to_num(known**-2), axis=0) * known[-1] ** 2
