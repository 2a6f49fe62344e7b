"""A Kalman filter that tests effects in the course of a run without a restart.

Its square-root information factor [R | z] carries the columns of more effects than its model has. The estimate of the
model is one small QR (``square_root_information.restrict``), and equals that of a filter without the other columns. So
is the test of every effect that is carried but not in the model. A dwell that closes is one update of the factor.

    running = Running.over(dwells, model, noise, state, candidates)
    running = running.after(dwell)               # as each dwell closes
    state, covariance, undetermined = running.solved()
    running.scan.statistics                      # fall of chi-squared by each candidate

The noise and the linearisation are those given. A constant inside the columns of an effect keeps its value, and
effects that show in slews only are not supported. ``calibrate`` iterates or estimates all of these.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.dwells.qr import triangle
from kf_calib.dwells.sufficient_statistics import DwellFactor
from kf_calib.effects import Effect
from kf_calib.estimation import square_root_information, whitened_rows
from kf_calib.estimation.attitude import at_its_mode, linearised_at
from kf_calib.estimation.candidate_scan import Scan, project
from kf_calib.estimation.dwell_columns import LinearisedDwells
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.settings import Prior
from kf_calib.noise.noise_model import Noise, steps


@dataclass(frozen=True)
class Running:
    """A filter after some dwells of a run; every change gives a new one.

    linearised: the dwells so far, with the columns of the model and of all candidates. inside: names of those effects
    that are in the model. noise, prior: those of the filter. factor (P, P + 1): square-root information factor of all
    columns; its states are differences from ``about``. left: sum of squares that all columns together leave. rows:
    number of whitened rows.
    """

    linearised: LinearisedDwells
    inside: tuple[str, ...]
    noise: Noise
    prior: Prior
    factor: Floats
    left: float = 0.0
    rows: int = 0

    @classmethod
    def over(
        cls,
        dwells: Sequence[DwellFactor],
        model: Model,
        noise: Noise,
        state: Floats,
        candidates: Iterable[Effect] = (),
        prior: Prior | None = None,
    ) -> Running:
        """The filter after ``dwells`` (one or more), linearised at the affine ``state`` (12,).

        model: the effects to be estimated. noise: by which readings are weighted. candidates: further effects whose
        columns are carried. prior: of the state (None: diffuse).
        """
        every = model
        for effect in candidates:
            every += effect
        at = np.concatenate([state[:STATE_COUNT], np.zeros(every.count - STATE_COUNT)])
        inside = tuple(str(effect) for effect in model.effects)
        empty = np.zeros((every.count, every.count + 1))
        # candidates, at zero, turn no dwell
        attitudes = linearised_at(dwells, model, at[: model.count], noise.weights).dwells
        return cls(LinearisedDwells(attitudes, every, at), inside, noise, prior or Prior(), empty)._rebuild()

    @property
    def dwells(self) -> Sequence[DwellFactor]:
        """The dwells so far."""
        return self.linearised.dwells

    @property
    def about(self) -> Floats:
        """The state (P,) from which the states of the factor are counted."""
        return self.linearised.state

    @cached_property
    def model(self) -> Model:
        """The current model: the twelve parameters and the effects in it, in the order in which they were added."""
        known = {str(effect): effect for effect in self.linearised.model.effects}
        return Model(self.linearised.model.bench, tuple(known[name] for name in self.inside))

    def after(self, dwell: DwellFactor, exact: bool = True) -> Running:
        """The filter after one more dwell.

        It is one update, unless the dwell changes what is known of the conditions in earlier dwells; then the factor is
        built again. exact: False leaves earlier dwells as they were known when they closed.
        """
        dwell = at_its_mode(dwell, self.linearised, self.noise.weights)
        if exact:
            linearised = LinearisedDwells([*self.dwells, dwell], self.linearised.model, self.about)
            if not all(map(np.array_equal, self.linearised.columns, linearised.columns[:-1])):
                return replace(self, linearised=linearised)._rebuild()
        else:
            linearised = self.linearised.followed_by(dwell)
        more = replace(self, linearised=linearised)
        return more._update(more._rows([-1])[0], steps(linearised.dwells[-2:], self.noise)[-1])

    def lean(self) -> Running:
        """The same filter without the columns of candidates in its dwells, which fill the memory in a long run. It can
        go on with ``exact=False`` only."""
        width = self.model.count
        columns = [own if own.shape[-1] == width else own[..., :width].copy() for own in self.linearised.columns]
        return replace(self, linearised=self.linearised.with_columns(columns))

    def solved(self) -> tuple[Floats, Floats, Floats]:
        """State (p,) of the model, its covariance (p, p), and a basis (p, q) of the combinations not determined."""
        kept = self._model_columns
        around = self.model.nominal_state() - self.about[kept]
        moved, covariance, undetermined = square_root_information.solve(
            square_root_information.restrict(self.factor, kept), around
        )
        return self.about[kept] + moved, covariance, undetermined

    @property
    def state(self) -> Floats:
        """The state (P,) of all columns: the estimate for those of the model, zero for those that are only carried."""
        out = np.zeros(len(self.about))
        out[self._model_columns] = self.solved()[0]
        return out

    @cached_property
    def scan(self) -> Scan:
        """The score tests of all effects that are carried but not in the model."""
        kept, parts = self._model_columns, self.linearised.model.parts
        outside = [effect for effect in self.linearised.model.effects if str(effect) not in self.inside]
        theirs = [range(*parts[str(effect)].indices(len(self.about))) for effect in outside]
        order = [*kept, *itertools.chain(*theirs), len(self.about)]
        upper = np.vstack([triangle(self.factor[:, order]), np.zeros((1, len(order)))])
        return project(upper, len(kept), outside, [len(own) for own in theirs])

    @property
    def misfit(self) -> tuple[float, int]:
        """The sum of squares that the current model leaves, and its degrees of freedom."""
        restricted = square_root_information.restrict(self.factor, self._model_columns)
        squares = self.left + float(np.sum(self.factor[:, -1] ** 2) - np.sum(restricted[:, -1] ** 2))
        return squares, self.rows - square_root_information.rank(restricted)

    @cached_property
    def _model_columns(self) -> list[int]:
        """Numbers of the columns of the current model among all."""
        parts, count = self.linearised.model.parts, len(self.about)
        return [*range(STATE_COUNT), *(k for name in self.inside for k in range(*parts[name].indices(count)))]

    def _update(self, rows: Floats, walked: Floats) -> Running:
        """Return the filter after an update with whitened rows and the variances of a random walk before them."""
        factor, left = square_root_information.update(self.factor, rows, walked)
        return replace(self, factor=factor, left=self.left + left, rows=self.rows + len(rows))

    def _rebuild(self) -> Running:
        """Return the same filter with its factor built again from all dwells."""
        factor = square_root_information.start(self.prior, self.linearised.model)
        factor[:, -1] -= factor[:, :-1] @ self.about
        variances = steps(self.dwells, self.noise)
        running = replace(self, factor=factor, left=0.0, rows=0)
        for k, variance in enumerate(variances):  # the rows of all dwells together would take much memory
            running = running._update(self._rows([k])[0], variance)
        return running

    def _rows(self, chosen: Sequence[int] | None = None) -> Sequence[Floats]:
        """Return the whitened rows of all dwells, or of those chosen."""
        chosen = range(len(self.dwells)) if chosen is None else chosen
        dwells, columns = (
            [self.linearised.dwells_at_state[k] for k in chosen],
            [self.linearised.columns[k] for k in chosen],
        )
        return whitened_rows.whiten(dwells, columns, self.noise.weights, self.about, self.about)
