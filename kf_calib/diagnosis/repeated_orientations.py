"""What repeated orientations tell of a misfit: whether it comes back with the orientation, or changes as noise does."""

from __future__ import annotations

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.evidence import MarginalLikelihood
from kf_calib.estimation.cross_validation import orientations
from kf_calib.estimation.results import Calibration
from kf_calib.noise.noise_model import mean_covariances


def log_odds_of_repeating(before: Calibration, noise: MarginalLikelihood) -> float:
    """Log odds that the misfit depends on the orientation alone, against noise from dwell to dwell of these sizes; 0
    where no orientation is repeated.

    They are those of the differences of residuals between the visits of an orientation: with the noise that was stated
    alone, or with that of the given parts, too.
    """
    groups = [group for group in orientations(before.fit.dwells) if len(group) > 1]
    stated, linearised = before.noise.for_goodness_of_fit, before.linearised
    if not groups or stated.attitude_unknown:
        return 0.0
    within = mean_covariances(stated.of_readings, linearised.means, linearised.state)
    scatter, force = np.zeros_like(within), linearised.means.design[:, 0, :3]
    for part, size in zip(noise.parts, noise.sizes, strict=False):
        if part == "setting":
            squares = np.sum(force**2, axis=1)[:, None, None] * np.eye(3) - force[:, :, None] * force[:, None, :]
            scatter += size**2 * squares
        elif part == "common":
            scatter += size**2 * np.eye(3)
    return sum(_log_ratio(before.residuals_mps2[group], within[group], scatter[group]) for group in groups)


def _log_ratio(residuals: Floats, within: Floats, scatter: Floats) -> float:
    """Return the log of the likelihood of the differences from the first visit without the scatter, over that with it;
    residuals (n, 3), covariances (n, 3, 3)."""
    differences = (residuals[1:] - residuals[0]).ravel()
    return _log_density(differences, within) - _log_density(differences, within + scatter)


def _log_density(differences: Floats, covariances: Floats) -> float:
    """Return the log density of differences (3 (n - 1),) from the first of n vectors, but for a constant."""
    count = len(covariances) - 1
    spread = np.kron(np.ones((count, count)), covariances[0])
    for k in range(count):
        spread[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += covariances[k + 1]
    return -0.5 * float(np.linalg.slogdet(spread)[1] + differences @ np.linalg.solve(spread, differences))
