"""Copies of tables with corrected readings, and temperatures of readings that are corrected batch by batch."""

import csv
import gzip
from pathlib import Path
from typing import Any

import numpy as np
import openpyxl
import pytest
from helpers.calibrations import simulated

from kf_calib.bench.arrays import Floats
from kf_calib.bench.streams import Batch, Stream
from kf_calib.errors import InputError
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.correction import Correction
from kf_calib.exchange.calibration_file import saved
from kf_calib.exchange.corrected_file import _Thermometer, apply_to_table
from kf_calib.sources.text.units import Units


def streams(rng: np.random.Generator) -> tuple[Stream, Stream]:
    """300 readings, and 40 temperatures of which some are no number and some come late or twice."""
    stamps = np.sort(rng.choice(100_000, 300, replace=False))
    of_temperature = np.sort(rng.choice(np.arange(5_000, 95_000), 40, replace=False))
    of_temperature[[9, 20]] = of_temperature[8], of_temperature[15]
    values = 20.0 + 3.0 * rng.normal(size=(40, 1))
    values[[5, 30], 0] = np.nan, np.inf
    return Stream(stamps, rng.normal(size=(300, 3))), Stream(of_temperature, values)


def used(temperature: Stream) -> tuple[Floats, Floats]:
    """Stamps and values of those that are numbers and later than all before."""
    before = np.append(-1, np.maximum.accumulate(temperature.time_ns)[:-1])
    chosen = (temperature.time_ns > before) & np.isfinite(temperature.values[:, 0])
    return temperature.time_ns[chosen].astype(float), temperature.values[chosen, 0]


@pytest.mark.parametrize("parts", [1, 7, 60])
def test_a_reading_has_the_temperature_between_those_beside_it_however_they_come(parts: int) -> None:
    """Those before the first temperature have the first, those after the last the last."""
    for seed in range(10):
        readings, temperature = streams(np.random.default_rng(seed))
        times, values = used(temperature)
        thermometer, pairs = _Thermometer(True), list[tuple[Stream, Floats | None]]()
        for k in range(parts):  # a share of each, whatever its stamps
            of_readings, of_temperature = (slice(k * n // parts, (k + 1) * n // parts) for n in (300, 40))
            pairs += thermometer.pairs(Batch(readings[of_readings], readings[:0], temperature[of_temperature]))
        pairs += thermometer.rest()
        np.testing.assert_array_equal(np.concatenate([stream.time_ns for stream, _ in pairs]), readings.time_ns)
        told = np.concatenate([own for _, own in pairs if own is not None])
        np.testing.assert_allclose(told, np.interp(readings.time_ns, times, values), rtol=1e-12)
        assert thermometer.extremes == (values.min(), values.max())


def test_readings_wait_for_a_temperature_as_late_as_they_are() -> None:
    readings, _ = streams(np.random.default_rng(1))
    none, late = Stream.empty(1), Stream(readings.time_ns[199:200], np.array([[21.0]]))
    thermometer = _Thermometer(True)
    assert thermometer.pairs(Batch(readings[:100], readings[:0], none)) == []
    with pytest.raises(InputError, match="has no temperature, which the calibration needs"):
        thermometer.rest()
    ((ready, values),) = thermometer.pairs(Batch(readings[100:], readings[:0], late))
    assert len(ready) == 200 and values is not None and set(values.tolist()) == {21.0}
    assert [len(stream) for stream, _ in thermometer.rest()] == [100]
    plain = _Thermometer(False)
    assert plain.pairs(Batch(readings, readings[:0], late)) == [(readings, None)] and plain.rest() == []


@pytest.fixture(scope="module")
def correction() -> Correction:
    return saved(calibrate(simulated(1)), "run.mcap").correction()


TABLES = {
    "names": [["pose", "ax", "ay", "az"]],
    "names with units": [["pose", "ax [g]", "ay [g]", "az [g]"]],
    "names, units below": [["pose", "ax", "ay", "az"], ["", "g", "g", "g"]],
    "a title, names, some units below": [["Bench 3"], ["pose", "ax [g]", "ay", "az"], ["", "", "g", "g"]],
    "two lines above, names, units below": [["A", "b"], ["C"], ["pose", "ax", "ay", "az"], ["", "g", "g", "g"]],
}


@pytest.mark.parametrize("suffix", [".csv", ".xlsx"])
@pytest.mark.parametrize("name", TABLES)
def test_a_corrected_table_has_names_where_names_were_and_units_where_units_were(
    name: str, suffix: str, correction: Correction, tmp_path: Path
) -> None:
    readings_g = np.vstack([np.eye(3), -np.eye(3)])
    heads, path, copy = TABLES[name], tmp_path / f"poses{suffix}", tmp_path / f"corrected{suffix}"
    rows: list[list[Any]] = [*heads, *([f"face {k}", *own] for k, own in enumerate(readings_g.tolist()))]
    if suffix == ".csv":
        path.write_text("\n".join(",".join(map(str, row)) for row in rows))
    else:
        book = openpyxl.Workbook()
        for row in rows:
            book.active.append([None if cell == "" else cell for cell in row])  # type: ignore[union-attr]
        book.save(path)
    apply_to_table(correction, path, copy, {}, {}, Units())
    if suffix == ".csv":
        found = list(csv.reader(copy.read_text().splitlines()))
    else:
        values = openpyxl.load_workbook(copy).active.values  # type: ignore[union-attr]
        found = [["" if cell is None else cell for cell in row] for row in values]
    named, below = ["pose", "ax_mps2", "ay_mps2", "az_mps2"], len(heads) - 1 if "below" in name else len(heads)
    assert [cell for cell in found[below - 1] if cell] == named
    if "below" in name:
        assert found[below] == [cell.replace("g", "m/s^2") for cell in heads[below]]
    for given, kept in zip(heads[: below - 1], found, strict=False):
        assert [cell for cell in kept if cell] == given
    corrected = np.array([[float(cell) for cell in row[1:]] for row in found[len(heads) :]])
    np.testing.assert_allclose(corrected, correction(readings_g * 9.80665), rtol=0, atol=1e-12)


@pytest.mark.parametrize("line", [1, 4])
@pytest.mark.parametrize("cell", ['"a\nb"', '"a\nb,c,d,e"'])
def test_a_row_that_goes_over_several_lines_is_refused(
    line: int, cell: str, correction: Correction, tmp_path: Path
) -> None:
    path, copy = tmp_path / "poses.csv", tmp_path / "corrected.csv"
    faces = np.vstack([np.eye(3), -np.eye(3)]).tolist()
    rows = ["ax [g],ay [g],az [g],remark", *(f'{x},{y},{z},"a face"' for x, y, z in faces)]
    rows[line - 1] = f"{rows[line - 1].rpartition(',')[0]},{cell}"
    path.write_text("\n".join(rows))
    with pytest.raises(InputError, match=f"the row that ends in line {line + 1} goes over several lines"):
        apply_to_table(correction, path, copy, {}, {}, Units())
    assert not copy.exists()


@pytest.mark.parametrize("codec", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "cp1252"])
def test_a_copy_has_the_encoding_of_the_table(codec: str, correction: Correction, tmp_path: Path) -> None:
    path, copy = tmp_path / "poses.csv", tmp_path / "corrected.csv"
    faces = np.vstack([np.eye(3), -np.eye(3)]).tolist()
    rows = ["ax größe [g],ay größe [g],az größe [g],Prüfung", *(f"{x},{y},{z},außen" for x, y, z in faces)]
    path.write_bytes("\n".join(rows).encode(codec))
    columns = {f"a{axis} größe [g]": f"a{axis}_g" for axis in "xyz"}
    apply_to_table(correction, path, copy, {}, columns, Units())
    assert copy.read_bytes()[:2] == path.read_bytes()[:2]
    first, *others = copy.read_text(codec).splitlines()
    assert first == "ax_mps2,ay_mps2,az_mps2,Prüfung" and all(other.endswith(",außen") for other in others)


def test_a_copy_of_a_packed_table_is_plain(correction: Correction, tmp_path: Path) -> None:
    path, copy = tmp_path / "poses.csv.gz", tmp_path / "corrected.csv"
    faces = np.vstack([np.eye(3), -np.eye(3)]).tolist()
    path.write_bytes(
        gzip.compress("\n".join(["ax [g],ay [g],az [g]", *(f"{x},{y},{z}" for x, y, z in faces)]).encode())
    )
    apply_to_table(correction, path, copy, {}, {}, Units())
    assert copy.read_text().splitlines()[0] == "ax_mps2,ay_mps2,az_mps2" and len(copy.read_text().splitlines()) == 7
