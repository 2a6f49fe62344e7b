"""Intervals of parameters where noise from dwell to dwell was not stated, and few dwells tell how large it is.

Scatter of size s and setting errors of size a are each in the run with a probability of 3 in 4 where they were not
stated, and any logarithm of a size is as likely as any other. By the restricted likelihood of the dwells' means, every
pair (s, a) has a posterior probability, an estimate x(s, a) and sigmas. The interval of 95 % about the estimate x_fit
is +- h, where

  sum over (s, a) of P(s, a | run) P(|x - x_fit| < h | s, a) = 0.95,

and no less than 1.96 sigma. Where there is scatter alone and no other noise is known, this is Student's t.

Where the intensities q of a walk were estimated, each q^2 is over its estimate as nu over a chi-squared of nu degrees
of freedom, at least one; 2 nu is the curvature of the likelihood by ln q. The estimates and sigmas of sixteen such q,
all as likely, move and widen those of scatter and setting error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import ROUNDING, Floats
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.dwells.qr import spanned
from kf_calib.estimation.fit import Fit
from kf_calib.noise.noise_model import mean_covariances
from kf_calib.noise.random_walk import known_at_end
from kf_calib.noise.reml import FREE, Part, with_shared_noise
from kf_calib.noise.terms import FLOOR_MPS2
from kf_calib.support.tail_probabilities import normal_quantile

LEVEL = 0.95
"""Probability with which an interval holds a parameter."""

NORMAL = normal_quantile(0.5 * (1.0 + LEVEL))
"""Half the length of the interval in sigmas where all noise is known."""

_PARTS: tuple[Part, ...] = ("common", "setting")
_MANY = 240  # degrees of freedom from which on the size of noise is known so well that 1.96 becomes no more than 1.98
_RANGE = math.log(1e2)  # width of the flat prior of the logarithm of a size
_LEAST, _MOST = 0.03, 30.0  # sizes that are tried, in units of one that would explain the misfit
_COARSE, _FINE = 14, 14  # of them, first over that range, then where they are likely
_HOPELESS = 12.0  # in log likelihood
_EACH = 16  # intensities of walks, each as likely
_FREE = 0.75  # prior probability of a part of the noise that was not stated


def sigmas_of_intervals(fitted: Fit) -> Floats:
    """Half the lengths (p,) of the intervals of 95 %, in units of sigma, of the twelve parameters and the coefficients
    of effects."""
    noise, count = fitted.noise, fitted.linearised.model.count
    stated = noise.scatter.stated, noise.setting.stated or noise.attitude_unknown
    free: list[Part] = [part for part, is_stated in zip(_PARTS, stated, strict=True) if not is_stated]
    unsure = (free or noise.walk.spreads.any()) and 3 * len(fitted.dwells) < _MANY
    means = _Means(fitted, free) if unsure else None
    if means is None or means.freedom <= 0:
        return np.full(count, NORMAL)
    with np.errstate(invalid="ignore"):
        return np.fmax(means.sigmas_of_intervals(), NORMAL)


class _Means:
    """The dwells' means in blocks that are independent of each other: one a dwell, or one of all where biases walk.

    free: the parts of the noise that were not stated.
    """

    def __init__(self, fitted: Fit, free: Sequence[Part]) -> None:
        noise, state = fitted.noise, fitted.linearised.state
        known = noise.without_estimates()
        means, prior = with_shared_noise(fitted.dwells, known, fitted.linearised.means, state)
        basis, turn, _ = spanned(means.design.reshape(-1, means.design.shape[2]).copy())
        along = basis.T @ means.readings.ravel()
        readings = means.readings.ravel() - basis @ along
        measured = len(means.readings) if noise.attitude_unknown else means.readings.size
        self.freedom = measured + len(prior) - basis.shape[1]
        of_prior = prior[:, :-1] @ turn
        self._prior = np.column_stack([of_prior, -of_prior @ along])
        self._to_parameters = _jacobian(state) @ turn[: len(state)]
        size = math.sqrt(float(readings @ readings) / max(self.freedom, 1)) + FLOOR_MPS2
        shapes = [np.broadcast_to(FREE[part].shapes(means, state).sum(axis=0), (len(means.counts), 3, 3))
                  for part in free]  # fmt: skip
        if free[:1] == ["common"] and noise.scatter_mps2.any():  # as unequal in the accelerometers as it was estimated
            shapes[0] = shapes[0] * noise.scatter_mps2**2 / np.mean(noise.scatter_mps2**2)
        self._units = np.array([size**2 / np.einsum("dii->di", shape).max(axis=1).mean() for shape in shapes])
        self._used = mean_covariances(noise, means, state)
        self._known, self._shapes = mean_covariances(known, means, state), np.array(shapes)
        width, self._walk = 3, noise.walk
        if noise.walk.steps:
            width = readings.size
            by_time = known_at_end(means.ends_s)
            self._paths = np.array([np.kron(by_time, np.diag(of_one)) for of_one in np.eye(3)])
            path = np.tensordot(self._walk.sizes**2, self._paths, axes=1)
            self._used, self._known = (_whole(each) + path for each in (self._used, self._known))
            self._shapes = np.array([_whole(shape) for shape in self._shapes])
        self._basis, self._readings = basis.reshape(-1, width, basis.shape[1]), readings.reshape(-1, width)

    def sigmas_of_intervals(self) -> Floats:
        """Half the lengths (p,) in units of the sigma with the noise that was taken."""
        _, about, taken = self._solved(self._used[None])
        weights, estimates, sigmas = self._of_scatter() if len(self._units) else (np.ones(1), about, taken)
        shifts, sigmas = (estimates - about) / taken, sigmas / taken
        if self._walk.spreads.any():
            moved, ratios = self._of_walks(about, taken)
            weights = np.repeat(weights / len(moved), len(moved))
            shifts = (shifts[:, None] + moved).reshape(len(weights), -1)
            sigmas = (sigmas[:, None] * ratios).reshape(len(weights), -1)
        return _half_lengths(weights, shifts, sigmas)

    def _of_walks(self, about: Floats, taken: Floats) -> tuple[Floats, Floats]:
        """Return shifts (K, p) and sigmas (K, p), in units of those taken, for intensities that are all as likely."""
        from scipy.special import gammaincinv

        at, freedom = (np.arange(_EACH) + 0.5) / _EACH, 0.5 / np.clip(self._walk.spreads, 1e-6, math.sqrt(0.5)) ** 2
        factors = 0.5 * freedom / gammaincinv(0.5 * freedom, at[:, None])  # those of q^2, (K, 3)
        more = np.tensordot((factors - 1.0) * self._walk.sizes**2, self._paths, axes=1)
        _, estimates, sigmas = self._solved(self._used + more[:, None])
        return (estimates - about) / taken, sigmas / taken

    def _of_scatter(self) -> tuple[Floats, Floats, Floats]:
        """Return weights (N,), estimates (N, p) and sigmas (N, p) for sizes of scatter and setting error."""
        coarse = np.geomspace(_LEAST, _MOST, _COARSE)
        axes = [coarse] * len(self._units)
        logs, *_ = self._at(axes)
        logs = logs.reshape([_COARSE + 1] * len(axes))
        likely = logs > logs.max() - _HOPELESS
        for k in range(len(axes)):
            along = np.flatnonzero(likely.any(axis=tuple(j for j in range(len(axes)) if j != k))[1:])
            first, last = (max(along[0] - 1, 0), min(along[-1] + 1, _COARSE - 1)) if len(along) else (0, 0)
            axes[k] = np.geomspace(coarse[first], coarse[last], _FINE) if last > first else coarse[:1]
        logs, estimates, sigmas = self._at(axes)
        weights = np.exp(logs - logs.max()) * _prior_of(axes)
        return weights / weights.sum(), estimates, sigmas

    def _at(self, axes: Sequence[Floats]) -> tuple[Floats, Floats, Floats]:
        """Return log likelihoods (N,), estimates (N, p) and sigmas (N, p) at all combinations of sizes, and none."""
        squares = [np.append(0.0, sizes**2) * unit for sizes, unit in zip(axes, self._units, strict=True)]
        mesh = np.stack([each.ravel() for each in np.meshgrid(*squares, indexing="ij")], axis=1)
        return self._solved(self._known + np.tensordot(mesh, self._shapes, axes=1))

    def _solved(self, covariances: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the same for covariances (N, B, b, b)."""
        size = covariances.shape[-1]
        covariances = covariances + ROUNDING * np.einsum("...ii", covariances)[..., None, None] * np.eye(size)
        lower = np.linalg.cholesky(covariances)
        rows = np.linalg.inv(lower) @ np.concatenate([self._basis, self._readings[..., None]], axis=2)
        rows = rows.reshape(len(rows), -1, rows.shape[-1])
        products = np.swapaxes(rows, 1, 2) @ rows + self._prior.T @ self._prior
        values = np.linalg.inv(np.linalg.cholesky(products[:, :-1, :-1]))
        turned = (values @ products[:, :-1, -1:])[..., 0]
        chi2 = products[:, -1, -1] - np.sum(turned**2, axis=1)
        log = np.log(np.einsum("npp->np", values)).sum(axis=1) - np.log(np.einsum("nbii->nbi", lower)).sum(axis=(1, 2))
        roots = values @ self._to_parameters.T
        return log - 0.5 * chi2, (turned[:, None] @ roots)[:, 0], np.sqrt(np.sum(roots**2, axis=1))


def _jacobian(state: Floats) -> Floats:
    """Return the derivatives (p, p) of the twelve parameters, and coefficients, by the states."""
    jacobian = np.eye(len(state))
    jacobian[:STATE_COUNT, :STATE_COUNT] = paper_parameters.jacobian(state[:STATE_COUNT])
    return jacobian


def _whole(blocks: Floats) -> Floats:
    """Return blocks (D, 3, 3) as one of all (1, 3 D, 3 D)."""
    whole = np.zeros((len(blocks), 3, len(blocks), 3))
    whole[np.arange(len(blocks)), :, np.arange(len(blocks))] = blocks
    return whole.reshape(1, 3 * len(blocks), -1)


def _prior_of(axes: Sequence[Floats]) -> Floats:
    """Return the prior probabilities (N,) of all combinations of sizes, and none, of parts of the noise."""
    priors = np.ones(1)
    for sizes in axes:
        step = math.log(sizes[-1] / sizes[0]) / (len(sizes) - 1) if len(sizes) > 1 else 0.0
        own = np.append(1.0 - _FREE, np.full(len(sizes), _FREE * step / _RANGE))
        priors = np.multiply.outer(priors, own).ravel()
    return priors


def _half_lengths(weights: Floats, shifts: Floats, sigmas: Floats) -> Floats:
    """Return the h (p,) with which a mixture of normal distributions of weights (N,), means (N, p) and sigmas (N, p)
    has 95 % within +-h."""
    from scipy.special import ndtr

    low, high = np.zeros(shifts.shape[1]), np.full(shifts.shape[1], 100.0 * NORMAL)
    for _ in range(50):
        half = 0.5 * (low + high)
        held = weights @ (ndtr((half - shifts) / sigmas) - ndtr((-half - shifts) / sigmas))
        low, high = np.where(held < LEVEL, half, low), np.where(held < LEVEL, high, half)
    return 0.5 * (low + high)
