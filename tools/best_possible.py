"""How often anyone could name the right effect: the chooser that knows all that can be known before the readings.

An effect of n sigma is drawn evenly over the directions its coefficients can take and the values of its constant, and
white noise is added; the chooser knows n, these odds, and the noise, and takes the effect that is likeliest after the
readings (Bayes). No rule is right more often, so what a diagnosis lacks of it is what better rules could gain.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.special import gammaln, ive

from kf_calib.samples import Floats
from kf_calib.scan import Candidate


def best_possible(
    spaces: Mapping[str, Sequence[Candidate]],
    same: Mapping[str, set[str]],
    sigmas: float,
    draws: int = 100,
    seed: int = 0,
) -> dict[str, float]:
    """Of each effect, the share of draws in which the likeliest one is it, or means the ``same`` as it.

    spaces: candidates of each effect, one for each value of its constant, in one orthonormal frame.
    """
    rng, names = np.random.default_rng(seed), list(spaces)
    out = dict[str, float]()
    for name in names:
        bases = [spaces[name][k].basis for k in rng.integers(len(spaces[name]), size=draws)]
        signals = np.array([sigmas * basis @ _direction(basis.shape[1], rng) for basis in bases])
        readings = signals + rng.standard_normal(signals.shape)
        likeliest = np.argmax([_log_odds(spaces[other], readings, sigmas) for other in names], axis=0)
        out[name] = float(np.mean([names[k] in same[name] for k in likeliest]))
    return out


def _direction(dof: int, rng: np.random.Generator) -> Floats:
    made = rng.standard_normal(dof)
    return made / np.linalg.norm(made)


def _log_odds(own: Sequence[Candidate], readings: Floats, sigmas: float) -> Floats:
    """log of the mean likelihood ratio (m,) of an effect against none, over its directions and constants.

    Over the sphere of k dimensions, w the part of the readings in the effect's space: the mean of exp(n u w - n^2 / 2)
    is Gamma(k/2) (2 / x)^v I_v(x) exp(-n^2 / 2), v = k/2 - 1, x = n |w| (von Mises, Fisher).
    """
    parts = list[Floats]()
    for each in own:
        order, x = 0.5 * each.dof - 1.0, sigmas * np.linalg.norm(readings @ each.basis, axis=1)
        parts.append(gammaln(0.5 * each.dof) + order * np.log(2.0 / x) + np.log(ive(order, x)) + x - 0.5 * sigmas**2)
    return np.logaddexp.reduce(parts, axis=0) - np.log(len(own))
