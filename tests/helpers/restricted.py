"""The restricted likelihood itself, of which the product needs only differences and slopes."""

from __future__ import annotations

import math

from kf_calib.bench.arrays import Floats
from kf_calib.noise import reml
from kf_calib.noise.means import Means
from kf_calib.noise.noise_model import Noise


def restricted_log_likelihood(noise: Noise, means: Means, state: Floats, held_s: float = math.inf) -> float:
    """Of the dwells' means, up to a constant; held_s: time constant with which a walk of the biases reverts to its
    mean, infinite for a random walk."""
    return -reml._likelihood(noise, (), reml._reduce(means), state, held_s).without().cost  # what the search maximizes
