"""The uncertainty budget of the twelve parameters, as the GUM has it (JCGM 100).

Type A is the covariance of the filter. Type B is what the readings cannot show: an error of the bench that is the same,
or has the same spread, in every run. With the change c_d of the mean readings of dwell d per unit of the error, and the
gain of weighted least squares

    G = (sum_d H_d^T R_d^-1 H_d)^-1 [H_1^T R_1^-1, H_2^T R_2^-1, ...]

the state changes by sum_d G_d c_d per unit, and the parameters by J times that, J = d parameters / d state. An error
that is drawn anew in each dwell gives the root of the sum of the squares instead. H, R and c are computed from the
gimbal angles, noise and state that a calibration file holds.

What a certificate says rests on it: results with expanded uncertainty, conformity, and all that the laboratory has
stated. Nothing here is made up: what is neither in the calibration nor in the statement is None, and is shown as not
stated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import date, datetime, timedelta
from typing import Literal

import numpy as np

from kf_calib import effects
from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.certificate.intrinsic import SYMBOLS, UNITS, intrinsic
from kf_calib.certificate.statement import DIVISORS, Rule, Statement, TypeB
from kf_calib.effects import Coefficient, Effect, Stimulus
from kf_calib.effects.stimulus import REFERENCE_TEMPERATURE_C
from kf_calib.errors import InputError
from kf_calib.estimation.measurement_model import Model
from kf_calib.exchange import calibration_file
from kf_calib.exchange.calibration_file import SavedCalibration, SavedParameter
from kf_calib.noise.means import Means
from kf_calib.noise.noise_model import Noise, lift_rounding, mean_covariances
from kf_calib.noise.terms import Scatter, SettingError
from kf_calib.support.text import parse_date
from kf_calib.support.units import quantity

COVERAGE = math.erf(math.sqrt(2.0))
"""Probability of the expanded uncertainty: 95.45 %, for which k is 2 at infinitely many degrees of freedom."""


@dataclass(frozen=True)
class Contribution:
    """One line of the budget.

    name, title: symbol and words. kind: A or B. standard: standard uncertainty of the input quantity in ``unit``, None
    for type A. covariance (12, 12): what it adds to that of the parameters. changes (12, k): change of each parameter
    per unit of it, one column where it is the same in all dwells, one for each where it is drawn anew; None for type A.
    dof: degrees of freedom, may be infinite.
    """

    name: str
    title: str
    kind: str
    standard: float | None
    unit: str
    distribution: str
    dof: float
    source: str | None
    covariance: Floats
    changes: Floats | None = None

    @property
    def parts(self) -> Floats:
        """The contribution (12,) to the standard uncertainty of each parameter."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @property
    def sensitivity(self) -> Floats | None:
        """The change (12,) of each parameter per unit of it; the root of the sum of the squares where it is drawn anew
        in each dwell."""
        if self.changes is None:
            return None
        return self.changes[:, 0] if self.changes.shape[1] == 1 else np.sqrt((self.changes**2).sum(axis=1))


@dataclass(frozen=True)
class Budget:
    """All contributions, and what they give for each of the twelve: combined standard uncertainty, effective degrees of
    freedom (Welch-Satterthwaite), coverage factor k and expanded uncertainty, (12,) each.

    left_out: effects of the model whose columns need more than a calibration file holds.
    """

    contributions: tuple[Contribution, ...]
    left_out: tuple[str, ...] = ()

    @property
    def covariance(self) -> Floats:
        """The covariance (12, 12) of the twelve parameters."""
        return sum((own.covariance for own in self.contributions), np.zeros((STATE_COUNT, STATE_COUNT)))

    @property
    def combined(self) -> Floats:
        """Root of the sum of the squares of the contributions."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @property
    def dof(self) -> Floats:
        """u^4 / sum_i (u_i^4 / nu_i), of Welch and Satterthwaite (GUM G.4.1)."""
        quartics = sum((own.parts**4 / own.dof for own in self.contributions), np.zeros(STATE_COUNT))
        return np.where(quartics > 0.0, self.combined**4 / np.where(quartics > 0.0, quartics, 1.0), np.inf)

    @property
    def k(self) -> Floats:
        """Coverage factors."""
        return coverage_factor(self.dof)

    @property
    def expanded(self) -> Floats:
        """U = k u."""
        return self.k * self.combined


def coverage_factor(dof: Floats) -> Floats:
    """k (n,) of Student's distribution for ``COVERAGE``, the degrees of freedom cut to a whole number (GUM G.6.4)."""
    from scipy.special import stdtrit

    whole = np.maximum(np.floor(dof), 1.0)
    return np.where(np.isinf(dof), 2.0, stdtrit(np.where(np.isinf(dof), 1e12, whole), 0.5 + 0.5 * COVERAGE))


def ellipsoid_factor(count: int, dof: float) -> float:
    """The factor k of an ellipsoid of so many quantities that holds ``COVERAGE`` of them (JCGM 102, 6.5): the root of
    the quantile of chi-squared or, where the size of the covariance has finite degrees of freedom, of n F(n, dof)."""
    from scipy.special import chdtri, fdtri

    if math.isinf(dof):
        return float(np.sqrt(chdtri(count, 1.0 - COVERAGE)))
    return float(np.sqrt(count * fdtri(count, max(math.floor(dof), 1.0), COVERAGE)))


def budget(saved: SavedCalibration, model: Model, stated: Sequence[TypeB]) -> Budget:
    """The budget of a calibration; model: that of it (``saved.model()``). Raises InputError for what cannot be had."""
    first = _type_a(saved)
    if not stated:
        return Budget((first,))
    stimulus = _stimulus(saved)
    kept, left_out = _known_columns(model, stimulus)
    changes = _gain(saved, model.columns(stimulus, np.array(saved.state.values))[:, :, kept], stimulus)
    changes = np.einsum("pq,qdi->pdi", paper_parameters.jacobian(np.array(saved.state.values[:STATE_COUNT])), changes)
    lines = [first]
    for number, uncertainty in enumerate(stated, 1):
        try:
            lines += _type_b(uncertainty, saved, stimulus, changes)
        except InputError as error:
            raise InputError(f"[[uncertainty]] {number}, {uncertainty.effect}: {error}") from None
    return Budget(tuple(lines), left_out)


def _type_a(saved: SavedCalibration) -> Contribution:
    """The filter's covariance; its degrees of freedom are those of the misfit where noise was estimated from it."""
    noise, judged = saved.noise, saved.consistency
    stated = noise.dwell_sigma_stated and noise.angle_sigma_stated
    if not stated and judged.dof < 1:
        raise InputError("the run has as many unknowns as mean readings, so that its noise from dwell to dwell is not "
                         "known: state --angle-sigma-deg and --scatter-sigma, or visit more orientations.")  # fmt: skip
    return Contribution(
        "u_A", "noise of the readings, of the dwells and of the setting of angles", "A", None, "", "normal",
        math.inf if stated else float(judged.dof), "covariance of the filter", saved.twelve[1],
    )  # fmt: skip


def _stimulus(saved: SavedCalibration) -> Stimulus:
    """The state of the bench in the middle of each dwell."""
    bench, dwells = saved.bench, saved.conditions.dwells
    angles = [each.gimbal_deg for each in dwells if each.gimbal_deg is not None]
    if len(angles) < len(dwells):
        raise InputError("the calibration holds no gimbal angles (attitude was recorded), so that errors of the bench "
                         "cannot be carried to the parameters: leave [[uncertainty]] out.")  # fmt: skip
    pose, ends = np.radians(np.array(angles)), np.array([(each.start_s, each.end_s) for each in dwells])
    middle, count = ends.mean(axis=1), len(dwells)
    force, before = bench.specific_force(middle, pose), np.maximum(np.arange(count) - 1, 0)
    warm = saved.conditions.temperature_mean_c
    return Stimulus(
        bench=bench, elapsed_s=middle, since_arrival_s=middle - ends[:, 0], force_mps2=force,
        previous_force_mps2=force[before], pose=pose, previous_pose=pose[before],
        temperature_c=np.full(count, np.nan if warm is None else warm),
        sensitivity=np.array(saved.state.values[:STATE_COUNT]).reshape(3, 4)[:, :3],
        variance_mps2_2=np.zeros((count, 3)), rate_radps=np.zeros((count, 3)), rate_change_radps2=np.zeros((count, 3)),
        half_s=0.5 * (ends[:, 1] - ends[:, 0]), within=np.zeros(count),
    )  # fmt: skip


def _known_columns(model: Model, stimulus: Stimulus) -> tuple[list[int], tuple[str, ...]]:
    """The states whose columns follow from orientation and time, and the names of the effects whose columns do not."""
    count = len(stimulus)
    other = replace(
        stimulus,
        temperature_c=REFERENCE_TEMPERATURE_C + np.linspace(1.0, 2.0, count),
        variance_mps2_2=np.ones((count, 3)),
    )
    kept, left_out = list(range(STATE_COUNT)), list[str]()
    for effect in model.effects:
        if effect.walks:
            continue
        shows = not effect.no_columns and not effect.oscillates
        if not shows or not np.array_equal(effect.columns(stimulus), effect.columns(other)):
            left_out.append(str(effect))
        else:
            kept += range(*model.parts[str(effect)].indices(model.count))
    return kept, tuple(left_out)


def _gain(saved: SavedCalibration, design: Floats, stimulus: Stimulus) -> Floats:
    """The change (12, D, 3) of the affine state per unit of each mean reading, by weighted least squares."""
    stated_noise, counts = saved.noise, np.array([[float(each.readings)] for each in saved.conditions.dwells])
    setting = SettingError(math.radians(stated_noise.angle_sigma_deg), considered=not stated_noise.dwell_sigma_stated)
    scatter, inflation = Scatter(np.array(stated_noise.dwell_sigma_mps2)), np.array(stated_noise.inflation)
    noise = Noise(np.array(stated_noise.sigma_mps2), inflation, (setting, scatter))
    means = Means(design, np.zeros(design.shape[:2]), stimulus.force_mps2, counts, np.zeros((len(counts), 2)))
    covariances = lift_rounding(mean_covariances(noise.weights, means, np.array(saved.state.values)))
    whiten = np.linalg.inv(np.linalg.cholesky(covariances))
    rows = (whiten @ design).reshape(-1, design.shape[2])
    scale = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    inverse = (np.linalg.pinv(rows / scale, rcond=1e-10) / scale[:, None])[:STATE_COUNT]
    return np.einsum("pdj,dji->pdi", inverse.reshape(STATE_COUNT, len(counts), 3), whiten)


def _type_b(uncertainty: TypeB, saved: SavedCalibration, stimulus: Stimulus, changes: Floats) -> list[Contribution]:
    """The lines of one error of the bench, one for each coefficient of its effect."""
    effect = effects.effect_named(uncertainty.effect, saved.bench)
    columns = _columns(effect, uncertainty, stimulus)
    per_dwell = np.einsum("pdi,diq->qpd", changes, columns)  # q: coefficient, p: parameter, d: dwell
    changes = per_dwell.sum(axis=2, keepdims=True) if uncertainty.varies == "run" else per_dwell
    divisor = uncertainty.k if uncertainty.distribution == "normal" else DIVISORS[uncertainty.distribution]
    return [
        _line(uncertainty, effect, coefficient, quantity(uncertainty.size, coefficient.unit) / divisor, changes[q])
        for q, coefficient in enumerate(effect.coefficients)
    ]


def _columns(effect: Effect, uncertainty: TypeB, stimulus: Stimulus) -> Floats:
    """What readings change by per unit of an error; of one that goes with temperature, at the change stated."""
    if effect.no_columns or effect.oscillates:
        raise InputError(f"it {effect.no_columns or 'is an oscillation'}: name an effect that shows in dwells.")
    warm = replace(stimulus, temperature_c=np.full(len(stimulus), REFERENCE_TEMPERATURE_C + 1.0))
    cold = replace(stimulus, temperature_c=np.full(len(stimulus), REFERENCE_TEMPERATURE_C))
    if np.array_equal(effect.columns(warm), effect.columns(cold)):
        return effect.columns(stimulus)
    if uncertainty.temperature is None:
        raise InputError('say by how much the temperature may be off, for example temperature = "0.5 K".')
    change = quantity(uncertainty.temperature, "K")
    return effect.columns(replace(cold, temperature_c=cold.temperature_c + change))


def _line(
    uncertainty: TypeB, effect: Effect, coefficient: Coefficient, standard: float, changes: Floats
) -> Contribution:
    words = {"run": "", "dwell": ", another in each dwell"}[uncertainty.varies]
    at = f", at {uncertainty.temperature}" if uncertainty.temperature else ""
    return Contribution(
        coefficient.symbol, f"{effect.title} ({effect}){words}{at}", "B", abs(standard), coefficient.unit,
        uncertainty.distribution, uncertainty.dof or math.inf, uncertainty.source,
        standard**2 * changes @ changes.T, changes,
    )  # fmt: skip


Conformity = Literal["pass", "conditionalPass", "conditionalFail", "fail"]
"""The four outcomes of a rule with guard band (ILAC-G8); simple acceptance has the first and the last."""
OUTCOMES: dict[Conformity, str] = {
    "pass": "pass", "conditionalPass": "conditional pass", "conditionalFail": "conditional fail", "fail": "fail",
}  # fmt: skip
"""The outcomes in words."""


@dataclass(frozen=True)
class CertifiedResult:
    """One parameter: value, standard and expanded uncertainty, coverage factor, effective degrees of freedom, in SI.

    before: value and expanded uncertainty before adjustment. limit: largest deviation from nominal that is allowed.
    value, standard and what follows from them are None where the run does not determine the parameter.
    """

    symbol: str
    unit: str
    nominal: float
    value: float | None
    standard: float | None
    expanded: float | None
    k: float
    dof: float
    before: tuple[float, float] | None = None
    limit: float | None = None
    conformity: Conformity | None = None


@dataclass(frozen=True)
class Certificate:
    """The whole content. begun, ended: of the measurements. created: when this document was made, in UTC."""

    saved: SavedCalibration
    statement: Statement
    budget: Budget
    results: tuple[CertifiedResult, ...]
    begun: date | None
    ended: date | None
    created: datetime

    @property
    def serial(self) -> str | None:
        """The serial number of the item: as stated, or as the recording has it."""
        return self.statement.item.serial or self.saved.provenance.bench.get("block_serial")

    @property
    def twelve(self) -> tuple[Floats, Floats] | None:
        """Values (12,) and covariance (12, 12) of the parameters; None where not all of them are determined."""
        values = [result.value for result in self.results]
        if any(value is None for value in values):
            return None
        return np.array(values, float), self.budget.covariance

    @property
    def intrinsic(self) -> tuple[CertifiedResult, ...]:
        """The nine that no choice of a frame changes, with the fewest degrees of freedom that any of the twelve has;
        none where not all of the twelve are determined."""
        if self.twelve is None:
            return ()
        nine, dof = intrinsic(*self.twelve), float(self.budget.dof.min())
        nominal = intrinsic(np.array([each.nominal for each in self.results]), np.zeros((12, 12))).values.tolist()
        k, standard = float(coverage_factor(np.array(dof))), np.sqrt(np.diag(nine.covariance)).tolist()
        return tuple(
            CertifiedResult(name, unit, usual, value, u, k * u, k, dof)
            for name, unit, usual, value, u in zip(
                SYMBOLS, UNITS, nominal, nine.values.tolist(), standard, strict=True)
        )  # fmt: skip

    @property
    def further(self) -> list[SavedParameter]:
        """Coefficients of effects that the run determined besides."""
        return [each for each in self.saved.parameters[len(self.results) :] if each.sigma is not None]

    @property
    def missing(self) -> tuple[str, ...]:
        """What a Digital Calibration Certificate must have and nobody has stated: keys of the statement."""
        statement = self.statement
        parties = {
            f"{name}.{key}": getattr(party, key)
            for name, party in (("laboratory", statement.laboratory), ("customer", statement.customer))
            for key in ("name", "city")
        }  # fmt: skip
        needed = {
            "number": statement.number, "begun": self.begun, "ended": self.ended, "site": statement.site,
            "laboratory.country": statement.laboratory.country, "item.name": statement.item.name,
            "item.serial": self.serial, "persons": statement.persons, **parties,
        }  # fmt: skip
        return tuple(name for name, value in needed.items() if not value)


def certificate(
    saved: SavedCalibration, model: Model, statement: Statement, before: tuple[SavedCalibration, Model] | None = None
) -> Certificate:
    """The certificate of a calibration with its model, and of a statement; before: the same before an adjustment.

    Raises InputError for a calibration without angles.
    """
    if saved.fixed or (before is not None and before[0].fixed):
        raise InputError(
            "a certificate states the angles of the axes in the frame of the platform, and this calibration was made "
            "without angles, in the frame of its sensors: calibrate on a bench that records angles."
        )
    uncertainties = budget(saved, model, statement.uncertainty)
    begun, ended = _dates(saved)
    return Certificate(
        saved, statement, uncertainties, _results(saved, uncertainties, statement, _before(before, statement)),
        statement.begun or begun, statement.ended or ended,
        datetime.fromisoformat(calibration_file.now()),
    )  # fmt: skip


def _before(before: tuple[SavedCalibration, Model] | None, statement: Statement) -> list[tuple[float, float]] | None:
    """Values and expanded uncertainties (12) before adjustment."""
    if before is None:
        return None
    of_earlier = budget(*before, statement.uncertainty)
    return list(zip(before[0].twelve[0].tolist(), of_earlier.expanded.tolist(), strict=True))


def _dates(saved: SavedCalibration) -> tuple[date, date] | tuple[None, None]:
    """The days on which the measurements began and ended, in UTC; None where the stamps are no dates."""
    if saved.conditions.began is None:
        return None, None
    began = parse_date(saved.conditions.began)
    return began.date(), (began + timedelta(seconds=saved.conditions.duration_s)).date()


def _results(
    saved: SavedCalibration, budget: Budget, statement: Statement, before: list[tuple[float, float]] | None
) -> tuple[CertifiedResult, ...]:
    combined, expanded, k, dof = (each.tolist() for each in (budget.combined, budget.expanded, budget.k, budget.dof))
    limits, results = statement.largest, list[CertifiedResult]()
    for i, parameter in enumerate(saved.parameters[: len(paper_parameters.SYMBOLS)]):
        value = None if parameter.sigma is None else parameter.value
        known, limit, judged = value is not None, limits.get(parameter.symbol), None
        if value is not None and limit is not None and statement.decision_rule is not None:
            judged = conformity(abs(value - parameter.nominal), limit, expanded[i], statement.decision_rule)
        results.append(CertifiedResult(
            parameter.symbol, parameter.unit, parameter.nominal, value,
            combined[i] if known else None, expanded[i] if known else None, k[i], dof[i],
            before[i] if before else None, limit, judged,
        ))  # fmt: skip
    return tuple(results)


def conformity(deviation: float, limit: float, expanded: float, rule: Rule) -> Conformity:
    """Whether a deviation is within its limit; the guard band is as wide as the expanded uncertainty."""
    if rule == "simple acceptance":
        return "pass" if deviation <= limit else "fail"
    if deviation <= limit:
        return "pass" if deviation <= limit - expanded else "conditionalPass"
    return "conditionalFail" if deviation <= limit + expanded else "fail"
