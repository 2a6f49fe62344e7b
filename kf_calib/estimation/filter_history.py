"""The filter from dwell to dwell: estimates with their sigmas, and innovations beside what noise alone would give.

Within dwells: the readings of one less the prediction of their mean, and how those of all correlate.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import ROUNDING, Floats, Mask
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.bench.streams import Source
from kf_calib.dwells.sufficient_statistics import Autocovariance
from kf_calib.errors import InputError
from kf_calib.estimation import square_root_information
from kf_calib.estimation.estimate import Estimate
from kf_calib.estimation.intervals import LEVEL, NORMAL
from kf_calib.estimation.residual_table import mean_sigmas
from kf_calib.estimation.results import Calibration, Parameter
from kf_calib.noise.noise_model import mean_covariances
from kf_calib.noise.noise_of_readings import expected_products

_MOST_LAGS = 20  # dwells


@dataclass(frozen=True)
class ParameterHistory:
    """The twelve parameters and the coefficients of effects after each dwell, in SI; NaN while not determined.

    - parameters: what they are, in the order of the columns.
    - numbers (n,): of the dwells; a stated prior comes first and has the number 0.
    - elapsed_s (n,): since the first reading.
    - values (n, p), sigmas (n, p): estimate and sigma after that dwell.
    """

    parameters: tuple[Parameter, ...]
    numbers: NDArray[np.int64]
    elapsed_s: Floats
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


def history_of(result: Calibration, within: bool = False) -> ParameterHistory:
    """The parameters along a run, as the filter estimated them after each dwell; within: several times in each, too."""
    ends = [(visit.dwell.end_s, visit.dwell.number, visit.estimate) for visit in result.visits]
    steps = [*result.trace()] if within else ends
    if not result.settings.prior.diffuse:
        steps.insert(0, (0.0, 0, prior_estimate(result)))
    elapsed_s, numbers, estimates = zip(*steps, strict=True)
    values, sigmas = np.array([_shown(result, each) for each in estimates]).swapaxes(0, 1)
    symbols = (*paper_parameters.SYMBOLS, *(each.symbol for each in result.model.coefficients))
    known = tuple(result.parameters[symbol] for symbol in symbols)
    return ParameterHistory(known, np.array(numbers), np.array(elapsed_s), values, sigmas)


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


@dataclass(frozen=True)
class InnovationTests:
    """The filter's steps beside what noise alone would give.

    - numbers (D,): of the dwells.
    - nis (D,), dof (D,): normalised innovation squared and its degrees of freedom, which may be 0.
    - ratios (D, 3): innovation of each accelerometer over its sigma; NaN where the dwells before do not predict it.
    """

    numbers: NDArray[np.int64]
    nis: Floats
    dof: NDArray[np.int64]
    ratios: Floats

    @cached_property
    def band(self) -> Floats:
        """The middle 95 % of chi-squared (D, 2) of each dwell; NaN without degrees of freedom."""
        return nis_band(self.dof)

    @cached_property
    def high(self) -> Mask:
        """Dwells (D,) whose NIS is above that: a misfit, whereas a small NIS is luck."""
        return np.asarray(self.nis > self.band[:, 1])

    @cached_property
    def per_dof(self) -> Floats:
        """The sum of the NIS so far over the sum of the degrees of freedom (D,); NaN while these are 0."""
        dof = np.cumsum(self.dof)
        return np.cumsum(np.where(self.dof > 0, self.nis, 0.0)) / np.where(dof > 0, dof, np.nan)

    @cached_property
    def per_dof_band(self) -> Floats:
        """The middle 95 % (D, 2) of that quotient."""
        dof = np.cumsum(self.dof)
        return nis_band(dof) / np.maximum(dof, 1)[:, None]

    @cached_property
    def autocorrelation(self) -> Floats:
        """Autocorrelation (L, 3) of the ratios at lags of 1, 2, ... L dwells, about zero."""
        known = self.ratios[np.isfinite(self.ratios).all(axis=1)]
        lags = range(1, min(_MOST_LAGS, len(known) // 2) + 1)
        return np.array([(known[lag:] * known[:-lag]).sum(axis=0) for lag in lags]).reshape(-1, 3) / np.maximum(
            (known**2).sum(axis=0), 1e-300
        )

    @cached_property
    def bound(self) -> Floats:
        """Half the interval (L,) of 95 % of that autocorrelation where the innovations are independent."""
        count = int(np.isfinite(self.ratios).all(axis=1).sum())
        return NORMAL * np.sqrt(count - np.arange(1, len(self.autocorrelation) + 1)) / max(count, 1)


def innovation_tests(result: Calibration) -> InnovationTests:
    """The innovations of a run beside what noise alone would give."""
    visits = result.visits
    return InnovationTests(
        np.array([visit.dwell.number for visit in visits]),
        np.array([visit.nis for visit in visits]),
        np.array([visit.dof for visit in visits]),
        _ratios(result),
    )


def _ratios(result: Calibration) -> Floats:
    """Return innovations over their sigma (D, 3), also of readings that are predicted while some states are not yet."""
    ratios = np.array([visit.innovation_mps2 / visit.innovation_sigma_mps2 for visit in result.visits])
    means, visits = result.linearised.means, result.visits
    noise_covariances = mean_covariances(result.noise.of_readings, means, result.linearised.state)
    for k in np.flatnonzero(np.isnan(ratios).any(axis=1) & (np.arange(len(ratios)) > 0)).tolist():
        before, rows = visits[k - 1].estimate, means.design[k]
        lost = before.undetermined / np.linalg.norm(before.undetermined, axis=0)
        seen = np.linalg.norm(rows @ lost, axis=1) < ROUNDING * np.linalg.norm(rows, axis=1)
        sigma = np.sqrt(np.diag(rows @ before.covariance @ rows.T) + np.diag(noise_covariances[k]))
        ratios[k] = np.where(seen, (means.readings[k] - rows @ before.state) / sigma, np.nan)
    return ratios


def nis_band(dof: NDArray[np.int64]) -> Floats:
    """The middle 95 % of chi-squared (n, 2); NaN without degrees of freedom."""
    known = np.where(dof > 0, dof, np.nan)
    return np.column_stack([chdtri(known, 0.5 * (1.0 + side * LEVEL)) for side in (1.0, -1.0)])


@dataclass(frozen=True)
class DwellReadings:
    """Readings of one dwell less their prediction.

    number: of the dwell, from 1. time_s (n,): since the first reading of the run. differences_mps2 (n, 3): readings
    less the model's prediction of their mean. every: one of so many readings is kept. count: of all readings.
    mean_mps2, sigma_mps2 (3,): mean of the differences over the dwell, and the sigma of it. start_s: when
    the first of them was used; what came earlier had not settled, or was rejected. left_out: whether the prediction is
    by all other orientations, so that the dwell has not drawn it to itself.
    """

    number: int
    time_s: Floats
    differences_mps2: Floats
    every: int
    count: int
    mean_mps2: Floats
    sigma_mps2: Floats
    start_s: float
    left_out: bool = False


def worst_dwell(result: Calibration) -> int:
    """Number of the dwell with the largest residual over its sigma."""
    ratios = np.abs(result.residuals_mps2 / mean_sigmas(result)).max(axis=1)
    return result.visits[int(ratios.argmax())].dwell.number


def readings_of(
    source: Source, result: Calibration, number: int | None = None, most: int = 4000, *, left_out: bool = False
) -> DwellReadings:
    """The readings of a dwell from a source that was calibrated, which is read once more up to the end of the dwell.

    number: of the dwell, as results number it; the worst where it is not given. most: greatest number of readings that
    are kept, evenly spread over the dwell. left_out: predict the dwell by all other orientations, where these determine
    the model, and begin with the arrival. Raises InputError where no dwell has the number.
    """
    number = worst_dwell(result) if number is None else number
    numbers = [visit.dwell.number for visit in result.visits]
    if number not in numbers:
        raise InputError(f"there is no dwell {number}: this run has {numbers[0]} to {numbers[-1]}.")
    k = numbers.index(number)
    dwell, error, sigma = result.visits[k].dwell, result.visits[k].residual_mps2, mean_sigmas(result)[k]
    others = result.held_out if left_out and result.bench.angles else None
    if others is not None:
        error, sigma = others.errors_mps2[k], np.sqrt(np.diag(others.covariance[k]))
    every = max(1, -(-dwell.count // most))
    first_s = dwell.start_s - (float(dwell.pieces.nodes.since_arrival_s.min()) if left_out else 0.0)
    time_s, readings = _inside(source, first_s, dwell.end_s, every)
    less, alone = readings - (dwell.means[4:] - error), others is not None
    return DwellReadings(number, time_s, less, every, dwell.count, error, sigma, dwell.start_s, alone)


def _inside(source: Source, start_s: float, end_s: float, every: int) -> tuple[Floats, Floats]:
    """Return time and value of one of ``every`` readings from a start to an end, in seconds since the first reading."""
    first_ns, seen, times, values = None, 0, list[Floats](), list[Floats]()
    for batch in source:
        stamps = batch.accel.time_ns
        if not len(stamps):
            continue
        first_ns = int(stamps[0]) if first_ns is None else first_ns
        elapsed_s = np.asarray((stamps - first_ns) * 1e-9, dtype=np.float64)
        own = np.flatnonzero((elapsed_s >= start_s - 1e-9) & (elapsed_s <= end_s + 1e-9))
        kept = own[-seen % every :: every]
        seen += len(own)
        times.append(elapsed_s[kept])
        values.append(batch.accel.values[kept])
        if elapsed_s[0] > end_s:
            break
    if not times:
        return np.zeros(0), np.zeros((0, 3))
    return np.concatenate(times), np.concatenate(values)


@dataclass(frozen=True)
class ReadingCorrelation:
    """Autocorrelation (L, 3) of the readings within dwells about their parabolas, at lags of 1, 2, ... L readings.

    white (L,): what white noise would give, of which a parabola removes a part. bound (L,): half the interval
    of 95 % about it.
    """

    values: Floats
    white: Floats
    bound: Floats


def reading_correlation(result: Calibration) -> ReadingCorrelation:
    """The autocorrelation of the readings within the dwells of a run, pooled; empty if the dwells are too short."""
    total = sum((dwell.autocovariance for dwell in result.fit.dwells), Autocovariance())
    size = round(total.count / max(total.blocks, 1))
    lags = min(len(total.pairs) - 1, size // 4)
    if lags < 1:
        return ReadingCorrelation(np.zeros((0, 3)), np.zeros(0), np.zeros(0))
    pairs = np.maximum(total.pairs[: lags + 1], 1.0)
    raw = total.products[: lags + 1] / pairs[:, None]
    white = expected_products(np.eye(1, size)[0], lags) / (size - np.arange(lags + 1))
    level = np.where(raw[0] > 0.0, raw[0], np.nan)
    return ReadingCorrelation(raw[1:] / level, white[1:] / white[0], NORMAL / np.sqrt(pairs[1:]))
