"""CSV: a table of all numbers, for a spreadsheet or a program of one's own.

    f = C (reading - b - e(f, T))

C_ij are the elements of the matrix, b1 b2 b3 the biases, e the effects by their formulas, with the coefficients and
constants in the table. Columns: name, value, sigma (1 sigma; empty where there is none), unit (SI).
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator

from kf_calib.exchange.exports.quoting import in_cell
from kf_calib.exchange.exports.target import Target


class Table(Target):
    """The twelve parameters, coefficients and constants of effects, and the matrix."""

    title = "spreadsheets"

    def text(self) -> str:
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(["name", "value", "sigma", "unit"])
        writer.writerows(self._rows())
        return out.getvalue()

    def _rows(self) -> Iterator[tuple[str, object, object, str]]:
        for own in self.saved.parameters:
            yield in_cell(own.symbol), own.value, own.sigma, in_cell(own.unit)
        for effect in self.correction.effects:
            if effect.unknown is not None and not effect.smooth:  # that of a smooth one is among the parameters
                yield effect.unknown.symbol, effect.value, None, effect.unknown.unit
        for i in range(3):
            for j in range(3):
                yield f"C{i + 1}{j + 1}", float(self.correction.matrix[i, j]), None, "1"
