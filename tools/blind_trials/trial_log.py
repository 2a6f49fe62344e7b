"""The file of outcomes: JSON lines, written as they come."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

from pydantic import TypeAdapter

from blind_trials.outcome import Outcome

_OUTCOME = TypeAdapter(Outcome)


def read_outcomes(path: Path) -> list[Outcome]:
    """Return the outcomes in a file of JSON lines; a last line that was cut short is left out."""
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    return [_OUTCOME.validate_json(line) for line in lines if line.endswith("\n")]


@contextlib.contextmanager
def append_to(path: Path | None) -> Iterator[Callable[[str], object]]:
    """Give a function that appends a line to a file at once; a last line that was cut short is overwritten."""
    if path is None:
        yield lambda line: None
        return
    with path.open("a+b") as file:
        file.seek(0)
        file.truncate(file.read().rfind(b"\n") + 1)

        def write(line: str) -> None:
            """Append a line."""
            file.write(line.encode())
            file.flush()

        yield write
