"""Lines of JSON or CSV, from a file or live from a stream, as a source of batches (docs/format.md, "Lines").

The first line that is not empty decides: ``{`` or ``[`` begins JSON lines, anything else is the header of a CSV table.
Bytes are taken as they arrive and cut into lines here; memory is that of one block and one line, whatever comes.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import BinaryIO

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench
from kf_calib.bench.counts import refuse_unread
from kf_calib.bench.keys import UNSTATED, BenchKeys
from kf_calib.bench.streams import Batch, bench_without_angles, with_accel, without_poses
from kf_calib.errors import InputError
from kf_calib.sources.files.fields import as_columns
from kf_calib.sources.text.columns import HOW, Columns, refuse_unknown_names
from kf_calib.sources.text.csv_lines import CsvLines
from kf_calib.sources.text.encoding import Cutter, TextFile, holds_any
from kf_calib.sources.text.heading import TextHeading
from kf_calib.sources.text.json_lines import POSE_KEYS, JsonLines, are_ours
from kf_calib.sources.text.reader import LineCounts, LineReader, first_line, is_json, named
from kf_calib.sources.text.units import Units

_BLOCK_BYTES = 1 << 18
_SAMPLED, _BLOCKS_SAMPLED = 64, 1000  # readings of a block that tell how numbers are to be read, and blocks
_TELLING_ROWS = 8  # of CSV, at the beginning of a stream
_SURVEY_LINES = 1_000_000  # without a pose in them, none will come


class Lines:
    """Lines as a ``Source``: a path can be iterated again, a stream only once.

    source: path of a file, or a binary stream, which is read as data arrive. overrides: bench metadata keys that win
    over those on the first line. columns: our name for each foreign column or key, for example
    ``{"acc_x[g]": "ax_g"}``. name: what messages call a stream. units: where the header names none, and the size of a
    count. angles: False to do without platform angles; poses that come are then left out; None to do so where a file
    of CSV has no column of them. described: what the lines say of the bench, as far as they were read. Raises
    InputError where the lines cannot be used.
    """

    described: LineReader | None = None

    def __init__(
        self,
        source: str | PathLike[str] | BinaryIO,
        overrides: BenchKeys = UNSTATED,
        columns: Mapping[str, str] = MappingProxyType({}),
        name: str = "standard input",
        *,
        units: Units | None = None,
        angles: bool | None = True,
    ) -> None:
        self.path = Path(source) if isinstance(source, str | PathLike) else None
        self._stream = None if isinstance(source, str | PathLike) else source
        self.name = str(self.path) if self.path else name
        self._said, self._overrides, self._stated = list[str](), overrides, columns
        self._columns = {**as_columns(overrides.get("joints", "")), **columns}
        self._units = units or Units.of(overrides)
        self._angles = True if angles is None and not self.path else angles
        self._counts, self.fraction = LineCounts(), 0.0
        self._file: TextFile | None = None
        self._begin_ns: int | None = None
        self._bench: Bench | None = None
        self._waiting: Iterator[Batch] | None = None  # begun to learn of the bench, not yet iterated

    @property
    def bench(self) -> Bench:
        """The bench; a stream is read for it up to the first pose, which shows how the platform is described."""
        if self._bench is None:
            batches, reader, default = self._begun(), self.described, self._units.input
            assert reader
            if reader.wants_pose:
                self._bench = reader.bench(self.name, self._overrides, default)
            else:
                stated = reader.stated(self.name, self._overrides, default)
                lacking = self._angles is None
                self._bench, self._said = bench_without_angles(self.name, stated, are_lacking=lacking)
            self._waiting = None if self.path else batches  # a file is read from its beginning again
        return self._bench

    @property
    def warnings(self) -> list[str]:
        """What was taken for what, where that is not plain, and what was not used."""
        chosen, trouble = (self._file.said, self._file.trouble) if self._file else ((), "")
        taken = "; ".join(self.described.said) if self.described else ""
        told = [*(f"{said}." for said in chosen), f"{taken}. {HOW}." * bool(taken), trouble, *self._counts.sentences()]
        return [*self._said, *(f"{self.name}: {sentence}" for sentence in told if sentence)]

    def __iter__(self) -> Iterator[Batch]:
        bench, sampled = self.bench, deque[Floats](maxlen=_BLOCKS_SAMPLED)
        for batch in self.batches():
            if count := len(batch.accel):
                sampled.append(batch.accel.values[:: count // _SAMPLED + 1].copy())
            converted = with_accel(batch, bench.input.readings(batch.accel.values))
            yield converted if bench.angles else without_poses(converted)
        if self.path:
            refuse_unread(np.concatenate([np.zeros((0, 3)), *sampled]), bench.input.counts, self.name)

    def batches(self) -> Iterator[Batch]:
        """What the lines hold, whatever the bench may be: raw readings."""
        batches, self._waiting = self._waiting or self._begun(), None
        for batch in batches:
            if self._begin_ns is None and len(batch.accel):
                self._begin_ns = int(batch.accel.time_ns[0])
            yield batch

    def begin_ns(self) -> int | None:
        """Stamp of the first reading; None where there is none. Reads a file as far as to there, unless it has been
        read."""
        if self._begin_ns is None and self.path:
            next((batch for batch in self if len(batch.accel)), None)
        return self._begin_ns

    def _begun(self) -> Iterator[Batch]:
        """Begin to read, up to the first readings and pose, if there must be one; return what all lines hold."""
        stream, self._stream = self._stream, None
        try:
            self._file = TextFile(self.path, self._units.dataset) if self.path else None
        except OSError as error:
            raise InputError(f"{self.name}: cannot be read ({error.strerror}).") from None
        if (opened := self._file or stream) is None:
            raise InputError(f"{self.name} can be read only once: record it to a file to read it again.")
        batches, ahead, has_accel = self._read(opened), deque[Batch](), False
        for batch in batches:
            ahead.append(batch)
            has_accel |= len(batch.accel) > 0
            lacks_pose = self.described is None or (self.described.wants_pose and not self.described.pose_width)
            if has_accel and not lacks_pose:
                break
            if self._counts.lines > _SURVEY_LINES:
                raise self._unusable("platform angles" if lacks_pose else "readings")
        return itertools.chain((ahead.popleft() for _ in range(len(ahead))), batches)

    def _read(self, stream: BinaryIO | TextFile) -> Iterator[Batch]:
        """Yield what all lines hold. The first of them choose the reader, of CSV with some rows, which tell what the
        header may not."""
        counts = self._counts = LineCounts()
        has_accel, has_pose, first = False, False, list[str]()
        try:
            blocks = self._blocks(stream)
            for lines in blocks:
                first += lines
                blank = first_line(first)
                counts.lines += blank
                del first[:blank]
                if first and are_telling(first):
                    break
            if not first:
                raise InputError(f"{self.name} holds no lines: check that the logger wrote any.")
            with named(self.name):
                reader, heading = self._reader(first)
            self.described = reader
            counts.lines += heading
            for lines in itertools.chain([first[heading:]], blocks):
                batch = reader.read(lines, counts.lines + 1)
                counts.lines += len(lines)
                has_accel, has_pose = has_accel or len(batch.accel) > 0, has_pose or len(batch.pose) > 0
                yield batch
        finally:
            if isinstance(stream, TextFile):
                stream.close()
        lacks_pose = reader.wants_pose and not (has_pose if has_accel else reader.pose_width)
        if lacks_pose or not has_accel:
            raise self._unusable("platform angles" if lacks_pose else "readings")

    def _blocks(self, stream: BinaryIO | TextFile) -> Iterator[list[str]]:
        """Yield whole lines, block by block as they arrive."""
        cutter = Cutter(self._counts.refuse)
        read = getattr(stream, "read1", stream.read)  # read1 does not wait until a whole block has come
        try:
            while block := read(_BLOCK_BYTES):
                if lines := cutter.push(block):
                    self.fraction = stream.fraction if isinstance(stream, TextFile) else math.nan
                    yield lines
        except OSError as error:
            raise InputError(f"{self.name}: cannot be read on ({error.strerror}).") from None
        if lines := cutter.rest():
            yield lines
        self.fraction = 1.0

    def _unusable(self, what: str) -> InputError:
        without = ", or do without (--no-angles)" if what == "platform angles" else ""
        advice = self.described.advice if self.described else ""
        return self._counts.refusal(f"{self.name}: no {what}", advice + without)

    def _reader(self, lines: Sequence[str]) -> tuple[LineReader, int]:
        angles = self._angles
        if angles is None and self.path and is_json(lines[0]):
            theirs = [name for name, ours in self._columns.items() if ours in POSE_KEYS]
            angles = holds_any(self.path, [f'"{name}"'.encode() for name in (*POSE_KEYS, *theirs)])
        return reader_for(lines, self._columns, self._counts, angles=angles, units=self._units, stated=self._stated)


def are_telling(lines: Sequence[str]) -> bool:
    """Whether these are enough of the first lines, of which the first is not blank, to choose a reader by."""
    return len(lines) > _TELLING_ROWS or (is_json(lines[0]) and TextHeading.of_json(lines[:1]) is None)


def reader_for(
    lines: Sequence[str], columns: Mapping[str, str], counts: LineCounts, *, angles: bool | None, units: Units,
    stated: Mapping[str, str] = MappingProxyType({}),
) -> tuple[LineReader, int]:  # fmt: skip
    """The reader that the first lines ask for, and how many of these are its heading.

    lines: the first of them is not empty. angles: whether a pose is wanted; None: where a header has one. stated: of
    the columns, those that a header must have. Raises InputError for one that does not say what is needed.
    """
    if is_json(lines[0]) and lines[0].lstrip(" \t\ufeff").startswith("["):
        raise InputError("is one array of JSON: write an object a line, as jq -c '.[]' does.")
    told = TextHeading.of_json(lines) if is_json(lines[0]) and not are_ours(lines, columns) else None
    if is_json(lines[0]) and told is None:
        return JsonLines(columns, counts, angles is not False), 0
    heading = told or TextHeading.of(lines)
    refuse_unknown_names(stated, heading.header)
    return CsvLines(Columns(heading, columns, units), counts, angles), heading.lines
