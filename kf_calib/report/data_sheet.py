"""A data sheet as a table for people, and as a JSON object."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from rich.console import Group, RenderableType
from rich.text import Text

from kf_calib.diagnosis.data_sheet import DataSheet, DataSheetRow
from kf_calib.support.units import shown
from kf_calib.views.json import members
from kf_calib.views.notation import symbol
from kf_calib.views.terminal import table

TITLE = "Data sheet with the symbols of IEEE Std 1293"
EQUATION = (
    "E / K1 = K0 + a_i + K2 a_i² + K3 a_i³ + ½ K0' sgn a_i + ½ K1' |a_i| + Koq a_i |a_i| + Kip a_i a_p + Kio a_i a_o + "
    "Kpo a_p a_o + Kpp a_p² + Koo a_o² + misalignments + what varies"
)
_NONE = "not determined"


def data_sheet_report(sheet: DataSheet) -> RenderableType:
    """The model equation and the table of its coefficients, value ± sigma of each accelerometer."""
    rows = list[tuple[str, ...]]()
    for row in sheet.rows:
        unit = shown(row.unit)
        if row.symbol == "K1":  # whose deviations are of the size of the others
            values = tuple(None if each is None else each - 1.0 for each in row.values)
            row = replace(row, symbol="K1 - 1", values=values)
        cells = [_cell(row, k) for k in range(len(row.values))]
        label = unit.label if any(cell != _NONE for cell in cells) else ""
        rows.append((symbol(row.symbol), row.words, *cells, label, row.how))
    headings = "", "coefficient", ">accelerometer 1", ">2", ">3", "unit", "estimated"
    told = "Found: missing by the diagnosis. Together: in one fit with the polynomial. Alone: beside what was found."
    return Group(Text(EQUATION), table(f"{TITLE} (1σ)", headings, rows), Text(told))


def _cell(row: DataSheetRow, k: int) -> str:
    value, sigma = row.values[k], row.sigmas[k]
    if value is None or sigma is None:
        return _NONE
    return " ± ".join(shown(row.unit).rounded(value, sigma))


def data_sheet_object(sheet: DataSheet) -> list[dict[str, Any]]:
    """An object for each coefficient, in SI."""
    return [
        {"symbol": row.symbol, "coefficient": row.words}
        | members(row, "unit", "values", "sigmas")
        | {"estimated": row.how}
        for row in sheet.rows
    ]
