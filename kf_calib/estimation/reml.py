"""The dwell parts of the noise by restricted maximum likelihood of the dwell means: setting error, scatter, walk.

The means of the readings of D dwells scatter about the model by V_d = diag(kappa sigma_w^2 / n + sigma_s^2) +
sigma_alpha^2 S (|f|^2 I - f f^T) S^T; a walk of the biases by steps from one to the next. The squares of the sizes are
the variances of ``restricted_likelihood``; of each mean less its share of the one before, a walk leaves those beside
each other correlated, and no others.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.dwells.sufficient_statistics import DwellFactor
from kf_calib.estimation.dwell_columns import Means
from kf_calib.estimation.noise_model import FLOOR_MPS2, Noise, mean_covariances, setting_covariances, slow_scatter
from kf_calib.estimation.random_walk import Links, mean_links
from kf_calib.estimation.restricted_likelihood import Point, Restricted
from kf_calib.support.tail_probabilities import chi_squared_tail

FEWEST = 6
"""Degrees of freedom between dwells; with fewer nothing is estimated."""

ENOUGH_DIRECTIONS = 12
"""Of gravity in the platform: where they are spread they check that a setting error only turns the specific force."""

_SIGNIFICANT = 5.41  # 1 % point of the likelihood ratio of a variance against zero: half of chi2 with 1 dof
_WALK = 0.5  # of log-likelihood that a walk has to gain
_HELD = 12  # time constants of a walk that is held back

Part = Literal["setting", "common", "scatter", "walk"]
Parts = tuple[Part, ...]


@dataclass(frozen=True)
class Likelihood:
    """Of the dwell means, by any of some parts beside a noise: shapes (k, D, 6, 3) of each part's numbers in ``units``
    (k,), which are as large as the misfit."""

    alone: Restricted
    shapes: Mapping[Part, Floats]
    units: Mapping[Part, Floats]

    def of(self, parts: Parts) -> Restricted:
        return replace(self.alone, shapes=np.concatenate([self.alone.shapes, *(self.shapes[part] for part in parts)]))

    def without(self) -> Point:
        return self.alone.at(np.zeros(0))


def with_dwell_parts(
    within: Noise,
    means: Means,
    state: Floats,
    angle_sigma_deg: float | None,
    scatter_mps2: float | None,
    walks: bool = False,
    near: Mapping[Parts, Floats] | None = None,
) -> tuple[Noise, Mapping[Parts, Floats]]:
    """The noise with its dwell parts: as stated, else estimated by restricted maximum likelihood where significant.

    Of the parts not stated (the scatter one number for all accelerometers, or one each), the combination with the best
    likelihood is taken, each number charged for by the 1 % point of its ratio against zero. ``walks``: the intensity
    of a walk of the biases is found with each, and not charged for. Fewer than 6 degrees of freedom between dwells:
    nothing is estimated. Too few orientations to tell a setting error from the sensors' scatter: the whole misfit
    counts as scatter.

    Second: the sizes that each combination was searched to. Given as ``near`` with means that have changed little, they
    shorten the searches.
    """
    stated = replace(
        within,
        setting_rad=float(np.radians(angle_sigma_deg or 0.0)),
        scatter_mps2=np.full(3, scatter_mps2 or 0.0),
        setting_stated=angle_sigma_deg is not None,
        scatter_stated=scatter_mps2 is not None,
        checked=scatter_mps2 is not None or _setting_is_checked(means.force_mps2),
        walk_mps2_per_sqrt_s=0.0 if walks else within.walk_mps2_per_sqrt_s,
    )
    if stated.setting_stated and stated.scatter_stated and not walks:
        return stated, {}
    means, _ = _reduced(means)
    free = means.readings.size - means.design.shape[2]
    if free < FEWEST:
        return stated, {}
    combinations = _combinations(stated, walks)
    likelihood = _likelihood(stated.weights, {part for parts in combinations for part in parts}, means, state)
    without = likelihood.without()
    if not walks and chi_squared_tail(free, without.misfit) > 0.1:  # spares the search
        return stated, {}
    return _chosen(stated, likelihood, combinations, without, near or {})


def _combinations(stated: Noise, walks: bool) -> list[Parts]:
    """Of the parts that may be estimated."""
    settings: list[Parts] = [()] if stated.setting_stated or not stated.checked else [(), ("setting",)]
    scatters: list[Parts] = [()] if stated.scatter_stated else [(), ("common",)]
    if stated.checked and not stated.scatter_stated:
        scatters.append(("scatter",))
    walking: list[Parts] = [(), ("walk",)] if walks else [()]
    return [setting + scatter + walk for walk, setting, scatter in product(walking, settings, scatters)][1:]


def _chosen(
    stated: Noise, likelihood: Likelihood, combinations: Sequence[Parts], without: Point, near: Mapping[Parts, Floats]
) -> tuple[Noise, Mapping[Parts, Floats]]:
    """The noise with the best of the combinations, and the sizes of each.

    The last of them has all others within it, so that none is likelier: what it leaves to be gained by those that are
    charged for more spares their search.
    """
    charges = {parts: _charge(parts, likelihood) for parts in combinations}
    best, score, most, found = (), -without.cost, math.inf, dict(near)
    for parts in [combinations[-1], *sorted(combinations[:-1], key=charges.__getitem__)]:
        if most - charges[parts] <= score:
            continue
        found[parts], point = likelihood.of(parts).most_likely(near.get(parts))
        most = -point.cost if parts == combinations[-1] else max(most, -point.cost)
        if -point.cost - charges[parts] > score:
            best, score = parts, -point.cost - charges[parts]
    if not best:
        return stated, found
    units = np.concatenate([likelihood.units[part] for part in best])
    noise = _with(stated, best, units * found[best])
    if "walk" in best:
        spread = _last_spread(likelihood.of(best).curvature(found[best]))
        noise = replace(noise, walk_spread=spread)
    return noise, found


def _charge(parts: Parts, likelihood: Likelihood) -> float:
    """What parts have to gain in log-likelihood."""
    return sum(_WALK if part == "walk" else 0.5 * _SIGNIFICANT * len(likelihood.units[part]) for part in parts)


def _last_spread(curvature: Floats) -> float:
    """1 sigma of the last of some logarithms, the others being found with it."""
    values, vectors = np.linalg.eigh(curvature)
    seen = values > 1e-3  # the others are parts that have run to zero
    return float(np.sqrt(np.sum(vectors[-1, seen] ** 2 / values[seen])))


def _setting_is_checked(force_mps2: Floats) -> bool:
    """Whether the readings along f overdetermine what they see by 3 or more: f^T S f + f^T b, 9 numbers at most."""
    x, y, z = force_mps2.T / np.linalg.norm(force_mps2, axis=1).mean()
    design = np.column_stack([x * x, y * y, z * z, x * y, x * z, y * z, x, y, z])
    return directions(force_mps2) - int(np.linalg.matrix_rank(design, tol=0.02)) >= ENOUGH_DIRECTIONS - 9


def directions(force_mps2: Floats) -> int:
    """How many different directions forces (D, 3) have, to a hundredth."""
    unit = force_mps2 / np.linalg.norm(force_mps2, axis=1).mean()
    return len(np.unique(np.round(unit, 2) + 0.0, axis=0))


def degrees_of_freedom(means: Means) -> int:
    """Degrees of freedom of the dwells' means beside the model's coefficients."""
    return means.readings.size - _reduced(means)[0].design.shape[2]


def gain_of(part: Part, noise: Noise, means: Means, state: Floats, prior: Floats) -> float:
    """What more of a part of the noise, as much as is likeliest, gains in log-likelihood.

    ``means`` and ``prior`` as ``with_slow_scatter`` has them.
    """
    means, prior = _reduced(means, prior)
    likelihood = _likelihood(noise, {part}, means, state, prior)
    _, point = likelihood.of((part,)).most_likely()
    return max(likelihood.without().cost - point.cost, 0.0)


def restoring_gain(noise: Noise, means: Means, state: Floats, prior: Floats) -> tuple[float, float]:
    """What a walk that is held back gains in log-likelihood over the walk that is in the noise, and the time constant
    with which it comes back, s (a Gauss-Markov process of any variance; that of infinite time constant is the walk).

    ``means`` and ``prior`` as ``with_slow_scatter`` has them.
    """
    means, prior = _reduced(means, prior)
    free, still = _likelihood(noise, (), means, state, prior).without(), replace(noise, walk_mps2_per_sqrt_s=0.0)
    spans_s, run_s = means.ends_s[:, 1] - means.ends_s[:, 0], float(means.ends_s[-1, 1] - means.ends_s[0, 0])
    times_s = np.geomspace(max(float(np.median(spans_s)) / 4.0, run_s * 1e-4), 2.0 * run_s, _HELD).tolist()
    costs = [
        _likelihood(still, {"walk"}, means, state, prior, held_s).of(("walk",)).most_likely()[1].cost
        for held_s in times_s
    ]
    least = int(np.argmin(costs))
    return max(free.cost - costs[least], 0.0), times_s[least]


def with_slow_scatter(dwells: Sequence[DwellFactor], noise: Noise, means: Means) -> tuple[Means, Floats]:
    """Means with the columns of what a stated scatter may have in common in dwells that follow each other, and the
    rows of their prior (q, p + q + 1)."""
    columns, sigma = slow_scatter(dwells, noise)
    design = np.concatenate([means.design, [own[0, 0] for own in columns]], axis=2)
    prior = np.zeros((len(sigma), design.shape[2] + 1))
    prior[:, means.design.shape[2] : -1] = np.diag(1.0 / sigma)
    return replace(means, design=design), prior


def misfit(noise: Noise, means: Means, state: Floats, prior: Floats | None = None) -> float:
    """Chi-squared of the dwell means about their generalised least-squares fit; ``prior`` (q, p + 1): rows of what is
    known of the coefficients."""
    means, prior = _reduced(means, prior)
    return _likelihood(noise, (), means, state, prior).without().misfit


def restricted_log_likelihood(
    noise: Noise, means: Means, state: Floats, prior: Floats | None = None, held_s: float = math.inf
) -> float:
    """Of the dwell means, up to a constant. ``prior`` as in ``misfit``; held_s: with which a walk of the biases comes
    back."""
    means, prior = _reduced(means, prior)
    return -_likelihood(noise, (), means, state, prior, held_s).without().cost


def _reduced(means: Means, prior: Floats | None = None) -> tuple[Means, Floats]:
    """The same with an orthonormal basis (D, 3, r) of the columns of which nothing is known, and the readings less what
    it explains; the prior's rows of that.

    Another basis changes the likelihood by a constant; the rounding of readings of size g is out of it.
    """
    design = means.design.reshape(-1, means.design.shape[2])
    prior = np.zeros((0, design.shape[1] + 1)) if prior is None else prior
    known = prior[:, :-1].any(axis=0)
    own = design[:, ~known]
    scale = np.linalg.norm(own, axis=0)
    left, singular, _ = np.linalg.svd(own / np.where(scale > 0, scale, 1.0), full_matrices=False)
    basis = left[:, singular > 1e-9 * singular[0]]
    rest = means.readings.ravel() - basis @ (basis.T @ means.readings.ravel())
    columns = np.hstack([basis, design[:, known]])
    means = replace(means, design=columns.reshape(*means.readings.shape, -1), readings=rest.reshape(-1, 3))
    return means, np.hstack([np.zeros((len(prior), basis.shape[1])), prior[:, np.append(known, True)]])


def _likelihood(
    noise: Noise,
    parts: Collection[Part],
    means: Means,
    state: Floats,
    prior: Floats | None = None,
    held_s: float = math.inf,
) -> Likelihood:
    """Of reduced means."""
    count, units = len(means.counts), _units(means)
    standing = "walk" not in parts and not noise.walk_mps2_per_sqrt_s
    path = Links(*(np.zeros(count - k) for k in (1, 0, 1))) if standing else mean_links(means.ends_s, held_s)
    design = np.concatenate([means.design, means.readings[:, :, None]], axis=2)
    rows = design.copy()
    rows[1:] -= path.share[:, None, None] * design[:-1]
    each = np.eye(3)[:, None, :, None] * np.eye(3)[:, None, None, :] * np.ones((count, 1, 1))
    walk = np.zeros((1, count, 6, 3))
    walk[0, :, :3] = path.alone[:, None, None] * np.eye(3)
    walk[0, :-1, 3:] = path.beside[:, None, None] * np.eye(3)
    shapes: dict[Part, Floats] = {
        "setting": _linked(setting_covariances(means, state)[None], path),
        "common": _linked(each.sum(axis=0, keepdims=True), path),
        "scatter": _linked(each, path),
        "walk": walk,
    }
    fixed = _linked(mean_covariances(noise, means, state), path) + noise.walk_mps2_per_sqrt_s**2 * walk[0]
    alone = Restricted(
        rows.reshape(3 * count, -1), np.zeros((0, rows.shape[2])) if prior is None else prior, fixed, walk[:0]
    )
    return Likelihood(alone, {part: units[part][:, None, None, None] ** 2 * shapes[part] for part in parts}, units)


def _linked(own: Floats, path: Links) -> Floats:
    """Covariances (..., D, 6, 3), as ``banded`` keeps them, of means each less its share of the one before; ``own``
    (..., D, 3, 3) is that of the means where each is independent of the others."""
    share, out = path.share[:, None, None], np.zeros((*own.shape[:-2], 6, 3))
    out[..., :3, :] = own
    out[..., 1:, :3, :] += share**2 * own[..., :-1, :, :]
    out[..., :-1, 3:, :] -= share * own[..., :-1, :, :]
    return out


def _units(means: Means) -> dict[Part, Floats]:
    """Each number of the parts as large as the misfit of reduced means."""
    size = np.sqrt(np.mean(means.readings**2, axis=0)) + FLOOR_MPS2
    span_s = max(float(means.ends_s[-1, 1] - means.ends_s[0, 0]), 1e-9)
    return {
        "setting": np.full(1, size.mean() / np.linalg.norm(means.force_mps2, axis=1).mean()),
        "common": np.full(1, size.mean()),
        "scatter": size,
        "walk": np.full(1, 2.0 * size.mean() / math.sqrt(span_s)),
    }


def _with(noise: Noise, parts: tuple[Part, ...], sizes: Floats) -> Noise:
    """The noise with its parts of these sizes: one number each, of a scatter that differs three."""
    left = iter(sizes.tolist())
    for part in parts:
        if part == "setting":
            noise = replace(noise, setting_rad=next(left))
        elif part == "walk":
            noise = replace(noise, walk_mps2_per_sqrt_s=next(left))
        elif part == "common":
            noise = replace(noise, scatter_mps2=np.full(3, next(left)))
        else:
            noise = replace(noise, scatter_mps2=np.array([next(left) for _ in range(3)]))
    return noise
