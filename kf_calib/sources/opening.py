"""What a file is, and the source that reads it: a recording, a log of samples, or a table of mean readings."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from datetime import datetime
from enum import Enum
from os import PathLike
from pathlib import Path
from types import MappingProxyType

import numpy as np

from kf_calib.bench.arrays import lengths
from kf_calib.bench.keys import UNSTATED, BenchKeys
from kf_calib.bench.streams import Source
from kf_calib.errors import InputError
from kf_calib.sources.containers.opening import dataset_of, kind_of_container
from kf_calib.sources.files.contents import CALIBRATION_FORMAT
from kf_calib.sources.files.mcap_file import HEAD_BYTES, is_lines
from kf_calib.sources.files.mcap_records import MAGIC
from kf_calib.sources.files.record_files import ROS1_BAG, SQLITE, first_bytes
from kf_calib.sources.files.recording import Recording
from kf_calib.sources.text.cells import DECIMAL_POINT, LineError
from kf_calib.sources.text.columns import READINGS, Columns
from kf_calib.sources.text.encoding import head_of
from kf_calib.sources.text.grid import OLD_SUFFIXES, TEXT_SUFFIXES, ZIP
from kf_calib.sources.text.heading import TextHeading
from kf_calib.sources.text.lines import Lines
from kf_calib.sources.text.means import open_table
from kf_calib.sources.text.reader import first_line, is_json
from kf_calib.support.text import date_of_stamp, parse_date

_OF_CALIBRATION = 200  # first bytes of a calibration, which name its format
_FEWEST_SAMPLES = 50
_SLOWEST_S = 1.0
"""Rows that are closer are samples, not dwells."""
_MANY, _ALIKE_RAD, _MOST = 500, 0.1, 0.5


class FileKind(Enum):
    """What a file holds.

    - RECORDING: messages in MCAP or SQLite, or nothing that is known.
    - SAMPLES: lines of CSV or JSON, one or more for each sample.
    - TABLE: a row of means for each dwell, in CSV or a spreadsheet.
    - CALIBRATION: the result of a run, as --save writes it.
    """

    RECORDING = "recording"
    SAMPLES = "samples"
    TABLE = "table"
    CALIBRATION = "calibration"


def kind_of(
    path: str | PathLike[str],
    columns: Mapping[str, str] = MappingProxyType({}),
    *,
    has_rate: bool = False,
    dataset: str = "",
) -> FileKind:
    """What a file is, by its beginning; columns: our names of foreign ones, as far as they are stated. has_rate:
    whether a rate of its rows is stated, which only samples have. dataset: of a container, the one that is meant."""
    file = Path(path)
    if not file.is_file():
        return FileKind.RECORDING
    if first_bytes(file).startswith((MAGIC, SQLITE, ROS1_BAG)):  # whatever its name ends in
        return FileKind.RECORDING
    is_container = kind_of_container(file) is not None
    try:
        if is_container and dataset_of(file, dataset).is_log:
            return FileKind.SAMPLES
        head = head_of(file, dataset)
    except OSError:  # said where the file is opened to be read
        return FileKind.RECORDING
    suffix = Path(file.stem if file.suffix.lower() == ".gz" else file).suffix.lower()
    if not is_container and (head.startswith(ZIP) or suffix in OLD_SUFFIXES):
        return FileKind.TABLE
    if not (is_container or suffix in TEXT_SUFFIXES or is_lines(head[:HEAD_BYTES])):
        return FileKind.RECORDING
    lines = head.decode("utf-8", errors="replace").splitlines()
    first = first_line(lines)
    if first == len(lines):
        return FileKind.TABLE
    if CALIBRATION_FORMAT.encode() in head[:_OF_CALIBRATION]:
        return FileKind.CALIBRATION
    if is_json(lines[first]):
        return FileKind.SAMPLES
    return FileKind.SAMPLES if has_rate or _are_samples(lines[first:-1] or lines[first:], columns) else FileKind.TABLE


def _are_samples(lines: list[str], stated: Mapping[str, str]) -> bool:
    """Whether the rows under a header are a time series: many, and close in time or, without one, alike."""
    try:
        columns = Columns(TextHeading.of(lines), stated)
    except InputError:
        return False
    if columns.marks_of_a_table or len(columns.rows) <= _FEWEST_SAMPLES:
        return False
    step_s = _step_s(columns)
    return _are_alike(columns) if math.isnan(step_s) else step_s < _SLOWEST_S


def _step_s(columns: Columns) -> float:
    """Return the usual step from row to row, s; NaN where no time can be told."""
    try:
        time = columns.time()
    except InputError:
        return math.nan
    stamps, numbers = list[int](), columns.numbers or DECIMAL_POINT
    for number, row in enumerate(columns.rows):
        with suppress(LineError):
            stamps.append(time.ns(row, columns.header, numbers, number))
    steps = np.abs(np.diff(np.array(stamps, float)))
    return float(np.median(steps)) / 1e9 if len(steps) else math.nan


def _are_alike(columns: Columns) -> bool:
    """Return whether the readings of most rows are as those before, as of a sensor that lies still between turns; a
    row a dwell would change from one to the next."""
    places = columns.places(*READINGS)
    if len(places) != 3 or len(columns.rows) < _MANY:
        return False
    values = columns.values(places)
    with np.errstate(invalid="ignore", divide="ignore"):
        unit = values / lengths(values)[:, None]
        return bool((lengths(np.diff(unit, axis=0)) < _ALIKE_RAD).mean() > _MOST)


def no_recording(path: str | PathLike[str]) -> InputError:
    """The error of a calibration where a recording is needed."""
    return InputError(
        f"{path}: is a calibration, not a recording: info says what it holds; apply, verify, export, certificate and "
        "history take it."
    )


def opened(source: Source | str | PathLike[str], overrides: BenchKeys = UNSTATED, *, angles: bool = True) -> Source:
    """The source itself, or that of the file at a path; overrides, angles: as of a ``Recording``."""
    if not isinstance(source, str | PathLike):
        return source
    match kind_of(source):
        case FileKind.TABLE:
            return open_table(source, overrides, angles=angles)
        case FileKind.SAMPLES:
            return Lines(source, overrides, angles=angles)
        case FileKind.RECORDING:
            return Recording(source, overrides, angles=angles)
        case FileKind.CALIBRATION:
            raise no_recording(source)


def run_date(source: Source) -> datetime | None:
    """When the run of a source began; None where nothing tells.

    As its bench states it (``date``), by the stamp of its first reading, or, where stamps count from the start of the
    board's clock, by the clock of the computer that received it.
    """
    stated = source.bench.notes.get("date")
    if stated is not None:
        return parse_date(stated)
    begin_ns = getattr(source, "begin_ns", None)
    return date_of_stamp(begin_ns() if begin_ns else None) or getattr(source, "received", None)
