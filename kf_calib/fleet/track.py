"""One parameter over all runs: population of the units with its outliers, and how runs of a unit scatter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench.arrays import Floats
from kf_calib.support.tail_probabilities import f_tail, sidak

_SIXTY_EIGHT = (0.1587, 0.5, 0.8413)
_FEWEST = 3  # units of which one can lie outside


@dataclass(frozen=True)
class Track:
    """One parameter over the runs that determine it, in SI.

    - target: sigma that is wanted, if any.
    - dates (n), places (n,): date of each run, and number of its unit. values (n,), sigmas (n,): what it found.
    - units (u,): mean of each unit; NaN where no run determines it. mean, spread: median of the units, and half the
      width of the middle 68 % of them.
    - chances (u,): chance that among as many units and parameters of a normal population one lies as far off.
    - deviations (n,): of each run from the mean of its unit, as large as those of single runs; where no unit was
      measured twice, from that of all. scatter: standard deviation of a run, pooled over the units: the root of
      Σ (value − mean of its unit)² / (runs − units), over units that were measured again.
    """

    symbol: str
    unit: str
    nominal: float
    target: float | None
    dates: tuple[datetime | None, ...]
    places: NDArray[np.intp]
    values: Floats
    sigmas: Floats
    units: Floats
    mean: float
    spread: float
    chances: Floats
    deviations: Floats
    scatter: float

    @property
    def distances(self) -> Floats:
        """How many spreads each unit (u,) lies from the mean."""
        return (self.units - self.mean) / (self.spread or np.inf)


def tracks(rows: Sequence[Mapping[str, Any]], units: Sequence[str], targets: Mapping[str, float]) -> tuple[Track, ...]:
    """The track of each parameter that a run determines, in the order of the runs."""
    numbers = {unit: k for k, unit in enumerate(units)}
    runs = dict[str, list[tuple[datetime | None, int, float, float]]]()
    units_and_nominals = dict[str, tuple[str, float]]()
    for row in rows:
        for parameter in row["parameters"] or ():
            if parameter["value"] is not None and parameter["sigma"] is not None:
                units_and_nominals.setdefault(parameter["symbol"], (parameter["unit"], parameter["nominal"]))
                of_run = (row["date"], numbers[row["unit"]], parameter["value"], parameter["sigma"])
                runs.setdefault(parameter["symbol"], []).append(of_run)
    many = len(runs) * len(units)
    return tuple(
        _track(name, *units_and_nominals[name], targets.get(name), list(zip(*of_runs, strict=True)), len(units), many)
        for name, of_runs in runs.items()
    )


def _track(
    symbol: str, unit: str, nominal: float, target: float | None, columns: Sequence[Any], count: int, many: int
) -> Track:
    dates, places = tuple(columns[0]), np.array(columns[1], dtype=np.intp)
    values, sigmas = np.array(columns[2]), np.array(columns[3])
    runs = np.bincount(places, minlength=count)
    sums = np.bincount(places, values - values[0], minlength=count)
    means = values[0] + np.divide(sums, runs, out=np.full(count, np.nan), where=runs > 0)
    mean, spread = _middle(means[runs > 0])
    deviations = _deviations(values, means[places], runs[places], mean)
    return Track(
        symbol, unit, nominal, target, dates, places, values, sigmas, means, mean, spread,
        _chances(means, mean, spread, many), deviations, _pooled(deviations, runs[places]),
    )  # fmt: skip


def _middle(values: Floats) -> tuple[float, float]:
    """Return the median, and half the width of the middle 68 %."""
    low, median, high = np.quantile(values, _SIXTY_EIGHT).tolist()
    return median, 0.5 * (high - low)


def _deviations(values: Floats, means: Floats, runs: NDArray[np.intp], mean: float) -> Floats:
    """Return the deviations of the runs; NaN for a unit that was measured once beside others measured again."""
    if (runs == 1).all():
        return values - mean
    again = runs > 1
    factor = np.sqrt(np.divide(runs, runs - 1, out=np.full(len(runs), np.nan), where=again))
    return (values - means) * factor


def _pooled(deviations: Floats, runs: NDArray[np.intp]) -> float:
    """Return the standard deviation pooled over groups of so many runs; each deviation is larger by √(n / (n − 1))."""
    known = np.isfinite(deviations)
    if (runs == 1).all():  # one group of all runs
        return float(np.std(deviations[known], ddof=1)) if known.sum() > 1 else 0.0
    shares = (runs[known] - 1.0) / runs[known]  # a unit of n runs has n - 1 degrees of freedom
    return float(np.sqrt(np.sum(shares * deviations[known] ** 2) / np.sum(shares)))


def _chances(units: Floats, mean: float, spread: float, many: int) -> Floats:
    """Return the chance (u,) by Student's t that any of ``many`` lies as far off as each unit."""
    known = np.isfinite(units)
    freedom = int(known.sum()) - 1
    if freedom + 1 < _FEWEST or not spread:
        return np.ones(len(units))
    squares = np.where(known, (units - mean) / spread, 0.0) ** 2
    return np.array([sidak(f_tail(1.0, float(freedom), each), many) for each in squares.tolist()])
