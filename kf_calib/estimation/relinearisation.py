"""Steps of the fit in which the attitudes of the dwells move with the state (Gauss-Newton with a line search)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.dwells.sufficient_statistics import DwellFactor
from kf_calib.estimation.attitude import at_their_modes, facing_readings, untold_directions
from kf_calib.estimation.dwell_columns import LinearisedDwells
from kf_calib.estimation.measurement_model import Model
from kf_calib.noise.noise_model import Noise

SETTLED = 1e-4
"""In sigmas of each state: a smaller step ends the search."""
UNSETTLED = 1.0
"""In sigmas: a fit whose last step was larger has not converged."""
_HALVES = 6
_UPHILL = 1e-6  # by which the misfit may grow, relative; more is no rounding
_TURNS = 4  # most times that attitudes are found at a given state
_STILL_RAD = 1e-7


def relinearised(
    linearised: LinearisedDwells, noise: Noise, model: Model, state: Floats, untold: Floats | None = None
) -> LinearisedDwells:
    """The dwells with the columns of a model at a state, and attitudes where the readings show them there.

    untold: as in ``at_their_modes``.
    """
    known = state if len(state) == linearised.model.count else linearised.state
    return LinearisedDwells(at_their_modes(linearised, noise, known, untold), model, state, linearised.slews)


def _farthest_rad(one: LinearisedDwells, other: LinearisedDwells) -> float:
    """Return the largest angle between the forces of two linearisations of the same dwells."""
    unit, there = (c.means.force_mps2 / np.linalg.norm(c.means.force_mps2, axis=1, keepdims=True) for c in (one, other))
    return float(np.linalg.norm(unit - there, axis=1).max())


def linearised_at(
    dwells: Sequence[DwellFactor], model: Model, state: Floats, noise: Noise, untold: Floats | None = None
) -> LinearisedDwells:
    """Dwells with the columns of a model at a state, and attitudes where the readings show them there.

    untold: as in ``at_their_modes``.
    """
    if noise.attitude_unknown:
        dwells = facing_readings(dwells, state, model.bench.gravity_mps2)
    linearised = LinearisedDwells(dwells, model, state)
    for _ in range(_TURNS if noise.setting_rad else 1):
        before, linearised = linearised, relinearised(linearised, noise, model, state, untold)
        if _farthest_rad(before, linearised) < _STILL_RAD:
            break
    return linearised


def at_its_mode(dwell: DwellFactor, so_far: LinearisedDwells, noise: Noise) -> DwellFactor:
    """A dwell that follows those ``so_far``, with its attitude where its readings show it at their state: the iterated
    update of a filter by one dwell."""
    if not noise.setting_rad:
        return dwell
    both, untold = [so_far.dwells[-1], dwell], untold_directions(so_far, noise)
    return linearised_at(both, so_far.model, so_far.state, noise, untold).dwells[-1]


def left_to_settle(state: Floats, before: Floats, sigma: Floats) -> float:
    """By how many of their sigmas (p,) the states moved at most; those without a sigma are not determined."""
    return float((np.abs(state - before) / np.where(sigma > 0, sigma, np.inf)).max())


def descended(
    linearised: LinearisedDwells, noise: Noise, state: Floats, misfit: Callable[[LinearisedDwells], float]
) -> LinearisedDwells:
    """The dwells linearised at ``state``, or on the way to it where the misfit is less there.

    misfit: of a linearisation at its own state, the sum of squares of all readings and all setting errors over their
    sigmas.
    """
    model, begin, share = linearised.model, linearised.state, 1.0
    highest = misfit(linearised) * (1.0 + _UPHILL)
    nearest = relinearised(linearised, noise, model, state)
    for _ in range(_HALVES - 1):
        if misfit(nearest) <= highest:
            break
        share *= 0.5
        nearest = relinearised(linearised, noise, model, begin + share * (state - begin))
    return nearest
