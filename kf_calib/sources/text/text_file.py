"""A file of text as bytes in UTF-8 with line ends LF, whatever it is written in, packed by gzip or not.

Logs and tables are read through this, so that both take the same files. Encodings are UTF-8 and UTF-16 with or without
a byte-order mark, and the code pages 1251 and 1252 of Windows; line ends are LF, CR LF or CR.
"""

from __future__ import annotations

import codecs
import gzip
import re
import zlib
from pathlib import Path
from typing import BinaryIO, Self, cast

from kf_calib.errors import InputError

_GZIP = b"\x1f\x8b"
_UTF16 = (b"\xff\xfe", b"\xfe\xff")
_CYRILLIC = re.compile(rb"[\xc0-\xff]{3}")
_HEAD_BYTES = 1 << 16
_MARK = "\ufeff"
_NOT_UNPACKED = (EOFError, zlib.error, gzip.BadGzipFile)


class TextFile:
    """Opened to be read once. trouble: a sentence if its end cannot be unpacked. Raises OSError."""

    def __init__(self, path: Path) -> None:
        self._size = max(path.stat().st_size, 1)
        self._raw = path.open("rb")
        try:
            packed = self._raw.peek(2).startswith(_GZIP)
            self._file = cast("BinaryIO", gzip.GzipFile(fileobj=self._raw)) if packed else self._raw
            self.trouble, self._has_ended = "", False
            self._head = self._unpacked(_HEAD_BYTES)
        except BaseException:
            self._raw.close()
            raise
        encoding = encoding_of(self._head)
        self._decoder = None if encoding == "utf-8" else codecs.getincrementaldecoder(encoding)("replace")
        self._ends_in_cr = b"\r" in self._head and b"\n" not in self._head

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def is_as_read(self) -> bool:
        """Whether what is read is byte for byte what is in the file."""
        return self._file is self._raw and self._decoder is None and not self._ends_in_cr

    @property
    def fraction(self) -> float:
        """The share of the file that has been read."""
        return min(self._raw.tell() / self._size, 1.0)

    def read(self, size: int) -> bytes:
        """The next bytes, about so many; none at the end."""
        block, self._head = self._head or self._unpacked(size), b""
        if self._ends_in_cr:
            block = block.replace(b"\r", b"\n")
        if self._decoder is None:
            return block
        text = self._decoder.decode(block, final=not block)
        return text.encode() or (self.read(size) if block else b"")

    def close(self) -> None:
        self._raw.close()

    def _unpacked(self, size: int) -> bytes:
        if self._has_ended:
            return b""
        try:
            block = self._file.read(size)
        except _NOT_UNPACKED as error:
            block, self.trouble = b"", f"its end cannot be unpacked ({error}): copy it anew, what comes before is used."
        self._has_ended = not block
        return block


def head_of(path: Path) -> bytes:
    """The beginning of a file: of one that is packed by gzip, of what is in it. Raises OSError."""
    with TextFile(path) as file:
        return file.read(_HEAD_BYTES)


def unpacked(path: Path) -> bytes:
    """The whole content of a file, of one that is packed by gzip what is in it. Raises OSError, and InputError where
    its end cannot be unpacked."""
    content = path.read_bytes()
    try:
        return gzip.decompress(content) if content.startswith(_GZIP) else content
    except _NOT_UNPACKED as error:
        raise InputError(f"{path}: its end cannot be unpacked ({error}): copy it anew.") from None


def text_of(path: Path, most: int) -> tuple[str, str]:
    """The whole text of a file without zeros at its end, as a logger leaves that set a length aside, and a sentence
    where its end cannot be unpacked. Raises OSError, and OverflowError where it has more than ``most`` bytes."""
    parts, size = list[bytes](), 0
    with TextFile(path) as file:
        while block := file.read(1 << 20):
            parts.append(block)
            size += len(block)
            if size > most:
                raise OverflowError
        trouble = file.trouble
    return b"".join(parts).decode("utf-8", errors="replace").removeprefix(_MARK).rstrip("\0"), trouble


def encoding_of(head: bytes) -> str:
    """The encoding of a text by its beginning.

    UTF-16 without a mark has a zero beside every letter of English. What is no UTF-8 is Cyrillic (1251) where three
    letters beyond ASCII follow each other, as in no Western language, or else 1252.
    """
    if head.startswith(_UTF16):
        return "utf-16"
    even, odd = head[0:_HEAD_BYTES:2].count(0), head[1:_HEAD_BYTES:2].count(0)
    if max(even, odd) > len(head) // 4 and min(even, odd) <= len(head) // 16:
        return "utf-16-le" if odd > even else "utf-16-be"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)  # whose last character may be cut in two
    except UnicodeDecodeError:
        return "cp1251" if _CYRILLIC.search(head) else "cp1252"
    return "utf-8"
