"""What a certificate says, as a report and as a JSON object."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Group, RenderableType
from rich.text import Text

from kf_calib.support.units import shown
from kf_calib.views.json import members
from kf_calib.views.notation import symbol
from kf_calib.views.terminal import ConsoleTable, note, table

if TYPE_CHECKING:
    from kf_calib.certificate.budget import Certificate, CertifiedResult
    from kf_calib.certificate.monte_carlo import MonteCarloCheck


_OF_A_LINE = "title", "kind", "standard", "unit", "distribution", "dof", "source", "sensitivity"
_OF_A_RESULT = "symbol", "value", "unit", "nominal", "standard", "expanded", "k", "dof"


def certificate_object(
    certificate: Certificate, standing: str, check: MonteCarloCheck | None, path: Path, xml: Path | None
) -> dict[str, Any]:
    """The JSON object of ``certificate``."""
    return {
        "out": path,
        "xml": xml,
        "xml_check": standing,
        "number": certificate.statement.number,
        "not_stated": certificate.missing,
        "decision_rule": certificate.statement.decision_rule,
        "parameters": [members(each, *_OF_A_RESULT, "before", "limit", "conformity") for each in certificate.results],
        "budget": [
            {"symbol": line.name, **members(line, *_OF_A_LINE), "contribution": line.parts}
            for line in certificate.budget.contributions
        ],
        "left_out": certificate.budget.left_out,
        "covariance": None if certificate.twelve is None else certificate.twelve[1],
        "intrinsic": [members(each, *_OF_A_RESULT) for each in certificate.intrinsic],
        "monte_carlo": check,
    }


def certificate_report(
    certificate: Certificate, standing: str, check: MonteCarloCheck | None, pdf: Path, xml: Path | None
) -> RenderableType:
    """The report of ``certificate``."""
    from kf_calib.certificate.budget import OUTCOMES  # loaded already by what makes certificates

    with_conformity = any(result.conformity for result in certificate.results)
    drawn, judged = [">U by Monte Carlo"] if check else [], ["conformity"] if with_conformity else []
    rows = list[list[str]]()
    first, combined = certificate.budget.contributions[0].parts, certificate.budget.combined
    for i, result in enumerate(certificate.results):
        unit = shown(result.unit)
        other = max(combined[i] ** 2 - first[i] ** 2, 0.0) ** 0.5
        by_draws = [] if check is None else [unit.number(float(check.expanded[i]), 2)]
        row = [symbol(result.symbol), *(unit.number(u, 2) for u in (first[i], other)),
               "" if result.expanded is None else unit.number(result.expanded, 2),
               *by_draws, f"{result.k:.2f}", unit.label]  # fmt: skip
        outcome = OUTCOMES[result.conformity] if result.conformity else "not judged"
        rows.append([*row, *([outcome] if with_conformity else [])])
    lines = [note(f"not stated, and left blank: {', '.join(certificate.missing)}")] if certificate.missing else []
    saved = [Text(f"saved {path}") for path in (pdf, xml) if path is not None]
    headings = "parameter", ">type A", ">type B", ">U", *drawn, ">k", "unit", *judged
    parts: list[RenderableType] = [table("Uncertainty (type A and type B: standard; U = k u)", headings, rows)]
    if certificate.intrinsic:
        parts.append(_intrinsic_table(certificate.intrinsic))
    return Group(*parts, *_drawn(certificate, check), Text(f"XML: {standing}."), *lines, *saved)


def _intrinsic_table(results: Sequence[CertifiedResult]) -> ConsoleTable:
    """Return the table of the nine that no choice of a frame changes."""
    rows = list[tuple[str, ...]]()
    for result in results:
        unit = shown(result.unit)
        assert result.value is not None and result.expanded is not None
        value, _ = unit.rounded(result.value - result.nominal, result.expanded)
        rows.append((symbol(result.symbol), value, unit.number(result.expanded, 2), f"{result.k:.2f}", unit.label))
    title = "Intrinsic: sensitivities, angles between the input axes, offsets"
    return table(title, ("parameter", ">less nominal", ">U", ">k", "unit"), rows, range(2, 9, 3))


def _drawn(certificate: Certificate, check: MonteCarloCheck | None) -> list[RenderableType]:
    """Return what a Monte Carlo check says of the budget, in a sentence."""
    if check is None:
        return []
    apart = [symbol(each.symbol) for each, agrees in zip(certificate.results, check.agrees, strict=True) if not agrees]
    how = f"to half of the second digit of u, by {check.draws} draws (JCGM 101)"
    if not apart:
        return [Text(f"U of all parameters is confirmed {how}.")]
    return [note(f"U of {', '.join(apart)} is not confirmed {how}: quote U by Monte Carlo for these")]
