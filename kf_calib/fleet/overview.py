"""What the runs of a fleet come to together: parameters, verdicts by week, common effects, units to look at first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from kf_calib.fleet.another_look import Look, looks
from kf_calib.fleet.pooled_diagnosis import PooledDiagnosis
from kf_calib.fleet.track import Track, tracks
from kf_calib.fleet.weeks import Weeks, weeks_of

COLUMNS = ("run", "unit", "bench", "date", "error", "consistent", "p_value", "missing", "parameters")
"""Columns of the table that an overview is made from."""


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
    looks: tuple[Look, ...]
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
