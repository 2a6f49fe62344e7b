"""A table of mean readings with specific force in their place, as a copy of the same kind: CSV or Excel.

Of the three columns of readings the names and the cells are replaced, in m/s^2; all else stays.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.errors import InputError
from kf_calib.estimation.correction import Correction
from kf_calib.exchange.corrected_file import Applied
from kf_calib.exchange.norm_at_rest import NormAtRest
from kf_calib.sources.files.csv_lines import cell_spans
from kf_calib.sources.tables.columns import READINGS, Columns
from kf_calib.sources.tables.grid import Grid, delimiter_of, grid_of
from kf_calib.sources.tables.numbers import Numbers
from kf_calib.sources.tables.opening import Opening
from kf_calib.sources.tables.spreadsheet import sheets_of, workbook_of
from kf_calib.sources.units import Units
from kf_calib.support.output_files import write_whole

_NAMES = ("ax_mps2", "ay_mps2", "az_mps2")


def apply_to_table(
    correction: Correction,
    path: Path,
    copy: Path,
    overrides: Mapping[str, str],
    columns: Mapping[str, str],
    units: Units,
    *,
    unchecked: bool = False,
) -> Applied:
    """Write the ``copy``, wholly or not at all; arguments as of ``open_table`` and ``apply_to_file``."""
    grid = grid_of(path)
    meanings = Columns.of(grid, columns, Numbers.of(grid))
    table = Opening(meanings, overrides, units, angles=False).table()
    means = np.array([own.mean_mps2 for own in table.orientations])
    warmth = np.array([own.temperature_c for own in table.orientations])
    if correction.needs_temperature and not np.isfinite(warmth).all():
        raise InputError(f"{path}: has no temperature, which the calibration needs: add a column of it.")
    norm = NormAtRest(correction)
    norm.add_means(means, float(np.max(correction.noise_mps2)))
    if not unchecked and (said := norm.misfit(table.bench.input, final=True)):
        raise InputError(f"{path}: {said}.")
    force = correction.of_readings(means, warmth if correction.needs_temperature else None)
    places = meanings.places(*READINGS)
    write = _to_excel if path.suffix.lower() in (".xlsx", ".xlsm") else _to_text
    write(path, copy, grid, places, force)
    known = warmth[np.isfinite(warmth)]
    used = (float(known.min()), float(known.max())) if correction.needs_temperature else None
    return Applied(len(force), int(np.count_nonzero(~np.isfinite(force).all(axis=1))), used)


def _to_excel(path: Path, copy: Path, grid: Grid, places: list[int], force: Floats) -> None:
    """Write a copy of a workbook."""
    book = workbook_of(path)
    sheet = book[next(each.name for each in sheets_of(path) if not each.hidden)]
    head = next(
        k for k in range(grid.numbers[0] - 1, 0, -1)
        if str(sheet.cell(k, places[0] + 1).value or "") in grid.header[places[0]]
    )  # fmt: skip
    for place, name in zip(places, _NAMES, strict=True):
        for k in range(head, grid.numbers[0]):  # the name, and a unit below it
            if sheet.cell(k, place + 1).value is not None:
                sheet.cell(k, place + 1).value = name if k == head else "m/s^2"
    for number, own in zip(grid.numbers, force.tolist(), strict=True):
        for place, value in zip(places, own, strict=True):
            cell = sheet.cell(number, place + 1)
            if type(cell).__name__ == "MergedCell":
                raise InputError(f"{path}: cell {cell.coordinate} is merged with others, so no reading can be written "
                                 "there: part the cells.")  # fmt: skip
            cell.value = value
    content = io.BytesIO()
    book.save(content)
    write_whole(copy, content.getvalue())


def _to_text(path: Path, copy: Path, grid: Grid, places: list[int], force: Floats) -> None:
    """Write a copy of a text."""
    content = path.read_bytes()
    utf16 = content.startswith((b"\xff\xfe", b"\xfe\xff"))
    text = content.decode("utf-16") if utf16 else content.decode("utf-8", errors="surrogateescape")
    lines = text.splitlines(keepends=True)
    plain = [line.rstrip("\r\n") for line in lines]
    delimiter = delimiter_of([line for line in plain if line.strip() and not line.startswith("#")])
    decimal = "," if delimiter != "," and not any("." in plain[k - 1] for k in grid.numbers) else "."
    changed = {number - 1: [repr(value).replace(".", decimal) for value in own]
               for number, own in zip(grid.numbers, force.tolist(), strict=True)}  # fmt: skip
    heads = [k for k in range(grid.numbers[0] - 1) if len(cell_spans(plain[k], delimiter)) > max(places)]
    for k in heads[-2:]:
        at = cell_spans(plain[k], delimiter)[places[0]]
        if plain[k][at[0] : at[1]].strip('" ') and plain[k][at[0] : at[1]].strip('" ') in grid.header[places[0]]:
            changed[k] = list(_NAMES) if k == heads[-1] or k == heads[0] else ["m/s^2"] * 3
    for k, texts in changed.items():
        spans, line = cell_spans(plain[k], delimiter), lines[k]
        for place, text in sorted(zip(places, texts, strict=True), reverse=True):
            line = line[: spans[place][0]] + text + line[spans[place][1] :]
        lines[k] = line
    joined = "".join(lines)
    write_whole(copy, joined.encode("utf-16") if utf16 else joined.encode("utf-8", errors="surrogateescape"))
