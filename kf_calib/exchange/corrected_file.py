"""A copy of a recording or a table with corrected readings in it.

In a recording they stand beside the raw ones, as one more topic, sensor_msgs/msg/Imu: ``linear_acceleration`` is
specific force in the frame of the block, and its covariance (row by row) that of the calibration, largest over all
directions of gravity, and of the noise of a reading. In a table of mean readings (CSV or Excel) the names and the cells
of the three columns of readings are replaced, in m/s^2; all else stays.
"""

from __future__ import annotations

import io
import struct
from codecs import BOM_UTF8
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.keys import BenchKeys
from kf_calib.bench.streams import Batch, Stream
from kf_calib.effects.stimulus import REFERENCE_TEMPERATURE_C
from kf_calib.errors import InputError
from kf_calib.estimation.correction import Correction
from kf_calib.exchange.corrected_lines import NormAtRest
from kf_calib.sources.files import cdr
from kf_calib.sources.files.contents import CALIBRATED_TOPIC
from kf_calib.sources.files.mcap_append import TopicAppender, source_file
from kf_calib.sources.files.recording import Recording
from kf_calib.sources.text.cells import written
from kf_calib.sources.text.encoding import encoding_of, unpacked
from kf_calib.sources.text.heading import TextHeading, with_texts
from kf_calib.sources.text.means import TableOfMeans
from kf_calib.sources.text.reader import named
from kf_calib.sources.text.spreadsheet import sheets_of, workbook_of
from kf_calib.sources.text.units import Units
from kf_calib.support.output_files import whole, write_whole

FRAME_ID = "block"


@dataclass(frozen=True)
class Applied:
    """What was corrected: number of readings, those that are not finite, and the extremes of the temperature, degC
    (None: not used)."""

    readings: int
    not_finite: int
    temperature_c: tuple[float, float] | None


def apply_to_file(
    correction: Correction,
    recording: Recording,
    copy: Path,
    on_progress: Callable[[float], None] | None = None,
    *,
    unchecked: bool = False,
) -> Applied:
    """Write the ``copy``, wholly or not at all; unchecked: though the norm at rest may not be gravity.

    Raises InputError where the recording cannot be read, is not whole, has no temperature where an effect needs one, or
    holds other readings than it is taken for.
    """
    norm = NormAtRest(correction)
    thermometer = _Thermometer(bool(correction.needs_temperature))
    count = bad = 0
    source = source_file(recording.path)
    with whole(copy) as part, part.open("wb") as file:
        copied, told = _half(on_progress, 0.0), _half(on_progress, 0.5)
        appender = TopicAppender(source, file, CALIBRATED_TOPIC, cdr.IMU, _template(correction), copied)
        for readings, temperature_c in _pairs(recording, thermometer, told):
            values = correction.of_readings(readings.values, temperature_c)
            norm.add(readings)
            appender.add(Stream(readings.time_ns, values))
            count, bad = count + len(values), bad + int(np.count_nonzero(~np.isfinite(values).all(axis=1)))
        if not unchecked and (said := norm.misfit(recording.bench.input, final=True)):
            raise InputError(f"{recording.path}: {said}.")
        if bad == count > 0:
            raise InputError(f"{recording.path}: none of the {count} readings is what the calibration's device can "
                             f"send ({correction.input}): state what they are, by --accel-unit, --accel-scale and "
                             "--channels.")  # fmt: skip
        appender.finish()
    return Applied(count, bad, thermometer.extremes)


def _pairs(
    recording: Recording, thermometer: _Thermometer, told: Callable[[float], None] | None
) -> Iterator[tuple[Stream, Floats | None]]:
    """Yield all readings of a recording with their temperatures."""
    for batch in recording:
        yield from thermometer.pairs(batch)
        if told is not None:
            told(recording.fraction)
    yield from thermometer.rest()


def _half(told: Callable[[float], None] | None, start: float) -> Callable[[float], None] | None:
    """Return what tells the progress of one of two halves of the work."""
    return None if told is None else lambda share: told(start + 0.5 * share)


def _template(correction: Correction) -> bytes:
    """Return a message with the covariance of corrected readings filled in."""
    covariances = correction.covariance_of(correction.gravities, REFERENCE_TEMPERATURE_C, noise=True)
    worst = covariances[np.argmax(np.einsum("nii->n", covariances))]
    message = bytearray(cdr.imu_message(FRAME_ID))
    message[-72:] = struct.pack("<9d", *worst.ravel())  # the last field of the message
    return bytes(message)


_FIRST_NS = np.iinfo(np.int64).min  # before any stamp


class _Thermometer:
    """Pairs readings with temperatures, interpolated between measurements and constant beyond them.

    Readings wait until a temperature as late as they are has come; memory is that of the readings between two
    temperatures.
    """

    def __init__(self, needed: bool) -> None:
        self._needed = needed
        self._times, self._values = np.zeros(0, np.int64), np.zeros(0)
        self._waiting, self._reached_ns = Stream.empty(3), _FIRST_NS
        self.extremes: tuple[float, float] | None = None

    def pairs(self, batch: Batch) -> list[tuple[Stream, Floats | None]]:
        """Readings that can be corrected now, and their temperatures (None: not needed)."""
        if not self._needed:
            return [(batch.accel, None)] if len(batch.accel) else []
        self._take(batch.temperature)
        self._waiting += batch.accel
        if not len(self._times):
            return []
        ready = self._waiting.time_ns <= self._times[-1]
        count = len(ready) if ready.all() else int(np.argmin(ready))  # in order of their coming
        if not count:
            return []
        found, self._waiting = self._waiting[:count], self._waiting[count:]
        self._reached_ns = int(found.time_ns[-1])
        return [self._paired(found)]

    def rest(self) -> list[tuple[Stream, Floats | None]]:
        """Readings after the last temperature. Raises InputError where there was none at all."""
        if not len(self._waiting):
            return []
        if not len(self._times):
            raise InputError(
                "the recording has no temperature, which the calibration needs: record it on /temperature, or name "
                "its topic by --temperature-topic."
            )
        return [self._paired(self._waiting)]

    def _take(self, stream: Stream) -> None:
        """Keep new temperatures that are finite and later than the last, and no more of the old ones than needed."""
        values = stream.values[:, 0] if len(stream) else np.zeros(0)
        last_ns = self._times[-1] if len(self._times) else _FIRST_NS
        before_ns = np.maximum.accumulate(np.append(last_ns, stream.time_ns))[:-1]
        fresh = (stream.time_ns > before_ns) & np.isfinite(values)
        if not fresh.any():
            return
        first = self._waiting.time_ns[0] if len(self._waiting) else self._reached_ns
        kept = max(int(np.searchsorted(self._times, first)) - 1, 0)
        self._times = np.append(self._times[kept:], stream.time_ns[fresh])
        self._values = np.append(self._values[kept:], values[fresh])
        low, high = float(values[fresh].min()), float(values[fresh].max())
        old = self.extremes or (low, high)
        self.extremes = min(low, old[0]), max(high, old[1])

    def _paired(self, readings: Stream) -> tuple[Stream, Floats]:
        return readings, np.interp(readings.time_ns, self._times, self._values)


_NAMES = ("ax_mps2", "ay_mps2", "az_mps2")


def apply_to_table(
    correction: Correction,
    path: Path,
    copy: Path,
    overrides: BenchKeys,
    columns: Mapping[str, str],
    units: Units,
    *,
    unchecked: bool = False,
) -> Applied:
    """Write the ``copy``, wholly or not at all; arguments as of ``open_table`` and ``apply_to_file``."""
    if units.where:
        raise InputError(f"{path}: a corrected copy has every row, of one sensor: put its rows in a file (--where).")
    with named(str(path)):
        opening = TableOfMeans(path, columns, overrides, units, angles=False)
        table = opening.table()
    means = table.orientations.mean_mps2
    warmth = table.orientations.temperature_c
    if correction.needs_temperature and not np.isfinite(warmth).all():
        raise InputError(f"{path}: has no temperature, which the calibration needs: add a column of it.")
    norm = NormAtRest(correction)
    norm.add_means(means, float(np.max(correction.noise_mps2)))
    if not unchecked and (said := norm.misfit(table.bench.input, final=True)):
        raise InputError(f"{path}: {said}.")
    force = correction.of_readings(means, warmth if correction.needs_temperature else None)
    write = _to_excel if path.suffix.lower() in (".xlsx", ".xlsm") else partial(_to_text, dataset=units.dataset)
    write(path, copy, opening.columns.heading, opening.columns.accel().at, force)
    known = warmth[np.isfinite(warmth)]
    used = (float(known.min()), float(known.max())) if correction.needs_temperature else None
    return Applied(len(force), int(np.count_nonzero(~np.isfinite(force).all(axis=1))), used)


def _heads(heading: TextHeading) -> Iterator[tuple[int, Sequence[str]]]:
    """Return the lines of the header and, where there is one, of units, with what a copy has there for the three
    readings."""
    return zip(heading.lines_of_names, (_NAMES, ["m/s^2"] * 3), strict=False)


def _to_excel(path: Path, copy: Path, heading: TextHeading, places: Sequence[int], force: Floats) -> None:
    """Write a copy of a workbook."""
    book = workbook_of(path)
    sheet = book[next(each.name for each in sheets_of(path) if not each.hidden)]
    for line, texts in _heads(heading):
        for place, text in zip(places, texts, strict=True):
            if sheet.cell(line + 1, place + 1).value is not None:
                sheet.cell(line + 1, place + 1).value = text
    for line, own in zip(heading.numbers, force.tolist(), strict=True):
        for place, value in zip(places, own, strict=True):
            cell = sheet.cell(line + 1, place + 1)
            if type(cell).__name__ == "MergedCell":
                raise InputError(f"{path}: cell {cell.coordinate} is merged with others, so no reading can be written "
                                 "there: part the cells.")  # fmt: skip
            cell.value = written(value)
    content = io.BytesIO()
    book.save(content)
    write_whole(copy, content.getvalue())


def _to_text(path: Path, copy: Path, heading: TextHeading, places: Sequence[int], force: Floats, dataset: str) -> None:
    """Write a copy of a text, or of a dataset of a container, in its encoding."""
    content = unpacked(path, dataset)
    encoding, plain_codec = encoding_of(content), "utf-8-sig" if content.startswith(BOM_UTF8) else "utf-8"
    codec, errors = (encoding, "strict") if encoding.startswith("utf-16") else (plain_codec, "surrogateescape")
    lines = content.decode(codec, errors).splitlines(keepends=True)
    are_commas = heading.delimiter != "," and not any("." in lines[number] for number in heading.numbers)
    texts = [[repr(written(value)).replace(".", "," if are_commas else ".") for value in own]
             for own in force.tolist()]  # fmt: skip
    for number, new in (*zip(heading.numbers, texts, strict=True), *_heads(heading)):
        line, is_units = lines[number], number in heading.lines_of_names[1:]
        spans = heading.spans(line.rstrip("\r\n"))
        cells = [line[start:end] for start, end in spans]
        if _is_part(cells) or not (is_units or len(spans) > max(places)):
            raise InputError(
                f"{path}: the row that ends in line {number + 1} goes over several lines: write it in one, without "
                "line breaks in its cells."
            )
        filled = {place: text for place, text in zip(places, new, strict=True)
                  if not is_units or (place < len(cells) and cells[place].strip('" '))}  # fmt: skip
        lines[number] = with_texts(line, spans, filled)
    write_whole(copy, "".join(lines).encode(codec, errors))


def _is_part(cells: Sequence[str]) -> bool:
    """Tell whether the cells of a line are the end of a row, in which a quoted cell has a line break."""
    in_quotes = any(cell.startswith('"') or cell.endswith('"') for cell in cells)
    return in_quotes and sum(cell.count('"') for cell in cells) % 2 == 1
