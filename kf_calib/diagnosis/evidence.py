"""The evidence of an explanation: the likelihood of the readings with all that is unknown about it averaged out.

What is averaged: the parameters of the model (flat prior); the coefficients of the added effects, of which neither
direction nor size is known; and the noise from dwell to dwell, where it was not stated or may be larger than stated.
All explanations of a run are weighed in the same noise within dwells and by the same priors, so that their evidence may
be compared, however many coefficients they have.

The means of the dwells have the restricted likelihood of ``reml``. What is seen within dwells adds rows of its own,
which no noise from dwell to dwell enters.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag

from kf_calib.bench.arrays import Floats
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.dwells.qr import triangle
from kf_calib.estimation.dwell_columns import LinearisedDwells
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.whitened_rows import flicker_of_scatter, whiten
from kf_calib.noise.means import Means
from kf_calib.noise.noise_model import Noise
from kf_calib.noise.reml import Likelihood, Part, Parts, likelihood_of, with_shared_noise
from kf_calib.noise.restricted_likelihood import Point
from kf_calib.noise.thermometer_error import thermometer_errors

_SIZES = np.exp(np.linspace(0.0, math.log(1e14), 120))  # prior variance of a coefficient over that of its estimate
_RANGE = math.log(1e4)  # width of the flat prior of the logarithm of a size of noise
_UNSTATED = 0.5  # prior probability of noise from dwell to dwell that was not stated
_BEYOND = 0.02  # prior probability of more noise than was stated
_FREE_MPS2 = 1e3  # scatter so large that nothing is left of a dwell's mean
_SEEN = 1e-6  # as in ``score_test``: the least share of a column that the model must leave


def size_evidence(dof: int, delta_chi2: Floats | float) -> Floats:
    """Log Bayes factor of an effect whose size and direction are unknown, against no effect.

    The coefficients have the prior N(0, g C) with C the covariance of their estimate, and ln g is uniform from 0 to
    ln 1e14, which is a size of 1 to 1e7 sigma (the g-prior of A. Zellner, 1986, mixed over g; F. Liang et al., 2008):

      B = mean over g of (1 + g)^(-k/2) exp(g / (1 + g) F / 2)

    dof: number of coefficients k. delta_chi2: fall of chi-squared F with them; a number or an array. Returns ln B.
    """
    parts = -0.5 * dof * np.log1p(_SIZES) + 0.5 * np.asarray(delta_chi2, float)[..., None] * (_SIZES / (1.0 + _SIZES))
    return np.logaddexp.reduce(parts, axis=-1) - math.log(len(_SIZES))


@dataclass(frozen=True)
class Weighed:
    """The evidence of an explanation with certain parts of the noise free.

    - parts: the free parts but for a walk. log: logarithm of the evidence, with the prior of the parts.
    - sizes: of the free parts, SI. delta_chi2: fall of chi-squared by the added effects, in this noise. dof: their
      number.
    """

    parts: Parts
    log: float
    sizes: tuple[float, ...]
    delta_chi2: float
    dof: int


@dataclass(frozen=True)
class _Rows:
    """Means of dwells with rows of prior knowledge, and how many of the last columns belong to added effects."""

    means: Means
    known: Floats
    dof: int


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

    @cached_property
    def _alone(self) -> _Rows:
        return self._rows(self._fit.linearised, self.noise)[0]

    def of(self, refit: Fit | None = None, walk: bool = False) -> list[Weighed]:
        """The evidence of the effects that a refit has and the fit has not, for each set of free parts of the noise.

        refit: the fit with the effects (None: none is added). walk: whether a random walk of the biases is among them.
        """
        noise, alone = self.noise, self._alone
        if refit is not None and refit.noise.sensitivity_mps2_per_k is not None:
            noise = replace(noise, sensitivity_mps2_per_k=refit.noise.sensitivity_mps2_per_k)
            (alone,) = self._rows(self._fit.linearised, noise)
        averaged = noise
        if refit is not None and refit.dwells[0].averaged != self._fit.dwells[0].averaged:
            # averages have a noise of their own; by that of single readings, of which there are more, it would be small
            averaged = replace(noise, sigma_mps2=refit.noise.sigma_mps2, inflation=refit.noise.inflation)
        own, *related = [alone] if refit is None else self._rows(refit.linearised, averaged, self._relations(refit))
        if refit is not None and not own.dof and not walk:
            own, related, averaged = alone, [], noise  # nothing of it is seen
        own_length, length = (float(np.linalg.norm(each.known[:, -1])) for each in (own, alone))
        alone = replace(alone, known=pad_residual_norm(alone.known, own_length))
        walking: Parts = ("walk",) if walk or self._walks else ()
        every: Parts = (*walking, "setting", "common")
        without = likelihood_of(noise, every, alone.means, self._fit.linearised.state, alone.known)
        with_, *with_related = (
            likelihood_of(averaged, every, rows.means, self._fit.linearised.state, rows.known)
            for rows in (own, *related)
        )
        relations = [(likelihood, rows.dof) for likelihood, rows in zip(with_related, related, strict=True)]
        free = self._free(len(alone.means.counts))
        found = (self._weighed(with_, without, parts + walking, own.dof, relations) for parts in free)
        # Readings that are folded otherwise, on a carrier or averaged, leave more or less of themselves within dwells.
        # That is no evidence for what they were folded for: it counts as noise does.
        folded, before = (refit or self._fit).dwells[0], self._fit.dwells[0]
        otherwise = (folded.carrier_hz, folded.averaged) != (before.carrier_hz, before.averaged)
        more = 0.5 * (own_length**2 - length**2) if otherwise else 0.0
        return [replace(each, log=each.log + more) for each in found if each is not None]

    def _relations(self, refit: Fit) -> list[Floats]:
        """Return what the added states may be together: matrices (q, k), times k free numbers each; empty where they
        may have any values."""
        added = refit.linearised.model.effects[len(self._fit.linearised.model.effects) :]
        if not any(effect.relations for effect in added):
            return []
        of_each = [effect.relations or [np.eye(len(effect.states))] for effect in added]
        return [np.asarray(block_diag(*chosen), float) for chosen in itertools.product(*of_each)]

    def _free(self, dwells: int) -> Iterator[Parts]:
        """Yield the sets of parts of the noise from dwell to dwell that may be free."""
        yield ()
        if (1 if self.noise.attitude_unknown else 3) * dwells <= self._fit.linearised.model.count:
            return
        yield ("common",)
        if self.noise.attitude_unknown:  # a rotation of the dwells has no limit anyway
            return
        yield ("setting",)
        if not (self.noise.setting_stated and self.noise.scatter_stated):
            yield "setting", "common"

    def _weighed(
        self,
        own: Likelihood,
        alone: Likelihood,
        parts: Parts,
        dof: int,
        relations: Sequence[tuple[Likelihood, int]],
    ) -> Weighed | None:
        """Return the evidence with these parts of the noise free; None where one of them is best at zero.

        The logarithms of the sizes of the parts are averaged out by Laplace's method. A part of no size is counted
        where it is absent. relations: the likelihood with each possible relation of the coefficients, and how many of
        them it leaves; they are averaged in the noise that is likeliest without a relation.
        """
        likelihood = own.of(parts)
        relative, point = likelihood.most_likely() if parts else (np.zeros(0), own.without())
        if not all(size for part, size in zip(parts, relative, strict=True) if part != "walk" or not self._walks):
            return None
        sizes = np.array([own.units[part][0] for part in parts]) * relative

        def at_sizes(each: Likelihood) -> Point:
            return each.of(parts).at((sizes / np.array([each.units[part][0] for part in parts])) ** 2)

        without = at_sizes(alone)
        delta_chi2, log = max(without.misfit - point.misfit, 0.0), self._log_prior(parts) - without.cost
        if parts:
            curves = np.linalg.eigvalsh(likelihood.curvature(relative))
            log += float(
                np.sum(0.5 * np.log(2.0 * np.pi / np.maximum(curves, 2.0 * np.pi / _RANGE**2)) - math.log(_RANGE))
            )
        if relations:
            falls = [(left, max(without.misfit - at_sizes(each).misfit, 0.0)) for each, left in relations]
            log += float(np.logaddexp.reduce([size_evidence(*each) for each in falls])) - math.log(len(falls))
        elif dof:
            log += float(size_evidence(dof, delta_chi2))
        beyond: Parts = tuple(part for part in parts if part != "walk")
        return Weighed(beyond, log, tuple(sizes.tolist()), delta_chi2, dof)

    def _log_prior(self, parts: Parts) -> float:
        """Return the logarithm of the prior probability that these parts of the noise are there and no others."""
        stated: dict[Part, bool] = {"setting": self.noise.setting_stated, "common": self.noise.scatter_stated}
        chances = {part: _BEYOND if known else _UNSTATED for part, known in stated.items()}
        return sum(math.log(own if part in parts else 1.0 - own) for part, own in chances.items())

    def _rows(self, linearised: LinearisedDwells, noise: Noise, relations: Sequence[Floats] = ()) -> list[_Rows]:
        """Return what the likelihood needs, with coefficients of any values and then with each relation of them:
        columns that the model hides are left out, and with an effect that was fitted with a constant the derivative by
        this constant counts as a column, but as no coefficient."""
        means, shared = with_shared_noise(linearised.dwells, noise, linearised.means)
        first, last, count = self._fit.linearised.model.count, linearised.model.count, means.design.shape[2]
        within = _within(linearised, noise, self._fit.linearised.state)
        known = np.vstack([shared, np.zeros((len(within), count + 1))])
        places = [*range(STATE_COUNT, last), *range(count + 1 - (within.shape[1] - last + STATE_COUNT), count + 1)]
        known[len(shared) :, places] = within
        constants, out = sum(place >= first for place in linearised.model.unknowns), list[_Rows]()
        for relation in (np.eye(last - first), *relations):
            turn = _visible(means, noise, known, first, last, relation)
            design, prior = (
                np.concatenate([own[..., :first], own[..., first:last] @ turn, own[..., last:]], axis=-1)
                for own in (means.design, known)
            )
            out.append(_Rows(replace(means, design=design), prior, max(turn.shape[1] - constants, 0)))
        return out


def pad_residual_norm(known: Floats, length: float) -> Floats:
    """Return rows of prior knowledge with another length of their last column, by what no other column explains.

    Where an oscillation is fitted, more of the readings within dwells is kept than elsewhere.
    """
    out = known.copy()
    out[-1, -1] = math.sqrt(max(out[-1, -1] ** 2 + length**2 - float(known[:, -1] @ known[:, -1]), 0.0))
    return out


def _within(linearised: LinearisedDwells, noise: Noise, state: Floats) -> Floats:
    """Return the triangular factor [G | T | z] of what the readings within dwells say of all effects G and of the
    errors T of the temperature.

    The mean of each dwell is left out: it is as if scatter had no limit. Scatter that is stated may be 1/f noise, which
    goes on within dwells.
    """
    setting_rad = noise.setting_rad if noise.attitude_unknown else 0.0
    free = replace(noise, scatter_mps2=np.full(3, _FREE_MPS2), setting_rad=setting_rad, walk_mps2_per_sqrt_s=0.0)
    columns = [own[..., STATE_COUNT:] for own in linearised.columns]
    if noise.sensitivity_mps2_per_k is not None:
        errors = thermometer_errors(linearised.dwells_at_state, noise.sensitivity_mps2_per_k)
        columns = [np.concatenate(both, axis=3) for both in zip(columns, errors, strict=True)]
    flicker = flicker_of_scatter(linearised.dwells_at_state, noise)
    rows = np.concatenate(whiten(linearised.dwells_at_state, columns, free, state, flicker_mps2=flicker, reduced=False))
    lacking = max(rows.shape[1] - len(rows), 0)
    return triangle(np.vstack([rows, np.zeros((lacking, rows.shape[1]))]))


def _visible(means: Means, noise: Noise, known: Floats, first: int, last: int, relation: Floats) -> Floats:
    """Return combinations (q, k) of the added columns that are orthonormal beside the model's, without hidden ones.

    first, last: the added columns follow those of the model, and come before those that have a prior. relation (q, r):
    the combinations that are possible.
    """
    sigma = noise.effective_sigma_mps2 / np.sqrt(means.counts[:, None])
    columns = np.vstack([(means.design / sigma[..., None]).reshape(-1, means.design.shape[2]), known[:, :-1]])
    model, own = _of_unit_length(columns[:, :first])[0], columns[:, first:last] @ relation
    own, lengths = _of_unit_length(own)
    left, singular, _ = np.linalg.svd(model, full_matrices=False)
    basis = left[:, singular > 1e-9 * singular[0]]
    _, singular, right = np.linalg.svd(own - basis @ (basis.T @ own), full_matrices=False)
    seen = singular > _SEEN
    return relation @ (right[seen].T / singular[seen] / lengths[:, None])


def _of_unit_length(columns: Floats) -> tuple[Floats, Floats]:
    """Return columns of length 1, and their lengths; columns of zeros stay so."""
    lengths = np.linalg.norm(columns, axis=0)
    lengths = np.where(lengths > 0, lengths, 1.0)
    return columns / lengths, lengths
