"""What a file of text, a spreadsheet or a container of arrays is: a log of samples, or a table of mean readings."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from kf_calib.bench.arrays import lengths
from kf_calib.errors import InputError
from kf_calib.sources.containers.opening import dataset_of, kind_of_container
from kf_calib.sources.file_kind import FileKind
from kf_calib.sources.files.contents import CALIBRATION_FORMAT
from kf_calib.sources.files.mcap_file import HEAD_BYTES, is_lines
from kf_calib.sources.text.columns import SLOWEST_S, Columns
from kf_calib.sources.text.encoding import head_of
from kf_calib.sources.text.grid import OLD_SUFFIXES, TEXT_SUFFIXES, ZIP
from kf_calib.sources.text.heading import TextHeading
from kf_calib.sources.text.names import READINGS
from kf_calib.sources.text.reader import first_line, is_json

_OF_CALIBRATION = 200  # first bytes of a calibration, which name its format
_MANY, _ALIKE_RAD, _MOST = 500, 0.1, 0.5


def kind_of_text(file: Path, columns: Mapping[str, str], *, has_rate: bool, dataset: str) -> FileKind:
    """What a file is that begins as no recording does; arguments as of ``kind_of``."""
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
    if not columns.may_be_samples:
        return False
    try:
        steps_ns = np.abs(np.diff(columns.stamps_ns(columns.time())))
    except InputError:
        return _are_alike(columns)
    return bool(len(steps_ns)) and float(np.median(steps_ns)) < 1e9 * SLOWEST_S


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
