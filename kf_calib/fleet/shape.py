"""What may be supposed of the coefficients of units that have an effect, where others do not have it.

Coefficients of any direction: a normal density, or one that vanishes where the runs show nothing.

The density of a unit's coefficients c is in proportion to (c' A c)^m N(c; 0, T) with A the information of its runs, a
moment prior (V. E. Johnson and D. Rossell, 2010). With m = 0 it is normal, and some of the units that have the effect
show little of it. The larger m, the more alike are their sizes in units of their noise. T is in proportion to A^-a with
a = m / (m + q / 2): if it were not, the factor would turn nearly all coefficients to the direction that is seen best.

Coefficients drawn about a mean that all units have in common which have the effect: a batch of their own.

Who has it and the mean depend on each other. The mean is the likeliest one for each share, spread and ratio of the mean
to the spread (expectation and maximisation, A. P. Dempster, N. M. Laird and D. B. Rubin, 1977); the evidence is that of
a normal density about it (Laplace), with the information that is left without knowing who has it (T. A. Louis, 1982).

A unit has the effect with a probability p, the share, of which nothing is known before. What the share is depends on
the shape: many units with a small effect look like few with a large one. So there are several shapes, each as likely as
any other before the runs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.fleet.campaign import SEEN, Group, log_evidence_of_modes, log_mean, modes, sizes
from kf_calib.fleet.own_coefficients import UnitInformation, told_of_mean
from kf_calib.support.tail_probabilities import weights

SHARES = (np.arange(50) + 0.5) / 50.0
"""Probabilities that a unit has the effect: before the runs, each is as likely as any other."""

_TOGETHER = 64  # units at a time, to save memory
_DRAWS = 4000
_LEAST_OF_UNIT = 1.0  # sigma of one run: the smallest size of the effect of a unit
_STEPS = {0: 2.0**0.5, 2: 2.0**0.5, 32: 1.2}  # ratio of a size to the one before: closer where sizes are alike
POWERS = tuple(_STEPS)
"""Of c' A c: normal, clearly not zero, and nearly of one size."""

_LARGEST_ALIKE = 64.0  # sigma of one run: the largest size that is tried where all are nearly one
_LEAST_SPREAD, _LARGEST_SPREAD = 0.25, 64.0  # sigma of one run: the smallest and the largest spread that is expected
_RATIOS = np.array([1.0, 3.0, 10.0])  # of the size of the mean to the spread
_ROUNDS = 60
_ENOUGH = 1e-3  # sigma of one run: a mean that moves by less has been found
_LOG_ODDS = np.log(SHARES / (1.0 - SHARES))[:, None]


@dataclass(frozen=True)
class CoefficientShape:
    """One supposition, for each share of a grid and each size of another.

    - units: their number. ratios: of a few of them, the log of the likelihood of each with the effect against that
      without, (units, shares or 1, sizes), to be computed when it is needed, to save memory.
    - log_prior (shares, sizes): of the suppositions before the runs; they sum to 1.
    - sizes (shares or 1, sizes): of a coefficient of a unit that has it, in ``Group.sigma``.
    """

    units: int
    ratios: Callable[[slice], Floats]
    log_prior: Floats
    sizes: Floats

    def _parts(self) -> Iterator[Floats]:
        """Yield the ratios of a few units at a time."""
        return (self.ratios(slice(first, first + _TOGETHER)) for first in range(0, self.units, _TOGETHER))

    def _odds(self) -> Iterator[tuple[Floats, Floats]]:
        """Yield the log of the likelihood (units, shares, sizes) of a few units at a time, whether or not they have it,
        and of that part of it in which they have it."""
        for part in self._parts():
            has = np.log(SHARES)[:, None] + part
            yield np.logaddexp(has, np.log1p(-SHARES)[:, None]), has

    @cached_property
    def _logs(self) -> Floats:
        """The log of likelihood times prior (shares, sizes)."""
        return self.log_prior + sum(whole.sum(axis=0) for whole, _ in self._odds())

    @cached_property
    def log_odds(self) -> float:
        """Log evidence that some units have the effect in this way, against that none has it."""
        return float(np.logaddexp.reduce(self._logs, axis=None))

    @property
    def log_odds_of_all(self) -> float:
        """The same that all units have it."""
        logs = self.log_prior + sum(part.sum(axis=0) for part in self._parts())
        return float(np.logaddexp.reduce(logs, axis=None))

    @property
    def size(self) -> float:
        """The likeliest size of a coefficient of a unit that has it."""
        return float(np.broadcast_to(self.sizes, self._logs.shape).flat[np.argmax(self._logs)])

    @cached_property
    def probabilities(self) -> Floats:
        """The probability (n,) that each unit has it."""
        weight = weights(self._logs)
        return np.concatenate([np.sum(np.exp(has - whole) * weight, axis=(1, 2)) for whole, has in self._odds()])

    def interval(self) -> tuple[float, float]:
        """The share of these units that have it with 95 % probability, by draws of who has it."""
        rng, counts = np.random.default_rng(0), np.zeros(_DRAWS)
        chosen = rng.choice(self._logs.size, _DRAWS, p=weights(self._logs).reshape(-1))
        for whole, has in self._odds():
            chances = np.exp(has - whole).reshape(len(whole), -1)[:, chosen]
            counts += np.sum(rng.random(chances.shape) < chances, axis=0)
        low, high = np.quantile(counts / self.units, [0.025, 0.975], method="inverted_cdf").tolist()
        return low, high


def about_zero(group: Group, information: UnitInformation, power: int) -> CoefficientShape:
    """The shape with m = ``power``."""
    values, along, _ = modes(information.info, information.score)
    tried = sizes(_LEAST_OF_UNIT, _LARGEST_ALIKE if power == max(POWERS) else group.largest, _STEPS[power])
    log_prior = np.full((len(SHARES), len(tried)), -np.log(len(SHARES) * len(tried)))
    ratios = _ratios(values, along, tried, power)[:, None]
    return CoefficientShape(len(values), ratios.__getitem__, log_prior, tried[None] / np.sqrt(values.shape[1]))


def _ratios(values: Floats, along: Floats, tried: Floats, power: int) -> Floats:
    """Return the log of the likelihood ratio (n, sizes) of coefficients that add ``tried`` sigmas to the readings.

    It is that of normal ones times the mean of (c' A c)^m after the readings over that before them. Everything is along
    the directions in which the information is apart, in units of the noise.
    """
    count = values.shape[1]
    seen = values > SEEN * values.max(axis=1, keepdims=True)
    noted = np.where(seen, along / np.sqrt(np.where(seen, values, 1.0)), 0.0)[:, None]
    spread = np.where(seen, values, 0.0) ** (0.5 * count / (power + 0.5 * count))
    spread = spread / np.maximum(np.mean(spread, axis=1, keepdims=True), SEEN) if power else spread
    before = spread[:, None] * tried[:, None] ** 2 / (2.0 * power + count)  # variances (n, sizes, q)
    after = before / (1.0 + before)
    normal = 0.5 * np.sum(noted**2 * after - np.log1p(before), axis=2)
    return normal + _log_moment(after, noted * after, power) - _log_moment(before, np.zeros_like(before), power)


def _log_moment(variances: Floats, means: Floats, power: int) -> Floats:
    """Return the log of the mean of (sum x^2)^m, but for a factor of m alone, of normal x with these variances and
    means (..., q): from the cumulants of the sum."""
    whole = np.sum(variances + means**2, axis=-1)
    whole = np.where(whole > 0.0, whole, 1.0)  # of a unit that sees nothing: before and after are the same
    part, squares = variances / whole[..., None], means**2 / whole[..., None]
    cumulants, moments = np.empty((power, *whole.shape)), np.ones((power + 1, *whole.shape))
    raised = np.ones_like(part)
    for k in range(power):
        cumulants[k] = np.sum(raised * (part + (k + 1) * squares), axis=-1)
        moments[k + 1] = np.einsum("k...,k...", cumulants[: k + 1], moments[k::-1]) / (k + 1)
        raised = 2.0 * part * raised
    return power * np.log(whole) + np.log(np.maximum(moments[-1], np.finfo(float).tiny))


@dataclass(frozen=True)
class _Told:
    """What units tell of the mean: log L = apart + score' mean - 1/2 mean' info mean, against no effect.

    apart (n,), info (n, q, q), score (n, q).
    """

    apart: Floats
    info: Floats
    score: Floats

    def ratios(self, mean: Floats) -> Floats:
        """log L (..., n) for means (..., q)."""
        squares = (mean[..., :, None] * mean[..., None, :]).reshape(*mean.shape[:-1], -1)
        return self.apart + mean @ self.score.T - 0.5 * squares @ self.info.reshape(len(self.info), -1).T

    def info_of(self, chances: Floats) -> Floats:
        """Information (..., q, q) of the mean where units have the effect with these probabilities (..., n)."""
        return (chances @ self.info.reshape(len(self.info), -1)).reshape(*chances.shape[:-1], *self.info.shape[1:])


def about_mean(information: UnitInformation) -> CoefficientShape:
    """The shape of units that have an effect about a mean of their own."""
    eigenmodes, count = modes(information.info, information.score), information.score.shape[1]
    means, logs, size = list[tuple[float, Floats]](), list[Floats](), list[Floats]()
    for spread in sizes(_LEAST_SPREAD, _LARGEST_SPREAD).tolist():
        unit_modes = _told(eigenmodes, spread)
        for prior in (spread * _RATIOS).tolist():
            mean = _likeliest(unit_modes, prior)
            means.append((spread, mean))
            logs.append(_log_volume(unit_modes, mean, prior))
            size.append(np.sqrt(spread**2 + np.sum(mean**2, axis=1) / count))

    def ratios(part: slice) -> Floats:
        here = [each[part] for each in eigenmodes]
        return np.stack([_told(here, spread).ratios(mean).T for spread, mean in means], axis=2)

    log_prior = np.stack(logs, axis=1) - np.log(len(SHARES) * len(means))
    return CoefficientShape(len(information.score), ratios, log_prior, np.stack(size, axis=1))


def _told(found: Sequence[Floats], spread: float) -> _Told:
    """Return what units tell of the mean, from their ``modes``, their own departures from it eliminated."""
    values, along, turned = found
    return _Told(log_evidence_of_modes(values, along, spread), *told_of_mean(values, along, turned, spread))


def _likeliest(told: _Told, prior: float) -> Floats:
    """Return the likeliest mean (shares, q) for each share; prior: standard deviation of its coefficients before."""
    known = np.eye(told.score.shape[1]) / prior**2
    pooled = np.linalg.solve(told.info.sum(axis=0) + known, told.score.sum(axis=0))
    mean = np.asarray(pooled / SHARES[:, None], float)
    for _ in range(_ROUNDS):
        chances = _chances(told.ratios(mean))
        new = np.linalg.solve(told.info_of(chances) + known, (chances @ told.score)[:, :, None])[:, :, 0]
        moved, mean = float(np.abs(new - mean).max()), np.asarray(new, float)
        if moved < _ENOUGH:
            break
    return mean


def _log_volume(told: _Told, mean: Floats, prior: float) -> Floats:
    """Return the log (shares,) of the prior density at the mean times the volume in which the mean is as likely."""
    chances = _chances(told.ratios(mean))
    departures = told.score - np.einsum("nij,sj->sni", told.info, mean)
    unsure = np.einsum("sn,sni,snj->sij", chances * (1.0 - chances), departures, departures, optimize=True)
    left = np.linalg.eigvalsh(told.info_of(chances) + np.eye(mean.shape[1]) / prior**2 - unsure)
    return -0.5 * np.sum((mean / prior) ** 2 + np.log(np.maximum(left * prior**2, 1.0)), axis=1)


def _chances(ratios: Floats) -> Floats:
    """Return the probability (shares, n) that each unit has the effect, from the log of its likelihood ratio."""
    from scipy.special import expit

    return expit(_LOG_ODDS + ratios)


_RULED_OUT = 0.025  # probability below which a shape is not asked for the share


class SomeUnits:
    """The likelihood of who has an effect, from what each unit tells of its coefficients beside all else."""

    def __init__(self, group: Group, information: UnitInformation, *, with_mean: bool = True) -> None:
        """with_mean: whether they may have a mean of their own; if not, that shape counts as impossible."""
        zero = {power: about_zero(group, information, power) for power in POWERS}
        self._clear = [shape for power, shape in zero.items() if power]
        self._shapes = [*zero.values(), *([about_mean(information)] if with_mean else [])]
        self._logs = np.array([shape.log_odds for shape in self._shapes]) - np.log(len(POWERS) + 1)

    @property
    def log_odds(self) -> float:
        """Log evidence that some units have it, each its own, against that none has it."""
        return float(np.logaddexp.reduce(self._logs))

    @property
    def log_odds_of_all(self) -> float:
        """The same that all units have it, in any direction and clearly not zero."""
        return float(log_mean(np.array([shape.log_odds_of_all for shape in self._clear])))

    @property
    def size(self) -> float:
        """The likeliest size of a coefficient of a unit that has it, in ``Group.sigma``."""
        return self._shapes[int(np.argmax(self._logs))].size

    @property
    def probabilities(self) -> Floats:
        """The probability (n,) that each unit has it, if some have it and others do not."""
        return weights(self._logs) @ np.array([shape.probabilities for shape in self._shapes])

    def share(self, all_have_it: float) -> tuple[float, tuple[float, float]]:
        """The share of these units that have it, with its 95 % interval.

        all_have_it: probability that all have it, rather than some.

        The interval reaches over those of all shapes that are not ruled out, and up to all units unless that is: how
        likely each was before the runs often decides which is the likelier, and so must not decide what the share is.
        """
        chances = (1.0 - all_have_it) * weights(self._logs)
        held = zip(self._shapes, chances.tolist(), strict=True)
        intervals = [shape.interval() for shape, chance in held if chance > _RULED_OUT]
        intervals += [(1.0, 1.0)] if all_have_it > _RULED_OUT else []
        low, high = min(low for low, _ in intervals), max(high for _, high in intervals)
        return all_have_it + (1.0 - all_have_it) * float(self.probabilities.mean()), (low, high)
