"""What a laboratory states for a certificate, in a TOML file: who, for whom, what, how, and what is not in a recording.

Everything may be left out, and is then left blank in the certificate. A misspelt key is refused.
"""

from __future__ import annotations

import math
from datetime import date
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError

from kf_calib.bench.paper_parameters import targets_of
from kf_calib.errors import InputError
from kf_calib.exchange.calibration_parts import first_misfit
from kf_calib.support.text import COMMANDS, cut
from kf_calib.support.toml_files import toml_table

_NONE = rf"{COMMANDS}\ufffe\uffff"  # no control characters, and nothing that XML cannot hold
StatedText = Annotated[str, StringConstraints(max_length=5000, pattern=rf"\A[^{_NONE}]*[^{_NONE}\s][^{_NONE}]*\z")]
Country = Annotated[str, StringConstraints(pattern=r"\A[A-Z]{2}\z")]
StatedPositive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
Rule = Literal["simple acceptance", "guard band"]

DIVISORS = {"rectangular": math.sqrt(3.0), "triangular": math.sqrt(6.0), "arcsine": math.sqrt(2.0)}
"""What a size, half the width of a distribution, is divided by for a standard uncertainty; a normal one has ``k``."""


_OF_KINDS = {
    "extra_forbidden": "this key is not known",
    "date_type": "must be a date without quotes, such as 2026-11-23",
    "string_pattern_mismatch": "must be text without control characters (of a country, two capital letters)",
}
"""What is said of values that pydantic refuses."""


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class Party(_Table):
    """A laboratory or a customer; country: two letters of ISO 3166-1."""

    name: StatedText | None = None
    street: StatedText | None = None
    postcode: StatedText | None = None
    city: StatedText | None = None
    country: Country | None = None
    email: StatedText | None = None
    phone: StatedText | None = None


class Item(_Table):
    """What was calibrated."""

    name: StatedText | None = None
    manufacturer: StatedText | None = None
    model: StatedText | None = None
    serial: StatedText | None = None
    state: StatedText | None = None


class Person(_Table):
    """Who is responsible for the certificate."""

    name: StatedText
    role: StatedText | None = None


class StatedConditions(_Table):
    """Conditions of the surroundings, in words with units."""

    temperature: StatedText | None = None
    humidity: StatedText | None = None
    pressure: StatedText | None = None
    note: StatedText | None = None


class TypeB(_Table):
    """An error of the bench that readings do not show: an effect of the catalogue and how large it may be.

    size: with a unit; ``distribution`` says of what: half the width, or ``k`` standard deviations of a normal one. It
    holds for each coefficient of the effect. varies: the same in all dwells (``run``) or another in each (``dwell``).
    temperature: by how much it may be off, for effects of it. dof: degrees of freedom of the size; None: exact.
    """

    effect: StatedText
    size: StatedText
    distribution: Literal["normal", "rectangular", "triangular", "arcsine"] = "normal"
    k: StatedPositive = 1.0
    varies: Literal["run", "dwell"] = "run"
    temperature: StatedText | None = None
    dof: StatedPositive | None = None
    source: StatedText | None = None


class Statement(_Table):
    """The content of the file; before: a calibration file from before an adjustment."""

    title: StatedText | None = None
    number: StatedText | None = None
    issued: date | None = None
    received: date | None = None
    begun: date | None = None
    ended: date | None = None
    site: Literal["laboratory", "customer", "laboratoryBranch", "customerBranch", "other"] | None = None
    location: StatedText | None = None
    method: StatedText | None = None
    norms: list[StatedText] = []
    traceability: StatedText | None = None
    remarks: StatedText | None = None
    decision_rule: Rule | None = None
    before: Annotated[Path, Field(strict=False)] | None = None
    laboratory: Party = Party()
    customer: Party = Party()
    item: Item = Item()
    conditions: StatedConditions = StatedConditions()
    persons: list[Person] = []
    limits: dict[str, StatedText] = {}
    uncertainty: list[TypeB] = []

    @property
    def largest(self) -> dict[str, float]:
        """The largest deviation from nominal allowed, by symbol, in SI; raises InputError."""
        largest = dict[str, float]()
        for name, size in self.limits.items():
            try:
                largest |= targets_of([f"{name}={size}"])
            except InputError:
                raise InputError(f"limits: {cut(name, 50)} = {cut(size, 50)!r} is none: name a parameter (theta1, K2), "
                                 "a kind (theta, phi, nu, K, b) or angles, with a size that fits it, such as 20 ppm, "
                                 "100 ug or 5 arcsec.") from None  # fmt: skip
        return largest


def read_statement(path: Path | None) -> Statement:
    """Read a statement and check all of it; raises InputError, with the place in it. None: nothing is stated."""
    if path is None:
        return Statement()
    try:
        stated = Statement.model_validate(toml_table(path, 'number = "2026-0147"'))
    except ValidationError as error:
        place, said, kind = first_misfit(error)
        raise InputError(
            f"{path}: {place}: {_OF_KINDS.get(kind, said)}: see docs/certificate.md for the keys."
        ) from None
    if stated.before is not None:
        stated = stated.model_copy(update={"before": path.parent / stated.before})
    try:
        limited = bool(stated.largest)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    if limited and stated.decision_rule is None:
        raise InputError(f"{path}: limits are given without the rule by which conformity is decided: add "
                         'decision_rule = "simple acceptance" or "guard band".')  # fmt: skip
    return stated
