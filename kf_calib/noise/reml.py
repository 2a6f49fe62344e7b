"""Restricted maximum likelihood (REML) estimates of setting error, scatter and random walk from the dwells' means.

The mean readings of dwell d have about the model the covariance

  V_d = diag(kappa sigma_w^2 / n + sigma_s^2) + sigma_alpha^2 S (|f|^2 I - f f^T) S^T,

where S holds the sensitivities and f is the specific force. A random walk of the biases adds a step from each dwell to
the next. The variances sigma_s^2, sigma_alpha^2 and q^2 are those of ``restricted_likelihood``. If from each mean its
share of the mean before is subtracted, the walk correlates only neighbouring differences, so that the covariance is
banded.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Literal, Protocol

import numpy as np

from kf_calib.bench.arrays import Floats, Mask
from kf_calib.dwells.pieces import OfPieces
from kf_calib.dwells.qr import spanned
from kf_calib.dwells.sufficient_statistics import Dwell
from kf_calib.dwells.table import DwellTable
from kf_calib.noise.means import Means, means_of
from kf_calib.noise.noise_model import Noise, mean_covariances
from kf_calib.noise.random_walk import Links, mean_links
from kf_calib.noise.restricted_likelihood import Point, Restricted
from kf_calib.noise.terms import FLOOR_MPS2, NoiseTerm, RandomWalk, Scatter, SettingError, setting_covariances
from kf_calib.support.tail_probabilities import SIGMAS_95, VARIANCE_SEEN, chi_squared_tail

FEWEST = 6
"""With fewer degrees of freedom between dwells than this, only scatter of one size is estimated."""

ENOUGH_DIRECTIONS = 12
"""With this many directions of gravity, if spread, it can be checked that a setting error only turns the force."""

_WALK = 0.5  # what each size of a walk has to gain at least, in log-likelihood
_STANDS = 1e-3  # intensity of a bias that stands, relative to one that walks: without steps a factor would be singular

Part = Literal["setting", "common", "scatter", "walk", "walks", "first", "second", "third"]
Parts = tuple[Part, ...]

WALKS: Parts = ("walk", "walks")
"""A random walk of one intensity, and of one for each accelerometer."""

OF_ONE: Parts = ("first", "second", "third")
"""The scatter of one accelerometer alone, as of a bad contact; "scatter" is that of each, "common" one of all."""


class FreeTerm(Protocol):
    """A term of the noise whose sizes are free.

    count: how many sizes it has.
    """

    @property
    def count(self) -> int: ...

    def units(self, means: Means, misfit_mps2: Floats) -> Floats:
        """A size (count,) at which it would explain a misfit of the means of this rms size (3,)."""
        ...

    def shapes(self, means: Means, state: Floats) -> Floats:
        """The covariances of the means that it contributes per unit of its variances, (count, D, 3, 3), or (count, 1,
        3, 3) where they are those of all dwells."""
        ...

    def term(self, sizes: Floats) -> NoiseTerm:
        """The term with these sizes (count,)."""
        ...


class _FreeSetting:
    count = 1

    def units(self, means: Means, misfit_mps2: Floats) -> Floats:
        return np.full(1, misfit_mps2.mean() / np.linalg.norm(means.force_mps2, axis=1).mean())

    def shapes(self, means: Means, state: Floats) -> Floats:
        return setting_covariances(means, state)[None]

    def term(self, sizes: Floats) -> NoiseTerm:
        return SettingError(float(sizes[0]))


class _FreeScatter:
    """Of groups of accelerometers that share a size."""

    def __init__(self, *groups: tuple[int, ...]) -> None:
        self._members = np.zeros((len(groups), 3))
        for row, group in zip(self._members, groups, strict=True):
            row[list(group)] = 1.0
        self.count = len(groups)

    def units(self, means: Means, misfit_mps2: Floats) -> Floats:
        return self._members @ misfit_mps2 / self._members.sum(axis=1)

    def shapes(self, means: Means, state: Floats) -> Floats:
        return (self._members[:, :, None] * np.eye(3))[:, None]

    def term(self, sizes: Floats) -> NoiseTerm:
        return Scatter(sizes @ self._members)


class _FreeWalk(_FreeScatter):
    """Its covariance is that of the path, which links each dwell to the next (``random_walk.mean_links``)."""

    def units(self, means: Means, misfit_mps2: Floats) -> Floats:
        span_s = max(float(means.ends_s[-1, 1] - means.ends_s[0, 0]), 1e-9)
        return 2.0 * super().units(means, misfit_mps2) / math.sqrt(span_s)

    def shapes(self, means: Means, state: Floats) -> Floats:
        path, alike = mean_links(means.ends_s), super().shapes(means, state)
        walk = np.zeros((self.count, len(means.counts), 6, 3))
        walk[:, :, :3] = path.alone[:, None, None] * alike
        walk[:, :-1, 3:] = path.beside[:, None, None] * alike
        return walk

    def term(self, sizes: Floats) -> NoiseTerm:
        each = sizes @ self._members
        return RandomWalk(np.maximum(each, _STANDS * each.max()))


FREE: Mapping[Part, FreeTerm] = {
    "setting": _FreeSetting(),
    "common": _FreeScatter((0, 1, 2)),
    "scatter": _FreeScatter((0,), (1,), (2,)),
    "walk": _FreeWalk((0, 1, 2)),
    "walks": _FreeWalk((0,), (1,), (2,)),
    **{part: _FreeScatter((k,)) for k, part in enumerate(OF_ONE)},
}


@dataclass(frozen=True)
class Likelihood:
    """The restricted likelihood of the dwells' means, with a given noise and any further parts of it.

    - alone: the likelihood without further parts.
    - shapes: the covariances (k, D, 6, 3) that each part contributes per unit of its variances, as of ``Restricted``.
    - units (k,): the natural size of each number of a part, chosen as large as the misfit.
    """

    alone: Restricted
    shapes: Mapping[Part, Floats]
    units: Mapping[Part, Floats]

    def of(self, parts: Parts) -> Restricted:
        """The likelihood with these parts, whose sizes are in ``units``."""
        return replace(self.alone, shapes=tuple(self.shapes[part] for part in parts))

    def without(self) -> Point:
        """The likelihood evaluated without any further part."""
        return self.alone.at(np.zeros(0))


@dataclass
class VarianceComponents:
    """Estimates the setting error, the scatter and the random walk of the biases from the dwells' means.

    - angle_sigma_deg, scatter_mps2: the stated parts, which are taken as they are; None if not stated.
    - walks: whether the intensity of a random walk of the biases is estimated.
    - sizes: those of each combination of parts at the last estimate. The next search begins there, which makes it
      shorter and has no influence on its result.
    """

    angle_sigma_deg: float | None
    scatter_mps2: float | None
    walks: bool = False
    sizes: dict[Parts, Floats] = field(default_factory=dict[Parts, Floats])

    def completed(self, within: Noise, means: Means, state: Floats, prior: Floats | None = None) -> Noise:
        """The noise within dwells, completed by setting error, scatter and, if ``walks``, the random walk.

        Of the combinations of the parts that are not stated (scatter as one number for all accelerometers or one for
        each), the one with the largest restricted likelihood is taken, less a charge per number of the scatter: the 1 %
        point of its likelihood ratio against zero. A walk has a smaller charge, a setting error none. With fewer than
        6 degrees of freedom between dwells nothing is estimated but scatter of one size: it is uncertain, but without
        it sigmas would be too small by any factor. If there are too few orientations to tell a setting error from
        scatter, the whole misfit counts as scatter. Where attitudes are not known, a dwell tells one number, and
        scatter has one size for all accelerometers.

        - means: the dwells' means; state (p,): where they are linearised.
        - prior: rows of prior knowledge about the coefficients, those of ``with_shared_noise``.
        """
        stated = self._stated(within, means)
        if stated.setting.stated and stated.scatter.stated and not self.walks:
            return stated
        reduced = _reduce(means, prior)
        measured = len(means.readings) if within.attitude_unknown else means.readings.size
        free = measured + len(reduced.prior) - reduced.means.design.shape[2]
        combinations = _combinations(stated, self.walks, free)
        if not combinations:
            return stated
        likelihood = _likelihood(stated.weights, {part for parts in combinations for part in parts}, reduced, state)
        without = likelihood.without()
        if not self.walks and chi_squared_tail(free, without.misfit) > 0.1:  # the model already fits
            combinations = [parts for parts in combinations if parts == ("setting",)]
        if not combinations:
            return stated
        best = self._likeliest(likelihood, combinations, without)
        return _with_estimates(stated, likelihood, best, self.sizes[best], without) if best else stated

    def _stated(self, within: Noise, means: Means) -> Noise:
        """Return the noise within dwells with the parts that are stated, and zeros for the others."""
        scatter = Scatter(np.full(3, self.scatter_mps2 or 0.0), stated=self.scatter_mps2 is not None)
        within = within.without(RandomWalk) if self.walks else within
        if within.attitude_unknown:
            return within.with_terms(scatter)
        setting = SettingError(
            float(np.radians(self.angle_sigma_deg or 0.0)),
            stated=self.angle_sigma_deg is not None,
            considered=not (scatter.stated or _setting_is_checked(means.force_mps2)),
        )
        return within.with_terms(setting, scatter)

    def _likeliest(self, likelihood: Likelihood, combinations: Sequence[Parts], without: Point) -> Parts:
        """Return the best combination of parts, () if none earns its charge, and keep the sizes of each.

        The last combination contains all others, so that its likelihood bounds theirs. A combination whose charge
        leaves nothing to gain under this bound is not searched.
        """
        charges = {parts: _charge(parts, likelihood) for parts in combinations}
        best, score, most = (), -without.cost, math.inf
        for parts in [combinations[-1], *sorted(combinations[:-1], key=charges.__getitem__)]:
            if most - charges[parts] <= score:
                continue
            self.sizes[parts], point = likelihood.of(parts).most_likely(self.sizes.get(parts))
            most = -point.cost if parts == combinations[-1] else max(most, -point.cost)
            if -point.cost - charges[parts] > score:
                best, score = parts, -point.cost - charges[parts]
        return best


def _combinations(stated: Noise, walks: bool, free: int) -> list[Parts]:
    """Return the combinations of parts that may be estimated from so many degrees of freedom; the last one contains all
    others."""
    if free < FEWEST:
        return [("common",)] if free > 0 and not stated.scatter.stated else []
    setting, scatter = stated.setting, stated.scatter
    settings: list[Parts] = [()] if setting.stated or setting.considered else [(), ("setting",)]
    scatters: list[Parts] = [()] if scatter.stated else [(), ("common",)]
    if not (setting.considered or scatter.stated or setting.is_unknown):
        scatters.append(("scatter",))
    walking: list[Parts] = [(), ("walk",)] if walks else [()]
    if walks and not setting.is_unknown:
        walking.append(("walks",))
    return [setting + scatter + walk for walk, setting, scatter in product(walking, settings, scatters)][1:]


def _with_estimates(stated: Noise, likelihood: Likelihood, parts: Parts, sizes: Floats, without: Point) -> Noise:
    """Return the noise with its parts at their likeliest sizes, and what is known of these."""
    noise = _with(stated, parts, np.concatenate([likelihood.units[part] for part in parts]) * sizes)
    if parts[-1] in WALKS:
        spreads = _spreads(likelihood.of(parts).curvature(sizes))[-FREE[parts[-1]].count :]
        noise = noise.with_terms(replace(noise.walk, spreads=np.broadcast_to(spreads, 3)))
    if "setting" in parts:
        rest: Parts = tuple(part for part in parts if part != "setting")
        cost = likelihood.of(rest).most_likely()[1].cost if rest else without.cost
        gain = cost - likelihood.of(parts).cost(sizes**2)
        clear = 2.0 * gain > SIGMAS_95**2  # one that is clearer belongs to the noise that judges
        noise = noise.with_terms(replace(noise.setting, judged=clear))
    return noise


def _charge(parts: Parts, likelihood: Likelihood) -> float:
    """Return the log-likelihood that the parts have to gain in order to be taken.

    A setting error is taken at its likeliest size, however small: left out below a limit, it would be missing in sigma.
    """
    charges = {"walk": _WALK, "walks": _WALK, "setting": 0.0}
    return sum(charges.get(part, 0.5 * VARIANCE_SEEN) * len(likelihood.units[part]) for part in parts)


def _spreads(curvature: Floats) -> Floats:
    """Return the sigmas (k,) of some logarithms that were estimated together, from the ``curvature`` of the cost."""
    values, vectors = np.linalg.eigh(curvature)
    seen = values > 1e-3  # directions without curvature belong to parts whose estimate is zero
    return np.asarray(np.sqrt(np.sum(vectors[:, seen] ** 2 / values[seen], axis=1)), float)


def _setting_is_checked(force_mps2: Floats) -> bool:
    """Tell whether the readings along f overdetermine their model f^T S f + f^T b, of at most 9 numbers, by 3 or
    more."""
    x, y, z = force_mps2.T / np.linalg.norm(force_mps2, axis=1).mean()
    design = np.column_stack([x * x, y * y, z * z, x * y, x * z, y * z, x, y, z])
    return directions(force_mps2) - int(np.linalg.matrix_rank(design, tol=0.02)) >= ENOUGH_DIRECTIONS - 9


def directions(force_mps2: Floats) -> int:
    """Number of different directions among the forces (D, 3), rounded to a hundredth."""
    unit = force_mps2 / np.linalg.norm(force_mps2, axis=1).mean()
    return len(np.unique(np.round(unit, 2) + 0.0, axis=0))


def degrees_of_freedom(means: Means, free: bool = False) -> int:
    """Degrees of freedom of the dwells' means beside the model's coefficients; free: attitudes are not known, and a
    dwell tells one number."""
    return (len(means.readings) if free else means.readings.size) - _reduce(means).means.design.shape[2]


def gain_of(part: Part, noise: Noise, means: Means, state: Floats, prior: Floats) -> float:
    """Gain in log-likelihood if a part of the noise is raised to its most likely size.

    ``means`` and ``prior`` are those that ``with_shared_noise`` returns.
    """
    likelihood = _likelihood(noise, (part,), _reduce(means, prior), state)
    _, point = likelihood.of((part,)).most_likely()
    return max(likelihood.without().cost - point.cost, 0.0)


def with_shared_noise(dwells: Sequence[Dwell], noise: Noise, means: Means, state: Floats) -> tuple[Means, Floats]:
    """Means with additional columns for the noise that dwells have in common, the terms of the run, and the rows (q, p
    + q + 1) of the prior of their coefficients."""
    table = DwellTable.of(dwells)
    columns = noise.with_scatter_as_flicker(len(table)).columns("run", table, state)
    count = columns.shape[3]
    if not count:
        return means, np.zeros((0, means.design.shape[2] + 1))
    added = means_of(table, OfPieces(columns, table.folded.ends)).design
    prior = np.zeros((count, means.design.shape[2] + count + 1))
    prior[:, means.design.shape[2] : -1] = np.eye(count)
    return replace(means, design=np.concatenate([means.design, added], axis=2)), prior


def misfit(noise: Noise, means: Means, state: Floats, prior: Floats | None = None) -> float:
    """Chi-squared of the dwells' means about their generalised least-squares fit.

    ``prior`` (q, p + 1) are whitened rows of prior knowledge about the coefficients.
    """
    return _likelihood(noise, (), _reduce(means, prior), state).without().misfit


@dataclass(frozen=True)
class _Reduced:
    """Means with an orthonormal basis (D, 3, r) in place of the columns without a prior, and the rows of the prior."""

    means: Means
    prior: Floats


def _reduce(means: Means, prior: Floats | None = None) -> _Reduced:
    """Return the means about the basis of those columns that have no prior.

    What the basis explains is subtracted from the readings. The change of basis alters the likelihood only by a
    constant, and the rounding of readings of size g no longer matters.
    """
    design = means.design.reshape(-1, means.design.shape[2])
    prior = np.zeros((0, design.shape[1] + 1)) if prior is None else prior
    known: Mask = np.array(prior[:, :-1].any(axis=0))
    basis = spanned(design[:, ~known])[0]
    rest = means.readings.ravel() - basis @ (basis.T @ means.readings.ravel())
    columns = np.hstack([basis, design[:, known]]) if known.any() else basis
    means = replace(means, design=columns.reshape(*means.readings.shape, -1), readings=rest.reshape(-1, 3))
    return _Reduced(means, np.hstack([np.zeros((len(prior), basis.shape[1])), prior[:, np.append(known, True)]]))


def _likelihood(noise: Noise, parts: Collection[Part], reduced: _Reduced, state: Floats) -> Likelihood:
    """Return the likelihood of the means, with the parts that may be added."""
    means, count, units = reduced.means, len(reduced.means.counts), _units(reduced.means)
    standing = not (noise.walk.steps or {*WALKS} & {*parts})
    rows = np.concatenate([means.design, means.readings[:, :, None]], axis=2)
    fixed = mean_covariances(noise, means, state, float(units["common"][0]))
    if standing:  # no means are correlated: only their own covariances are kept
        shapes: dict[Part, Floats] = {part: FREE[part].shapes(means, state) for part in parts}
        alone = Restricted(rows.reshape(3 * count, -1), reduced.prior, fixed, ())
        return Likelihood(alone, _scaled(shapes, units), units)
    path = mean_links(means.ends_s)
    rows[1:] -= path.share[:, None, None] * rows[:-1].copy()
    walks = FREE["walks"].shapes(means, state)
    alone = Restricted(
        rows.reshape(3 * count, -1),
        reduced.prior,
        _conditional_covariances(fixed, path) + np.tensordot(noise.walk_mps2_per_sqrt_s**2, walks, 1),
        (),
    )
    shapes: dict[Part, Floats] = {
        part: shape if part in WALKS else _conditional_covariances(shape, path)
        for part in parts
        for shape in [FREE[part].shapes(means, state)]
    }
    return Likelihood(alone, _scaled(shapes, units), units)


def _scaled(shapes: Mapping[Part, Floats], units: Mapping[Part, Floats]) -> dict[Part, Floats]:
    """Return the covariances of parts per unit of their sizes; one for all dwells where that is the same."""
    return {part: units[part][:, None, None, None] ** 2 * of_part for part, of_part in shapes.items()}


def _conditional_covariances(covariances: Floats, path: Links) -> Floats:
    """Return the covariances (..., D, 6, 3), in the layout of ``banded``, of means less their share of the mean before.

    ``covariances`` (..., D, 3, 3), or (..., 1, 3, 3) of all alike, are those of the means themselves, which are
    independent of each other.
    """
    covariances = np.broadcast_to(covariances, (*covariances.shape[:-3], len(path.share) + 1, 3, 3))
    share, banded = path.share[:, None, None], np.zeros((*covariances.shape[:-2], 6, 3))
    banded[..., :3, :] = covariances
    banded[..., 1:, :3, :] += share**2 * covariances[..., :-1, :, :]
    banded[..., :-1, 3:, :] -= share * covariances[..., :-1, :, :]
    return banded


def _units(means: Means) -> dict[Part, Floats]:
    """Return a size for each number of the parts at which it would explain the misfit of the reduced means."""
    size = np.sqrt(np.mean(means.readings**2, axis=0)) + FLOOR_MPS2
    return {part: free.units(means, size) for part, free in FREE.items()}


def _with(noise: Noise, parts: Parts, sizes: Floats) -> Noise:
    """Return the noise with its parts at these sizes, those of a part after those of the part before."""
    first = 0
    for part in parts:
        count = FREE[part].count
        noise = noise.with_terms(FREE[part].term(sizes[first : first + count]))
        first += count
    return noise
