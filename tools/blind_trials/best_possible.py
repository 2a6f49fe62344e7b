"""The best possible share of right names: that of a chooser that knows all that can be known before the readings.

An effect of n sigma is drawn evenly over the directions that its coefficients can take, or over the paths of a random
walk, and white noise is added. The chooser knows n, these probabilities and the noise, and takes the effect with the
largest posterior probability (Bayes); for a constant within an effect it knows the range, not the value. No rule is
right more often, so the distance of a diagnosis from it is what better rules could gain. For two effects at once, each
of n sigma, it takes the likeliest pair. Rivals are explanations that have no name.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from scipy.special import gammaln
from scipy.stats import vonmises_fisher

from blind_trials.bayes_factor import log_odds
from kf_calib.bench.arrays import Floats

_NEAR = 12.0  # in the logarithm of the odds: a pair that lags by more is never the likeliest
_DRAWN = 400  # directions, for the mean over them
_ONE_TO_TWO = 4.0  # odds of one effect against two, before the readings
_SEEN = 1e-3  # singular value of a combination of columns that counts
_TRIED = np.exp(np.linspace(0.0, np.log(1e7), 60))  # sizes of a walk, sigma
_INTENSITIES, _PATHS = 8, 2000  # intensities of a process that are tried, and paths that give their range

_SIZES = np.exp(np.linspace(0.0, math.log(1e14), 120))  # prior variance of a coefficient over that of its estimate


def size_evidence(dof: int, delta_chi2: Floats | float) -> Floats:
    """Log Bayes factor of an effect whose size and direction are unknown, against no effect.

    The coefficients have the prior N(0, g C) with C the covariance of their estimate, and ln g is uniform from 0 to
    ln 1e14, which is a size of 1 to 1e7 sigma (the g-prior of A. Zellner, 1986, mixed over g; F. Liang et al., 2008):

      B = mean over g of (1 + g)^(-k/2) exp(g / (1 + g) F / 2)

    dof: number of coefficients k. delta_chi2: decrease F of chi-squared with them; a number or an array. Returns
    ln B.
    """
    log_terms = -0.5 * dof * np.log1p(_SIZES) + 0.5 * np.asarray(delta_chi2, float)[..., None] * (
        _SIZES / (1.0 + _SIZES)
    )
    return np.logaddexp.reduce(log_terms, axis=-1) - math.log(len(_SIZES))


@dataclass(frozen=True)
class Sphere:
    """Signals of n sigma, distributed evenly over the directions of an orthonormal basis (d, k)."""

    basis: Floats

    def log_odds(self, readings: Floats, sigmas: float) -> Floats:
        """Return the log of the mean likelihood ratio (m,) of the signals against none, for readings (m, d)."""
        return log_odds(self.basis.shape[1], np.sum((readings @ self.basis) ** 2, axis=1), sigmas)

    def spread(self, sigmas: float) -> Floats:
        """Return the root (d, k) of the covariance of normal signals of the same mean square."""
        return self.basis * sigmas / np.sqrt(self.basis.shape[1])


@dataclass(frozen=True)
class Normal:
    """Normal signals with ``variances`` (k,) along an orthonormal basis (d, k)."""

    basis: Floats
    variances: Floats

    def log_odds(self, readings: Floats, _: float) -> Floats:
        """Return the log of the likelihood ratio (m,) of the signals against none, for readings (m, d)."""
        wider, along = 1.0 + self.variances, readings @ self.basis
        return 0.5 * np.sum(along**2 * (1.0 - 1.0 / wider) - np.log(wider), axis=-1)

    def spread(self, _: float) -> Floats:
        """Return the root (d, k) of the covariance."""
        return self.basis * np.sqrt(self.variances)

    def whiten(self, rows: Floats) -> Floats:
        """Return rows (d, c) times the inverse root of 1 + the covariance."""
        shrunk = 1.0 - 1.0 / np.sqrt(1.0 + self.variances)
        return rows - self.basis @ (shrunk[:, None] * (self.basis.T @ rows))


class Effect(Protocol):
    """The signals of an effect in an orthonormal frame of d dimensions."""

    def signals(self, count: int, rng: np.random.Generator) -> Floats:
        """Draw signals (count, d) of one sigma each."""
        ...

    def parts(self, sigmas: float, /) -> Sequence[Sphere | Normal]:
        """Return the distributions that the signals have, all equally likely."""
        ...


@dataclass(frozen=True)
class Columns:
    """An effect with linear coefficients.

    bases: orthonormal (d, k), one for each value of its constant. hidden: those with which it is hidden, where these
    differ.
    """

    bases: Sequence[Floats]
    hidden: Sequence[Floats] = ()

    def signals(self, count: int, rng: np.random.Generator) -> Floats:
        own = self.hidden or self.bases
        return np.array([_along(own[k], rng) for k in rng.integers(len(own), size=count)])

    def parts(self, _: float) -> Sequence[Sphere]:
        return [Sphere(basis) for basis in self.bases]


@dataclass(frozen=True)
class Process:
    """A random process with covariance ``root`` root^T, root (d, k), such as a walk of the biases.

    All its paths have one size. The chooser takes them as normal, with the intensities that such paths have.
    """

    root: Floats

    def signals(self, count: int, rng: np.random.Generator) -> Floats:
        paths = self._paths(count, rng)
        return paths / np.linalg.norm(paths, axis=1)[:, None]

    def parts(self, sigmas: float) -> Sequence[Normal]:
        basis, variances, intensities = self._modes
        return [Normal(basis, (sigmas * each) ** 2 * variances) for each in intensities]

    @cached_property
    def _modes(self) -> tuple[Floats, Floats, Floats]:
        basis, sizes, _ = np.linalg.svd(self.root, full_matrices=False)
        kept = sizes > 1e-6 * sizes[0]
        lengths = np.linalg.norm(self._paths(_PATHS, np.random.default_rng(0)), axis=1)
        shares = (np.arange(_INTENSITIES) + 0.5) / _INTENSITIES
        return basis[:, kept], sizes[kept] ** 2, np.quantile(1.0 / lengths, shares)

    def _paths(self, count: int, rng: np.random.Generator) -> Floats:
        return rng.standard_normal((count, self.root.shape[1])) @ self.root.T


def best_possible(
    effects: Mapping[str, Effect],
    same: Mapping[str, set[str]],
    sigmas: float,
    draws: int = 100,
    seed: int = 0,
    rivals: Mapping[str, Effect] | None = None,
) -> dict[str, float]:
    """Return for each effect the share of draws in which the likeliest explanation is right.

    effects: by name. same: the names that mean the same as each. sigmas: size of the effects. draws: for each effect.
    rivals: further explanations, which are never hidden.
    """
    return {
        name: float(np.mean([names[k] in same[name] for k in np.argmax(logs, axis=0)]))
        for name, names, logs in _log_odds_of_all(effects, sigmas, draws, seed, rivals)
    }


def best_possible_probability(
    effects: Mapping[str, Effect], same: Mapping[str, set[str]], sigmas: float, draws: int = 100, seed: int = 0
) -> dict[str, float]:
    """Return for each effect the mean probability that the same chooser gives to the truth."""
    return {
        name: float(np.mean(np.exp(logs - np.logaddexp.reduce(logs, axis=0))[[k in same[name] for k in names]].sum(0)))
        for name, names, logs in _log_odds_of_all(effects, sigmas, draws, seed, None)
    }


def probability_where_two_are_possible(
    effects: Mapping[str, Effect], same: Mapping[str, set[str]], sigmas: float, draws: int = 10, seed: int = 0
) -> dict[str, float]:
    """Return for each effect the mean probability of the truth for a chooser that knows neither size nor number.

    Every size is equally likely on a logarithmic scale. One effect is four times as likely as two at once, which have
    columns, each at its best constant.
    """
    out, rng = dict[str, float](), np.random.default_rng(seed)
    for name in effects:
        readings = sigmas * effects[name].signals(draws, rng)
        readings = readings + rng.standard_normal(readings.shape)
        alone = np.array([_log_odds_of_any_size(each, readings) for each in effects.values()]) - np.log(len(effects))
        both = np.array([_log_odds_of_pairs(effects.values(), own) for own in readings]) - np.log(_ONE_TO_TWO)
        logs = alone - np.logaddexp.reduce([*alone, both], axis=0)
        out[name] = float(np.mean(np.exp(logs[[each in same[name] for each in effects]]).sum(0)))
    return out


def _log_odds_of_any_size(effect: Effect, readings: Floats) -> Floats:
    """Return the log of the mean likelihood ratio (m,) of the signals of any size against none."""
    parts = [
        size_evidence(each.basis.shape[1], np.sum((readings @ each.basis) ** 2, axis=1))
        if isinstance(each, Sphere)
        else np.logaddexp.reduce([replace(each, variances=each.variances * n**2).log_odds(readings, n) for n in _TRIED])
        - np.log(len(_TRIED))
        for each in effect.parts(1.0)
    ]
    return np.logaddexp.reduce(parts, axis=0) - np.log(len(parts))


def _log_odds_of_pairs(effects: Iterable[Effect], readings: Floats) -> float:
    """Return the log of the mean likelihood ratio of all pairs of effects with columns, of any size, against none."""
    best, logs = list[tuple[Floats, float]](), list[float]()
    for bases in (effect.bases for effect in effects if isinstance(effect, Columns)):
        falls = np.array([np.sum((readings @ basis) ** 2) for basis in bases])
        share = np.logaddexp.reduce(0.5 * (falls - falls.max())) - np.log(len(falls))
        best.append((bases[int(np.argmax(falls))], float(share)))
    for (one, of_one), (other, of_other) in itertools.combinations(best, 2):
        left, singular, _ = np.linalg.svd(np.hstack([one, other]), full_matrices=False)
        basis = left[:, singular > _SEEN]
        logs.append(float(size_evidence(basis.shape[1], float(np.sum((readings @ basis) ** 2)))) + of_one + of_other)
    return float(np.logaddexp.reduce(logs)) - np.log(len(logs))


def _log_odds_of_all(
    effects: Mapping[str, Effect], sigmas: float, draws: int, seed: int, rivals: Mapping[str, Effect] | None
) -> Iterator[tuple[str, list[str], Floats]]:
    """Yield for each hidden effect the names of the explanations, and their log odds (n, draws) in readings with it."""
    every, rng = {**effects, **(rivals or {})}, np.random.default_rng(seed)
    for name in effects:
        readings = sigmas * effects[name].signals(draws, rng)
        readings = readings + rng.standard_normal(readings.shape)
        yield name, list(every), np.array([_log_odds(each, readings, sigmas) for each in every.values()])


def best_possible_pairs(
    effects: Mapping[str, Effect],
    same: Mapping[str, set[str]],
    sigmas: float,
    pairs: Sequence[tuple[str, str]],
    draws: int = 100,
    seed: int = 0,
) -> list[tuple[tuple[str, str], bool]]:
    """Return for each draw the hidden pair, one of ``pairs``, and whether the likeliest pair means both effects."""
    rng, out = np.random.default_rng(seed), list[tuple[tuple[str, str], bool]]()
    for _ in range(draws):
        true = pairs[int(rng.integers(len(pairs)))]
        signal = sigmas * np.sum([effects[name].signals(1, rng)[0] for name in true], axis=0)
        readings = signal + rng.standard_normal(signal.shape)

        def likely(pair: tuple[str, str], of: Callable[..., float], readings: Floats = readings) -> float:
            both = itertools.product(*(effects[name].parts(sigmas) for name in pair))
            parts = [of(one, other, readings, sigmas, rng) for one, other in both]
            return float(np.logaddexp.reduce(parts) - np.log(len(parts)))

        rough = [likely(pair, _rough_log_odds) for pair in pairs]
        near = [pairs[k] for k in np.argsort(rough)[::-1] if rough[k] > max(rough) - _NEAR]
        best = max(near, key=lambda pair: likely(pair, _pair_log_odds))
        out.append((true, any(a in same[true[0]] and b in same[true[1]] for a, b in (best, best[::-1]))))
    return out


def _along(basis: Floats, rng: np.random.Generator) -> Floats:
    made = basis @ rng.standard_normal(basis.shape[1])
    return made / np.linalg.norm(made)


def _log_odds(effect: Effect, readings: Floats, sigmas: float) -> Floats:
    parts = [each.log_odds(readings, sigmas) for each in effect.parts(sigmas)]
    return np.logaddexp.reduce(parts, axis=0) - np.log(len(parts))


def _rough_log_odds(one: Sphere | Normal, other: Sphere | Normal, readings: Floats, sigmas: float, _: object) -> float:
    """Return the log of the mean likelihood ratio of two effects against none, both taken as normal:

    r^T M (1 + M^T M)^-1 M^T r / 2 - log|1 + M^T M| / 2, M M^T their covariance.
    """
    spread = np.hstack([one.spread(sigmas), other.spread(sigmas)])
    inner, along = np.eye(spread.shape[1]) + spread.T @ spread, spread.T @ readings
    return float(0.5 * along @ np.linalg.solve(inner, along) - 0.5 * np.linalg.slogdet(inner)[1])


def _pair_log_odds(
    one: Sphere | Normal, other: Sphere | Normal, readings: Floats, sigmas: float, rng: np.random.Generator
) -> float:
    """Return the log of the mean likelihood ratio of two effects of n sigma each against none.

    The mean over the directions of the larger effect, or over the paths of a walk, has a closed form. The directions of
    the smaller one are drawn about the likeliest and weighted.
    """
    if isinstance(other, Normal) or (isinstance(one, Sphere) and one.basis.shape[1] < other.basis.shape[1]):
        one, other = other, one
    assert isinstance(other, Sphere)
    if isinstance(one, Normal):
        basis, left = one.whiten(other.basis), one.whiten(readings[:, None])[:, 0]
        directions, weights = _directions(basis, left, sigmas, rng)
        signals = sigmas * directions @ basis.T
        parts = weights + signals @ left - 0.5 * np.sum(signals**2, axis=1) + one.log_odds(readings, sigmas)
    else:
        beside = other.basis - one.basis @ (one.basis.T @ other.basis)
        directions, weights = _directions(beside, readings, sigmas, rng)
        signals = sigmas * directions @ other.basis.T
        parts = weights + signals @ readings - 0.5 * sigmas**2 + one.log_odds(readings - signals, sigmas)
    return float(np.logaddexp.reduce(parts))


def _directions(basis: Floats, readings: Floats, sigmas: float, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Return directions (m, k) about the likeliest one, and the log of their weights (m,), for a mean over all.

    They are drawn from a von Mises-Fisher distribution; the weights make up for it.
    """
    dof = basis.shape[1]
    if dof == 1:
        return np.array([[-1.0], [1.0]]), np.log([0.5, 0.5])
    most = np.linalg.lstsq(basis, readings, rcond=1e-6)[0]
    closeness = float(np.linalg.svd(basis, compute_uv=False)[-1]) ** 2
    concentration: Any = 1.0 + 0.5 * sigmas**2 * closeness  # scipy's stubs ask for an integer
    proposal = vonmises_fisher(most / np.linalg.norm(most), concentration)
    drawn = proposal.rvs(_DRAWN, random_state=rng)
    even = gammaln(0.5 * dof) - np.log(2.0) - 0.5 * dof * np.log(np.pi)  # over the sphere's surface
    return drawn, even - proposal.logpdf(drawn) - np.log(_DRAWN)
