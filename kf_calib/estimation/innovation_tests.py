"""What innovations and readings look like beside what noise of the model alone would give: size and whiteness."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from kf_calib.bench.arrays import Floats, Mask
from kf_calib.dwells.sufficient_statistics import Autocovariance
from kf_calib.estimation.results import Calibration
from kf_calib.noise.autoregression import expected_products
from kf_calib.noise.noise_model import mean_covariances

_MIDDLE = (0.025, 0.975)  # probabilities between which 95 % of all values lie
_BOUND = 2.0  # sigmas
_ROUNDING = 1e-9
_MOST_LAGS = 20  # dwells


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
        return _band(self.dof)

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
        return _band(dof) / np.maximum(dof, 1)[:, None]

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
        """2 sigma (L,) of that autocorrelation where the innovations are independent."""
        count = int(np.isfinite(self.ratios).all(axis=1).sum())
        return _BOUND * np.sqrt(count - np.arange(1, len(self.autocorrelation) + 1)) / max(count, 1)


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
        seen = np.linalg.norm(rows @ lost, axis=1) < _ROUNDING * np.linalg.norm(rows, axis=1)
        sigma = np.sqrt(np.diag(rows @ before.covariance @ rows.T) + np.diag(noise_covariances[k]))
        ratios[k] = np.where(seen, (means.readings[k] - rows @ before.state) / sigma, np.nan)
    return ratios


@dataclass(frozen=True)
class ReadingCorrelation:
    """Autocorrelation (L, 3) of the readings within dwells about their parabolas, at lags of 1, 2, ... L readings.

    white (L,): what white noise would give, of which a parabola removes a part. bound (L,): 2 sigma about it.
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
    return ReadingCorrelation(raw[1:] / level, white[1:] / white[0], _BOUND / np.sqrt(pairs[1:]))


def _band(dof: NDArray[np.int64]) -> Floats:
    """Return the middle 95 % of chi-squared (n, 2); NaN without degrees of freedom."""
    known = np.where(dof > 0, dof, np.nan)
    return np.column_stack([chdtri(known, 1.0 - probability) for probability in _MIDDLE])
