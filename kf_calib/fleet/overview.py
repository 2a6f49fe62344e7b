"""What the runs of a fleet come to together: each parameter over the population of the units, verdicts by week, common
effects, units to look at first.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import date, datetime, timedelta
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench.arrays import Floats
from kf_calib.estimation.results import format_p
from kf_calib.fleet.pooled_diagnosis import PooledDiagnosis
from kf_calib.fleet.pooled_terms import Attribution
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

    @property
    def of_runs(self) -> dict[str, float]:
        """Of the runs, whatever unit: their number, ``median`` and ``spread`` of their values as of the units, and
        ``sigma``, the median of those that they give."""
        median, spread = _middle(self.values)
        return {"runs": len(self.values), "median": median, "spread": spread, "sigma": float(np.median(self.sigmas))}


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
    median, spread = _middle(means[runs > 0])
    deviations = _deviations(values, means[places], runs[places], median)
    return Track(
        symbol, unit, nominal, target, dates, places, values, sigmas, means, median, spread,
        _chances(means, median, spread, many), deviations, _pooled(deviations, runs[places]),
    )  # fmt: skip


def _middle(values: Floats) -> tuple[float, float]:
    """Return the median, and half the width of the middle 68 % of values, 1 sigma of a normal population."""
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


COLUMNS = ("run", "unit", "bench", "date", "error", "consistent", "p_value", "missing", "parameters")
"""Columns of the table that an overview is made from."""
_LEVEL = 0.01
"""Chance below which a unit is named."""
_REASONS = 2  # that are told of a unit


@dataclass(frozen=True)
class FleetOverview:
    """The runs of a fleet together.

    - name: folder of the table. runs, failed, inconsistent: numbers of runs.
    - units, benches: their names. first, last: dates of the runs. A run that failed before it said of which unit it is
      belongs to none.
    - tracks: each parameter over the runs. weeks: verdicts by week. looks: units that need another look first.
    - pooled: the diagnosis of all runs together; None where there is none. remarks: why, and what it lacks.
    """

    name: str
    runs: int
    failed: int
    inconsistent: int
    units: tuple[str, ...]
    benches: tuple[str, ...]
    first: datetime | None
    last: datetime | None
    tracks: tuple[Track, ...]
    weeks: Weeks
    looks: tuple[AnotherLook, ...]
    pooled: PooledDiagnosis | None
    remarks: tuple[str, ...]


def overview_of(
    name: str,
    rows: Sequence[Mapping[str, Any]],
    targets: Mapping[str, float],
    pooled: PooledDiagnosis | None,
    remarks: tuple[str, ...],
) -> FleetOverview:
    """The overview of the rows of a table with ``COLUMNS``; a run without a unit is a unit of its own."""
    rows = sorted(rows, key=lambda row: (row["date"] is None, row["date"], row["run"]))
    units = tuple(sorted({_unit(row) for row in rows if row["unit"] or row["error"] is None}))
    rows = [{**row, "unit": _unit(row)} for row in rows]
    followed, dates = tracks(rows, units, targets), [row["date"] for row in rows if row["date"] is not None]
    return FleetOverview(
        name, len(rows), sum(row["error"] is not None for row in rows),
        sum(row["consistent"] is False for row in rows), units,
        tuple(sorted({row["bench"] for row in rows if row["bench"]})), min(dates, default=None),
        max(dates, default=None), followed, weeks_of(rows), looks(rows, units, followed, pooled), pooled, remarks,
    )  # fmt: skip


def _unit(row: Mapping[str, Any]) -> str:
    return row["unit"] or row["run"]


@dataclass(frozen=True)
class AnotherLook:
    """A unit to look at; chance: that the strongest of the reasons is nothing but noise, given how many were tried.

    reasons: in words, the strongest first.
    """

    unit: str
    chance: float
    reasons: tuple[str, ...]

    @property
    def why(self) -> str:
        """The strongest reasons, and how many more there are."""
        more = [f"{len(self.reasons) - _REASONS} more"] if len(self.reasons) > _REASONS else []
        return "; ".join([*self.reasons[:_REASONS], *more])


def looks(
    rows: Sequence[Mapping[str, Any]], units: Sequence[str], tracks: Sequence[Track], pooled: PooledDiagnosis | None
) -> tuple[AnotherLook, ...]:
    """The units that need another look, first those that need it most."""
    every = [*_of_runs(rows), *_of_parameters(units, tracks), *_of_effects(pooled)]
    reasons = dict[str, list[tuple[float, str]]]()
    for unit, chance, said in sorted(every, key=lambda reason: reason[1]):
        if chance < _LEVEL:
            reasons.setdefault(unit, []).append((chance, said))
    found = [AnotherLook(unit, own[0][0], tuple(said for _, said in own)) for unit, own in reasons.items()]
    return tuple(sorted(found, key=lambda look: (look.chance, -len(look.reasons), look.unit)))


_Reason = tuple[str, float, str]


def _of_runs(rows: Sequence[Mapping[str, Any]]) -> list[_Reason]:
    """Return the runs that failed, and those that their model does not explain."""
    reasons = list[_Reason]()
    for row in rows:
        name = PurePosixPath(row["run"]).name
        if row["error"] is not None:
            reasons.append((row["unit"], 0.0, f"{name} failed"))
        elif row["consistent"] is False and row["p_value"] is not None:
            missing = f"shows {row['missing']}" if row["missing"] else "does not fit its model"
            reason = f"{name} {missing} (p {format_p(row['p_value'])})"
            reasons.append((row["unit"], sidak(row["p_value"], len(rows)), reason))
    return reasons


def _of_parameters(units: Sequence[str], tracks: Sequence[Track]) -> list[_Reason]:
    """Return the units of which a parameter lies outside the population of the others."""
    return [
        (unit, chance, f"{track.symbol} is {abs(distance):.1f} spreads from the median of the units")
        for track in tracks
        for unit, chance, distance in zip(units, track.chances.tolist(), track.distances.tolist(), strict=True)
    ]


def _of_effects(pooled: PooledDiagnosis | None) -> list[_Reason]:
    """Return the units that have an effect which other units do not have."""
    findings = () if pooled is None else pooled.findings
    return [
        (figures.unit, max(1.0 - figures.probability, 0.0), f"has {finding.effect}, which others have not")
        for finding in findings
        if finding.attribution is Attribution.SOME
        for figures in finding.units
    ]


@dataclass(frozen=True)
class Weeks:
    """How many runs came to what in each week, the most frequent verdict first; begins: Mondays, without gaps.

    undated: runs of which nobody knows the date.
    """

    begins: tuple[date, ...]
    counts: Mapping[str, tuple[int, ...]]
    undated: int


def counted(rows: Iterable[Mapping[str, Any]]) -> dict[str, int]:
    """How many rows came to what verdict, the most frequent first."""
    return dict(Counter(verdict_of(row) for row in rows).most_common())


def verdict_of(row: Mapping[str, Any]) -> str:
    """What the run of a row came to, in a word or two."""
    if row["error"] is not None:
        return "failed"
    if row["consistent"] is None:
        return "not judged"
    return row["missing"] or ("consistent" if row["consistent"] else "inconsistent")


def weeks_of(rows: Sequence[Mapping[str, Any]]) -> Weeks:
    """The verdicts of the runs by week."""
    verdicts = [(row["date"], verdict_of(row)) for row in rows if row["date"] is not None]
    dated = [(when.date() - timedelta(days=when.weekday()), verdict) for when, verdict in verdicts]
    mondays = sorted({monday for monday, _ in dated})
    count = (mondays[-1] - mondays[0]).days // 7 + 1 if mondays else 0
    begins = tuple(mondays[0] + timedelta(weeks=k) for k in range(count))
    counts, whole = Counter(dated), Counter(verdict for _, verdict in dated)
    of_each = {verdict: tuple(counts[monday, verdict] for monday in begins) for verdict, _ in whole.most_common()}
    return Weeks(begins, of_each, len(rows) - len(dated))
