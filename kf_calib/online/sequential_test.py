"""Sequential test of a run: after every dwell, whether the model still agrees and which effects seem to be missing.

A test after every dwell is repeated many times, and would cross a fixed level by chance far more often than a single
test. The false-alarm probability is therefore spent: the k-th test has 1/(k (k + 1)) of it, so that all tests together
have no more than a single run. A test is one update of a factor and one projection. Noise, linearisation and threshold
are computed again whenever the run has grown by a quarter. The cause of an alarm is found by ``diagnose``, from the
same dwells.

    sequential = SequentialTest.over(dwells, bench)
    sequential = sequential.after(dwell)        # as each dwell closes
    sequential.alarmed, sequential.p_value, sequential.suspects

The filter carries the columns of more effects than its model has. The estimate of the model is one small QR
(``square_root_information.restrict``), and equals that of a filter without the other columns. So is the test of every
effect that is carried but not in the model. A dwell that closes is one update of the square-root information factor.

    recursive = RecursiveTest.over(dwells, model, noise, state, candidates)
    recursive = recursive.after(dwell)               # as each dwell closes
    state, covariance, undetermined = recursive.solved()
    recursive.scan.statistics                      # fall of chi-squared by each candidate

The noise and the linearisation are those given. A constant inside the columns of an effect keeps its value, and
effects that show in slews only are not supported. ``calibrate`` iterates or estimates all of these.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from kf_calib.bench.arrays import Floats, one_blas_thread
from kf_calib.bench.bench import Bench
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.diagnosis.candidate_tests import candidates, critical_delta_chi2, independent_tests
from kf_calib.dwells.qr import triangle
from kf_calib.dwells.sufficient_statistics import Dwell
from kf_calib.dwells.table import DwellTable
from kf_calib.effects import Effect
from kf_calib.estimation import square_root_information, whitened_rows
from kf_calib.estimation.attitude import at_its_mode, linearised_at
from kf_calib.estimation.candidate_scan import Scan, project
from kf_calib.estimation.dwell_columns import LinearisedDwells
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.iterated_fit import fit
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.settings import Prior, Settings
from kf_calib.estimation.within_dwell_trend import Trend, trend_beside, unless_lines_make_it
from kf_calib.noise.noise_model import Noise, steps
from kf_calib.noise.terms import SlowWaves
from kf_calib.support.tail_probabilities import LEVEL, REST, SHARE, sidak


@dataclass(frozen=True)
class RecursiveTest:
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
        dwells: DwellTable,
        model: Model,
        noise: Noise,
        state: Floats,
        candidates: Iterable[Effect] = (),
        prior: Prior | None = None,
    ) -> RecursiveTest:
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
    def dwells(self) -> DwellTable:
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

    def after(self, dwell: Dwell | DwellTable, exact: bool = True, like: DwellTable | None = None) -> RecursiveTest:
        """The filter after one more dwell.

        It is one update, unless the dwell changes what is known of the conditions in earlier dwells; then the factor is
        built again. dwell: it, or a table of it alone. exact: False leaves earlier dwells as they were known when they
        closed. like: all of these dwells, where they are a table already.
        """
        dwell = at_its_mode(DwellTable.of(dwell), self.linearised, self.noise.weights)
        if exact:
            linearised = LinearisedDwells(self.dwells.beside(dwell), self.linearised.model, self.about)
            if not all(map(np.array_equal, self.linearised.columns, linearised.columns[:-1])):
                return replace(self, linearised=linearised)._rebuild()
        else:
            linearised = self.linearised.followed_by(dwell, like)
        more = replace(self, linearised=linearised)
        return more._update(more._rows([-1])[0], steps(linearised.dwells, self.noise)[-1])

    def lean(self) -> RecursiveTest:
        """The same filter without the columns of candidates in its dwells, which fill the memory in a long run. It can
        go on with ``exact=False`` only."""
        width = self.model.count
        columns = [own if own.shape[-1] == width else own[..., :width].copy() for own in self.linearised.columns]
        return replace(self, linearised=self.linearised.with_columns(columns))

    def solved(self) -> tuple[Floats, Floats, Floats]:
        """State (p,) of the model, its covariance (p, p), and a basis (p, q) of the combinations not determined."""
        kept = self._model_columns
        around = self.model.nominal_state() - self.about[kept]
        restricted = square_root_information.restrict(self.factor, kept)
        moved, covariance, undetermined = square_root_information.solve(restricted, around)
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

    def _update(self, rows: Floats, walked: Floats) -> RecursiveTest:
        """Return the filter after an update with whitened rows and the variances of a random walk before them."""
        factor, left = square_root_information.update(self.factor, rows, walked)
        return replace(self, factor=factor, left=self.left + left, rows=self.rows + len(rows))

    def _rebuild(self) -> RecursiveTest:
        """Return the same filter with its factor built again from all dwells."""
        factor = square_root_information.start(self.prior, self.linearised.model)
        factor[:, -1] -= factor[:, :-1] @ self.about
        variances = steps(self.dwells, self.noise)
        recursive = replace(self, factor=factor, left=0.0, rows=0)
        for first in range(0, len(variances), _TOGETHER):
            part = range(first, min(first + _TOGETHER, len(variances)))
            for k, rows in zip(part, self._rows(part), strict=True):
                recursive = recursive._update(rows, variances[k])
        return recursive

    def _rows(self, chosen: Sequence[int] | None = None) -> Sequence[Floats]:
        """Return the whitened rows of all dwells, or of those chosen."""
        chosen = range(len(self.dwells)) if chosen is None else chosen
        dwells, columns = self.linearised.dwells_at_state.take(chosen), [self.linearised.columns[k] for k in chosen]
        return whitened_rows.whiten(dwells, columns, self.noise.weights, self.about, self.about)


_GROWN = 1.25
_TOGETHER = 16  # dwells whose rows are whitened together: those of a long run would take much memory
_FEWEST = 4
"""Number of dwells with which a sequential test can begin: fewer cannot determine scale factors and misalignments."""


@dataclass(frozen=True)
class SequentialTest:
    """The sequential test of a run; every dwell gives a new one.

    recursive: filter that carries the columns of the candidates. fitted_at: number of dwells when noise and threshold
    were computed. tests: effective number of independent tests among the candidates. looks: number of tests so far.
    alarmed: number of dwells after which the level was first crossed (None: never).
    """

    bench: Bench
    settings: Settings
    recursive: RecursiveTest
    fitted_at: int
    tests: float
    looks: int = 0
    alarmed: int | None = None

    @classmethod
    def over(
        cls,
        dwells: DwellTable,
        bench: Bench,
        settings: Settings | None = None,
        looks: int = 0,
        fitted: Fit | None = None,
    ) -> SequentialTest:
        """The sequential test after the first dwells, at least four, which count as one test.

        settings: of the calibration. looks: number of tests made before with another model. fitted: the model fitted to
        these dwells, where it is known. Raises ValueError for fewer than four dwells.
        """
        settings = settings or Settings()
        if len(dwells) < _FEWEST:
            raise ValueError(f"a sequential test begins with {_FEWEST} dwells, not {len(dwells)}")
        with one_blas_thread():
            return cls(bench, settings, *_begun(dwells, bench, settings, fitted), looks)._tested()

    def after(
        self, dwell: Dwell | DwellTable, fitted: Fit | None = None, dwells: DwellTable | None = None
    ) -> SequentialTest:
        """The sequential test after one more dwell, or a table of it alone.

        fitted: the model fitted to all dwells, this one included, where it is known. dwells: all of them, where pieces
        of earlier ones may have been merged since.
        """
        with one_blas_thread():
            like = None if fitted is None else fitted.dwells
            recursive = self.recursive.after(dwell, exact=False, like=like).lean()
            if len(recursive.dwells) < _GROWN * self.fitted_at:  # else it is built again
                return replace(self, recursive=recursive)._tested()
            recursive, fitted_at, tests = _begun(dwells or recursive.dwells, self.bench, self.settings, fitted)
            return replace(self, recursive=recursive, fitted_at=fitted_at, tests=tests)._tested()

    @property
    def dwells(self) -> DwellTable:
        """The dwells so far."""
        return self.recursive.dwells

    @cached_property
    def p_value(self) -> float | None:
        """The p-value of the latest test alone: the smallest of misfit, candidates and trends, as in ``diagnose``.

        None where nothing is left to judge by.
        """
        from scipy.special import chdtrc

        statistic, dof = self.recursive.misfit
        if dof <= 0:
            return None
        scan = self.recursive.scan
        own = [float(chdtrc(c.dof, x)) for c, x in zip(scan.candidates, scan.statistics, strict=True) if c.dof]
        p_values = [float(chdtrc(dof, statistic)), *([sidak(min(own), self.tests)] if own else [])]
        going = self.trend
        p_values += [going.p_value * SHARE / REST] if going else []
        return min(1.0, min(p_values) / SHARE)

    @cached_property
    def trend(self) -> Trend | None:
        """The test of trends within dwells; None where spectral lines would give trends as well."""
        going = trend_beside(self.recursive.linearised, self.recursive.noise, self.recursive.state)
        return unless_lines_make_it(going, self.dwells)

    @property
    def suspects(self) -> list[str]:
        """Names of the effects that are significant in the latest test, the one with the highest score first."""
        scan = self.recursive.scan
        scores = {
            str(each.effect): float(delta_chi2) - critical_delta_chi2(each, self.tests)
            for each, delta_chi2 in zip(scan.candidates, scan.statistics, strict=True)
            if each.dof
        }
        return sorted((name for name, score in scores.items() if score > 0), key=lambda name: -scores[name])

    def _tested(self) -> SequentialTest:
        """Return the sequential test after a test, at the level that is spent on it."""
        if self.p_value is None:
            return self
        looks = self.looks + 1
        crossed = self.p_value < LEVEL / (looks * (looks + 1))
        alarmed = len(self.dwells) if crossed and self.alarmed is None else self.alarmed
        looked = replace(self, looks=looks, alarmed=alarmed)
        looked.__dict__.update({name: vars(self)[name] for name in ("p_value", "trend") if name in vars(self)})
        return looked


def _begun(
    dwells: DwellTable, bench: Bench, settings: Settings, fitted: Fit | None
) -> tuple[RecursiveTest, int, float]:
    """Return the filter with noise and linearisation from the dwells so far, their number, and the effective tests."""
    if fitted is None or fitted.linearised.slews or len(fitted.dwells) != len(dwells):
        fitted = fit(dwells, Model.of(bench, settings.effects), settings.walk_mps2_per_sqrt_s)
    noise = fitted.noise.for_goodness_of_fit.without(SlowWaves)
    noise = noise.with_terms(replace(noise.setting, considered=False))  # a test of the misfit allows for all of it
    model, state = fitted.linearised.model, fitted.linearised.state
    recursive = RecursiveTest.over(dwells, model, noise, state, _effects_to_watch(fitted)).lean()
    return recursive, len(dwells), independent_tests(recursive.scan)


def _effects_to_watch(fitted: Fit) -> list[Effect]:
    """Return one candidate of each effect; an unknown constant has the middle value of its grid."""
    first = dict[str, list[Effect]]()
    for effect in candidates(fitted.linearised.model):
        first.setdefault(str(effect), []).append(effect)
    return [own[len(own) // 2] for own in first.values()]
