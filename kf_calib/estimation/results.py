"""What a calibration gives: parameters, the course of the estimate, consistency."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from threadpoolctl import threadpool_limits

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats, Mask
from kf_calib.bench.bench import Bench
from kf_calib.dwells.blocks import Tally
from kf_calib.dwells.sufficient_statistics import DwellFactor
from kf_calib.estimation import square_root_information
from kf_calib.estimation.cross_validation import HeldOut, held_out
from kf_calib.estimation.dwell_columns import Carried, columns_of, means_of
from kf_calib.estimation.fit import WALK, Fit
from kf_calib.estimation.measurement_model import STATE_COUNT, Model
from kf_calib.estimation.noise_model import Noise, considered_information, steps
from kf_calib.estimation.score_test import Frame
from kf_calib.estimation.settings import Settings
from kf_calib.estimation.signal_quality import Readings
from kf_calib.support.printing import printed
from kf_calib.support.tail_probabilities import f_tail

_HOPELESS = {"rad": np.radians(10.0), "1": 0.2, "m/s^2": 2.0}  # a larger sigma means: not seen by this run
_SHOWN = {"rad": ("arcsec", math.degrees(3600.0)), "1": ("ppm", 1e6), "m/s^2": ("m/s^2", 1.0)}


@dataclass(frozen=True)
class Parameter:
    """An estimate with its sigma in SI units; value and sigma are None where the orientations cannot see it.

    Deviations times ``per_si`` are in ``shown_unit``, the unit of the field.
    """

    symbol: str
    value: float | None
    sigma: float | None
    unit: str
    nominal: float
    shown_unit: str
    per_si: float


@dataclass(frozen=True)
class Estimate:
    """State (p,): the affine twelve, then effects; its covariance; basis (p, q) of the combinations not determined."""

    state: Floats
    covariance: Floats
    undetermined: Floats

    @cached_property
    def parameters(self) -> Floats:
        """The paper's parameters (12,)."""
        return paper_parameters.parameters_of(self.state[:STATE_COUNT])

    @cached_property
    def parameter_covariance(self) -> Floats:
        """Their covariance (12, 12), carried over by the closed-form Jacobian."""
        jacobian = paper_parameters.jacobian(self.state[:STATE_COUNT])
        return jacobian @ self.covariance[:STATE_COUNT, :STATE_COUNT] @ jacobian.T

    @cached_property
    def unseen(self) -> Mask:
        """Which of the twelve the orientations do not determine, (12,) bool."""
        sigma = np.sqrt(np.diag(self.parameter_covariance))
        unseen = sigma > np.array([_HOPELESS[unit] for unit in paper_parameters.UNITS])
        if self.undetermined.size:
            jacobian = paper_parameters.jacobian(self.state[:STATE_COUNT])
            unseen |= np.linalg.norm(jacobian @ self._lost[:STATE_COUNT], axis=1) > 1e-6
        return np.asarray(unseen)

    @cached_property
    def _lost(self) -> Floats:
        return self.undetermined / np.linalg.norm(self.undetermined, axis=0)

    @cached_property
    def determined(self) -> Mask:
        """Which numbers of the state the orientations determine, (p,) bool."""
        return np.asarray(np.linalg.norm(self._lost, axis=1) < 1e-9)

    @cached_property
    def sigma(self) -> Floats:
        """1 sigma of the twelve (12,); NaN where not determined."""
        return np.where(self.unseen, np.nan, np.sqrt(np.diag(self.parameter_covariance)))

    @cached_property
    def effects(self) -> Floats:
        """Coefficients of the effects (q,)."""
        return self.state[STATE_COUNT:]

    @cached_property
    def effect_sigma(self) -> Floats:
        """1 sigma of the coefficients (q,); NaN where not determined."""
        sigma = np.sqrt(np.diag(self.covariance)[STATE_COUNT:])
        if self.undetermined.size:
            lost = np.abs(self.undetermined[STATE_COUNT:]).max(axis=1)
            largest = np.abs(self.undetermined).max()
            sigma = np.where(lost > 1e-9 * largest, np.nan, sigma)
        return sigma


@dataclass(frozen=True)
class Visit:
    """One dwell as the filter saw it; the estimate is the one after it.

    innovation_mps2 (3,) is the dwell's mean reading less its prediction from the dwells before, with its sigma
    (NaN while the prediction is undetermined); residual_mps2 (3,) is against the final estimate. dof may be 0.
    """

    dwell: DwellFactor
    estimate: Estimate
    nis: float
    dof: int
    innovation_mps2: Floats
    innovation_sigma_mps2: Floats
    residual_mps2: Floats


@dataclass(frozen=True)
class Consistency:
    """Do the dwells agree with the model within the noise? None where nothing is left over to judge by.

    The statistic is the sum of the normalised innovations squared, chi-squared with ``dof`` (F with ``noise_dof`` where
    the noise itself was estimated from few readings). Scatter that was estimated from the same misfit is left out.
    """

    statistic: float
    dof: int
    p_value: float | None
    consistent: bool | None

    @property
    def nis_per_dof(self) -> float | None:
        return self.statistic / self.dof if self.dof > 0 else None


@dataclass(frozen=True)
class Turn:
    """A gimbal (from 0) that explains a dwell's readings at another angle: as it was recorded and as it would be."""

    gimbal: int
    axis: str
    recorded_deg: float
    mended_deg: float
    sigma_deg: float

    def __str__(self) -> str:
        digits = min(max(1 - math.floor(math.log10(max(self.sigma_deg, 1e-6))), 0), 5)
        mended, recorded = (f"{angle:.{digits}f}" for angle in (self.mended_deg, self.recorded_deg))
        return f"gimbal {self.axis} stood at {mended} ± {self.sigma_deg:.1g} deg, not at {recorded}"


@dataclass(frozen=True)
class OutlyingDwell:
    """A dwell and what it is off by, mean reading less prediction (3,); p_value: of the run. turns: of single gimbals,
    that explain it; without: the calibration from all other dwells, which agrees with itself."""

    dwell: DwellFactor
    number: int
    error_mps2: Floats
    p_value: float
    turns: tuple[Turn, ...]
    without: Calibration

    def __str__(self) -> str:
        pose = self.dwell.recorded_pose
        axes = self.without.bench.axes
        at = f" (recorded at {', '.join(f'{angle:.4g}' for angle in np.degrees(pose))} deg)" if axes else ""
        size = float(np.linalg.norm(self.error_mps2))
        told = f"dwell {self.number}{at} alone does not fit: it is off by {size:.2g} m/s^2"
        if self.turns:
            told += f", as if {' or '.join(map(str, self.turns))}"
        elif axes:
            told += ", which no turn of one gimbal explains"
        p_value = self.without.consistency.p_value
        agrees = "" if p_value is None else f" (p = {p_value:.2g})"
        return f"{told}; without it model and measurements agree{agrees}: --leave-out {self.number}."


@dataclass(frozen=True)
class Calibration:
    """The result of a run."""

    bench: Bench
    settings: Settings
    fit: Fit
    visits: tuple[Visit, ...]
    estimate: Estimate
    consistency: Consistency
    residual_rms_mps2: float
    tally: Tally
    warnings: tuple[str, ...]
    reread: Callable[..., Calibration] | None = field(default=None, repr=False, compare=False)
    """The same source evaluated anew: for models that need its readings folded otherwise."""
    readings: Readings = field(default_factory=Readings)
    """What the readings themselves show, whatever the model."""
    outlying: tuple[OutlyingDwell, ...] = ()
    """The dwell that alone does not fit, or those of which any one could be it."""
    frames: list[Frame] = field(default_factory=list[Frame], repr=False, compare=False)
    """The candidates' columns, kept for all models of the run."""

    @cached_property
    def refits(self) -> dict[tuple[str, ...], Calibration]:
        """The models that were asked for (``refitted``), by their effects: none is fitted twice."""
        return {}

    @cached_property
    def held_out(self) -> HeldOut | None:
        """What each orientation is predicted to read by a fit without it; None where there are too few."""
        with threadpool_limits(1, user_api="blas"):  # small decompositions
            return held_out(self.fit)

    @property
    def held_out_rms_mps2(self) -> float | None:
        """Rms error of the mean readings of orientations that were left out."""
        return None if self.held_out is None else self.held_out.rms_mps2

    @property
    def held_out_floor_mps2(self) -> float | None:
        """What noise alone would give."""
        return None if self.held_out is None else self.held_out.floor_mps2

    @property
    def noise(self) -> Noise:
        return self.fit.noise

    @property
    def carried(self) -> Carried:
        return self.fit.carried

    @property
    def model(self) -> Model:
        return self.carried.model

    @property
    def parameters(self) -> dict[str, Parameter]:
        """The twelve parameters, then the effects' coefficients, by symbol."""
        estimate, nominal = self.estimate, paper_parameters.nominal(self.bench.nominal)
        coefficients, (effects, gains) = self.model.coefficients, self.model.natural(self.estimate.state)
        sigmas = estimate.effect_sigma * gains
        sigmas = np.where((gains != 1.0) & (sigmas > effects), np.nan, sigmas)  # a constant not known within itself
        found = [
            *zip(
                paper_parameters.SYMBOLS,
                estimate.parameters,
                estimate.sigma,
                nominal,
                paper_parameters.UNITS,
                strict=True,
            ),
            *((c.symbol, *own, 0.0, c.unit) for c, *own in zip(coefficients, effects, sigmas, strict=True)),
        ]
        shown = [*(_SHOWN[unit] for unit in paper_parameters.UNITS), *((c.shown_unit, c.per_si) for c in coefficients)]
        if self.model.walks:
            intensity, spread = self.noise.walk_mps2_per_sqrt_s, self.noise.walk_spread
            found.append((WALK.symbol, intensity, intensity * spread if spread else math.nan, 0.0, WALK.unit))
            shown.append((WALK.shown_unit, WALK.per_si))
        for effect in self.model.stepped:
            assert effect.unknown is not None
            constant, spread = effect.unknown, self.fit.spreads[str(effect)]
            sigma = effect.value * spread if spread < 1.0 else math.nan  # not known within itself
            found.append((constant.symbol, effect.value, sigma, 0.0, constant.unit))
            shown.append((constant.shown_unit, constant.per_si))
        return {
            symbol: Parameter(
                symbol,
                float(value) if np.isfinite(sigma) else None,
                float(sigma) if np.isfinite(sigma) else None,
                unit,
                float(expected),
                *own,
            )
            for (symbol, value, sigma, expected, unit), own in zip(found, shown, strict=True)
        }

    @property
    def residuals_mps2(self) -> Floats:
        """Mean readings of the dwells less the final estimate, (D, 3)."""
        return np.array([visit.residual_mps2 for visit in self.visits])

    def considering(self, state: Floats, covariance: Floats) -> Estimate:
        """Another engine's state and covariance, the latter enlarged by what is considered only."""
        extra = (
            considered_information(self.noise, self.carried.means, self.carried.state).sum(axis=0) + self.fit.considered
        )
        return Estimate(state, covariance + covariance @ extra @ covariance, self.estimate.undetermined)

    def __str__(self) -> str:
        return printed(self)

    def __repr__(self) -> str:  # of all arrays in it, it would be megabytes
        return f"<Calibration: {self.model.sum}, {len(self.visits)} dwells, p {format_p(self.consistency.p_value)}>"

    def trace(self) -> Iterator[tuple[float, int, Estimate]]:
        """(elapsed_s, number of the dwell, estimate) within and after every dwell: after a second, two, four ..."""
        model, state, around = self.model, self.carried.state, self.model.nominal_state()
        factor = square_root_information.start(self.settings.prior, model)
        extra = np.zeros((model.count, model.count))
        for index, (dwell, columns, (pause, _)) in enumerate(
            zip(self.carried.dwells, self.carried.columns, self.fit.steps, strict=True)
        ):
            before, extra_before = factor, extra
            for part in dwell.prefixes():
                own = [columns[: len(part.pieces)]]
                rows = square_root_information.whiten([part], own, self.noise.weights, state)[0]
                walked = np.array([pause, steps([part], self.noise)[0, 1]])
                factor, _ = square_root_information.update(before, rows, walked)
                extra = extra_before + considered_information(self.noise, means_of([part], own), state)[0]
                yield part.end_s, dwell.number, estimate_of(factor, around, extra)
            if len(self.fit.following[index]):
                factor, _ = square_root_information.update(factor, self.fit.following[index])

    def during(self, dwell: DwellFactor) -> Estimate:
        """The estimate were a dwell that follows the run, and is not in it yet, to end as it is now."""
        fitted, (factor, extra) = self.fit, self.reached
        both, state = [fitted.dwells[-1], dwell], self.carried.state
        own = columns_of(both, self.model, state)[1:]
        rows = square_root_information.whiten([dwell], own, self.noise.weights, state)[0]
        factor, _ = square_root_information.update(factor, rows, steps(both, self.noise)[-1])
        extra = extra + considered_information(self.noise, means_of([dwell], own), state)[0]
        return estimate_of(factor, self.model.nominal_state(), extra)

    @cached_property
    def reached(self) -> tuple[Floats, Floats]:
        """The filter's factor after the last dwell, and what is considered only, as in the covariance."""
        fitted, first = self.fit, square_root_information.start(self.settings.prior, self.model)
        last = square_root_information.run(first, fitted.rows(), fitted.steps, fitted.following)[-1]
        extra = considered_information(self.noise, self.carried.means, self.carried.state)
        return last.factor, extra.sum(axis=0) + fitted.considered


def estimate_of(factor: Floats, nominal_state: Floats, extra: Floats) -> Estimate:
    """The estimate of a factor, its covariance P enlarged by what is considered: P + P B P, B = ``extra`` (12, 12)."""
    return estimates(factor[None], nominal_state, extra)[0]


def estimates(factors: Floats, nominal_state: Floats, extra: Floats) -> list[Estimate]:
    """The same of many factors (n, p, p + 1), ``extra`` (n, p, p)."""
    states, covariances, undetermined = zip(*square_root_information.solve_all(factors, nominal_state), strict=True)
    covariance = np.array(covariances)
    covariance = covariance + covariance @ extra @ covariance
    return [Estimate(*each) for each in zip(states, covariance, undetermined, strict=True)]


def consistency(fitted: Fit) -> Consistency:
    """Whether the dwells agree with the fitted model within the noise it is judged by."""
    noise, dwells, rows = fitted.noise, fitted.dwells, fitted.judged
    upper = square_root_information.accumulate(rows, fitted.steps)
    statistic = float(upper[-1, -1] ** 2)
    dof = sum(square_root_information.row_rank(own) for own in rows) - square_root_information.rank(upper[:-1])
    dof -= int(not noise.setting_stated and noise.setting_rad > 0)
    if dof <= 0:
        return Consistency(statistic, 0, None, None)
    noise_dof = float(sum(max(dwell.count - 4, 1) for dwell in dwells) / noise.inflation.mean())
    p_value = f_tail(dof, max(noise_dof, 1.0), statistic / dof)
    return Consistency(statistic, dof, p_value, p_value >= 0.01)


def format_p(p_value: float | None) -> str:
    """``= 0.034``, or a bound where the number has underflowed."""
    return "= -" if p_value is None else "< 1e-300" if p_value < 1e-300 else f"= {p_value:.2g}"
