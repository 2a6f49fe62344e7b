"""A fit of model and noise to the dwells: its estimate, its whitened rows, and how well other noise would do."""

from __future__ import annotations

import bisect
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from kf_calib.bench.arrays import ROUNDING, Floats
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.dwells.pieces import OfPieces, of_all_pieces
from kf_calib.dwells.table import DwellTable
from kf_calib.effects import RotationEffect
from kf_calib.estimation import square_root_information, whitened_rows
from kf_calib.estimation.dwell_columns import LinearisedDwells, candidate_columns
from kf_calib.noise.means import Means
from kf_calib.noise.noise_model import Noise, steps
from kf_calib.noise.reml import Part, gain_of, misfit, with_shared_noise
from kf_calib.noise.terms import RandomWalk, SlowWaves, WavesOverRun

_LOST = 1e-6  # share of a combination of states, below which a coefficient has no part in it


@dataclass(frozen=True, repr=False)
class Fit:
    """The dwells with the columns of the fitted model, and the noise by which they are weighted.

    - spreads: by effect, the sigma of ln(value) of each constant without a derivative.
    - beginning: without angles, the fit of the nine parameters alone, from which that of any model begins.
    """

    linearised: LinearisedDwells
    noise: Noise
    spreads: Mapping[str, float] = field(default_factory=dict[str, float])
    beginning: Fit | None = None

    @property
    def dwells(self) -> DwellTable:
        """The dwells that were fitted."""
        return self.linearised.dwells

    @property
    def steps(self) -> Floats:
        """Variances (D, 2, 3) of the biases' steps before and within each dwell; zeros if they do not walk."""
        return steps(self.dwells, self.noise)

    @property
    def state(self) -> Floats:
        """The estimate (p,) from all readings; if the biases walk, it holds their values after the last dwell."""
        return self._solution[0]

    @property
    def sigma(self) -> Floats:
        """Sigmas (p,) of the estimate from all readings, without considered parameters and what is not determined."""
        return np.sqrt(np.diag(self._solution[1]))

    @property
    def sigma_of_determined(self) -> Floats:
        """The same with zeros for states that are not determined, of which the covariance has no more than
        rounding."""
        lost = self._solution[2]
        lost = lost / np.linalg.norm(lost, axis=0)
        return np.where(np.linalg.norm(lost, axis=1) < ROUNDING, self.sigma, 0.0)

    @cached_property
    def _solution(self) -> tuple[Floats, Floats, Floats]:
        return square_root_information.solve(self._factor, self.linearised.model.nominal_state())

    @cached_property
    def _factor(self) -> Floats:
        return square_root_information.accumulate(self.all_rows(), self.steps)[:-1]

    @property
    def redundant(self) -> list[str]:
        """Symbols of coefficients of rotations that do nothing that others before them do not do, to first order: of
        each combination of several that the readings do not determine, the last.

        Beside each other they would be told by what is of second order in themselves alone, as the tilts of two axes
        about a third one are: a fit would run far along what is hardly curved, and call certain what it finds there.
        """
        model = self.linearised.model
        turning = [effect for effect in model.effects if isinstance(effect, RotationEffect)]
        starts = [(model.parts[str(effect)].start, effect.coefficients) for effect in turning]
        places = {start + k: each.symbol for start, those in starts for k, each in enumerate(those)}
        if len(places) < 2:
            return []
        redundant, lost = list[str](), square_root_information.lost(self._factor)[list(places)]
        for k, symbol in reversed([*enumerate(places.values())]):
            along = lost @ lost[k]  # what is lost and has the most of this coefficient
            own = math.sqrt(along[k])
            if own > _LOST and (np.abs(np.delete(along, k)) > _LOST * own).any():
                lost = lost - np.outer(along, lost[k]) / along[k]
                redundant.append(symbol)
        return redundant

    @cached_property
    def misfit_rows(self) -> Sequence[Floats]:
        """Whitened rows [H | W | z] by which the misfit is judged, see ``whitened_rows.misfit_rows``."""
        linearised = self.linearised
        rows, _ = whitened_rows.misfit_rows(
            linearised.dwells_at_state,
            linearised.columns,
            self.noise.for_goodness_of_fit,
            linearised.state,
            linearised.model.count,
        )
        return whitened_rows.with_frame(rows, linearised.model, self.noise, len(rows) - len(self.dwells))

    @cached_property
    def following(self) -> list[Floats]:
        """Whitened rows [H | z] of the slews that follow each dwell; (0, p + 1) where none is used."""
        linearised, noise = self.linearised, self.noise.weights.of(moving=True)
        following = [np.zeros((0, linearised.model.count + 1))] * len(self.dwells)
        if linearised.slews:
            whitened = whitened_rows.whiten(
                DwellTable.of(linearised.slews), linearised.slew_columns, noise, linearised.state
            )
            numbers = [dwell.number for dwell in self.dwells]
            for slew, rows in zip(linearised.slews, whitened, strict=True):
                before = bisect.bisect_right(numbers, slew.number) - 1
                following[before] = np.vstack([following[before], rows])
        return following

    def all_rows(self, noise: Noise | None = None) -> Sequence[Floats]:
        """Whitened rows of each dwell together with those of the slews after it; within a slew the biases are
        constant."""
        if not self.linearised.slews:
            return self.rows(noise)
        both = list[Floats]()
        for of_dwell, of_slews in zip(self.rows(noise), self.following, strict=True):
            standing = np.zeros((len(of_slews), of_dwell.shape[1] - of_slews.shape[1]))
            both.append(np.vstack([of_dwell, np.hstack([standing, of_slews])]) if len(of_slews) else of_dwell)
        return both

    @cached_property
    def considered(self) -> Floats:
        """Contribution B (p, p) of considered parameters to the covariance, which becomes P + P B P: constants without
        a derivative, known effects, and the terms of the noise that are drawn once for the run.

        B is the sum of b b^T with b = A^T W g, where A is the design, W the weights and g the change of the readings if
        the constant changes by 1 sigma. The constants are considered parameters: known to be uncertain, but not
        estimated (Schmidt-Kalman filter).
        """
        linearised, information = self.linearised, np.zeros((self.linearised.model.count,) * 2)
        of_run = self.noise.columns("run", linearised.dwells_at_state, linearised.state)
        if of_run.shape[3]:
            information += self._considered(OfPieces(of_run, self.dwells.folded.ends))
        for known in linearised.model.known:
            columns = candidate_columns(
                linearised.dwells_at_state, [known.effect], linearised.model.bench, linearised.state
            )
            information += self._considered(OfPieces(columns.values @ known.root, self.dwells.folded.ends))
        for effect in linearised.model.stepped:
            spread, part = self.spreads.get(str(effect), 0.0), linearised.model.parts[str(effect)]
            ends = [effect.at(effect.value * math.exp(step)) for step in (spread, -spread)]
            more, less = (
                candidate_columns(linearised.dwells_at_state, [end], linearised.model.bench, linearised.state)
                for end in ends
            )
            information += self._considered(
                OfPieces(0.5 * (more.values - less.values) @ linearised.state[part, None], self.dwells.folded.ends)
            )
        if (waves := self.noise.term(SlowWaves)) is not None and linearised.model.effects:
            information += self._considered_of_effects(waves.flicker_mps2)
        return information

    def _considered_of_effects(self, flicker_mps2: Floats) -> Floats:
        """Return B (p, p) of the waves of 1/f noise that are slower than a dwell, as far as they enter the coefficients
        of effects: noise that is alike in consecutive dwells looks like a drift, and the scatter from dwell to dwell
        has all of it for the twelve parameters, which do not.

        Where slow waves within the dwells show that the scatter is 1/f noise, the scatter tells the size of these.
        """
        dwells = self.linearised.dwells_at_state
        of_scatter = np.where(flicker_mps2 > 0.0, self.noise.scatter.flicker_mps2(len(dwells)), 0.0)
        waves = WavesOverRun(np.maximum(of_scatter, flicker_mps2))
        extra = self._considered(OfPieces(waves.columns(dwells, self.linearised.state), dwells.folded.ends))
        covariance = self._solution[1]
        gained = (covariance @ extra @ covariance)[STATE_COUNT:, STATE_COUNT:]
        seen = np.zeros_like(extra)
        seen[STATE_COUNT:, STATE_COUNT:] = gained
        sizes = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        sizes = np.where(sizes > 0.0, sizes, 1.0)
        inverse = np.linalg.pinv(covariance / np.outer(sizes, sizes), hermitian=True) / np.outer(sizes, sizes)
        return inverse @ seen @ inverse

    def _considered(self, changes: Sequence[Floats]) -> Floats:
        """Return B (p, p) of considered constants from the changes (pieces, K nodes, 3, c) of each dwell's readings by
        1 sigma of each."""
        linearised, count = self.linearised, self.linearised.model.count
        both = np.concatenate([of_all_pieces(linearised.columns), of_all_pieces(changes)], axis=3)
        columns = OfPieces(both, self.dwells.folded.ends)
        rows = whitened_rows.whiten(linearised.dwells_at_state, columns, self.noise.weights, linearised.state)
        upper = square_root_information.accumulate(rows, self.steps)
        gains = upper[:count, :count].T @ upper[:count, count:-1]
        return gains @ gains.T

    @cached_property
    def walk_gain(self) -> float:
        """Gain in log-likelihood of a random walk of the biases over none, given the stated scatter.

        Scatter that was estimated from the same misfit is left out.
        """
        return self._gain_of("walk")

    @cached_property
    def scatter_gain(self) -> float:
        """Gain in log-likelihood of more noise that is independent from dwell to dwell, scatter or setting error, than
        was stated."""
        return max(self._gain_of("common"), self._gain_of("setting"))

    @cached_property
    def misfit(self) -> float:
        """Chi-squared of the dwells' means under the same likelihood as ``walk_gain`` and ``scatter_gain``."""
        noise, means, prior = self._wandering
        return misfit(noise, means, self.linearised.state, prior)

    def _gain_of(self, part: Part) -> float:
        """Return the gain in log-likelihood of one part of the noise."""
        noise, means, prior = self._wandering
        return gain_of(part, noise, means, self.linearised.state, prior)

    @cached_property
    def _wandering(self) -> tuple[Noise, Means, Floats]:
        """Return the noise without a walk, the means with columns for slow scatter, and the prior of these columns."""
        noise, linearised = self.noise.for_goodness_of_fit.without(RandomWalk), self.linearised
        return noise, *with_shared_noise(linearised.dwells, noise, linearised.means, linearised.state)

    def rows(self, noise: Noise | None = None) -> Sequence[Floats]:
        """Whitened rows [H | z] of each dwell, with the weights of the fit or with another noise."""
        return self._weighted if noise is None else self._whitened(noise)

    @cached_property
    def _weighted(self) -> Sequence[Floats]:
        return self._whitened(self.noise.weights)

    def _whitened(self, noise: Noise) -> Sequence[Floats]:
        linearised = self.linearised
        rows = whitened_rows.whiten(linearised.dwells_at_state, linearised.columns, noise, linearised.state)
        return whitened_rows.with_frame(rows, linearised.model, noise)
