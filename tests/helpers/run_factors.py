"""Reduced factors of runs with random columns, whose readings are noise and a given effect."""

from collections.abc import Callable, Mapping

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.paper_parameters import STATES
from kf_calib.dwells.qr import triangle
from kf_calib.fleet.campaign import Group
from kf_calib.fleet.run_factor import RunFactor

EFFECTS: Mapping[str, tuple[str, ...]] = {
    "second-order": ("K2_1", "K2_2", "K2_3"),
    "hysteresis": ("h1", "h2", "h3"),
    "flexure": ("dX", "dY", "dZ"),
    "base-tilt": ("deltaN", "deltaE"),
    "gravity-error": ("epsG",),
}
NOMINAL = np.array([1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0])
_ROWS = 60

Hidden = Callable[[int], Mapping[str, Floats]]
"""The coefficients of the hidden effects in the run of a number; one unit of each is one sigma."""


def nothing(_: int) -> Mapping[str, Floats]:
    """No effect in any run."""
    return {}


def run_factor_of(
    number: int, hidden: Hidden = nothing, unit: str = "", bench: str = "", date: str = "", scale: float = 1.0
) -> RunFactor:
    """The factor of one run; scale: its true scale factors, all three."""
    rng = np.random.default_rng(number)
    own = rng.standard_normal((_ROWS, len(STATES))) * 1e6
    names = [f"{effect}/{symbol}" for effect, symbols in EFFECTS.items() for symbol in symbols]
    columns = {name: rng.standard_normal(_ROWS) for name in names}
    columns["gravity-error/epsG"] = own @ NOMINAL
    readings = own @ (scale * NOMINAL) + rng.standard_normal(_ROWS)
    for effect, coefficients in hidden(number).items():
        for symbol, size in zip(EFFECTS[effect], coefficients, strict=True):
            readings = readings + columns[f"{effect}/{symbol}"] * size / np.sqrt(_ROWS - len(STATES))
    moment = date or f"2026-01-01T{number // 60:02d}:{number % 60:02d}"
    rows = np.column_stack([own, *columns.values(), readings])
    return RunFactor(
        f"run{number:03d}", unit or f"unit{number:03d}", bench or "bench 1", moment,
        (*STATES, *names), len(STATES), triangle(rows), _ROWS, {}, NOMINAL, False,
    )  # fmt: skip


def campaign_of(count: int, hidden: Hidden = nothing) -> list[RunFactor]:
    """The factors of runs of as many units."""
    return [run_factor_of(number, hidden) for number in range(count)]


def columns_of(run: RunFactor, group: Group) -> Floats:
    """Of an effect, in sigma, whitened and without what the states of the run absorb (n, k)."""
    return run.factor[run.width :, [run.places[f"{group.name}/{symbol}"] for symbol in group.symbols]] * group.sigma


def readings_of_run(run: RunFactor) -> Floats:
    return run.factor[run.width :, -1]
