"""Which sides to turn up where there are no angles: of 26 directions, one after another, always that in which |f| is
known worst, which is the one that lowers the generalised variance of the nine parameters most."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.free_attitude import covariance_of, most_informative, row_of, weak_covariance
from kf_calib.estimation.measurement_model import Model

SYMBOLS = ("K1", "b1", "nu1", "K2", "b2", "theta3", "phi3", "K3", "b3")
"""The nine parameters that are left without angles."""


@dataclass(frozen=True)
class HandPlan:
    """Sides to turn up, each by the axes that point up alike (``+x``, ``+x -z``), and the sigmas (poses + 1, 9) before
    and after each, in SI."""

    up: tuple[str, ...]
    sigma: Floats

    @classmethod
    def of(cls, count: int, model: Model, mean_mps2: float, before: Fit | None = None) -> HandPlan:
        """The plan of ``count`` poses after a run or from nothing; ``mean_mps2``: sigma of a pose's mean reading."""
        state = model.nominal_state() if before is None else before.linearised.state
        square_rad = model.bench.square_rad
        covariance = weak_covariance() if before is None else covariance_of(before.linearised, before.noise, square_rad)
        gravity, up, sigmas = model.bench.gravity_mps2, list[str](), [_sigmas(covariance, state)]
        for _ in range(count):
            up.append(most_informative(covariance, state, gravity))
            row, across = row_of(up[-1], state, gravity)
            gain = covariance @ row
            covariance = covariance - np.outer(gain, gain) / (row @ gain + mean_mps2**2 * (across @ across))
            sigmas.append(_sigmas(covariance, state))
        return cls(tuple(up), np.array(sigmas))


def _sigmas(covariance: Floats, state: Floats) -> Floats:
    """Return the sigmas (9,) of the parameters."""
    jacobian = paper_parameters.jacobian(state)
    places = [paper_parameters.SYMBOLS.index(symbol) for symbol in SYMBOLS]
    return np.sqrt(np.maximum(np.diag(jacobian @ covariance @ jacobian.T), 0.0))[places]
