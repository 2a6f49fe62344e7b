"""Steps of the fit in which the attitudes of the dwells move with the state (Gauss-Newton with a line search)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.dwells.sufficient_statistics import DwellFactor
from kf_calib.estimation.attitude import at_their_modes, facing_readings
from kf_calib.estimation.dwell_columns import Carried
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.noise_model import Noise

if TYPE_CHECKING:
    from kf_calib.estimation.fit import Fit

SETTLED = 1e-4
"""In sigmas of each state: a smaller step ends the search."""
UNSETTLED = 1.0
"""In sigmas: a fit whose last step was larger has not converged."""
_HALVES = 6
_UPHILL = 1e-6  # by which the misfit may grow, relative; more is no rounding
_TURNS = 4  # most times that attitudes are found at a given state
_STILL_RAD = 1e-7


def linearised(fitted: Fit, model: Model, state: Floats) -> Carried:
    """The dwells of a fit with the columns of a model at a state, and attitudes where the readings show them there."""
    return _once(fitted.carried, fitted.noise, model, state)


def _once(carried: Carried, noise: Noise, model: Model, state: Floats) -> Carried:
    known = state if len(state) == carried.model.count else carried.state
    return Carried(at_their_modes(carried, noise, known), model, state, carried.slews)


def _farthest_rad(one: Carried, other: Carried) -> float:
    """Return the largest angle between the forces of two linearisations of the same dwells."""
    unit, there = (
        c.means.force_mps2 / np.linalg.norm(c.means.force_mps2, axis=1, keepdims=True) for c in (one, other)
    )
    return float(np.linalg.norm(unit - there, axis=1).max())


def carried_at(dwells: Sequence[DwellFactor], model: Model, state: Floats, noise: Noise) -> Carried:
    """Dwells with the columns of a model at a state, and attitudes where the readings show them there."""
    if noise.attitude_unknown:
        dwells = facing_readings(dwells, state, model.bench.gravity_mps2)
    carried = Carried(dwells, model, state)
    for _ in range(_TURNS if noise.setting_rad else 1):
        before, carried = carried, _once(carried, noise, model, state)
        if _farthest_rad(before, carried) < _STILL_RAD:
            break
    return carried


def left_to_settle(fitted: Fit, state: Floats) -> float:
    """By how many of their sigmas the states move from where the fit is linearised; 0 where no attitude moves."""
    if not fitted.noise.weights.setting_rad:
        return 0.0
    return float((np.abs(state - fitted.carried.state) / np.where(fitted.sigma > 0, fitted.sigma, np.inf)).max())


def descended(fitted: Fit, model: Model, state: Floats) -> tuple[Carried, Floats]:
    """The dwells linearised at ``state``, or on the way to it where the misfit is less there, and that state.

    The misfit of a state is the sum of squares of all readings and all setting errors over their sigmas.
    """
    carried, begin = linearised(fitted, model, state), fitted.carried.state
    searching = fitted.noise.attitude_unknown and model is fitted.carried.model
    if not searching or fitted.noise.walk_mps2_per_sqrt_s:
        return carried, state
    highest = _misfit(fitted, fitted.carried) * (1.0 + _UPHILL)
    nearest, share = carried, 1.0
    for _ in range(_HALVES):
        if _misfit(fitted, nearest) <= highest:
            return nearest, nearest.state
        share *= 0.5
        nearest = linearised(fitted, model, begin + share * (state - begin))
    return nearest, nearest.state


def _misfit(fitted: Fit, carried: Carried) -> float:
    """Return chi-squared of a linearisation at its own state, in the noise of the fit."""
    rows = replace(fitted, carried=carried).all_rows()
    return float(sum(np.sum((r[:, -1] - r[:, :-1] @ carried.state) ** 2) for r in rows))
