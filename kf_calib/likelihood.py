"""The dwell parts of the noise by restricted maximum likelihood of the dwell means: setting error, scatter, walk.

The means of the readings of D dwells scatter about the model by V_d = diag(kappa sigma_w^2 / n + sigma_s^2) +
sigma_alpha^2 S (|f|^2 I - f f^T) S^T; a walk of the biases by steps from one to the next. The model's coefficients are
integrated out (Patterson and Thompson, 1971).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from kf_calib.folding import DwellFactor, Means
from kf_calib.noise import FLOOR_MPS2, Noise, lifted, mean_covariances, wander
from kf_calib.samples import Floats
from kf_calib.triangle import triangle
from kf_calib.walk import Links, links

FEWEST = 6
"""Degrees of freedom between dwells; with fewer nothing is estimated."""

_SIGNIFICANT = 5.41  # 1 % point of the likelihood ratio of a variance against zero: half of chi2 with 1 dof
_HELD = 12  # time constants of a walk that is held back
_RANGE = (-9.0, 3.0)  # of the logarithm of a part's size, about the size of the misfit

Part = Literal["setting", "common", "scatter", "walk"]


def with_dwell_parts(
    within: Noise,
    means: Means,
    state: Floats,
    angle_sigma_deg: float | None,
    scatter_mps2: float | None,
    walks: bool = False,
) -> Noise:
    """The noise with its dwell parts: as stated, else estimated by restricted maximum likelihood where significant.

    Of the parts not stated (the scatter one number for all accelerometers, or one each), the combination with the best
    likelihood is taken, each number charged for by the 1 % point of its ratio against zero. ``walks``: the intensity
    of a walk of the biases is found with each, and not charged for. Fewer than 6 degrees of freedom between dwells:
    nothing is estimated. Too few orientations to tell a setting error from the sensors' scatter: the whole misfit
    counts as scatter.
    """
    from scipy.special import chdtrc

    stated = replace(
        within,
        setting_rad=float(np.radians(angle_sigma_deg or 0.0)),
        scatter_mps2=np.full(3, scatter_mps2 or 0.0),
        setting_stated=angle_sigma_deg is not None,
        scatter_stated=scatter_mps2 is not None,
        checked=scatter_mps2 is not None or _setting_is_checked(means.force_mps2),
    )
    means = _reduced(means)
    freedom = means.readings.size - means.design.shape[2]
    if freedom < FEWEST or (stated.setting_stated and stated.scatter_stated and not walks):
        return stated
    if not walks and chdtrc(freedom, misfit(stated.weights, means, state)) > 0.1:  # spares the search
        return stated
    settings: list[tuple[Part, ...]] = [()] if stated.setting_stated or not stated.checked else [(), ("setting",)]
    scatters: list[tuple[Part, ...]] = [()] if stated.scatter_stated else [(), ("common",)]
    if stated.checked and not stated.scatter_stated:
        scatters.append(("scatter",))
    best, best_score = stated, restricted_log_likelihood(stated.weights, means, state)
    for parts in sorted({setting + scatter for setting in settings for scatter in scatters} - {()}):
        found, score = _most_likely(stated, parts, means, state)
        if score > best_score:
            best, best_score = found, score
    return best if not walks else _walking(stated, settings, scatters, means, state, best, best_score)


def _walking(
    stated: Noise,
    settings: list[tuple[Part, ...]],
    scatters: list[tuple[Part, ...]],
    means: Means,
    state: Floats,
    best: Noise,
    least: float,
) -> Noise:
    """The noise with a walk of the biases beside its most likely dwell parts; without, where it gains nothing."""
    score = least + 0.5
    for parts in sorted({setting + scatter for setting in settings for scatter in scatters}):
        found, own = _most_likely(stated, (*parts, "walk"), means, state)
        if own + 0.5 * _SIGNIFICANT > score:
            spread = _walk_spread(stated, found, (*parts, "walk"), means, state)
            best, score = replace(found, walk_spread=spread), own + 0.5 * _SIGNIFICANT
    return best


def _setting_is_checked(force_mps2: Floats) -> bool:
    """Whether the readings along f overdetermine what they see by 3 or more: f^T S f + f^T b, 9 numbers at most."""
    x, y, z = force_mps2.T / np.linalg.norm(force_mps2, axis=1).mean()
    design = np.column_stack([x * x, y * y, z * z, x * y, x * z, y * z, x, y, z])
    directions = len(np.unique(np.round(design[:, 6:], 2), axis=0))
    return directions - int(np.linalg.matrix_rank(design, tol=0.02)) >= 3


def _most_likely(stated: Noise, parts: tuple[Part, ...], means: Means, state: Floats) -> tuple[Noise, float]:
    """The noise with the most likely sizes of ``parts``, and its log-likelihood less the charge for them.

    Where biases stand the search is over the squares, in which the way to zero has a slope; a walk spans many decades.
    """
    from scipy.optimize import minimize

    begin = _sizes(means, parts)
    if "walk" in parts:
        cost, bounds = _cost(stated, parts, means, state), np.log(begin)[:, None] + np.array(_RANGE)
        found = minimize(cost, np.log(begin), method="L-BFGS-B", bounds=bounds, options={"eps": 1e-3})
        sizes = np.exp(found.x)
    else:
        slope, bounds = _cost_and_slope(stated, parts, means, state), [(0.0, math.exp(2.0 * _RANGE[1]))] * len(begin)
        found = minimize(slope, np.ones(len(begin)), method="L-BFGS-B", jac=True, bounds=bounds)
        sizes = begin * np.sqrt(found.x)
    return _with(stated, parts, sizes), -float(found.fun) - 0.5 * _SIGNIFICANT * len(begin)


def _cost(stated: Noise, parts: tuple[Part, ...], means: Means, state: Floats) -> Callable[[Floats], float]:
    """Minus the log-likelihood, by the logarithms of the sizes."""
    return lambda logs: -restricted_log_likelihood(_with(stated, parts, np.exp(logs)).weights, means, state)


def _cost_and_slope(
    stated: Noise, parts: tuple[Part, ...], means: Means, state: Floats
) -> Callable[[Floats], tuple[float, Floats]]:
    """The same where biases stand, by the squares of the sizes over those the search begins with; and its derivative.

    V = V_0 + sum v_k K_k, dl/dv_k = (r' V^-1 K_k V^-1 r - tr(P K_k)) / 2, P = V^-1 - V^-1 A (A' V^-1 A)^-1 A' V^-1 of
    which only the dwells' own blocks matter (Searle, Casella and McCulloch, 1992, sec. 6.6).
    """
    begin = np.diag(_sizes(means, parts))
    fixed, *wider = (
        mean_covariances(_with(stated, parts, own).weights, means, state) for own in [0.0 * begin[0], *begin]
    )
    shapes, width = np.array(wider) - fixed, means.design.shape[2]
    stacked = np.concatenate([means.design, means.readings[:, :, None]], axis=2)

    def cost(squares: Floats) -> tuple[float, Floats]:
        root = _root(fixed + np.tensordot(squares, shapes, 1))
        back = np.linalg.inv(root)
        whitened = back @ stacked
        basis, upper = np.linalg.qr(whitened.reshape(-1, width + 1)[:, :width])
        rest = whitened[:, :, width].ravel()
        rest = rest - basis @ (basis.T @ rest)
        log_root = np.log(np.einsum("dii->di", root)).sum() + np.log(np.abs(np.diag(upper))).sum()
        blocks, rest = basis.reshape(*means.readings.shape, width), rest.reshape(-1, 3, 1)
        inner = np.eye(3) - blocks @ np.swapaxes(blocks, 1, 2) - rest @ np.swapaxes(rest, 1, 2)
        slope = 0.5 * np.einsum("kdij,dij->k", shapes, np.swapaxes(back, 1, 2) @ inner @ back)
        return float(log_root + 0.5 * np.sum(rest**2)), slope

    return cost


def _walk_spread(stated: Noise, found: Noise, parts: tuple[Part, ...], means: Means, state: Floats) -> float:
    """1 sigma of ln q, the other parts being found with it: from the likelihood's curvature (central differences)."""
    cost, at, step = _cost(stated, parts, means, state), np.log(_sizes_in(found, parts)), 0.05
    moves = step * np.eye(len(at))
    curvature = np.array([
        [cost(at + a + b) - cost(at + a - b) - cost(at - a + b) + cost(at - a - b) for a in moves] for b in moves
    ]) / (4.0 * step**2)  # fmt: skip
    values, vectors = np.linalg.eigh(curvature)
    seen = values > 1e-3  # the others are parts that have run to zero
    return float(np.sqrt(np.sum(vectors[-1, seen] ** 2 / values[seen])))


def gain_of(part: Part, noise: Noise, means: Means, state: Floats, prior: Floats) -> float:
    """What more of a part of the noise, as much as is likeliest, gains in log-likelihood.

    ``means`` and ``prior`` as ``wandering`` has them.
    """
    from scipy.optimize import minimize_scalar

    def cost(log_size: float) -> float:
        more = math.exp(log_size)
        if part == "walk":
            wider = replace(noise, walk_mps2_per_sqrt_s=math.hypot(noise.walk_mps2_per_sqrt_s, more))
        elif part == "setting":
            wider = replace(noise, setting_rad=math.hypot(noise.setting_rad, more))
        else:
            wider = replace(noise, scatter_mps2=np.hypot(noise.scatter_mps2, more))
        return -restricted_log_likelihood(wider, means, state, prior)

    begin = math.log(_sizes(_reduced(means), (part,))[0])
    bounds = begin + _RANGE[0], begin + _RANGE[1]
    found = minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 1e-2})
    return max(-float(found.fun) - restricted_log_likelihood(noise, means, state, prior), 0.0)


def held_gain(noise: Noise, means: Means, state: Floats, prior: Floats) -> tuple[float, float]:
    """What a walk that is held back gains in log-likelihood over the walk that is in the noise, and the time constant
    with which it comes back, s (a Gauss-Markov process of any variance; that of infinite time constant is the walk).

    ``means`` and ``prior`` as ``wandering`` has them.
    """
    from scipy.optimize import minimize_scalar

    begin, spans_s = math.log(noise.walk_mps2_per_sqrt_s), means.ends_s[:, 1] - means.ends_s[:, 0]

    def best(held_s: float) -> float:
        def cost(log_size: float) -> float:
            other = replace(noise, walk_mps2_per_sqrt_s=math.exp(log_size))
            return -restricted_log_likelihood(other, means, state, prior, held_s)

        # a process of one variance moves the faster the sooner it is back
        bounds = begin - 1.0, begin + 2.0 + 0.5 * max(math.log(run_s / held_s), 0.0)
        return -float(minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 1e-2}).fun)

    run_s = float(means.ends_s[-1, 1] - means.ends_s[0, 0])
    times_s = np.geomspace(max(float(np.median(spans_s)) / 4.0, run_s * 1e-4), 2.0 * run_s, _HELD).tolist()
    gains = [best(held_s) for held_s in times_s]
    most = int(np.argmax(gains))
    return max(gains[most] - restricted_log_likelihood(noise, means, state, prior), 0.0), times_s[most]


def wandering(dwells: Sequence[DwellFactor], noise: Noise, means: Means) -> tuple[Means, Floats]:
    """Means with the columns of what a stated scatter may have in common in dwells that follow each other, and the
    rows of their prior (q, p + q + 1)."""
    columns, sigma = wander(dwells, noise)
    design = np.concatenate([means.design, [own[0, 0] for own in columns]], axis=2)
    prior = np.zeros((len(sigma), design.shape[2] + 1))
    prior[:, means.design.shape[2] : -1] = np.diag(1.0 / sigma)
    return replace(means, design=design), prior


def _reduced(means: Means) -> Means:
    """The same with an orthonormal basis (D, 3, r) of the columns, and the readings less what it explains.

    Another basis changes the likelihood by a constant; the rounding of readings of size g is out of it.
    """
    design = means.design.reshape(-1, means.design.shape[2])
    scale = np.linalg.norm(design, axis=0)
    left, singular, _ = np.linalg.svd(design / np.where(scale > 0, scale, 1.0), full_matrices=False)
    basis = left[:, singular > 1e-9 * singular[0]]
    rest = means.readings.ravel() - basis @ (basis.T @ means.readings.ravel())
    return replace(means, design=basis.reshape(*means.readings.shape, -1), readings=rest.reshape(-1, 3))


def _sizes(means: Means, parts: tuple[Part, ...]) -> Floats:
    """A starting point of the search: each number of the parts as large as the misfit of reduced means."""
    size = np.sqrt(np.mean(means.readings**2, axis=0)) + FLOOR_MPS2
    span_s = max(float(means.ends_s[-1, 1] - means.ends_s[0, 0]), 1e-9)
    sizes: dict[Part, Floats] = {
        "setting": np.full(1, size.mean() / np.linalg.norm(means.force_mps2, axis=1).mean()),
        "common": np.full(1, size.mean()),
        "scatter": size,
        "walk": np.full(1, 2.0 * size.mean() / math.sqrt(span_s)),
    }
    return np.concatenate([sizes[part] for part in parts])


def _sizes_in(noise: Noise, parts: tuple[Part, ...]) -> Floats:
    """The numbers that ``_with`` takes."""
    sizes: dict[Part, Floats] = {
        "setting": np.full(1, noise.setting_rad),
        "common": noise.scatter_mps2[:1],
        "scatter": noise.scatter_mps2,
        "walk": np.full(1, noise.walk_mps2_per_sqrt_s),
    }
    return np.concatenate([sizes[part] for part in parts])


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


def misfit(noise: Noise, means: Means, state: Floats, prior: Floats | None = None) -> float:
    """Chi-squared of the dwell means about their generalised least-squares fit; ``prior`` (q, p + 1): rows of what is
    known of the coefficients."""
    rows, _ = _rows(noise, means, state)
    return float(triangle(rows if prior is None else np.vstack([prior, rows]))[-1, -1] ** 2)


def restricted_log_likelihood(
    noise: Noise, means: Means, state: Floats, prior: Floats | None = None, held_s: float = math.inf
) -> float:
    """REML of the dwell means: -1/2 (log|V| + log|A' V^-1 A| + r' V^-1 r), up to a constant.

    ``prior`` (q, p + 1): rows of what is known of the coefficients. held_s: with which a walk of the biases comes back.
    """
    rows, log_root = _rows(noise, means, state, held_s)
    upper = triangle(rows if prior is None else np.vstack([prior, rows]))
    width = upper.shape[1] - 1
    scale = np.linalg.norm(upper[:width, :-1], axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    size = np.abs(np.diag(triangle(upper[:width, :-1] / scale)))
    left = float(np.sum(upper[width:, -1] ** 2))
    return -log_root - float(np.log(size[size > 1e-9]).sum() + np.log(scale).sum()) - 0.5 * left


def _rows(noise: Noise, means: Means, state: Floats, held_s: float = math.inf) -> tuple[Floats, float]:
    """Whitened dwell means [A | z] (3 D, p + 1), and log|V|^(1/2) of their covariance V."""
    own = mean_covariances(noise, means, state)
    stacked = np.concatenate([means.design, means.readings[:, :, None]], axis=2)
    if noise.walk_mps2_per_sqrt_s:
        return _linked_rows(own, noise.walk_mps2_per_sqrt_s, links(means.ends_s, held_s), stacked)
    root = _root(own)
    rows = np.linalg.solve(root, stacked).reshape(-1, stacked.shape[2])
    return np.asarray(rows, float), float(np.log(np.einsum("dii->di", root)).sum())


def _root(covariances: Floats) -> Floats:
    """Triangular roots (D, 3, 3) of covariances."""
    return np.asarray(np.linalg.cholesky(lifted(covariances)), float)


def _linked_rows(own: Floats, intensity: float, path: Links, stacked: Floats) -> tuple[Floats, float]:
    """The same where the biases walk: of the means less a share of those before, whose covariance is banded."""
    from scipy.linalg import cholesky_banded, solve_banded

    share, rows = path.share[:, None, None], stacked.copy()
    rows[1:] -= share * stacked[:-1]
    diagonal = own + intensity**2 * path.alone[:, None, None] * np.eye(3)
    diagonal[1:] += share**2 * own[:-1]
    diagonal = lifted(diagonal)
    beside = intensity**2 * path.beside[:, None, None] * np.eye(3) - share * own[:-1]
    bands = np.zeros((6, len(own), 3))
    for i in range(3):
        for j in range(3):
            if i >= j:
                bands[i - j, :, j] = diagonal[:, i, j]
            bands[3 + i - j, :-1, j] += beside[:, i, j]
    root = cholesky_banded(bands.reshape(6, -1), lower=True)
    whitened = solve_banded((5, 0), root, rows.reshape(-1, rows.shape[2]))
    return np.asarray(whitened, float), float(np.log(root[0]).sum())
