"""The unknown constants inside effects' formulas (time constants, frequencies, widths), as a fit goes on.

They are searched on a grid and refined by Gauss-Newton steps, in which the derivative with respect to the constant is
one more column. A constant without a derivative is averaged over its posterior.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.effects import Effect
from kf_calib.estimation.dwell_columns import LinearisedDwells, stimulus_of
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.score_test import delta_chi2


def estimate_and_steps(fitted: Fit) -> tuple[Floats, Floats]:
    """The estimate (p,) with the unknown constants at zero, and the steps (p,) of these constants, zeros
    elsewhere."""
    state = fitted.state.copy()
    moved = np.zeros_like(state)
    places = list(fitted.linearised.model.unknowns)
    moved[places], state[places] = state[places], 0.0
    return state, moved


def largest_steps(fitted: Fit) -> Floats:
    """The largest allowed step (p,) of each state: for an unknown constant by its kind, 1 for the others, which
    are not moved."""
    model, reach = fitted.linearised.model, np.ones(fitted.linearised.model.count)
    if model.unknowns:
        stimulus = stimulus_of(fitted.linearised.dwells_at_state, model.bench, fitted.linearised.state)
        for k, effect in model.unknowns.items():
            reach[k] = effect.reach(stimulus)
    return reach


def placed_on_grid(fitted: Fit) -> Model:
    """The model with each unknown constant at the grid value at which its effect lowers chi-squared most."""
    model = fitted.linearised.model
    stimulus = stimulus_of(fitted.linearised.dwells_at_state, model.bench, fitted.linearised.state)
    for effect in model.unknowns.values():
        grid = [effect.at(value) for value in effect.grid(stimulus)]
        model = model.with_effect(grid[_best(fitted, model - effect, grid)])
    return model


def averaged_over_posterior(fitted: Fit) -> tuple[Model, dict[str, float]]:
    """The model with each constant without a derivative at its posterior mean, and the sigma of each constant's
    logarithm.

    The likelihood is exp(decrease of chi^2 / 2) and the prior is flat in ln(value). The likelihood is constant between
    values at which the columns step.
    """
    model, spreads = fitted.linearised.model, dict[str, float]()
    stimulus = stimulus_of(fitted.linearised.dwells_at_state, model.bench, fitted.linearised.state)
    for effect in model.stepped:
        edges = np.log(effect.edges(stimulus))
        middles, widths = 0.5 * (edges[1:] + edges[:-1]), np.diff(edges)
        deltas = _delta_chi2(fitted, model - effect, [effect.at(value) for value in np.exp(middles)])
        weights = np.exp(0.5 * (deltas - deltas.max())) * widths
        mean = float(np.average(middles, weights=weights))
        spreads[str(effect)] = float(np.sqrt(np.average((middles - mean) ** 2 + widths**2 / 12.0, weights=weights)))
        model = model.with_effect(effect.at(math.exp(mean)))
    return model, spreads


def _best(fitted: Fit, rest: Model, grid: Sequence[Effect]) -> int:
    """Return the index of the value in ``grid`` at which the effect lowers chi-squared most beside the ``rest`` of the
    model."""
    return int(np.argmax(_delta_chi2(fitted, rest, grid)))


def _delta_chi2(fitted: Fit, rest: Model, grid: Sequence[Effect]) -> Floats:
    """Return the decrease of chi-squared for the same effect at several values, each added to the ``rest`` of the
    model."""
    parts, state = fitted.linearised.model.parts, fitted.linearised.state
    state = np.concatenate([state[:STATE_COUNT], *(state[parts[str(effect)]] for effect in rest.effects)])
    return delta_chi2(LinearisedDwells(fitted.dwells, rest, state), fitted.noise.weights, grid)
