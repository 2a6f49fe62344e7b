"""Fleets as their overviews, from rows and factors that are made up."""

from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np

from helpers.run_factors import Hidden, nothing, run_factor_of
from kf_calib.fleet.overview import FleetOverview, overview_of
from kf_calib.fleet.pooled_diagnosis import pooled_diagnosis

BENT = np.array([2.0, -1.5, 2.5])
BEGIN = datetime(2026, 1, 1, tzinfo=UTC)


def rows_of(count: int, outlying: int | None = None) -> list[dict[str, Any]]:
    """Rows of units measured twice, a week apart each; one of them lies far from the others."""
    rng = np.random.default_rng(5)
    own = rng.standard_normal(count)
    if outlying is not None:
        own[outlying] = 60.0
    return [
        {
            "run": f"run{k:03d}", "unit": f"unit{k % count:02d}", "bench": "bench 1", "error": None, "consistent": True,
            "p_value": 0.5, "missing": None, "date": BEGIN + timedelta(weeks=k),
            "parameters": [{
                "symbol": "b1", "value": 1e-4 * own[k % count] + 1e-6 * rng.standard_normal(), "sigma": 1e-6,
                "unit": "m/s^2", "nominal": 0.0,
            }],
        }
        for k in range(2 * count)
    ]  # fmt: skip


def overview_with(hidden: Hidden = nothing, outlying: int | None = None) -> FleetOverview:
    factors = [run_factor_of(k, hidden, date=(BEGIN + timedelta(weeks=k)).isoformat()) for k in range(20)]
    return overview_of("fleet", rows_of(20, outlying), {"b1": 2e-6}, pooled_diagnosis(factors), ())
