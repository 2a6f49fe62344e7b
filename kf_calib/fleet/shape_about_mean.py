"""Coefficients drawn about a mean that all units have in common which have the effect: a batch of their own.

Who has it and the mean depend on each other. The mean is the likeliest one for each share, spread and ratio of the mean
to the spread (expectation and maximisation, A. P. Dempster, N. M. Laird and D. B. Rubin, 1977); the evidence is that of
a normal density about it (Laplace), with the information that is left without knowing who has it (T. A. Louis, 1982).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.fleet.evidence import log_evidence_of_modes, modes, sizes
from kf_calib.fleet.own_coefficients import UnitInformation
from kf_calib.fleet.population import told_of_mean
from kf_calib.fleet.shape import SHARES, Shape

_LEAST, _ALIKE = 0.25, 64.0  # sigma of one run: the smallest and the largest spread that is expected
_RATIOS = np.array([1.0, 3.0, 10.0])  # of the size of the mean to the spread
_ROUNDS = 60
_ENOUGH = 1e-3  # sigma of one run: a mean that moves by less has been found
_LOG_ODDS = np.log(SHARES / (1.0 - SHARES))[:, None]


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


def about_mean(information: UnitInformation) -> Shape:
    """The shape of units that have an effect about a mean of their own."""
    eigenmodes, count = modes(information.info, information.score), information.score.shape[1]
    means, logs, size = list[tuple[float, Floats]](), list[Floats](), list[Floats]()
    for spread in sizes(_LEAST, _ALIKE).tolist():
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
    return Shape(len(information.score), ratios, log_prior, np.stack(size, axis=1))


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
