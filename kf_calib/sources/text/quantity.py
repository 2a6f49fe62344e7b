"""A quantity in the cells of a row: three readings, the angles of the gimbals, an attitude or a temperature."""

from __future__ import annotations

import math
from collections.abc import Container, Sequence
from dataclasses import dataclass
from operator import mul

from kf_calib.sources.text.numbers import CellError, LineError, Numbers
from kf_calib.support.text import cut

CsvRow = Sequence[str]


@dataclass(frozen=True)
class QuantityColumns:
    """Where a quantity stands in a row, the factors that bring it to our units, and texts that stand for no value."""

    at: tuple[int, ...] = ()
    factors: tuple[float, ...] = ()
    absent: Container[str] = ()

    def values(self, row: CsvRow, header: Sequence[str], numbers: Numbers) -> list[float] | None:
        """The quantity, None where it is not measured. Raises CellError where it cannot be used."""
        cells = [row[at] for at in self.at]
        if not all(cells):
            if any(cells):
                raise CellError(self.at[cells.index("")], "some components of a vector are missing")
            return None
        try:
            values = numbers.values(cells)
        except ValueError:
            values = [math.nan]
        if not math.isfinite(sum(values)):  # which numbers beyond 1e308 together are not, either
            if cells[0].lower() in self.absent:
                return None
            self._refuse_cells(cells, header, numbers)
        return list(map(mul, values, self.factors))

    def _refuse_cells(self, cells: Sequence[str], header: Sequence[str], numbers: Numbers) -> None:
        """Raise CellError for the first cell that holds no finite number, if there is one."""
        for at, cell in zip(self.at, cells, strict=True):
            try:
                is_number = math.isfinite(numbers.value(cell))
            except LineError as error:
                raise CellError(at, str(error)) from None
            except ValueError:
                is_number = False
            if not is_number:
                raise CellError(at, f"column {cut(header[at], 40)!r} is {cut(cell, 40)!r}, which is no number")
