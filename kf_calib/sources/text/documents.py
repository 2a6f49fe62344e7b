"""Objects that take more than a line each, as lines of JSON with one object each: those of one array of JSON, and the
messages that ``rostopic echo`` and ``ros2 topic echo`` print as documents of YAML.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable

_ARRAY = re.compile(rb"\s*\[\s*\{")
_BRACE = re.compile(rb'"(?:[^"\\]|\\.)*(?:"|\Z)|[{}]', re.DOTALL)
_BORDER = re.compile(r"(?m)^---[ \t]*\r?\n")
_LINE = re.compile(r"[ \t]*(-|- .*|(- )?[\w./]+:( .*)?)")
_KEY = re.compile(r"([^\s:'\"\[]+):(?:\s+(.*))?")
_FEWEST_LINES = 3
LONGEST_LINE_BYTES = 1 << 20


Cut = Callable[[bytes], tuple[list[bytes], bytes]]
"""The objects that end in a text, and what is left of it behind them."""


class Objects:
    """Cuts text, block by block, into objects. One that does not end, or not in a megabyte, is given as it is, for the
    reader of lines to refuse and count."""

    def __init__(self, cut: Cut) -> None:
        self._cut, self._tail = cut, b""

    def push(self, block: bytes) -> bytes:
        """The objects that end in a block of UTF-8, a line each."""
        objects, self._tail = self._cut(self._tail + block)
        if len(self._tail) > LONGEST_LINE_BYTES:
            objects, self._tail = [*objects, self._tail], b""
        return b"".join(map(_as_line, objects))

    def rest(self) -> bytes:
        """A line of what has not ended; none if there is nothing but the end of an array."""
        tail, self._tail = self._tail.strip(b" \t\r\n,]"), b""
        return _as_line(tail) if tail else b""


def cut_array(text: bytes) -> tuple[list[bytes], bytes]:
    """The objects in one array of JSON."""
    objects, depth, first, end = list[bytes](), 0, 0, 0
    for match in _BRACE.finditer(text):
        if match[0] == b"{":
            first = first if depth else match.start()
            depth += 1
        elif match[0] == b"}" and depth:
            depth -= 1
            if not depth:
                end = match.end()
                objects.append(text[first:end])
    return objects, text[end:]


def cut_echo(text: bytes) -> tuple[list[bytes], bytes]:
    """The documents of YAML between lines of three hyphens."""
    *documents, tail = _BORDER.split(text.decode("utf-8", "surrogateescape"))
    return [_flat(document) for document in documents if document.strip()], tail.encode("utf-8", "surrogateescape")


def objects_in(head: bytes) -> Objects | None:
    """What cuts a text that begins so into objects; None where its lines are to be read as they are."""
    if _ARRAY.match(head.removeprefix(b"\xef\xbb\xbf")):
        return Objects(cut_array)
    documents = _BORDER.split(head.decode("utf-8", "replace").lstrip("\ufeff"))
    lines = next((lines for each in documents[:-1] if (lines := each.strip().splitlines())), [])
    is_echo = len(lines) >= _FEWEST_LINES and all(_LINE.fullmatch(line) for line in lines)
    return Objects(cut_echo) if is_echo else None


def _as_line(text: bytes) -> bytes:
    return text.replace(b"\r", b" ").replace(b"\n", b" ") + b"\n"


def _flat(document: str) -> bytes:
    """Return a document of nested keys and lists as one object, of which the keys are paths, as ``stamp.sec``."""
    path, items, cells = list[tuple[int, str]](), Counter[str](), list[str]()
    for line in filter(str.strip, document.splitlines()):
        body = line.strip()
        indent = 2 * (len(line) - len(line.lstrip()))
        if body == "-" or body.startswith("- "):  # the key of a list may stand as far to the left as its items
            path = [(at, key) for at, key in path if at <= indent]
            name = ".".join(key for _, key in path)
            path.append((indent + 1, str(items[name])))
            items[name] += 1
            body, indent = body[2:].strip(), indent + 4
        if match := _KEY.fullmatch(body):
            path = [*((at, key) for at, key in path if at < indent), (indent, match[1])]
            body = (match[2] or "").strip()
        if body:
            cells.append(f"{json.dumps('.'.join(key for _, key in path))}: {_of_json(body)}")
    return f"{{{', '.join(cells)}}}".encode("utf-8", "surrogateescape")


def _of_json(value: str) -> str:
    """Return a number, a text, or a list of them between brackets, as JSON has it."""
    try:
        float(value)
    except ValueError:
        return value.replace("'", '"') if value.startswith("[") else json.dumps(value.strip("'\""))
    return value
