"""The best that can be said of an injected effect: by exact evidence among the effects that are injected.

The chooser knows the formulas of the trial, its effects' constants, the size in sigma, and the distribution of the
coefficients, and takes the scatter of the poses for white noise of known size. Only the direction of the coefficients
is unknown to it, and averaged.
"""

from __future__ import annotations

import numpy as np

from kf_calib.bench.arrays import Floats
from real_trials.injected import EFFECTS, injected
from real_trials.recordings import RealRecording

_DRAWS = 100_000


def chosen(recording: RealRecording, added: Floats, sigmas: float, seed: int) -> dict[str, float]:
    """Probability of each visible effect, by what the parameters leave of the poses of an altered recording."""
    readings = recording.left + recording.seen(added)
    directions = np.random.default_rng(7).normal(size=(3, _DRAWS))
    logs = dict[str, float]()
    for name, formula in EFFECTS.items():
        if injected(recording, name, sigmas, seed) is None:
            continue
        shape = formula(recording)
        shape *= recording.scatter_mps2 / np.abs(shape).max()
        columns = np.array([recording.seen(shape * channel) for channel in np.eye(3)]).T
        lengths = np.sqrt(np.maximum(np.sum(directions * (columns.T @ columns @ directions), axis=0), 1e-300))
        along = (columns.T @ readings) @ directions
        logs[name] = float(np.logaddexp.reduce(sigmas * along / lengths))  # -|z - v|^2 / 2 with |v| = sigmas
    largest = max(logs.values())
    weights = {name: np.exp(log - largest) for name, log in logs.items()}
    return {name: float(weight / sum(weights.values())) for name, weight in weights.items()}


def credible(probabilities: dict[str, float]) -> list[str]:
    """The effects that together have 99 %, the likeliest first."""
    ranked, total, names = sorted(probabilities.items(), key=lambda each: -each[1]), 0.0, list[str]()
    for name, probability in ranked:
        if total < 0.99:
            names.append(name)
        total += probability
    return names
