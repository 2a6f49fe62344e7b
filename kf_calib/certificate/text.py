"""What a certificate says, as a report and as a JSON object."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Group, RenderableType
from rich.text import Text

from kf_calib.support.units import shown
from kf_calib.views.console import symbol
from kf_calib.views.json import clean
from kf_calib.views.terminal import ConsoleTable, note

if TYPE_CHECKING:
    from kf_calib.certificate.budget import Certificate, CertifiedResult, Contribution
    from kf_calib.certificate.monte_carlo import MonteCarloCheck


def certificate_object(
    certificate: Certificate, standing: str, check: MonteCarloCheck | None, path: Path, xml: Path | None
) -> dict[str, Any]:
    """The JSON object of ``certificate``."""
    return clean(
        {
            "out": str(path),
            "xml": None if xml is None else str(xml),
            "xml_check": standing,
            "number": certificate.statement.number,
            "not_stated": list(certificate.missing),
            "decision_rule": certificate.statement.decision_rule,
            "parameters": [_result_object(each) for each in certificate.results],
            "budget": [_line_object(line) for line in certificate.budget.contributions],
            "left_out": list(certificate.budget.left_out),
            "covariance": None if certificate.twelve is None else certificate.twelve[1].tolist(),
            "intrinsic": [_intrinsic_object(each) for each in certificate.intrinsic],
            "monte_carlo": None
            if check is None
            else {"draws": check.draws, "expanded": check.expanded.tolist(), "agrees": list(check.agrees)},
        }
    )


def _intrinsic_object(result: CertifiedResult) -> dict[str, Any]:
    return {key: value for key, value in _result_object(result).items()
            if key not in ("before", "limit", "conformity")}  # fmt: skip


def _result_object(result: CertifiedResult) -> dict[str, Any]:
    return {
        "symbol": result.symbol, "value": result.value, "unit": result.unit, "nominal": result.nominal,
        "standard": result.standard, "expanded": result.expanded, "k": result.k, "dof": result.dof,
        "before": None if result.before is None else list(result.before),
        "limit": result.limit, "conformity": result.conformity,
    }  # fmt: skip


def _line_object(line: Contribution) -> dict[str, Any]:
    return {
        "symbol": line.name, "title": line.title, "kind": line.kind, "standard": line.standard, "unit": line.unit,
        "distribution": line.distribution, "dof": line.dof, "source": line.source,
        "sensitivity": None if line.sensitivity is None else line.sensitivity.tolist(),
        "contribution": line.parts.tolist(),
    }  # fmt: skip


def certificate_report(
    certificate: Certificate, standing: str, check: MonteCarloCheck | None, pdf: Path, xml: Path | None
) -> RenderableType:
    """The report of ``certificate``."""
    from kf_calib.certificate.budget import OUTCOMES  # loaded already by what makes certificates

    with_conformity = any(result.conformity for result in certificate.results)
    table = ConsoleTable(title="Uncertainty (type A and type B: standard; U = k u)", title_justify="left")
    drawn = ["U by Monte Carlo"] if check else []
    judged = ["conformity"] if with_conformity else []
    for heading in ("parameter", "type A", "type B", "U", *drawn, "k", "unit", *judged):
        table.add_column(heading, justify="left" if heading in ("parameter", "unit", "conformity") else "right")
    first, combined = certificate.budget.contributions[0].parts, certificate.budget.combined
    for i, result in enumerate(certificate.results):
        unit = shown(result.unit)
        other = max(combined[i] ** 2 - first[i] ** 2, 0.0) ** 0.5
        by_draws = [] if check is None else [unit.number(float(check.expanded[i]), 2)]
        row = [symbol(result.symbol), *(unit.number(u, 2) for u in (first[i], other)),
               "" if result.expanded is None else unit.number(result.expanded, 2),
               *by_draws, f"{result.k:.2f}", unit.label]  # fmt: skip
        table.add_row(
            *row, *([OUTCOMES[result.conformity] if result.conformity else "not judged"] if with_conformity else [])
        )
    lines = [note(f"not stated, and left blank: {', '.join(certificate.missing)}")] if certificate.missing else []
    saved = [Text(f"saved {path}") for path in (pdf, xml) if path is not None]
    parts: list[RenderableType] = [table]
    if certificate.intrinsic:
        parts.append(_intrinsic_table(certificate.intrinsic))
    return Group(*parts, *_drawn(certificate, check), Text(f"XML: {standing}."), *lines, *saved)


def _intrinsic_table(results: Sequence[CertifiedResult]) -> ConsoleTable:
    """Return the table of the nine that no choice of a frame changes."""
    title = "Intrinsic: sensitivities, angles between the input axes, offsets"
    table = ConsoleTable(title=title, title_justify="left")
    for heading in ("parameter", "less nominal", "U", "k", "unit"):
        table.add_column(heading, justify="left" if heading in ("parameter", "unit") else "right")
    for k, result in enumerate(results):
        unit = shown(result.unit)
        assert result.value is not None and result.expanded is not None
        value, _ = unit.rounded(result.value - result.nominal, result.expanded)
        table.add_row(symbol(result.symbol), value, unit.number(result.expanded, 2), f"{result.k:.2f}", unit.label,
                      end_section=k % 3 == 2)  # fmt: skip
    return table


def _drawn(certificate: Certificate, check: MonteCarloCheck | None) -> list[RenderableType]:
    """Return what a Monte Carlo check says of the budget, in a sentence."""
    if check is None:
        return []
    apart = [symbol(each.symbol) for each, agrees in zip(certificate.results, check.agrees, strict=True) if not agrees]
    how = f"to half of the second digit of u, by {check.draws} draws (JCGM 101)"
    if not apart:
        return [Text(f"U of all parameters is confirmed {how}.")]
    return [note(f"U of {', '.join(apart)} is not confirmed {how}: quote U by Monte Carlo for these")]
