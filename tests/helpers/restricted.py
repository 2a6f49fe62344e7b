"""The restricted likelihood itself, of which the product needs only differences and slopes."""

from kf_calib.bench.arrays import Floats
from kf_calib.noise import reml
from kf_calib.noise.means import Means
from kf_calib.noise.noise_model import Noise


def restricted_log_likelihood(noise: Noise, means: Means, state: Floats) -> float:
    """Of the dwells' means, up to a constant."""
    return -reml._likelihood(noise, (), reml._reduce(means), state).without().cost  # what the search maximizes
