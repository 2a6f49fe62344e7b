"""The readings within dwells: those of one less the prediction of their mean, and how those of all correlate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.streams import Source
from kf_calib.dwells.sufficient_statistics import Autocovariance
from kf_calib.errors import InputError
from kf_calib.estimation.residual_table import mean_sigmas
from kf_calib.estimation.results import Calibration
from kf_calib.noise.autoregression import expected_products

_BOUND = 2.0  # sigmas


@dataclass(frozen=True)
class DwellReadings:
    """Readings of one dwell less their prediction.

    number: of the dwell, from 1. time_s (n,): since the first reading of the run. differences_mps2 (n, 3): readings
    less the model's prediction of their mean. every: one of so many readings is kept. count: of all readings.
    mean_mps2, sigma_mps2 (3,): mean of the differences over the dwell, its residual, and the sigma of it.
    """

    number: int
    time_s: Floats
    differences_mps2: Floats
    every: int
    count: int
    mean_mps2: Floats
    sigma_mps2: Floats


def worst_dwell(result: Calibration) -> int:
    """Number of the dwell with the largest residual over its sigma."""
    ratios = np.abs(result.residuals_mps2 / mean_sigmas(result)).max(axis=1)
    return result.visits[int(ratios.argmax())].dwell.number


def readings_of(source: Source, result: Calibration, number: int | None = None, most: int = 4000) -> DwellReadings:
    """The readings of a dwell from a source that was calibrated, which is read once more up to the end of the dwell.

    number: of the dwell, as results number it; the worst where it is not given. most: greatest number of readings that
    are kept, evenly spread over the dwell. Raises InputError where no dwell has the number.
    """
    number = worst_dwell(result) if number is None else number
    numbers = [visit.dwell.number for visit in result.visits]
    if number not in numbers:
        raise InputError(f"there is no dwell {number}: this run has {numbers[0]} to {numbers[-1]}.")
    k = numbers.index(number)
    dwell, residual = result.visits[k].dwell, result.visits[k].residual_mps2
    every = max(1, -(-dwell.count // most))
    time_s, readings = _inside(source, dwell.start_s, dwell.end_s, every)
    predicted = dwell.means[4:] - residual
    return DwellReadings(number, time_s, readings - predicted, every, dwell.count, residual, mean_sigmas(result)[k])


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
