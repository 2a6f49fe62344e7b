"""All cases whose numbers are stored, by the names of their files."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from helpers import numbered_commands, numbered_functions, numbered_runs
from helpers.numbered_runs import Numbers


def _of_run(made: Callable[[], Numbers]) -> numbered_commands.Made:
    return lambda folder: made()


_WITHOUT_FOLDER = {**numbered_functions.FUNCTIONS, **numbered_runs.CALIBRATED, **numbered_runs.DIAGNOSED}
FAST: dict[str, Callable[[Path], Mapping[str, Any]]] = {
    **{name: _of_run(made) for name, made in _WITHOUT_FOLDER.items()},
    **numbered_commands.COMMANDS,
}
SLOW: dict[str, Callable[[Path], Mapping[str, Any]]] = {
    name: _of_run(made) for name, made in numbered_runs.SLOW.items()
}
