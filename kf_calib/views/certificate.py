"""What ``certificate`` says: as a report, and as a JSON object."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.console import Group, RenderableType
from rich.text import Text

from kf_calib.exchange.certificate.budget import Contribution
from kf_calib.exchange.certificate.content import OUTCOMES, Certificate, CertifiedResult
from kf_calib.support.units import shown
from kf_calib.views.console import symbol
from kf_calib.views.json import clean
from kf_calib.views.tables import ConsoleTable
from kf_calib.views.terminal import note


def certificate_object(certificate: Certificate, standing: str, path: Path, xml: Path | None) -> dict[str, Any]:
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
        }
    )


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


def certificate_report(certificate: Certificate, standing: str, pdf: Path, xml: Path | None) -> RenderableType:
    """The report of ``certificate``."""
    with_conformity = any(result.conformity for result in certificate.results)
    table = ConsoleTable(title="Uncertainty (type A and type B: standard; U = k u)", title_justify="left")
    for heading in ("parameter", "type A", "type B", "U", "k", "unit", *(["conformity"] if with_conformity else [])):
        table.add_column(heading, justify="left" if heading in ("parameter", "unit", "conformity") else "right")
    first, combined = certificate.budget.contributions[0].parts, certificate.budget.combined
    for i, result in enumerate(certificate.results):
        unit = shown(result.unit)
        other = max(combined[i] ** 2 - first[i] ** 2, 0.0) ** 0.5
        row = [symbol(result.symbol), *(unit.number(u, 2) for u in (first[i], other)),
               "" if result.expanded is None else unit.number(result.expanded, 2),
               f"{result.k:.2f}", unit.label]  # fmt: skip
        table.add_row(
            *row, *([OUTCOMES[result.conformity] if result.conformity else "not judged"] if with_conformity else [])
        )
    lines = [note(f"not stated, and left blank: {', '.join(certificate.missing)}")] if certificate.missing else []
    saved = [Text(f"saved {path}") for path in (pdf, xml) if path is not None]
    return Group(table, Text(f"XML: {standing}."), *lines, *saved)
