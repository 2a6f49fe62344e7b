"""From bytes to lines, in whichever encoding, with whichever line ends, packed by gzip or not.

A file of text is given as bytes in UTF-8, piece by piece; memory is that of a piece and a line, whatever comes.
"""

from __future__ import annotations

import codecs
import gzip
import itertools
import re
import zlib
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path

from kf_calib.errors import InputError
from kf_calib.sources.containers.opening import DatasetText, dataset_of, kind_of_container
from kf_calib.sources.text.documents import LONGEST_LINE_BYTES, objects_in

_GZIP = b"\x1f\x8b"
LARGEST_TABLE_BYTES = 50_000_000
TOO_LARGE = (
    "{}: is larger than a table of orientations can be: leave out what is not part of it; if it holds samples, save "
    "them as CSV with a column of time (docs/own_csv.md)."
)
_HEAD_BYTES, _BLOCK_BYTES = 1 << 18, 1 << 20
_CYRILLIC = re.compile(rb"[\xc0-\xff]{3}")


class TextFile(AbstractContextManager["TextFile"]):
    """Opened to be read once. dataset: of a container, that which is read, or the one that is taken where it is empty.

    trouble: a sentence if its end cannot be unpacked. said: what of a container was taken, where that was a choice.
    Raises OSError, and InputError of a container.
    """

    def __init__(self, path: Path, dataset: str = "") -> None:
        self._size = max(path.stat().st_size, 1)
        arrays = dataset_of(path, dataset) if kind_of_container(path) else None
        self.trouble, self._head, self._has_ended, self.said = "", b"", False, arrays.said if arrays else ()
        self._raw = path.open("rb")
        try:
            self._text = DatasetText(arrays) if arrays else None
            packed = self._raw.peek(2).startswith(_GZIP)
            self._file = self._text or (gzip.GzipFile(fileobj=self._raw) if packed else self._raw)
            self._head = self.unpacked(_HEAD_BYTES)
        except BaseException:
            self.close()
            raise
        encoding = encoding_of(self._head)
        self._decoder = None if encoding == "utf-8" else codecs.getincrementaldecoder(encoding)("replace")
        plain = self._decoder is None
        self._objects = objects_in(self._head if plain else self._head.decode(encoding, "ignore").encode())

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def fraction(self) -> float:
        """The share of the file that has been read."""
        return self._text.fraction if self._text else min(self._raw.tell() / self._size, 1.0)

    def read(self, size: int) -> bytes:
        """The next bytes, about so many; none at the end. Of objects over several lines, a line each."""
        if self._objects is None:
            return self._decoded(size)
        while block := self._decoded(size):
            if lines := self._objects.push(block):
                return lines
        return self._objects.rest()

    def _decoded(self, size: int) -> bytes:
        block = self.unpacked(size)
        if self._decoder is None:
            return block
        text = self._decoder.decode(block, final=not block)
        return text.encode() or (self._decoded(size) if block else b"")

    def unpacked(self, size: int) -> bytes:
        """The next bytes as they stand in the file, or in what gzip has packed there, so many; fewer at the end."""
        block, self._head = bytearray(self._head), b""
        try:
            while len(block) < size and not self._has_ended:
                piece = self._file.read1(size - len(block))
                block += piece
                self._has_ended = not piece
        except (EOFError, zlib.error, gzip.BadGzipFile) as error:
            self.trouble = f"its end cannot be unpacked ({error}): copy it anew, what comes before is used."
            self._has_ended = True
        return bytes(block)

    def close(self) -> None:
        self._raw.close()


def head_of(path: Path, dataset: str = "") -> bytes:
    """The beginning of a file: of one that is packed by gzip, of what is in it. dataset, raises: as of ``TextFile``."""
    with TextFile(path, dataset) as file:
        return file.read(_HEAD_BYTES)


def holds_any(path: Path, words: Sequence[bytes]) -> bool:
    """Whether any of these words, in UTF-8, is in a text. Raises OSError."""
    with TextFile(path) as file:
        blocks = itertools.chain([b""], iter(partial(file.read, _BLOCK_BYTES), b""))
        return any(word in before + block for before, block in itertools.pairwise(blocks) for word in words)


def unpacked(path: Path, dataset: str = "") -> bytes:
    """The whole of a file, unpacked; of a container the lines of a dataset.

    Raises InputError where it has more bytes than a table of orientations or its end cannot be unpacked, OSError where
    it cannot be read.
    """
    with TextFile(path, dataset) as file:
        content = file.unpacked(LARGEST_TABLE_BYTES + 1)
    if len(content) > LARGEST_TABLE_BYTES:
        raise InputError(TOO_LARGE.format(path))
    if file.trouble:
        raise InputError(f"{path}: {file.trouble.partition(': ')[0]}: copy it anew.")
    return content


def encoding_of(content: bytes) -> str:
    """UTF-8 or UTF-16, each with or without a byte-order mark, or else a code page of Windows, by the beginning.

    It is Cyrillic (1251) where three letters beyond ASCII follow each other, as in no Western language, or else 1252.
    """
    head = content[:_HEAD_BYTES]
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    plain = head.rstrip(b"\0")
    for at, encoding in ((1, "utf-16-le"), (0, "utf-16-be")):
        if plain[at::2].count(0) > len(plain) // 4:  # of every second byte more than half
            return encoding
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        return "cp1251" if _CYRILLIC.search(head) else "cp1252"
    return "utf-8"


class Cutter:
    """Bytes as they come, cut into lines; a line that is too long is left empty, and refused with its number.

    Lines end with a carriage return where one comes alone before any line feed, else with a line feed. keeps_ends:
    whether lines are given with what ends them, and with bytes that are no UTF-8 (as surrogates), so that they can be
    written again.
    """

    def __init__(self, refuse: Callable[[int, str], None], *, keeps_ends: bool = False) -> None:
        self._refuse, self._keeps_ends = refuse, keeps_ends
        self._tail, self._cut, self._end = bytearray(), 0, b""

    @property
    def is_amid(self) -> bool:
        """Whether the last line has not ended yet."""
        return bool(self._tail)

    def push(self, block: bytes) -> list[str]:
        """The lines that end in ``block``."""
        self._tail += block
        if not self._end:  # of a carriage return at the end, what follows tells whether it ends a line alone
            self._end = b"\n" if b"\n" in self._tail else b"\r" if b"\r" in self._tail[:-1] else b""
        count = self._tail.rfind(self._end or b"\n") + 1
        lines = self._lines(bytes(self._tail[:count])) if count else []
        self._tail = self._tail[count:][: LONGEST_LINE_BYTES + 1]
        return lines

    def rest(self) -> list[str]:
        """The line without an end, if there is one."""
        block = bytes(self._tail)
        self._tail.clear()
        return self._lines(block) if block else []

    def _lines(self, block: bytes) -> list[str]:
        """Return the lines of a block, of which the last may have no end."""
        mark, too_long = self._end or b"\n", list[int]()
        if len(block) > LONGEST_LINE_BYTES:
            too_long = [k for k, line in enumerate(block.split(mark)) if len(line) > LONGEST_LINE_BYTES]
        if not self._keeps_ends and mark == b"\n":
            block = block.replace(b"\r\n", b"\n").removesuffix(b"\r")
        text, end = block.decode("utf-8", "surrogateescape" if self._keeps_ends else "replace"), mark.decode()
        lines = text.removesuffix(end).split(end)
        if self._keeps_ends:
            lines = [*(line + end for line in lines[:-1]), lines[-1] + end * text.endswith(end)]
        for k in too_long:
            self._refuse(self._cut + k + 1, "it is longer than 1 MiB")
            lines[k] = ""
        self._cut += len(lines)
        return lines
