"""The evidence of an explanation: the likelihood of the readings with all that is unknown about it averaged out.

What is averaged: the parameters of the model (flat prior); the coefficients of the added effects, of which neither
direction nor size is known; and the noise from dwell to dwell, where it was not stated or may be larger than stated.
All explanations of a run are weighed in the same noise within dwells and by the same priors, so that their evidence may
be compared, however many coefficients they have.

The means of the dwells have the restricted likelihood of ``reml``. The readings within dwells add rows of prior
knowledge, since noise from dwell to dwell does not enter them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.diagnosis.coefficient_sizes import AddedEffects, sensor_grade
from kf_calib.dwells.qr import triangle
from kf_calib.effects.effect import Grade
from kf_calib.estimation.candidate_scan import SEEN
from kf_calib.estimation.cross_validation import orientations
from kf_calib.estimation.dwell_columns import LinearisedDwells
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.whitened_rows import flicker_of_scatter, whiten
from kf_calib.noise.means import Means
from kf_calib.noise.noise_model import Noise, mean_covariances, setting_covariances
from kf_calib.noise.reml import OF_ONE, Likelihood, Part, Parts, likelihood_of, with_shared_noise
from kf_calib.noise.restricted_likelihood import Restricted
from kf_calib.noise.temperature_course import thermometer_errors

_RANGE = math.log(1e4)  # width of the flat prior of the logarithm of a size of noise
_UNSTATED = 0.5  # prior probability of noise from dwell to dwell that was not stated
_BEYOND = 0.02  # prior probability of more noise than was stated
_OF_ONE = 0.1  # share of one accelerometer alone in scatter
_NO_WORSE = 1.01  # to which share a misfit may grow with more coefficients, by rounding and what is not linear
_IMMENSE_MPS2 = 1e3  # scatter so large that nothing is left of a dwell's mean


@dataclass(frozen=True)
class MarginalLikelihood:
    """The evidence of an explanation where certain parts of the noise are estimated rather than stated.

    - parts: these parts, without a random walk.
    - log: the logarithm of the evidence, with the prior of the parts.
    - sizes: the likeliest sizes of the parts, SI.
    - delta_chi2: the decrease of chi-squared by the added effects, in this noise.
    - dof: the number of their coefficients.
    """

    parts: Parts
    log: float
    sizes: tuple[float, ...]
    delta_chi2: float
    dof: int


@dataclass(frozen=True)
class _ColumnBlocks:
    """The blocks of columns [H | G | W | z] of a likelihood.

    H: the ``model`` columns of the model without the added effects. G: the coefficients of these, up to ``with_added``.
    W: noise that dwells share, the errors of the thermometer last, up to ``count``. z: the readings, one column.
    """

    model: int
    with_added: int
    count: int

    def spread(self, within: Floats) -> Floats:
        """Rows (n, count + 1) from rows [effects | thermometer | z] of the readings within dwells, in which the twelve
        parameters have no columns."""
        effects = self.with_added - STATE_COUNT
        thermometer_and_z = within.shape[1] - effects
        rows = np.zeros((len(within), self.count + 1))
        rows[:, STATE_COUNT : self.with_added] = within[:, :effects]
        rows[:, self.count + 1 - thermometer_and_z :] = within[:, effects:]
        return rows

    def combined(self, columns: Floats, combinations: Floats) -> Floats:
        """Columns (..., c) with combinations (q, k) of the q added columns in place of these."""
        model, added, rest = np.split(columns, [self.model, self.with_added], axis=-1)
        return np.concatenate([model, added @ combinations, rest], axis=-1)


@dataclass(frozen=True)
class _LikelihoodRows:
    """What a likelihood is made of: the means of the dwells, rows of prior knowledge, and the number of coefficients of
    the added effects.

    added: the columns of what is seen of the effects. seen (r, q): makes their numbers of the q coefficients.
    """

    means: Means
    prior: Floats
    dof: int
    added: slice
    seen: Floats


@dataclass(frozen=True)
class _AddedColumns:
    """The columns of added effects in a likelihood, before ``after`` others. seen (r, q): as in ``_LikelihoodRows``."""

    effects: AddedEffects
    seen: Floats
    after: int

    def log_bayes(self, delta_chi2: float, likelihood: Restricted, variances: Floats) -> float:
        """The log Bayes factor of the effects against none at these variances (k,) of the noise."""
        stop = likelihood.rows.shape[1] - 1 - self.after
        root, readings = likelihood.root_of(variances, slice(stop - len(self.seen), stop))
        return self.effects.log_bayes(delta_chi2, root @ self.seen, readings)


class Evidence:
    """The evidence of effects added to the model of a fit, and of none."""

    def __init__(self, before: Fit) -> None:
        noise = before.noise
        self._fit, self._walks = before, before.linearised.model.walks
        self.noise: Noise = replace(
            noise,
            walk_mps2_per_sqrt_s=0.0 if self._walks else noise.walk_mps2_per_sqrt_s,
            scatter_mps2=noise.scatter_mps2 if noise.scatter_stated else np.zeros(3),
            setting_rad=noise.setting_rad if noise.setting_stated else 0.0,
        )
        self.grade: Grade = sensor_grade(before)

    @cached_property
    def _without_effects(self) -> _LikelihoodRows:
        return self._rows(self._fit.linearised, self.noise)

    def of(self, refit: Fit | None = None, walk: bool = False) -> list[MarginalLikelihood]:
        """The evidence of the effects that a refit has and the fit has not, for each set of free parts of the noise.

        refit: the fit with the effects (None: none is added). walk: whether a random walk of the biases is among them.
        """
        noise, without = self.noise, self._without_effects
        if refit is not None and refit.noise.sensitivity_mps2_per_k is not None:
            noise = replace(noise, sensitivity_mps2_per_k=refit.noise.sensitivity_mps2_per_k)
            without = self._rows(self._fit.linearised, noise)
        averaged = noise
        if refit is not None and refit.dwells[0].averaged != self._fit.dwells[0].averaged:
            # averages have a noise of their own; by that of single readings, of which there are more, it would be small
            averaged = replace(noise, sigma_mps2=refit.noise.sigma_mps2, inflation=refit.noise.inflation)
        added = without if refit is None else self._rows(refit.linearised, averaged)
        if refit is not None and not added.dof and not walk:  # nothing of the effects is seen
            added, averaged = without, noise
        norm, norm_without = (float(np.linalg.norm(rows.prior[:, -1])) for rows in (added, without))
        without = replace(without, prior=pad_residual_norm(without.prior, norm))
        walking: Parts = ("walk",) if walk or self._walks else ()
        sets = list(self._free_parts(with_effects=refit is not None))
        free: Parts = (*walking, *dict.fromkeys(part for parts in sets for part in parts))
        likelihood_without, likelihood = (
            likelihood_of(
                noise_of_rows, free, rows.means, self._fit.linearised.state, rows.prior, rows.added
            )
            for noise_of_rows, rows in ((noise, without), (averaged, added))
        )  # fmt: skip
        columns = self._added(refit, added) if refit is not None and added.dof else None
        marginals = [self._marginal(likelihood, likelihood_without, parts + walking, columns) for parts in sets]
        # Readings that are folded otherwise, on a carrier or averaged, leave more or less of themselves within dwells.
        # That is no evidence for what they were folded for: it counts as noise does.
        folded, folded_before = (refit or self._fit).dwells[0], self._fit.dwells[0]
        otherwise = (folded.carrier_hz, folded.averaged) != (folded_before.carrier_hz, folded_before.averaged)
        gain = 0.5 * (norm**2 - norm_without**2) if otherwise else 0.0
        return [replace(marginal, log=marginal.log + gain) for marginal in marginals if marginal is not None]

    def _added(self, refit: Fit, rows: _LikelihoodRows) -> _AddedColumns:
        """Return the columns of the effects that a refit has in addition."""
        effects = refit.linearised.model.effects[len(self._fit.linearised.model.effects) :]
        known = AddedEffects([effect for effect in effects if effect.coefficients], self.grade, rows.dof)
        after = rows.means.design.shape[2] - rows.added.stop
        return _AddedColumns(known, rows.seen, after)

    def _free_parts(self, with_effects: bool) -> Iterator[Parts]:
        """Yield the sets of parts of the noise from dwell to dwell that may be free.

        Scatter of one accelerometer alone, that with the largest residuals, stands against all effects: beside one it
        would hide what else is missing, which often shows in one accelerometer.
        """
        yield ()
        model, dwells = self._fit.linearised.model, len(self._without_effects.means.counts)
        if (1 if self.noise.attitude_unknown else 3) * dwells <= model.count - len(model.fixed):
            return
        yield ("common",)
        if self.noise.attitude_unknown:  # a rotation of the dwells has no limit anyway
            return
        if not with_effects:
            means, sigma = self._fit.linearised.means, self.noise.effective_sigma_mps2
            residuals = (means.readings - means.design @ self._fit.linearised.state) * np.sqrt(means.counts[:, None])
            yield (OF_ONE[int(np.argmax(np.sum(residuals**2, axis=0) / sigma**2))],)
        yield ("setting",)
        if not (self.noise.setting_stated and self.noise.scatter_stated):
            yield "setting", "common"

    def _marginal(
        self,
        likelihood: Likelihood,
        likelihood_without: Likelihood,
        parts: Parts,
        added: _AddedColumns | None,
    ) -> MarginalLikelihood | None:
        """Return the evidence with these parts of the noise free; None where one of them is best at zero, and where the
        effects make the misfit larger, as a fit does that has not converged.

        The logarithms of the sizes of the parts are averaged out by Laplace's method. A part of no size is counted
        where it is absent. added: the columns of the added effects, whose coefficients are averaged in the noise that
        is likeliest; None where there are none.
        """
        at_parts = likelihood.of(parts)
        relative, point = at_parts.most_likely() if parts else (np.zeros(0), likelihood.without())
        if not all(size for part, size in zip(parts, relative, strict=True) if part != "walk" or not self._walks):
            return None
        sizes = np.array([likelihood.units[part][0] for part in parts]) * relative
        variances_without = (sizes / np.array([likelihood_without.units[part][0] for part in parts])) ** 2
        without = likelihood_without.of(parts).at(variances_without)
        if point.misfit > without.misfit * _NO_WORSE + 1.0:
            return None
        delta_chi2, log = max(without.misfit - point.misfit, 0.0), self._log_prior(parts) - without.cost
        if parts:
            curvatures = np.linalg.eigvalsh(at_parts.curvature(relative))
            log += float(
                np.sum(0.5 * np.log(2.0 * np.pi / np.maximum(curvatures, 2.0 * np.pi / _RANGE**2)) - math.log(_RANGE))
            )
        if added is not None:
            log += added.log_bayes(delta_chi2, at_parts, relative**2)
        beyond: Parts = tuple(part for part in parts if part != "walk")
        return MarginalLikelihood(beyond, log, tuple(sizes.tolist()), delta_chi2, added.effects.dof if added else 0)

    def _log_prior(self, parts: Parts) -> float:
        """Return the logarithm of the prior probability that these parts of the noise are there and no others."""
        stated: dict[Part, bool] = {"setting": self.noise.setting_stated, "common": self.noise.scatter_stated}
        priors = {part: _BEYOND if is_stated else _UNSTATED for part, is_stated in stated.items()}
        if parts and parts[0] in OF_ONE:
            return math.log(_OF_ONE / len(OF_ONE)) + self._log_prior(("common", *parts[1:]))
        return sum(math.log(prior if part in parts else 1.0 - prior) for part, prior in priors.items())

    def _rows(self, linearised: LinearisedDwells, noise: Noise) -> _LikelihoodRows:
        """Return what the likelihood needs.

        Columns that the model hides are left out. Where an effect was fitted with an unknown constant, the derivative
        by this constant is one more column, but no coefficient.
        """
        means, shared_prior = with_shared_noise(linearised.dwells, noise, linearised.means)
        blocks = _ColumnBlocks(self._fit.linearised.model.count, linearised.model.count, means.design.shape[2])
        prior = np.vstack([shared_prior, blocks.spread(_within(linearised, noise, self._fit.linearised.state))])
        constants = [column - blocks.model for column in linearised.model.unknowns if column >= blocks.model]
        seen, numbers = _visible(means, noise, prior, blocks)
        seen_means, added = replace(means, design=blocks.combined(means.design, seen)), len(numbers)
        return _LikelihoodRows(
            seen_means, blocks.combined(prior, seen), max(added - len(constants), 0),
            slice(blocks.model, blocks.model + added), np.delete(numbers, constants, axis=1),
        )  # fmt: skip


def pad_residual_norm(prior: Floats, norm: float) -> Floats:
    """Return rows of prior knowledge whose last column, the residual, has another norm.

    The difference is put where no other column can explain it. The statistics of dwells on a carrier hold more of the
    readings than others. Without this, a fit that has no carrier would seem to explain what its statistics do not hold.
    """
    padded = prior.copy()
    padded[-1, -1] = math.sqrt(max(padded[-1, -1] ** 2 + norm**2 - float(prior[:, -1] @ prior[:, -1]), 0.0))
    return padded


def _within(linearised: LinearisedDwells, noise: Noise, state: Floats) -> Floats:
    """Return the triangular factor [G | T | z] of what the readings within dwells say of all effects G and of the
    errors T of the temperature.

    An immense scatter takes the mean of each dwell out of them. Where scatter was stated, it may be 1/f noise, which
    shows within dwells, too.
    """
    setting_rad = noise.setting_rad if noise.attitude_unknown else 0.0
    without_means = replace(
        noise, scatter_mps2=np.full(3, _IMMENSE_MPS2), setting_rad=setting_rad, walk_mps2_per_sqrt_s=0.0
    )
    columns = [design[..., STATE_COUNT:] for design in linearised.columns]
    if noise.sensitivity_mps2_per_k is not None:
        errors = thermometer_errors(linearised.dwells_at_state, noise.sensitivity_mps2_per_k)
        columns = [np.concatenate(both, axis=3) for both in zip(columns, errors, strict=True)]
    flicker = flicker_of_scatter(linearised.dwells_at_state, noise)
    whitened = whiten(linearised.dwells_at_state, columns, without_means, state, flicker_mps2=flicker, reduced=False)
    rows = np.concatenate(whitened)
    lacking = max(rows.shape[1] - len(rows), 0)
    return triangle(np.vstack([rows, np.zeros((lacking, rows.shape[1]))]))


def _visible(means: Means, noise: Noise, prior: Floats, blocks: _ColumnBlocks) -> tuple[Floats, Floats]:
    """Return combinations (q, r) of the added columns that are orthonormal beside the model's, without hidden ones, and
    what makes their numbers (r, q) of those of the columns."""
    sigma = noise.effective_sigma_mps2 / np.sqrt(means.counts[:, None])
    columns = np.vstack([(means.design / sigma[..., None]).reshape(-1, means.design.shape[2]), prior[:, :-1]])
    model, _ = _of_unit_length(columns[:, : blocks.model])
    added, lengths = _of_unit_length(columns[:, blocks.model : blocks.with_added])
    left, singular, _ = np.linalg.svd(model, full_matrices=False)
    basis = left[:, singular > 1e-9 * singular[0]]
    _, singular, right = np.linalg.svd(added - basis @ (basis.T @ added), full_matrices=False)
    seen = singular > SEEN
    right, singular = right[seen], singular[seen]
    return right.T / singular / lengths[:, None], singular[:, None] * right * lengths


def _of_unit_length(columns: Floats) -> tuple[Floats, Floats]:
    """Return columns of length 1, and their lengths; columns of zeros stay so."""
    lengths = np.linalg.norm(columns, axis=0)
    lengths = np.where(lengths > 0, lengths, 1.0)
    return columns / lengths, lengths


def log_odds_of_repeating(before: Calibration, noise: MarginalLikelihood) -> float:
    """Log odds that the misfit depends on the orientation alone, against noise from dwell to dwell of these sizes; 0
    where no orientation is repeated.

    They are those of the differences of residuals between the visits of an orientation: with the noise that was stated
    alone, or with that of the given parts, too.
    """
    groups = [group for group in orientations(before.fit.dwells) if len(group) > 1]
    stated, linearised = before.noise.for_goodness_of_fit, before.linearised
    if not groups or stated.attitude_unknown:
        return 0.0
    within = mean_covariances(stated.of_readings, linearised.means, linearised.state)
    scatter = np.zeros_like(within)
    for part, size in zip(noise.parts, noise.sizes, strict=False):
        if part == "setting":
            scatter += size**2 * setting_covariances(linearised.means, linearised.state)
        elif part == "common":
            scatter += size**2 * np.eye(3)
        elif part in OF_ONE:
            scatter[:, OF_ONE.index(part), OF_ONE.index(part)] += size**2
    return sum(_log_ratio(before.residuals_mps2[group], within[group], scatter[group]) for group in groups)


def _log_ratio(residuals: Floats, within: Floats, scatter: Floats) -> float:
    """Return the log of the likelihood of the differences from the first visit without the scatter, over that with it;
    residuals (n, 3), covariances (n, 3, 3)."""
    differences = (residuals[1:] - residuals[0]).ravel()
    return _log_density(differences, within) - _log_density(differences, within + scatter)


def _log_density(differences: Floats, covariances: Floats) -> float:
    """Return the log density of differences (3 (n - 1),) from the first of n vectors, but for a constant."""
    count = len(covariances) - 1
    spread = np.kron(np.ones((count, count)), covariances[0])
    for k in range(count):
        spread[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += covariances[k + 1]
    return -0.5 * float(np.linalg.slogdet(spread)[1] + differences @ np.linalg.solve(spread, differences))
