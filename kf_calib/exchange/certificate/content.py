"""What a certificate says: results with expanded uncertainty, conformity, and all that the laboratory has stated.

Nothing here is made up: what is neither in the calibration nor in the statement is None, and is shown as not stated.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from typing import Literal

from kf_calib.bench import paper_parameters
from kf_calib.errors import InputError
from kf_calib.estimation.measurement_model import Model
from kf_calib.exchange import calibration_file
from kf_calib.exchange.calibration_file import SavedCalibration, SavedParameter
from kf_calib.exchange.certificate import budget as budgets
from kf_calib.exchange.certificate.budget import Budget
from kf_calib.exchange.certificate.statement import Rule, Statement

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
    uncertainties = budgets.budget(saved, model, statement.uncertainty)
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
    of_earlier = budgets.budget(*before, statement.uncertainty)
    return list(zip(before[0].twelve[0].tolist(), of_earlier.expanded.tolist(), strict=True))


def _dates(saved: SavedCalibration) -> tuple[date, date] | tuple[None, None]:
    """The days on which the measurements began and ended, in UTC; None where the stamps are no dates."""
    if saved.conditions.began is None:
        return None, None
    began = datetime.fromisoformat(saved.conditions.began).astimezone(UTC)
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
