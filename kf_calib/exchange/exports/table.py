"""CSV: a table of all numbers, for a spreadsheet or a program of one's own.

    f = C (raw - o) - E e(f, T)

raw: what the device sends; C_ij, o1 o2 o3: matrix and offset, with the order, sign and size of its channels in them;
e: the effects by their formulas, with the coefficients and constants in the table, E_ij: their matrix. channel1 ...:
the channel of each accelerometer, count1 ...: the size of one count of each channel. Columns: name, value, sigma
(1 sigma; empty where there is none), unit (SI).
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.exchange.exports.quoting import in_cell
from kf_calib.exchange.exports.target import Target


class Table(Target):
    """The twelve parameters, coefficients and constants of effects, and the matrix."""

    title = "spreadsheets"

    def text(self) -> str:
        written = io.StringIO()
        writer = csv.writer(written, lineterminator="\n")
        writer.writerow(["name", "value", "sigma", "unit"])
        writer.writerows(self._rows())
        return written.getvalue()

    def _rows(self) -> Iterator[tuple[str, object, object, str]]:
        for own in self.saved.parameters:
            yield in_cell(own.symbol), own.value, own.sigma, in_cell(own.unit)
        for effect in self.correction.effects:
            if effect.unknown is not None and not effect.smooth:  # that of a smooth one is among the parameters
                yield effect.unknown.symbol, effect.value, None, effect.unknown.unit
        given, unit = self.input, "1" if self.input.is_plain else "m/s^2 a count"
        for i in range(3):
            yield f"channel{i + 1}", given.channels[i], None, "1"
            yield f"count{i + 1}", float(given.factors[i]), None, "m/s^2"
        yield from _elements("C", self.correction.matrix @ given.matrix, unit)
        offset = np.linalg.solve(given.matrix, self.correction.bias_mps2)
        yield from ((f"o{i + 1}", float(offset[i]), None, "m/s^2" if given.is_plain else "count") for i in range(3))
        yield from _elements("E", self.correction.matrix, "1") if self.correction.effects else ()


def _elements(name: str, matrix: Floats, unit: str) -> Iterator[tuple[str, object, object, str]]:
    """Rows of the elements of a matrix (3, 3)."""
    return ((f"{name}{i + 1}{j + 1}", float(matrix[i, j]), None, unit) for i in range(3) for j in range(3))
