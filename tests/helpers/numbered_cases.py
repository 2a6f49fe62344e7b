"""All cases whose numbers are stored, by the names of their files."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from helpers import numbered_commands, numbered_runs
from helpers.numbered_runs import Numbers


def _of_run(made: Callable[[], Numbers]) -> numbered_commands.Made:
    return lambda folder: made()


FAST: dict[str, Callable[[Path], Mapping[str, Any]]] = {
    **{name: _of_run(made) for name, made in (numbered_runs.DIAGNOSED | numbered_runs.CALIBRATED).items()},
    **numbered_commands.COMMANDS,
}
SLOW: dict[str, Callable[[Path], Mapping[str, Any]]] = {
    name: _of_run(made) for name, made in numbered_runs.SLOW.items()
}
