"""What a file is, and the source that reads it: a recording, a log of samples, or a table of mean readings."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from os import PathLike
from pathlib import Path
from types import MappingProxyType

from kf_calib.bench.keys import UNSTATED, BenchKeys
from kf_calib.bench.streams import Source
from kf_calib.errors import InputError
from kf_calib.sources.file_kind import FileKind
from kf_calib.sources.files.mcap_records import MAGIC
from kf_calib.sources.files.record_files import ROS1_BAG, SQLITE, first_bytes
from kf_calib.sources.files.recording import Recording
from kf_calib.support.text import date_of_stamp, parse_date


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
    from kf_calib.sources.kind_of_text import kind_of_text  # here: a recording needs no reader of text, nor their 30 ms

    return kind_of_text(file, columns, has_rate=has_rate, dataset=dataset)


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
            from kf_calib.sources.text.means import open_table

            return open_table(source, overrides, angles=angles)
        case FileKind.SAMPLES:
            from kf_calib.sources.text.lines import Lines

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
