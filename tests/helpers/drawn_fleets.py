"""Fleets that are drawn in numpy alone: whitened rows of runs with correlated columns, hidden coefficients, and noise.

Nothing of the program is used but the form in which it takes a run (``RunFactor``).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.paper_parameters import STATES
from kf_calib.fleet.run_factor import RunFactor

SYMBOLS: Mapping[str, tuple[str, ...]] = {
    "flexure": ("dX", "dY", "dZ"),
    "second-order": ("K2_1", "K2_2", "K2_3"),
    "hysteresis": ("h1", "h2", "h3"),
    "thermal-bias": ("alpha1", "alpha2", "alpha3"),
}
_ROWS = 40
_OVERLAP = 0.6  # of the columns of different effects

Coefficients = Mapping[str, Floats]


@dataclass(frozen=True)
class Plan:
    """A fleet: runs of each unit, benches, units with a second-order term, and how large all is.

    - of_bench: size of the flexure of each bench, in sigma of one run. affected: how many units have a second-order
      term. their_mean, their_spread: of its coefficients. spread: of the hysteresis that every unit has about a mean.
    """

    units: int
    benches: int
    runs_each: int
    affected: int
    of_bench: float = 6.0
    their_mean: float = 12.0
    their_spread: float = 5.0
    mean: float = 4.0
    spread: float = 3.0


@dataclass(frozen=True)
class DrawnFleet:
    """Runs, and what is hidden in them: coefficients of benches and of units."""

    plan: Plan
    runs: Sequence[RunFactor]
    flexure: Mapping[str, Floats]
    second_order: Mapping[str, Floats]
    hysteresis: Mapping[str, Floats]


def drawn_fleet(plan: Plan, rng: np.random.Generator) -> DrawnFleet:
    """Draw a fleet; units are measured on one bench after another."""
    benches, units = [f"bench {k}" for k in range(plan.benches)], [f"unit {k}" for k in range(plan.units)]
    flexure = {bench: plan.of_bench * _direction(rng) for bench in benches}
    common, theirs = plan.mean * _direction(rng), plan.their_mean * _direction(rng)
    hysteresis = {unit: common + plan.spread * rng.standard_normal(3) for unit in units}
    having = {units[k] for k in rng.permutation(plan.units)[: plan.affected]}
    departures = {unit: theirs + plan.their_spread * rng.standard_normal(3) for unit in units}
    second_order = {unit: departures[unit] * (unit in having) for unit in units}
    runs = list[RunFactor]()
    for number in range(plan.units * plan.runs_each):
        unit, bench = units[number % plan.units], benches[(number + number // plan.units) % plan.benches]
        hidden = {"flexure": flexure[bench], "second-order": second_order[unit], "hysteresis": hysteresis[unit]}
        runs.append(_run(number, unit, bench, hidden, rng))
    return DrawnFleet(plan, runs, flexure, second_order, hysteresis)


def _direction(rng: np.random.Generator) -> Floats:
    vector = rng.standard_normal(3)
    return vector / np.linalg.norm(vector)


def _run(number: int, unit: str, bench: str, hidden: Coefficients, rng: np.random.Generator) -> RunFactor:
    """Return a run whose columns of different effects overlap, with unit noise."""
    states, width = rng.standard_normal((_ROWS, len(STATES))) * 1e6, 3 * len(SYMBOLS)
    shared, alone = rng.standard_normal((_ROWS, 3)), rng.standard_normal((_ROWS, width))
    columns = np.sqrt(_OVERLAP) * np.tile(shared, len(SYMBOLS)) + np.sqrt(1.0 - _OVERLAP) * alone
    columns /= np.sqrt(_ROWS - len(STATES))
    truth = np.concatenate([hidden.get(name, np.zeros(3)) for name in SYMBOLS])
    readings = columns @ truth + rng.standard_normal(_ROWS)
    rows = np.column_stack([states, columns, readings])
    names = [f"{name}/{symbol}" for name, own in SYMBOLS.items() for symbol in own]
    return RunFactor(
        f"run {number:03d}", unit, bench, f"2026-01-01T{number // 60:02d}:{number % 60:02d}",
        (*STATES, *names), len(STATES), np.linalg.qr(rows, mode="r"), _ROWS, {}, np.zeros(len(STATES)), False,
    )  # fmt: skip
