"""How often anyone could name the right effect: the chooser that knows all that can be known before the readings.

An effect of n sigma is drawn evenly over the directions its coefficients can take and the values of its constant, and
white noise is added; the chooser knows n, these odds, and the noise, and takes the effect that is likeliest after the
readings (Bayes). No rule is right more often, so what a diagnosis lacks of it is what better rules could gain. Of two
effects at once, each of n sigma, it takes the likeliest pair.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.special import gammaln, ive

from kf_calib.samples import Floats
from kf_calib.scan import Candidate

_NEAR = 12.0  # of the logarithm of the odds: of pairs further behind none is the likeliest
_DRAWN = 400


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


def best_possible_pairs(
    spaces: Mapping[str, Sequence[Candidate]],
    same: Mapping[str, set[str]],
    sigmas: float,
    apart: float,
    draws: int = 100,
    seed: int = 0,
) -> float:
    """The share of draws in which the likeliest pair means both effects that are hidden, of which none overlaps the
    other by ``apart`` or more."""
    rng = np.random.default_rng(seed)
    pairs = [
        (one, other)
        for one, other in itertools.combinations(spaces, 2)
        if max(a.overlap(b) for a, b in itertools.product(spaces[one], spaces[other])) < apart
    ]
    right = 0
    for _ in range(draws):
        true = pairs[rng.integers(len(pairs))]
        bases = [spaces[name][rng.integers(len(spaces[name]))].basis for name in true]
        readings = sum(sigmas * basis @ _direction(basis.shape[1], rng) for basis in bases)
        readings = readings + rng.standard_normal(len(bases[0]))
        rough = [_pair_log_odds(spaces, pair, readings, sigmas, None) for pair in pairs]
        near = [pairs[k] for k in np.argsort(rough)[::-1] if rough[k] > max(rough) - _NEAR]
        said = max(near, key=lambda pair: _pair_log_odds(spaces, pair, readings, sigmas, rng))
        right += any(a in same[true[0]] and b in same[true[1]] for a, b in (said, said[::-1]))
    return right / draws


def _pair_log_odds(
    spaces: Mapping[str, Sequence[Candidate]],
    pair: tuple[str, str],
    readings: Floats,
    sigmas: float,
    rng: np.random.Generator | None,
) -> float:
    """log of the mean likelihood ratio of two effects against none, over their directions and constants.

    Without ``rng``: of coefficients that are normal, of the same mean square.
    """
    of = _normal_log_odds if rng is None else _sphere_log_odds
    both = itertools.product(spaces[pair[0]], spaces[pair[1]])
    parts = [of(one.basis, other.basis, readings, sigmas, rng) for one, other in both]
    return float(np.logaddexp.reduce(parts) - np.log(len(parts)))


def _normal_log_odds(one: Floats, other: Floats, readings: Floats, sigmas: float, _: object = None) -> float:
    """r^T M (1 + M^T M)^-1 M^T r / 2 - log|1 + M^T M| / 2, M the bases times n / sqrt(k)."""
    spread = np.hstack([basis * sigmas / np.sqrt(basis.shape[1]) for basis in (one, other)])
    inner, along = np.eye(spread.shape[1]) + spread.T @ spread, spread.T @ readings
    return float(0.5 * along @ np.linalg.solve(inner, along) - 0.5 * np.linalg.slogdet(inner)[1])


def _sphere_log_odds(one: Floats, other: Floats, readings: Floats, sigmas: float, rng: np.random.Generator) -> float:
    """The same of effects of n sigma each: over the directions of the larger one in closed form, given that of the
    smaller, which is drawn about where it is likeliest (von Mises, Fisher) and weighted by its odds."""
    from scipy.stats import vonmises_fisher

    one, other = sorted((one, other), key=lambda basis: -basis.shape[1])
    dof = other.shape[1]
    if dof == 1:
        drawn, weights = np.array([[-1.0], [1.0]]), np.log([0.5, 0.5])
    else:
        spread = np.hstack([one, other])
        most = np.linalg.lstsq(spread, readings, rcond=1e-6)[0][-dof:]
        closeness = 1.0 - float(np.linalg.svd(one.T @ other, compute_uv=False)[0]) ** 2
        proposal = vonmises_fisher(most / np.linalg.norm(most), 1.0 + 0.5 * sigmas**2 * closeness)
        drawn = proposal.rvs(_DRAWN, random_state=rng)
        even = gammaln(0.5 * dof) - np.log(2.0) - 0.5 * dof * np.log(np.pi)  # over the sphere's surface
        weights = even - proposal.logpdf(drawn) - np.log(_DRAWN)
    given = readings - sigmas * drawn @ other.T
    parts = weights + sigmas * drawn @ (other.T @ readings) - 0.5 * sigmas**2 + _even_log_odds(one, given, sigmas)
    return float(np.logaddexp.reduce(parts))


def _direction(dof: int, rng: np.random.Generator) -> Floats:
    made = rng.standard_normal(dof)
    return made / np.linalg.norm(made)


def _log_odds(own: Sequence[Candidate], readings: Floats, sigmas: float) -> Floats:
    """log of the mean likelihood ratio (m,) of an effect against none, over its directions and constants.

    Over the sphere of k dimensions, w the part of the readings in the effect's space: the mean of exp(n u w - n^2 / 2)
    is Gamma(k/2) (2 / x)^v I_v(x) exp(-n^2 / 2), v = k/2 - 1, x = n |w| (von Mises, Fisher).
    """
    parts = [_even_log_odds(each.basis, readings, sigmas) for each in own]
    return np.logaddexp.reduce(parts, axis=0) - np.log(len(own))


def _even_log_odds(basis: Floats, readings: Floats, sigmas: float) -> Floats:
    """The same (m,) at one value of its constant."""
    dof = basis.shape[1]
    order, x = 0.5 * dof - 1.0, sigmas * np.linalg.norm(readings @ basis, axis=1)
    return gammaln(0.5 * dof) + order * np.log(2.0 / x) + np.log(ive(order, x)) + x - 0.5 * sigmas**2
