"""A file of text as bytes in UTF-8, piece by piece: packed by gzip or not, and in whichever encoding it is written."""

from __future__ import annotations

import codecs
import gzip
import zlib
from pathlib import Path
from typing import BinaryIO, Self, cast

from kf_calib.sources.files.line_parts import Account

LONGEST_LINE_BYTES = 1 << 20

_GZIP, _UTF16 = b"\x1f\x8b", (b"\xff\xfe", b"\xfe\xff")
_HEAD_BYTES = 1 << 16


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
        encoding = _encoding(self._head)
        self._decoder = None if encoding == "utf-8" else codecs.getincrementaldecoder(encoding)("replace")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def fraction(self) -> float:
        """The share of the file that has been read."""
        return min(self._raw.tell() / self._size, 1.0)

    def read(self, size: int) -> bytes:
        """The next bytes, about so many; none at the end."""
        block, self._head = self._head or self._unpacked(size), b""
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
        except (EOFError, zlib.error, gzip.BadGzipFile) as error:
            block, self.trouble = b"", f"its end cannot be unpacked ({error}): copy it anew, what comes before is used."
        self._has_ended = not block
        return block


def head_of(path: Path) -> bytes:
    """The beginning of a file: of one that is packed by gzip, of what is in it. Raises OSError."""
    with TextFile(path) as file:
        return file.read(_HEAD_BYTES)


def _encoding(head: bytes) -> str:
    """Return UTF-8 or UTF-16 with or without a byte-order mark, or else Windows-1252."""
    if head.startswith(_UTF16):
        return "utf-16"
    whole = head[: head.rfind(b"\n") + 1] or head
    try:
        whole.decode("utf-8")
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8"


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
