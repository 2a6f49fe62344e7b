"""Lines of JSON or CSV, from a file or live from a stream, as a source of batches (docs/format.md, "Lines").

The first line that is not empty decides: ``{`` or ``[`` begins JSON lines, anything else is the header of a CSV table.
Bytes are taken as they arrive and cut into lines here; memory is that of one block and one line, whatever comes.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
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
from kf_calib.sources.text.json_lines import POSE_KEYS, JsonLines
from kf_calib.sources.text.reader import Account, Described, LineReader, first_line, is_json, named
from kf_calib.sources.text.units import Units

_BLOCK_BYTES = 1 << 18
_SAMPLED, _BLOCKS_SAMPLED = 64, 1000  # readings of a block that tell how numbers are to be read, and blocks
_TELLING_ROWS = 8  # of CSV, at the beginning of a stream
OpenReader = Callable[[Sequence[str], Account], tuple[LineReader, int]]
_SURVEY_LINES = 1_000_000  # without a pose in them, none will come


class Lines:
    """Lines as a ``Source``: a path can be iterated again, a stream only once.

    source: path of a file, or a binary stream, which is read as data arrive. overrides: bench metadata keys that win
    over those on the first line. columns: our name for each foreign column or key, for example
    ``{"acc_x[g]": "ax_g"}``. name: what messages call a stream. units: where the header names none, and the size of a
    count. angles: False to do without platform angles; poses that come are then left out; None to do so where a file
    of CSV has no column of them. Raises InputError where the lines cannot be used.
    """

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
        self._wants_pose = True
        self._begin_ns: int | None = None
        self._bench: Bench | None = None
        self._waiting: _Passage | None = None  # begun to learn of the bench, not yet iterated
        self._latest: _Passage | None = None

    @property
    def bench(self) -> Bench:
        """The bench; a stream is read for it up to the first pose, which shows how the platform is described."""
        if self._bench is None:
            passage = self._begin()
            passage.close()  # a file is read from its beginning again, if it is
            reader, default = passage.parser, self._units.input
            if reader.wants_pose:
                self._bench = reader.bench(self.name, self._overrides, default)
            else:
                stated = reader.stated(self.name, self._overrides, default)
                lacking = self._angles is None
                self._bench, self._said = bench_without_angles(self.name, stated, are_lacking=lacking)
            self._wants_pose, self._waiting = reader.wants_pose, None if self.path else passage
        return self._bench

    @property
    def warnings(self) -> list[str]:
        told = self._latest.sentences() if self._latest else []
        return [*self._said, *(f"{self.name}: {sentence}" for sentence in told)]

    @property
    def fraction(self) -> float:
        return self._latest.fraction if self._latest else 0.0

    def __iter__(self) -> Iterator[Batch]:
        readings = self.bench.input.readings  # here, so that a bench that cannot be used is told first
        converted = (with_accel(batch, readings(batch.accel.values)) for batch in self.batches())
        yield from converted if self._wants_pose else map(without_poses, converted)
        if self.path and self._latest:
            sampled = np.concatenate([np.zeros((0, 3)), *self._latest.sampled])
            refuse_unread(sampled, self.bench.input.counts, self.name)

    def batches(self) -> Iterator[Batch]:
        """What the lines hold, whatever the bench may be: raw readings."""
        passage, self._waiting = self._waiting or self._begin(), None
        for batch in passage:
            if self._begin_ns is None and len(batch.accel):
                self._begin_ns = int(batch.accel.time_ns[0])
            yield batch

    def begin_ns(self) -> int | None:
        """Stamp of the first reading; None where there is none. Reads a file as far as to there, unless it has been
        read."""
        if self._begin_ns is None and self.path:
            next((batch for batch in self if len(batch.accel)), None)
        return self._begin_ns

    @property
    def described(self) -> Described | None:
        """What the lines say of the bench, as far as they were read."""
        return self._latest.parser if self._latest else None

    def _begin(self) -> _Passage:
        stream, self._stream = self._stream, None
        try:
            stream = TextFile(self.path, self._units.dataset) if self.path else stream
        except OSError as error:
            raise InputError(f"{self.name}: cannot be read ({error.strerror}).") from None
        if stream is None:
            raise InputError(f"{self.name} can be read only once: record it to a file to read it again.")
        self._latest = _Passage(self.name, stream, self._reader)
        return self._latest

    def _reader(self, lines: Sequence[str], account: Account) -> tuple[LineReader, int]:
        angles = self._angles
        if angles is None and self.path and is_json(lines[0]):
            theirs = [name for name, ours in self._columns.items() if ours in POSE_KEYS]
            angles = holds_any(self.path, [f'"{name}"'.encode() for name in (*POSE_KEYS, *theirs)])
        return reader_for(lines, self._columns, account, angles=angles, units=self._units, stated=self._stated)


def reader_for(
    lines: Sequence[str], columns: Mapping[str, str], account: Account, *, angles: bool | None, units: Units,
    stated: Mapping[str, str] = MappingProxyType({}),
) -> tuple[LineReader, int]:  # fmt: skip
    """The reader that the first lines ask for, and how many of these are its heading.

    lines: the first of them is not empty. angles: whether a pose is wanted; None: where a header has one. stated: of
    the columns, those that a header must have. Raises InputError for one that does not say what is needed.
    """
    if is_json(lines[0]):
        return JsonLines(columns, account, angles is not False), 0
    heading = TextHeading.of(lines)
    refuse_unknown_names(stated, heading.header)
    return CsvLines(Columns(heading, columns, units), account, angles), heading.lines


class _Passage:
    """One reading of the lines, from the first to the last; iterated once.

    parser: chosen by the first lines, of CSV by some rows as well, which tell what the header may not. sampled: some of
    the readings (n, 3) as they stand in the lines. What is read for the first readings and pose, if there must be one,
    is kept till it is iterated.
    """

    def __init__(self, name: str, stream: BinaryIO | TextFile, open_reader: OpenReader) -> None:
        self.account, self._name, self._stream = Account(), name, stream
        self._file = stream if isinstance(stream, TextFile) else None
        self.fraction = 0.0 if self._file else math.nan
        self._has_accel = self._has_pose = False
        self.sampled = deque[Floats](maxlen=_BLOCKS_SAMPLED)
        self._blocks = self._split()
        try:
            first = self._first_lines()
            with named(name):
                self.parser, heading = open_reader(first, self.account)
            self._said = self.parser.said
            self.account.lines += heading
            self._ahead = [self._parse(first[heading:])]
            while not self._has_accel or self._lacks_pose:
                lines = next(self._blocks, None)
                if lines is None or self.account.lines > _SURVEY_LINES:
                    raise self._unusable("platform angles" if self._lacks_pose else "readings")
                self._ahead.append(self._parse(lines))
        except BaseException:
            self.close()
            raise

    def sentences(self) -> list[str]:
        """What was taken for what, where that is not plain, and what was not used."""
        chosen, trouble = (self._file.said, self._file.trouble) if self._file else ((), "")
        told = [f"{'; '.join(self._said)}. {HOW}."] if self._said else []
        return [*(f"{said}." for said in chosen), *told, *([trouble] if trouble else []), *self.account.sentences()]

    def close(self) -> None:
        """Closes a file opened here."""
        if self._file:
            self._file.close()

    def _first_lines(self) -> list[str]:
        """Return lines from the first on that is not blank, as many as tell what they are."""
        first = list[str]()
        for lines in self._blocks:
            first += lines
            blank = first_line(first)
            self.account.lines += blank
            del first[:blank]
            if len(first) > _TELLING_ROWS or (first and is_json(first[0])):
                break
        if not first:
            raise InputError(f"{self._name} holds no lines: check that the logger wrote any.")
        return first

    @property
    def _lacks_pose(self) -> bool:
        return self.parser.wants_pose and not self.parser.pose_width

    def __iter__(self) -> Iterator[Batch]:
        try:
            while self._ahead:
                yield self._ahead.pop(0)
            yield from map(self._parse, self._blocks)
        finally:
            self.close()
        if not self._has_accel:
            raise self._unusable("readings")
        if self.parser.wants_pose and not self._has_pose:
            raise self._unusable("platform angles")

    def _parse(self, lines: list[str]) -> Batch:
        batch = self.parser.read(lines, self.account.lines + 1)
        self.account.lines += len(lines)
        if count := len(batch.accel):
            self._has_accel = True
            self.sampled.append(batch.accel.values[:: count // _SAMPLED + 1].copy())
        self._has_pose |= len(batch.pose) > 0
        return batch

    def _split(self) -> Iterator[list[str]]:
        """Whole lines, block by block as they arrive."""
        cutter = Cutter(self.account.refuse)
        read = getattr(self._stream, "read1", self._stream.read)  # read1 does not wait until a whole block has come
        try:
            while block := read(_BLOCK_BYTES):
                if lines := cutter.push(block):
                    self.fraction = self._file.fraction if self._file else math.nan
                    yield lines
        except OSError as error:
            raise InputError(f"{self._name}: cannot be read on ({error.strerror}).") from None
        if lines := cutter.rest():
            yield lines
        self.fraction = 1.0

    def _unusable(self, what: str) -> InputError:
        without = ", or do without (--no-angles)" if what == "platform angles" else ""
        return self.account.refusal(f"{self._name}: no {what}", self.parser.advice + without)
