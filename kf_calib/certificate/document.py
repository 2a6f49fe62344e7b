"""The certificate as a document: PDF/A-3b, tagged for screen readers (PDF/UA-1), with the XML attached, by Typst.

The template beside this module is fixed; all that comes from files reaches it as JSON. The same content with the same
date gives the same bytes, as only the fonts inside Typst are used, unless a text needs a letter that these lack.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from importlib.metadata import version
from importlib.resources import files
from typing import Any

import numpy as np

from kf_calib.certificate import dcc
from kf_calib.certificate.budget import OUTCOMES, Certificate, CertifiedResult, Contribution
from kf_calib.certificate.statement import Party
from kf_calib.errors import InputError, need
from kf_calib.estimation.results import format_p
from kf_calib.exchange.calibration_parts import SavedParameter
from kf_calib.support.text import cut
from kf_calib.support.units import Unit, field_unit
from kf_calib.views.notation import symbol

ATTACHED = "certificate.xml"
_UNITS = {"rad": Unit("°", math.degrees(1.0)), "1": Unit("1", 1.0), "m/s^2": Unit("m/s²", 1.0)}

_INCOMPLETE = ("Incomplete: not stated are {}. The attached XML is not a DCC (Digital Calibration Certificate), which "
               "must have these.")  # fmt: skip

TableRow = dict[str, Any]


def pdf(certificate: Certificate, xml: bytes, standing: str) -> bytes:
    """The PDF of a certificate with its XML attached; standing: what the check of the XML found, in words."""
    need("typst", "report", "a certificate")
    import typst

    inputs = {"data": json.dumps(content(certificate, standing)), "xml": xml.decode()}
    template = (files("kf_calib.certificate") / "certificate.typ").read_bytes()
    try:
        try:
            return _compiled(template, inputs, True)
        except typst.TypstError as error:
            if "font" not in error.message and "glyph" not in error.message:
                raise
            return _compiled(template, inputs, False)  # a letter that only a font of this machine has
    except typst.TypstError as error:
        raise InputError(f"the certificate cannot be set as PDF/A ({cut(' '.join(error.message.split()), 200)}): "
                         "install a font that has the letter, or write the text with others.") from None  # fmt: skip


def _compiled(template: bytes, inputs: dict[str, str], own_fonts_only: bool) -> bytes:
    import typst

    made = typst.compile(
        template, format="pdf", ignore_system_fonts=own_fonts_only, sys_inputs=inputs, pdf_standards=["a-3b", "ua-1"]
    )
    assert isinstance(made, bytes)
    return made


def content(certificate: Certificate, standing: str) -> TableRow:
    """What the template shows, as strings."""
    stated, day = certificate.statement, certificate.created
    return {
        "title": stated.title or "Calibration certificate",
        "author": stated.laboratory.name or "not stated",
        "date": [day.year, day.month, day.day, day.hour, day.minute, day.second],
        "number": stated.number,
        "laboratory": {"name": stated.laboratory.name},
        "attachment": ATTACHED,
        "missing": None if not certificate.missing else _INCOMPLETE.format(", ".join(certificate.missing)),
        "facts": _facts(certificate),
        "method": _method(certificate),
        "results": _results(certificate.results),
        "intrinsic": _results(certificate.intrinsic),
        "correlations": _correlations(certificate),
        "adjustment": _adjustment(certificate.results),
        "rule": dcc.rule(certificate),
        "conformity": _conformity(certificate.results),
        "budget_words": _budget_words(certificate),
        "inputs": [_input(line) for line in certificate.budget.contributions],
        "names": [symbol(each.symbol) for each in certificate.results],
        "small_units": [field_unit(each.unit).label for each in certificate.results],
        "contributions": _contributions(certificate),
        "sensitivities": [
            _sensitivity(certificate, line) for line in certificate.budget.contributions if line.sensitivity is not None
        ],
        "further": list(map(_coefficient, certificate.further)),
        "remarks": _remarks(certificate, standing),
        "persons": [each.model_dump() for each in stated.persons],
    }


def _facts(certificate: Certificate) -> list[list[str | None]]:
    stated = certificate.statement
    days = [_text(certificate.begun), _text(certificate.ended)]
    performed = None if None in days else days[0] if days[0] == days[1] else f"{days[0]} to {days[1]}"
    item = stated.item
    return [
        ["Certificate number", stated.number],
        ["Laboratory", _party(stated.laboratory)],
        ["Place of calibration", stated.location or stated.site],
        ["Customer", _party(stated.customer)],
        ["Item", item.name],
        ["Manufacturer, model", ", ".join(filter(None, (item.manufacturer, item.model))) or None],
        ["Serial number", certificate.serial],
        ["State of the item", item.state],
        ["Received", _text(stated.received)],
        ["Calibrated", performed],
        ["Issued", _text(stated.issued)],
    ]


def _party(party: Party) -> str | None:
    place = " ".join(filter(None, (party.postcode, party.city)))
    return ", ".join(filter(None, (party.name, party.street, place, party.country, party.email, party.phone))) or None


def _text(value: object) -> str | None:
    return None if value is None else str(value)


def _method(certificate: Certificate) -> list[list[str | None]]:
    stated, saved = certificate.statement, certificate.saved
    conditions, bench = saved.conditions, saved.bench
    warmth = None
    if conditions.temperature_min_c is not None and conditions.temperature_max_c is not None:
        warmth = f"{conditions.temperature_min_c:.2f} °C to {conditions.temperature_max_c:.2f} °C"
    around = stated.conditions
    named = {"Air temperature": around.temperature, "Humidity": around.humidity, "Air pressure": around.pressure}
    return [
        ["Method", f"{stated.method or dcc.METHOD}."],
        ["Standards", "; ".join(stated.norms) or None],
        ["Model", " + ".join(["twelve parameters", *(each.text for each in saved.effects)])],
        ["Orientations", f"{len(conditions.dwells)} in {conditions.duration_s:.0f} s, "
                         f"{sum(each.readings for each in conditions.dwells)} readings"],
        ["Local gravity", f"{bench.gravity_mps2:.7g} m/s², taken as exact but for the budget below"],
        ["Temperature of the block", warmth],
        *([name, text] for name, text in named.items()),
        *([["Conditions", around.note]] if around.note else []),
        ["Traceability", stated.traceability],
    ]  # fmt: skip


def _results(results: Sequence[CertifiedResult]) -> list[TableRow]:
    rows = list[TableRow]()
    for result in results:
        large, small = _UNITS[result.unit], field_unit(result.unit)
        value, expanded = _pair(result.value, result.expanded, large)
        rows.append({
            "name": symbol(result.symbol), "value": value, "expanded": expanded, "unit": large.label,
            "small": _pair(result.value, result.expanded, small)[1], "small_unit": small.label,
            "k": f"{result.k:.2f}", "dof": _count(result.dof),
        })  # fmt: skip
    return _aligned(rows, "value", "expanded", "small")


def _correlations(certificate: Certificate) -> list[TableRow]:
    """Rows of the correlations of the parameters, of type A and type B together; none where one is not determined."""
    if certificate.twelve is None:
        return []
    covariance = certificate.twelve[1]
    sigma = np.sqrt(np.diag(covariance))
    rows = (covariance / np.outer(sigma, sigma)).tolist()
    return [{"symbol": symbol(result.symbol), "values": [_minus(f"{value:.3f}") for value in row]}
            for result, row in zip(certificate.results, rows, strict=True)]  # fmt: skip


def _adjustment(results: Sequence[CertifiedResult]) -> list[TableRow]:
    rows = list[TableRow]()
    for result in results:
        if result.before is not None:
            unit = _UNITS[result.unit]
            before, before_u = _pair(*result.before, unit)
            after, after_u = _pair(result.value, result.expanded, unit)
            rows.append({"name": symbol(result.symbol), "before": before, "before_u": before_u, "after": after,
                         "after_u": after_u, "unit": unit.label})  # fmt: skip
    return _aligned(rows, "before", "before_u", "after", "after_u")


def _conformity(results: Sequence[CertifiedResult]) -> list[TableRow]:
    rows = list[TableRow]()
    for result in results:
        if result.limit is not None:
            unit = field_unit(result.unit)
            deviation = None if result.value is None else result.value - result.nominal
            shown, expanded = _pair(deviation, result.expanded, unit)
            rows.append({
                "name": symbol(result.symbol), "deviation": shown, "expanded": expanded, "unit": unit.label,
                "limit": f"{result.limit * unit.per_si:.6g}",
                "outcome": "not determined" if result.conformity is None else OUTCOMES[result.conformity],
            })  # fmt: skip
    return _aligned(rows, "deviation", "expanded", "limit")


def _budget_words(certificate: Certificate) -> str:
    words = (
        "Type A is the covariance of the filter. Type B carries each stated error of the bench through the weighted "
        "least squares of this run to the parameters. Contributions are taken as uncorrelated and added in quadrature; "
        "k follows from the effective degrees of freedom (Welch–Satterthwaite) for a coverage probability of 95.45 %, "
        "and is 2.00 where these are infinite."
    )
    if len(certificate.budget.contributions) == 1:
        words += " No error of the bench is stated: U covers the scatter of the readings only."
    if certificate.budget.left_out:
        left_out = ", ".join(certificate.budget.left_out)
        words += (f" Sensitivity coefficients leave out what the model has for {left_out}, whose "
                  "columns need more than the calibration file holds.")  # fmt: skip
    return words


def _input(line: Contribution) -> TableRow:
    unit = field_unit(line.unit)
    standard = "–" if line.standard is None else f"{line.standard * unit.per_si:.3g}"
    return {
        "symbol": symbol(line.name), "title": line.title, "kind": line.kind, "distribution": line.distribution,
        "standard": standard, "unit": unit.label if line.unit else "–", "dof": _count(line.dof), "source": line.source,
    }  # fmt: skip


def _contributions(certificate: Certificate) -> list[TableRow]:
    """Rows of the matrix of contributions, each column with three significant digits of the combined uncertainty."""
    per_si = np.array([field_unit(result.unit).per_si for result in certificate.results])
    known = [result.standard is not None for result in certificate.results]
    budget = certificate.budget
    places = [max(0, 2 - math.floor(math.log10(u))) if u > 0 else 3 for u in (budget.combined * per_si).tolist()]

    def row(name: str, values: Any) -> TableRow:
        return texts(name, [f"{value:.{digits}f}" for value, digits in zip(values, places, strict=True)])

    def texts(name: str, cells: list[str]) -> TableRow:
        return {"symbol": name, "values": [text if ok else "–" for text, ok in zip(cells, known, strict=True)]}

    plain = [texts("ν", [_count(v) for v in budget.dof]), texts("k", [f"{v:.2f}" for v in budget.k])]
    lines = [row(symbol(line.name), line.parts * per_si) for line in budget.contributions]
    return [*lines, row("u", budget.combined * per_si), *plain, row("U", budget.expanded * per_si)]


def _sensitivity(certificate: Certificate, line: Contribution) -> TableRow:
    assert line.sensitivity is not None
    per_si = np.array([field_unit(result.unit).per_si for result in certificate.results]) / field_unit(line.unit).per_si
    values = line.sensitivity * per_si
    values[np.abs(values) < 1e-9] = 0.0  # rounding
    largest = float(np.abs(values).max())
    form = "{:.4f}" if not largest or 0.01 <= largest < 1e4 else "{:.2e}"
    return {"symbol": symbol(line.name), "values": [_minus(form.format(value)) for value in values.tolist()]}


def _coefficient(each: SavedParameter) -> TableRow:
    unit = field_unit(each.unit)
    value, sigma = _pair(each.value, each.sigma, unit)
    return {"name": symbol(each.symbol), "value": value or "–", "sigma": sigma or "–", "unit": unit.label}


def _remarks(certificate: Certificate, standing: str) -> list[str]:
    saved, agreement = certificate.saved, certificate.saved.consistency
    agree = {True: "agree", False: "do not agree: the uncertainties above do not hold"}
    remarks = [f"Attached file {ATTACHED}: {standing}."]
    if agreement.consistent is not None and agreement.p_value is not None:
        remarks.append(f"Model and measurements {agree[agreement.consistent]} (p {format_p(agreement.p_value)}, "
                       f"{agreement.dof} degrees of freedom).")  # fmt: skip
    else:
        remarks.append("Nothing was left over to judge the agreement of model and measurements by.")
    if saved.not_seen:
        remarks.append(f"Effects that this run could not have shown: {', '.join(saved.not_seen)}.")
    if not (raw := saved.bench.input).is_plain:
        remarks.append(f"The results belong to readings made of {raw}: {raw.formula}, m/s².")
    remarks += [f"Of the recording: {sentence}" for sentence in saved.provenance.warnings]
    remarks += [certificate.statement.remarks] if certificate.statement.remarks else []
    origin = saved.provenance
    if origin.recording:
        remarks.append(f"Recording {origin.recording}, SHA-256 {origin.sha256 or 'not known'}.")
    made = origin.versions.get("kf_calib", "?")
    return [*remarks, f"Calculated by kf_calib {made} on {origin.created}; written by kf_calib "
                      f"{version('kf_calib')} on {certificate.created.isoformat()}."]  # fmt: skip


def _count(dof: float) -> str:
    return "∞" if math.isinf(dof) or dof > 1e4 else f"{math.floor(dof)}"


def _minus(text: str) -> str:
    return text.replace("-", "−") if float(text) else text.removeprefix("-")


def _pair(value: float | None, sigma: float | None, unit: Unit) -> tuple[str | None, str | None]:
    """A value and its uncertainty, rounded to two significant digits of the latter."""
    if value is None or sigma is None:
        return None, None
    first, second = unit.rounded(value, sigma)
    return _minus(first), second if float(second) < 100.0 else unit.number(sigma, 2)


def _aligned(rows: list[TableRow], *keys: str) -> list[TableRow]:
    """The rows with the texts of these columns padded to as many decimals as the longest has."""
    for key in keys:
        longest = max((_behind(row[key]) for row in rows if row[key] is not None), default=0)
        for row in rows:
            if (text := row[key]) is not None:
                lacking = longest - _behind(text)
                row[key] = {"text": text, "pad": "." * (lacking > 0 and "." not in text) + "0" * (
                    lacking - (lacking > 0 and "." not in text))}  # fmt: skip
    return rows


def _behind(text: str) -> int:
    """Characters from the point on, the point too."""
    return len(text) - text.index(".") if "." in text else 0
