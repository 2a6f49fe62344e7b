"""Lines of JSON or CSV, from a file or live from a stream, as a source of batches (docs/format.md, "Lines").

The first line that is not empty decides: ``{`` or ``[`` begins JSON lines, anything else is the header of a CSV table.
Bytes are taken as they arrive and cut into lines here; memory is that of one block and one line, whatever comes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import BinaryIO, Protocol

from kf_calib.bench.bench import Bench
from kf_calib.bench.gravity_alone import bench_without_angles, without_poses
from kf_calib.bench.streams import Batch
from kf_calib.errors import BenchError, InputError
from kf_calib.sources.files.csv_lines import CsvLines
from kf_calib.sources.files.joints import as_columns
from kf_calib.sources.files.json_lines import JsonLines
from kf_calib.sources.files.line_parts import Account, LineReader

_BLOCK_BYTES = 1 << 18
LONGEST_LINE_BYTES = 1 << 20
_SURVEY_LINES = 1_000_000  # without a pose in them, none will come


class Lines:
    """Lines as a ``Source``: a path can be iterated again, a stream only once.

    source: path of a file, or a binary stream, which is read as data arrive. overrides: bench metadata keys that win
    over those on the first line. columns: our name for each foreign column or key, for example
    ``{"acc_x[g]": "ax_g"}``. name: what messages call a stream. angles: False to do without platform angles; poses that
    come are then left out. Raises InputError where the lines cannot be used.
    """

    def __init__(
        self,
        source: str | PathLike[str] | BinaryIO,
        overrides: Mapping[str, str] = MappingProxyType({}),
        columns: Mapping[str, str] = MappingProxyType({}),
        name: str = "standard input",
        *,
        angles: bool = True,
    ) -> None:
        self._path = Path(source) if isinstance(source, str | PathLike) else None
        self._stream = None if isinstance(source, str | PathLike) else source
        self.name = str(self._path) if self._path else name
        self._angles, self._said = angles, list[str]()
        self._overrides, self._columns = overrides, {**as_columns(overrides.get("joints", "")), **columns}
        self._bench: Bench | None = None
        self._waiting: _Passage | None = None  # begun to learn of the bench, not yet iterated
        self._latest: _Passage | None = None

    @property
    def bench(self) -> Bench:
        """The bench; a stream is read for it up to the first pose, which shows how the platform is described."""
        if self._bench is None:
            self._waiting = self._begin()
            with self._waiting.closed_on_failure():
                self._bench = self._describe_bench(self._waiting)
        return self._bench

    @property
    def warnings(self) -> list[str]:
        account = self._latest.account if self._latest else Account()
        return [*self._said, *(f"{self.name}: {sentence}" for sentence in account.sentences())]

    @property
    def fraction(self) -> float:
        return self._latest.fraction if self._latest else 0.0

    def __iter__(self) -> Iterator[Batch]:
        _ = self.bench  # so that a bench that cannot be used is told first
        return self.batches() if self._angles else map(without_poses, self.batches())

    def batches(self) -> Iterator[Batch]:
        """What the lines hold, whatever the bench may be."""
        passage, self._waiting = self._waiting or self._begin(), None
        return iter(passage)

    @property
    def described(self) -> Described | None:
        """What the lines say of the bench, as far as they were read."""
        return self._latest.parser if self._latest else None

    def _begin(self) -> _Passage:
        try:
            if self._path:
                stream, size = self._path.open("rb"), self._path.stat().st_size
            elif self._stream is not None:
                stream, size, self._stream = self._stream, None, None
            else:
                raise InputError(f"{self.name} can be read only once: record it to a file to read it again.")
        except OSError as error:
            raise InputError(f"{self.name}: cannot be read ({error.strerror}).") from None
        self._latest = _Passage(self.name, stream, size, self._columns, self._angles)
        with self._latest.closed_on_failure():
            self._latest.survey()
        return self._latest

    def _describe_bench(self, passage: _Passage) -> Bench:
        if self._angles:
            return bench_of(self.name, passage.parser, self._overrides)
        bench, self._said = bench_without_angles(self.name, {**passage.parser.metadata, **self._overrides})
        return bench


class Described(Protocol):
    """What has been learnt of the bench from what it sent."""

    metadata: dict[str, str]
    has_angles: bool
    pose_width: int


def bench_of(name: str, reader: Described, overrides: Mapping[str, str]) -> Bench:
    """The bench, once a pose has been read. Raises InputError where it cannot be that one."""
    try:
        bench = Bench.from_metadata({**reader.metadata, **overrides}, reader.has_angles)
    except BenchError as error:
        raise BenchError(f"{name}: {error}") from error
    if bench.pose_width != reader.pose_width:
        raise InputError(
            f"{name}: poses have {reader.pose_width} angles and the bench has {bench.pose_width} axes: state "
            'as many axes as there are angles, outer first, for example --axes "y z x".'
        )
    return bench


class Cutter:
    """Bytes as they come, cut into lines; a line that is too long is refused and left empty."""

    def __init__(self, account: Account) -> None:
        self._account, self._tail, self._cut = account, bytearray(), 0

    @property
    def is_amid(self) -> bool:
        """Whether the last line has not ended yet."""
        return bool(self._tail)

    def push(self, block: bytes) -> list[str]:
        """The lines that end in ``block``."""
        end, lines = block.rfind(b"\n") + 1, list[str]()
        if end:
            lines = self._decode(bytes(self._tail) + block[: end - 1])
            self._tail.clear()
        if len(self._tail) <= LONGEST_LINE_BYTES:  # else what comes up to the next end of line is not kept
            self._tail += block[end:]
        return lines

    def rest(self) -> list[str]:
        """The line without an end, if there is one."""
        block = bytes(self._tail)
        self._tail.clear()
        return self._decode(block) if block else []

    def _decode(self, block: bytes) -> list[str]:
        lines = block.replace(b"\r\n", b"\n").removesuffix(b"\r").split(b"\n")
        if len(block) > LONGEST_LINE_BYTES:
            for i, line in enumerate(lines):
                if len(line) > LONGEST_LINE_BYTES:
                    self._account.refuse(self._cut + i + 1, "it is longer than 1 MiB")
                    lines[i] = b""
        self._cut += len(lines)
        return b"\n".join(lines).decode("utf-8", errors="replace").split("\n")


def reader_for(first: str, columns: Mapping[str, str], account: Account, angles: bool = True) -> LineReader:
    """The reader that the first line asks for; angles: whether a pose is wanted.

    Raises InputError for a header that does not say what is needed.
    """
    return JsonLines(columns, account) if first[0] in "{[" else CsvLines(first, columns, account, angles)


class _Passage:
    """One reading of the lines, from the first to the last; iterated once."""

    parser: LineReader

    def __init__(self, name: str, stream: BinaryIO, size: int | None, columns: Mapping[str, str], angles: bool) -> None:
        self.account, self._angles = Account(), angles
        self.fraction = 0.0 if size else math.nan
        self._name, self._columns, self._size, self._stream = name, columns, size, stream
        self._is_ours = size is not None  # a file opened here
        self._blocks = self._split(stream)
        self._ahead = list[Batch]()
        self._has_accel = self._has_pose = False

    @contextmanager
    def closed_on_failure(self) -> Iterator[None]:
        """Closes a file opened here where what is done within fails."""
        try:
            yield
        except BaseException:
            if self._is_ours:
                self._stream.close()
            raise

    def survey(self) -> None:
        """Reads up to the first pose, if there must be one, and keeps what it has read."""
        self._open_parser()
        while self._angles and not self.parser.pose_width:
            batch = self._next_batch()
            if batch is None or self.account.lines > _SURVEY_LINES:
                raise self._unusable("platform angles")
            self._ahead.append(batch)

    def __iter__(self) -> Iterator[Batch]:
        while self._ahead:
            yield self._ahead.pop(0)
        while (batch := self._next_batch()) is not None:
            yield batch
        met = {"readings": self._has_accel, "platform angles": self._has_pose or not self._angles}
        for what, is_met in met.items():
            if not is_met:
                raise self._unusable(what)

    def _open_parser(self) -> None:
        for lines in self._blocks:
            for i, line in enumerate(lines):
                text = line.lstrip("\ufeff").strip()
                if text:
                    self._start(text, lines[i:], i)
                    return
            self.account.lines += len(lines)
        raise InputError(f"{self._name} holds no lines: check that the logger wrote any.")

    def _start(self, first: str, lines: list[str], before: int) -> None:
        """Chooses the parser by the first line and has it read the rest of the first block."""
        self.account.lines += before
        try:
            self.parser = reader_for(first, self._columns, self.account, self._angles)
        except InputError as error:
            raise InputError(f"{self._name}: {error}") from None
        rows = lines[1:]
        if isinstance(self.parser, CsvLines):  # the header has been read
            self.account.lines += 1
        else:
            rows = [first, *rows]
        self._ahead.append(self._parse(rows))

    def _next_batch(self) -> Batch | None:
        lines = next(self._blocks, None)
        return None if lines is None else self._parse(lines)

    def _parse(self, lines: list[str]) -> Batch:
        batch = self.parser.read(lines, self.account.lines + 1)
        self.account.lines += len(lines)
        self._has_accel |= len(batch.accel) > 0
        self._has_pose |= len(batch.pose) > 0
        return batch

    def _split(self, stream: BinaryIO) -> Iterator[list[str]]:
        """Whole lines, block by block as they arrive."""
        cutter, position = Cutter(self.account), 0
        for block in self._read(stream):
            position += len(block)
            if lines := cutter.push(block):
                self.fraction = min(position / self._size, 1.0) if self._size else math.nan
                yield lines
        if lines := cutter.rest():
            yield lines
        self.fraction = 1.0

    def _read(self, stream: BinaryIO) -> Iterator[bytes]:
        read = getattr(stream, "read1", stream.read)  # read1 does not wait until a whole block has come
        with stream if self._is_ours else nullcontext():
            while block := self._read_block(read):
                yield block

    def _read_block(self, read: Callable[[int], bytes]) -> bytes:
        try:
            return read(_BLOCK_BYTES)
        except OSError as error:
            raise InputError(f"{self._name}: cannot be read on ({error.strerror}).") from None

    def _unusable(self, what: str) -> InputError:
        found = "".join(f"; {sentence.rstrip('.')}" for sentence in self.account.sentences())
        return InputError(f"{self._name}: no {what} in {self.account.lines} lines{found}: {self.parser.advice}.")
