"""The table of a fleet on disk: files in one folder, of which the newest row of each run counts.

Rows are appended as small Arrow files, which take a hundredth of the time of Parquet, and merged into Parquet from time
to time and at the end. Every file is written beside its place and renamed when it is whole: whoever reads the folder,
at any time and however the writer ended, finds whole files only, and all that was finished. What else lies in the
folder is somebody's own, and neither read nor removed: files of the table are known by their names and columns. A row
that does not say of which run it is or when that was evaluated, or whose factor or parameters are not whole, counts as
not there.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import MAXYEAR, MINYEAR, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.dataset as ds
import pyarrow.parquet as pq

from kf_calib.bench.arrays import Mask
from kf_calib.errors import InputError
from kf_calib.fleet.run_list import SCHEMA, Row, are_whole, name_their_parameters
from kf_calib.support.output_files import lock, whole, writer

pc: Any = pyarrow.compute  # its functions are made when it is imported, which no type checker sees
_SMALL, _LARGE = "*.arrow", "*.parquet"
_OWN_NAME = re.compile(r"runs-\d{20}-\d+")
_KNOWN = ["run", "evaluated", "version", "sha256", "settings"]
_DAMAGE = (pa.ArrowException, OSError, UnicodeDecodeError, MemoryError)
"""What is raised for a damaged file: names of columns may be no text, and lengths more than there is memory."""
_MOST_SMALL = 256
"""Small files that are merged while a fleet is being evaluated."""

AT_ONCE = 64
"""Rows that are in memory together where factors are among their columns: these make a row some 60 kB large."""

_MANY = 8192
"""The same where they are not."""


@dataclass(frozen=True)
class Known:
    """What the table has of a run: when it was evaluated, and by what it is seen whether it has to be again."""

    evaluated: datetime
    version: str
    sha256: str | None
    settings: str


class Store:
    """The folder of a table; it may not exist yet."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "runs"
        self._written = 0
        self._tables = dict[Path, bool]()

    @property
    def exists(self) -> bool:
        """Whether there is a table."""
        return bool(self._files(_LARGE) or self._files(_SMALL))

    @contextmanager
    def taken(self) -> Iterator[None]:
        """Keep everybody else from writing in the folder. Raises InputError where somebody does, or where it cannot be
        made."""
        path = self.folder / ".lock"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            file = path.open("ab")
        except OSError as error:
            raise InputError(f"{self.folder}: {error.strerror}: give another folder (-o).") from None
        with file:
            if not lock(file):
                raise InputError(
                    f"{self.folder.parent} is being written by {writer(path) or 'another run'}: wait for it."
                )
            yield

    def append(self, rows: Sequence[Row]) -> None:
        """Write rows; when this returns they are on disk."""
        if rows:
            with whole(self._new(_SMALL)) as part, pa.ipc.new_file(part, SCHEMA) as file:
                file.write_table(pa.Table.from_pylist(list(rows), SCHEMA))
        if len(small := self._files(_SMALL)) >= _MOST_SMALL:
            self._merge(small)

    def compact(self) -> None:
        """Merge the small files into one; where rows were superseded, all files into one without them."""
        if small := self._files(_SMALL):
            self._merge(small)
        large = self._files(_LARGE)
        if sum(batch.num_rows for batch in _all_rows(large, ["run"], _MANY)) > len(self.known()):
            self._merge(large)

    def known(self) -> dict[str, Known]:
        """What the table has of each run."""
        return _latest(_rows(self._every, _KNOWN, _MANY))

    def checked(self) -> tuple[dict[str, Known], list[str]]:
        """The same of whole rows, for which all are read, and sentences on what counts as not there."""
        lost = 0

        def whole_rows() -> Iterator[pa.RecordBatch]:
            nonlocal lost
            for batch in _all_rows(self._every, [*_KNOWN, "date", "parameters", "factor"], AT_ONCE):
                sound = _sound(batch)
                lost += batch.num_rows - sound.num_rows
                yield sound.select(_KNOWN)

        known = _latest(whole_rows())
        notes = [f"{file} has not the columns of a table of runs, and is passed over: move it away."
                 for file in self._named() if not self._is_table(file)]  # fmt: skip
        if lost:
            rows = "1 row of the table is not whole: its run is" if lost == 1 else (
                f"{lost} rows of the table are not whole: their runs are")  # fmt: skip
            notes.append(f"{self.folder}: {rows} evaluated again, if they are among those named.")
        return known, notes

    def batches(self, columns: Sequence[str], rows: int = _MANY) -> Iterator[pa.RecordBatch]:
        """The newest row of each run, so many at a time; memory is that of one batch and the names of the runs."""
        return _newest(self._every, columns, rows)

    def _merge(self, files: Sequence[Path]) -> None:
        with (
            whole(self._new(_LARGE)) as part,
            pq.ParquetWriter(part, SCHEMA, compression="zstd", write_page_checksum=True) as writer_,
        ):
            for batch in _together(_newest(files, SCHEMA.names, AT_ONCE)):
                writer_.write_table(batch)
        for file in files:
            file.unlink()

    @property
    def _every(self) -> list[Path]:
        return [*self._files(_LARGE), *self._files(_SMALL)]

    def _files(self, kind: str) -> list[Path]:
        return [file for file in self._named() if file.match(kind) and self._is_table(file)]

    def _named(self) -> list[Path]:
        """Return the files that have names of the table's."""
        named = (file for kind in (_LARGE, _SMALL) for file in self.folder.glob(kind) if _OWN_NAME.fullmatch(file.stem))
        return sorted(file for file in named if file.is_file())

    def _is_table(self, file: Path) -> bool:
        """Tell whether a file has columns of the table; one that is damaged is said to be when its rows are read."""
        if file not in self._tables:
            try:
                form = "parquet" if file.match(_LARGE) else "ipc"
                types = {field.name: field.type for field in ds.dataset(str(file), format=form).schema}
            except _DAMAGE:
                return True
            alike = all(types[field.name].equals(field.type) for field in SCHEMA if field.name in types)
            self._tables[file] = alike and {"run", "evaluated"} <= types.keys()
        return self._tables[file]

    def _new(self, kind: str) -> Path:
        self._written += 1
        return self.folder / kind.replace("*", f"runs-{time.time_ns():020d}-{self._written}")


def _latest(batches: Iterable[pa.RecordBatch]) -> dict[str, Known]:
    """Return what the newest row of each run says of it."""
    latest = dict[str, Known]()
    for batch in batches:
        for row in batch.to_pylist():
            if row["run"] not in latest or latest[row["run"]].evaluated <= row["evaluated"]:
                latest[row["run"]] = Known(row["evaluated"], row["version"], row["sha256"], row["settings"])
    return latest


def _newest(files: Sequence[Path], columns: Sequence[str], rows: int) -> Iterator[pa.RecordBatch]:
    """Yield the rows of some files that no other row among them supersedes."""
    newest = dict[str, datetime]()
    for batch in _rows(files, ["run", "evaluated"], _MANY):
        for run, evaluated in zip(*(column.to_pylist() for column in batch.columns), strict=True):
            newest[run] = max(evaluated, newest.get(run, evaluated))
    read = list(dict.fromkeys([*columns, "run", "evaluated"]))
    for batch in _rows(files, read, rows):
        pairs = zip(batch["run"].to_pylist(), batch["evaluated"].to_pylist(), strict=True)
        is_newest = [newest.get(run) == evaluated and bool(newest.pop(run)) for run, evaluated in pairs]
        yield batch.filter(pa.array(is_newest, pa.bool_())).select(list(columns))


def _together(batches: Iterable[pa.RecordBatch]) -> Iterator[pa.Table]:
    """Yield batches joined to ``AT_ONCE`` rows or somewhat more: each becomes a row group, of which a reader keeps a
    description of 10 kB and more in memory."""
    waiting = list[pa.RecordBatch]()
    for batch in batches:
        waiting.append(batch)
        if sum(each.num_rows for each in waiting) >= AT_ONCE:
            yield pa.Table.from_batches(waiting)
            waiting = []
    if waiting:
        yield pa.Table.from_batches(waiting)


def _sound(batch: pa.RecordBatch) -> pa.RecordBatch:
    """Return the rows of a batch that say of which run they are and when it was evaluated, and are whole."""
    sound = np.ones(batch.num_rows, bool)
    for name in ("run", "evaluated"):
        sound &= batch[name].is_valid().to_numpy(zero_copy_only=False)
    for name in {"date", "evaluated"} & set(batch.schema.names):
        sound &= _are_dates(batch[name])
    if "factor" in batch.schema.names:
        sound &= are_whole(batch["factor"])
    if "parameters" in batch.schema.names:
        sound &= name_their_parameters(batch["parameters"])
    return batch if sound.all() else batch.filter(pa.array(sound))


def _are_dates(stamps: pa.TimestampArray) -> Mask:
    """Tell which stamps (n,) are in a year that a date can have, or null."""
    years = pc.year(stamps.cast(pa.timestamp(stamps.type.unit))).fill_null(1).to_numpy(zero_copy_only=False)
    return np.asarray((years >= MINYEAR) & (years <= MAXYEAR))


def _rows(files: Sequence[Path], columns: Sequence[str], rows: int) -> Iterator[pa.RecordBatch]:
    """Yield the sound rows of some files; ``run`` and ``evaluated`` are among the columns."""
    return map(_sound, _all_rows(files, columns, rows))


def _all_rows(files: Sequence[Path], columns: Sequence[str], rows: int) -> Iterator[pa.RecordBatch]:
    """Yield all rows of some files; raises InputError where one of them is damaged."""
    checked = ds.ParquetFileFormat(
        default_fragment_scan_options=ds.ParquetFragmentScanOptions(page_checksum_verification=True)
    )
    for kind, form in ((_LARGE, checked), (_SMALL, "ipc")):
        if own := [str(file) for file in files if file.match(kind)]:
            try:
                data = ds.dataset(own, schema=SCHEMA, format=form)
                # with threads each would keep memory of its own, more with every pass over the table
                for batch in data.to_batches(columns=list(columns), batch_size=rows, batch_readahead=1,
                                             fragment_readahead=1, use_threads=False):  # fmt: skip
                    batch.validate(full=True)  # a damaged small file ends the process elsewhere
                    yield batch
            except _DAMAGE as error:
                said = " ".join(str(error).split()).rstrip(".")
                raise InputError(
                    f"a file of the table is damaged ({said}): move it away, and its runs are evaluated again."
                ) from None
