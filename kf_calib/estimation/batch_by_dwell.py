"""How far the filter is, after every dwell, from least squares over all dwells so far."""

from __future__ import annotations

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.estimation.measurement_model import STATE_COUNT
from kf_calib.estimation.results import Calibration, Estimate

_AT_MOST = 200
"""Dwells after which least squares is solved."""


def batch_differences(result: Calibration) -> Floats:
    """Differences (D, 12 + q) of parameters and coefficients after each dwell, in sigma of the filter's estimate.

    Least squares solves the whitened rows [H | z] of all dwells so far with one singular value decomposition. It knows
    neither a prior nor a walk of the biases, so it differs where one is stated. NaN while not all is determined, and
    after all but some hundred dwells of a long run.
    """
    out, width = np.full((len(result.visits), result.model.count), np.nan), result.model.count + 1
    rows = [own[:, -width:] for own in result.fit.all_rows()]
    for count in np.unique(np.linspace(1, len(rows), min(len(rows), _AT_MOST)).round().astype(int)):
        estimate, own = result.visits[count - 1].estimate, np.concatenate(rows[:count])
        scale = np.linalg.norm(own[:, :-1], axis=0)
        if estimate.undetermined.size or not scale.all():
            continue
        found, _, rank, _ = np.linalg.lstsq(own[:, :-1] / scale, own[:, -1])
        if rank == len(scale):
            apart = _values(result, found / scale) - _values(result, estimate.state)
            out[count - 1] = apart / _sigma(result, estimate)
    return out


def _values(result: Calibration, state: Floats) -> Floats:
    """Return the twelve parameters and the coefficients of effects."""
    return np.append(paper_parameters.parameters_of(state[:STATE_COUNT]), result.model.natural(state)[0])


def _sigma(result: Calibration, estimate: Estimate) -> Floats:
    """Return the sigma of each; NaN where not determined."""
    return np.append(estimate.sigma, estimate.effect_sigma * result.model.natural(estimate.state)[1])
