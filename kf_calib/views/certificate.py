"""What ``certificate`` says: as a report, and as a JSON object."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.console import Group, RenderableType
from rich.text import Text

from kf_calib.exchange.certificate.budget import Contribution
from kf_calib.exchange.certificate.content import OUTCOMES, Certificate, Result
from kf_calib.support.units import shown
from kf_calib.views.console import symbol
from kf_calib.views.json import clean
from kf_calib.views.tables import Table
from kf_calib.views.terminal import note


def certificate_object(own: Certificate, standing: str, out: Path, xml: Path | None) -> dict[str, Any]:
    """The JSON object of ``certificate``."""
    return clean(
        {
            "out": str(out),
            "xml": None if xml is None else str(xml),
            "xml_check": standing,
            "number": own.statement.number,
            "not_stated": list(own.missing),
            "decision_rule": own.statement.decision_rule,
            "parameters": [_result_object(each) for each in own.results],
            "budget": [_line_object(line) for line in own.budget.contributions],
            "left_out": list(own.budget.left_out),
        }
    )


def _result_object(each: Result) -> dict[str, Any]:
    return {
        "symbol": each.symbol, "value": each.value, "unit": each.unit, "nominal": each.nominal,
        "standard": each.standard, "expanded": each.expanded, "k": each.k, "dof": each.dof,
        "before": None if each.before is None else list(each.before),
        "limit": each.limit, "conformity": each.conformity,
    }  # fmt: skip


def _line_object(line: Contribution) -> dict[str, Any]:
    return {
        "symbol": line.name, "title": line.title, "kind": line.kind, "standard": line.standard, "unit": line.unit,
        "distribution": line.distribution, "dof": line.dof, "source": line.source,
        "sensitivity": None if line.sensitivity is None else line.sensitivity.tolist(),
        "contribution": line.parts.tolist(),
    }  # fmt: skip


def certificate_report(own: Certificate, standing: str, out: Path, xml: Path | None) -> RenderableType:
    """The report of ``certificate``."""
    judged = any(each.conformity for each in own.results)
    table = Table(title="Uncertainty (type A and type B: standard; U = k u)", title_justify="left")
    for heading in ("parameter", "type A", "type B", "U", "k", "unit", *(["conformity"] if judged else [])):
        table.add_column(heading, justify="left" if heading in ("parameter", "unit", "conformity") else "right")
    first, combined = own.budget.contributions[0].parts, own.budget.combined
    for i, each in enumerate(own.results):
        unit = shown(each.unit)
        other = max(combined[i] ** 2 - first[i] ** 2, 0.0) ** 0.5
        row = [symbol(each.symbol), *(unit.number(u, 2) for u in (first[i], other)),
               "" if each.expanded is None else unit.number(each.expanded, 2), f"{each.k:.2f}", unit.label]  # fmt: skip
        table.add_row(*row, *([OUTCOMES[each.conformity] if each.conformity else "not judged"] if judged else []))
    lines = [note(f"not stated, and left blank: {', '.join(own.missing)}")] if own.missing else []
    saved = [Text(f"saved {path}") for path in (out, xml) if path is not None]
    return Group(table, Text(f"XML: {standing}."), *lines, *saved)
