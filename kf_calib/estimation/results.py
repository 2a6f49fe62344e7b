"""The results of a calibration: parameters, the estimate after each dwell, and the test of consistency."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats, one_blas_thread
from kf_calib.bench.bench import Bench
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.dwells.blocks import SampleCounts
from kf_calib.dwells.sufficient_statistics import Dwell
from kf_calib.dwells.table import DwellTable
from kf_calib.effects.drift import WarmUp
from kf_calib.estimation import square_root_information, whitened_rows
from kf_calib.estimation.attitude import at_its_mode
from kf_calib.estimation.correction import Corrected, Correction
from kf_calib.estimation.cross_validation import HeldOut, held_out
from kf_calib.estimation.dwell_columns import LinearisedDwells
from kf_calib.estimation.estimate import Estimate, Parameter, Parameters, enlarged, estimate_of
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.intervals import NORMAL, sigmas_of_intervals
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.residual_table import residual_table, table_as
from kf_calib.estimation.settings import Settings
from kf_calib.estimation.signal_quality import Readings
from kf_calib.estimation.within_dwell_trend import Trend, trend, unless_lines_make_it
from kf_calib.noise.means import means_of
from kf_calib.noise.noise_model import Noise, considered_information, steps
from kf_calib.noise.terms import ATTITUDE_UNKNOWN_RAD, SettingError
from kf_calib.support.tail_probabilities import LEVEL, NO_CHANCE, f_tail
from kf_calib.support.text import as_html, printed
from kf_calib.support.units import field_unit, shown

_WEAK = 5.0  # times the size that a coefficient may well have


@dataclass(frozen=True)
class Visit:
    """One dwell and the filter's step on it.

    - estimate: the estimate after the dwell.
    - nis, dof: the normalised innovation squared and its degrees of freedom, which may be 0.
    - innovation_mps2 (3,), innovation_sigma_mps2 (3,): the mean reading less its prediction from the dwells before, and
      its sigma; NaN while the prediction is not determined.
    - residual_mps2 (3,): the mean reading less its prediction by the final estimate.
    """

    dwell: Dwell
    estimate: Estimate
    nis: float
    dof: int
    innovation_mps2: Floats
    innovation_sigma_mps2: Floats
    residual_mps2: Floats


@dataclass(frozen=True)
class Condition:
    """What was not stated of a bench, and was estimated from the misfit that it explains: the key that states it, its
    size and unit."""

    name: str
    value: float
    unit: str

    def __str__(self) -> str:
        """What has to be true of the bench, after "if"."""
        if self.name == "angle_sigma_deg":
            angle = shown("rad")
            return f"your table sets angles no better than {angle.text(math.radians(self.value), 2)}"
        return f"your dwells scatter by {shown('m/s^2').text(self.value, 2)}"


@dataclass(frozen=True)
class Consistency:
    """A test of whether the dwells agree with the model within the noise.

    The statistic is the sum of the normalised innovations squared, chi-squared distributed with ``dof`` degrees of
    freedom; its quotient by ``dof`` is tested against an F distribution, because the noise itself was estimated from
    finitely many readings. Scatter that was estimated from the same misfit is left out. ``p_value`` and ``consistent``
    are None if there are no degrees of freedom, or if all of the noise was estimated from the misfit. condition: what
    was estimated from the misfit, without which they would not agree; None where nothing was. trend: of the readings
    within dwells, where it is this that does not agree and ``p_value`` is that of it, by its share; else None. quiet:
    whether the dwells differ by so much less than the noise that it cannot be as large.
    """

    statistic: float
    dof: int
    p_value: float | None
    consistent: bool | None
    condition: Condition | None = None
    trend: Trend | None = None
    quiet: bool = False

    @property
    def unconditional(self) -> bool | None:
        """Whether they agree; None where that rests on what was not stated, too."""
        return None if self.consistent and self.condition else self.consistent

    @property
    def nis_per_dof(self) -> float | None:
        """The statistic divided by its degrees of freedom; None if there are none."""
        return self.statistic / self.dof if self.dof > 0 else None


@dataclass(frozen=True)
class Turn:
    """A gimbal (numbered from 0) whose angle, if corrected, explains a dwell's readings: its recorded and its corrected
    angle."""

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
    """A dwell that does not fit the others.

    - error_mps2 (3,): its mean reading less its prediction.
    - p_value: the p-value over all dwells of the run.
    - turns: corrections of one gimbal's angle, each of which explains it.
    - without: the calibration from all other dwells, which is consistent.
    """

    dwell: Dwell
    number: int
    error_mps2: Floats
    p_value: float
    turns: tuple[Turn, ...]
    without: Calibration

    def __str__(self) -> str:
        pose = self.dwell.recorded_pose
        axes = self.without.bench.axes
        at = f" (recorded at {', '.join(f'{angle:.4g}' for angle in np.degrees(pose))} deg)" if axes else ""
        error_mps2 = float(np.linalg.norm(self.error_mps2))
        told = f"dwell {self.number}{at} alone does not fit: it is off by {shown('m/s^2').text(error_mps2, 2)}"
        causes = list(map(str, self.turns))
        if self.number < self.without.fit.dwells[0].number and error_mps2 < max(WarmUp.typical.mems or (0.0,)):
            causes.append("the block was still warming up")
        if causes:
            told += f", as if {' or '.join(causes)}"
        elif axes:
            told += ", which no turn of one gimbal explains"
        p_value = self.without.consistency.p_value
        agrees = "" if p_value is None else f" (p {format_p(p_value)})"
        return f"{told}; without it model and measurements agree{agrees}: --leave-out {self.number}."


@dataclass(frozen=True)
class Calibration:
    """The result of a run: the fit, the estimate after each dwell and at the end, and the tests of the model."""

    bench: Bench
    settings: Settings
    fit: Fit
    visits: Sequence[Visit]
    estimate: Estimate
    consistency: Consistency
    residual_rms_mps2: float
    counts: SampleCounts
    warnings: tuple[str, ...]
    readings: Readings = field(default_factory=Readings)
    """Defects of the readings, found independently of the model."""
    outlying: tuple[OutlyingDwell, ...] = ()
    """The dwell that alone does not fit, or several if any one of them could be the cause."""

    @cached_property
    def fixed(self) -> dict[str, Literal["frame", "square"]]:
        """Parameters that are not estimated because no angles are used, and what fixes each: the ``frame`` of the
        sensors, or axes that are taken for ``square``."""
        if self.bench.angles:
            return {}
        fixed: dict[str, Literal["frame", "square"]] = {"theta1": "frame", "phi1": "frame", "nu2": "frame"}
        for angle in self.model.square:
            fixed[angle] = "square"
        return fixed

    @cached_property
    def held_out(self) -> HeldOut | None:
        """The predictions of each orientation by a fit to all others; None if there are too few orientations."""
        with one_blas_thread():
            return held_out(self.fit)

    @property
    def held_out_rms_mps2(self) -> float | None:
        """Held-out error: the rms of mean readings less their prediction by a fit without their orientation, m/s^2."""
        return None if self.held_out is None else self.held_out.rms_mps2

    @property
    def held_out_floor_mps2(self) -> float | None:
        """Noise floor: the held-out error that noise alone would give, m/s^2."""
        return None if self.held_out is None else self.held_out.floor_mps2

    @property
    def noise(self) -> Noise:
        """The fitted noise model."""
        return self.fit.noise

    @property
    def linearised(self) -> LinearisedDwells:
        """The dwells with the columns of the fitted model."""
        return self.fit.linearised

    @property
    def model(self) -> Model:
        """The fitted model."""
        return self.linearised.model

    @cached_property
    def interval_sigmas(self) -> Floats:
        """Half the lengths (p,) of the intervals of 95 % in units of sigma, of the twelve parameters and the
        coefficients of effects: 1.96, or more where noise that was not stated is known from few dwells only."""
        with one_blas_thread():
            return sigmas_of_intervals(self.fit)

    def aims(self, wanted: Floats) -> Floats:
        """The sigmas (12,) whose intervals are as long as those of ``wanted`` sigmas if all noise were known."""
        return wanted * (NORMAL / self.interval_sigmas[:STATE_COUNT])

    def interval(self, parameter: Parameter) -> tuple[float, float] | tuple[None, None]:
        """The interval of 95 % of a parameter in SI units; None, None where it is not determined."""
        if parameter.value is None or parameter.sigma is None:
            return None, None
        half = self._sigmas_by_symbol.get(parameter.symbol, NORMAL) * parameter.sigma
        return parameter.value - half, parameter.value + half

    @cached_property
    def _sigmas_by_symbol(self) -> dict[str, float]:
        symbols = [*paper_parameters.SYMBOLS, *(coefficient.symbol for coefficient in self.model.coefficients)]
        return dict(zip(symbols, self.interval_sigmas.tolist(), strict=True))

    @property
    def parameters(self) -> Parameters:
        """The twelve parameters, then the coefficients of effects and the constants in them, by symbol."""
        estimate, nominal = self.estimate, paper_parameters.nominal(self.bench.nominal)
        coefficients, (effects, gains) = self.model.coefficients, self.model.natural(self.estimate.state)
        sigmas = estimate.effect_sigma * gains
        sigmas = np.where((gains != 1.0) & (sigmas > effects), np.nan, sigmas)  # not known: sigma over value
        if not self.bench.angles:  # |f| tells of some effects little more than that they are not absurdly large
            scales = np.array([coefficient.scale for coefficient in coefficients])
            weak = (sigmas > _WEAK * scales) & (np.abs(effects) < NORMAL * sigmas)
            sigmas = np.where((gains == 1.0) & weak, np.nan, sigmas)
        rows = [
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
        units = [*map(field_unit, paper_parameters.UNITS), *((c.shown_unit, c.per_si) for c in coefficients)]
        if (walk := self.model.intensity) is not None:
            intensity, spread = self.noise.walk.rms_mps2_per_sqrt_s, self.noise.walk.spread
            rows.append((walk.symbol, intensity, intensity * spread or math.nan, 0.0, walk.unit))
            units.append((walk.shown_unit, walk.per_si))
        for effect in self.model.constants_beside_state:
            assert effect.unknown is not None
            constant, spread = effect.unknown, self.fit.spreads.get(str(effect), math.inf)
            sigma = effect.value * spread if spread < 1.0 else math.nan  # sigma over value
            rows.append((constant.symbol, effect.value, sigma, 0.0, constant.unit))
            units.append((constant.shown_unit, constant.per_si))
        return Parameters(
            Parameter(
                symbol,
                float(value) if np.isfinite(sigma) and symbol not in self.fixed else None,
                float(sigma) if np.isfinite(sigma) and symbol not in self.fixed else None,
                unit,
                float(expected),
                *own,
            )
            for (symbol, value, sigma, expected, unit), own in zip(rows, units, strict=True)
        )

    def residuals(self, kind: Literal["numpy", "pandas", "polars"] = "numpy") -> Any:
        """The residuals as a table with a row for each dwell and accelerometer, and what the bench did there.

        kind: ``numpy`` for a structured array, ``pandas`` or ``polars`` for a DataFrame of that package. Columns are
        those of ``residual_table``, with units in their names.
        """
        return table_as(residual_table(self), kind)

    @property
    def residuals_mps2(self) -> Floats:
        """Residuals (D, 3): mean readings of the dwells less their prediction by the final estimate."""
        means = self.linearised.means
        return np.asarray(means.readings - means.design @ self.estimate.state, float)

    def changed(self, **changes: Any) -> Calibration:
        """The same fit with other remarks on it; what was computed of its dwells is kept."""
        changed = replace(self, **changes)
        changed.__dict__.update({name: self.__dict__[name] for name in ("held_out",) if name in self.__dict__})
        return changed

    @cached_property
    def correction(self) -> Correction:
        """What turns readings into specific force; raises UnobservableError if the run did not determine all of it."""
        return Correction(
            self.bench, self.model, self.estimate.state, self.estimate.covariance, self.noise.sigma_mps2,
            self.undetermined,
        )  # fmt: skip

    def apply(self, raw: Floats, temperature_c: Floats | float | None = None) -> Corrected:
        """Specific force from raw readings (n, 3) as the device sends them (``bench.input``), with its uncertainty.

        temperature_c: of each reading (n,), or of all; needed where an effect of the model depends on it.
        """
        return self.correction.corrected(raw, temperature_c)

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Symbols of the twelve parameters and of the coefficients of effects that the run does not determine; those
        that are fixed are known."""
        states = {*paper_parameters.SYMBOLS, *(each.symbol for each in self.model.coefficients)} - set(self.fixed)
        return tuple(p.symbol for p in self.parameters.values() if p.symbol in states and p.sigma is None)

    def considering(self, state: Floats, covariance: Floats) -> Estimate:
        """The estimate from another engine's state and covariance, with the considered parameters added to the
        covariance."""
        extra = (
            considered_information(self.noise, self.linearised.means, self.linearised.state).sum(axis=0)
            + self.fit.considered
        )
        return Estimate(state, enlarged(covariance, extra), self.estimate.undetermined)

    def __str__(self) -> str:
        return printed(self)

    def _repr_html_(self) -> str | None:
        return as_html(self)

    def __repr__(self) -> str:  # the generated one would print every array, which is megabytes
        return f"<Calibration: {self.model.sum}, {len(self.visits)} dwells, p {format_p(self.consistency.p_value)}>"

    def trace(self) -> Iterator[tuple[float, int, Estimate]]:
        """Yield (elapsed_s, number of the dwell, estimate) several times within each dwell, at growing intervals, and
        at its end."""
        model, state, around = self.model, self.linearised.state, self.model.nominal_state()
        factor = square_root_information.start(self.settings.prior, model)
        extra = np.zeros((model.count, model.count))
        for index, (columns, (pause, _)) in enumerate(zip(self.linearised.columns, self.fit.steps, strict=True)):
            before, extra_before = factor, extra
            for part in self.linearised.dwells_at_state.prefixes(index):
                columns_so_far = [columns[: len(part.folded.pieces)]]
                rows = whitened_rows.whiten(part, columns_so_far, self.noise.weights, state)[0]
                walked = np.array([pause, steps(part, self.noise)[0, 1]])
                factor, _ = square_root_information.update(before, rows, walked)
                extra = extra_before + considered_information(self.noise, means_of(part, columns_so_far), state)[0]
                yield part[0].end_s, part[0].number, estimate_of(factor, around, extra)
            if len(self.fit.following[index]):
                factor, _ = square_root_information.update(factor, self.fit.following[index])

    def during(self, dwell: Dwell) -> Estimate:
        """The estimate as if ``dwell``, which follows the run and is not yet complete, ended now."""
        fitted, (factor, extra) = self.fit, self.reached
        state, last = self.linearised.state, fitted.dwells[-1:]
        both = last.beside(at_its_mode(DwellTable.of([dwell]), self.linearised, self.noise.weights))
        linearised = LinearisedDwells(both, self.model, state)
        here, last_columns = linearised.dwells_at_state[1:], linearised.columns[1:]
        rows = whitened_rows.whiten(here, last_columns, self.noise.weights, state)[0]
        factor, _ = square_root_information.update(factor, rows, steps(both, self.noise)[-1])
        extra = extra + considered_information(self.noise, means_of(here, last_columns), state)[0]
        return estimate_of(factor, self.model.nominal_state(), extra)

    @cached_property
    def reached(self) -> tuple[Floats, Floats]:
        """The filter's factor [R | z] after the last dwell, and the contribution (p, p) of considered parameters."""
        fitted, first = self.fit, square_root_information.start(self.settings.prior, self.model)
        last = square_root_information.run(first, fitted.rows(), fitted.steps, fitted.following)[-1]
        extra = considered_information(self.noise, self.linearised.means, self.linearised.state)
        return last.factor, extra.sum(axis=0) + fitted.considered


def consistency(fitted: Fit) -> Consistency:
    """Test whether the dwells agree with the fitted model within the noise by which the misfit is judged."""
    noise, rows = fitted.noise, fitted.misfit_rows
    upper = square_root_information.accumulate(rows, fitted.steps)
    statistic = float(upper[-1, -1] ** 2)
    dof = square_root_information.row_ranks(rows) - square_root_information.rank(upper[:-1])
    estimated = not noise.setting.stated and noise.for_goodness_of_fit.setting_rad > 0
    dof -= int(estimated)
    if dof <= 0:
        return Consistency(statistic, 0, None, None)
    if not noise.within_seen and not noise.scatter.stated:  # the noise was taken from this misfit
        scatter_mps2 = float(np.sqrt(np.mean(noise.scatter_mps2**2)))
        return Consistency(statistic, dof, None, None, Condition("scatter_sigma_mps2", scatter_mps2, "m/s^2"))
    left, tested = statistic, dof
    if estimated and (along := _dof_along_force(fitted)):
        # What lies across the force has the size of the setting error that was estimated from it: it is as large as
        # its degrees of freedom whatever the model is, and the misfit along the force alone is left to be tested.
        left, tested = max(statistic - (dof - along), 0.0), along
    p_value = f_tail(tested, max(_freedom_of_noise(fitted), 1.0), left / tested)
    condition, known = None, replace(fitted, noise=noise.without_estimates())
    if estimated and p_value >= LEVEL and consistency(known).consistent is False:
        condition = Condition("angle_sigma_deg", math.degrees(noise.setting_rad), "deg")
    return Consistency(statistic, dof, p_value, p_value >= LEVEL, condition, quiet=1.0 - p_value < NO_CHANCE)


def _freedom_of_noise(fitted: Fit) -> float:
    """Return the degrees of freedom of the noise beside which the misfit is judged: n readings tell the variance of
    their mean to a relative variance of (4 kappa - 2) / n, as those of n / (2 kappa - 1) white ones do. Channels in
    which dwells have unequal noise, or share it unequally, know it of each dwell from its own readings alone. The
    reciprocals are averaged."""
    folded, lost = fitted.dwells.folded, 2.0 * fitted.noise.correlation_length - 1.0
    counts, own = np.maximum(folded.counts - 4, 1), (folded.weights != 1.0).any(axis=0)
    own = own | (folded.correlations != folded.correlations[:1]).any(axis=(0, 1))
    return float(1.0 / np.mean(lost * np.where(own, np.mean(1.0 / counts), 1.0 / counts.sum())))


def judged_with_trend(fitted: Fit) -> Consistency:
    """The same, with the test of trends within dwells."""
    judged = consistency(fitted)
    if judged.p_value is None:
        return judged
    going = unless_lines_make_it(trend(fitted), fitted.dwells)
    if going is None or going.run_p >= min(LEVEL, judged.p_value):
        return judged
    return replace(judged, p_value=going.run_p, consistent=False, trend=going)


def _dof_along_force(fitted: Fit) -> int:
    """Return the degrees of freedom of the sizes of the force, which no setting error changes."""
    linearised, noise = (
        fitted.linearised,
        fitted.noise.for_goodness_of_fit.with_terms(SettingError(ATTITUDE_UNKNOWN_RAD, stated=True)),
    )
    rows = whitened_rows.whiten(linearised.dwells_at_state, linearised.columns, noise, linearised.state)
    known = square_root_information.rank(
        square_root_information.accumulate(rows)[:-1][:, -linearised.model.count - 1 :]
    )
    return max(square_root_information.row_ranks(rows) - known, 0)


def format_p(p_value: float | None) -> str:
    """Format a p-value as ``= 0.034``, or as a bound if it has underflowed."""
    return "= -" if p_value is None else "< 1e-300" if p_value < 1e-300 else f"= {p_value:.2g}"
