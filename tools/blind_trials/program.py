"""The program that is tried, run in this process by its command line."""

from __future__ import annotations

import contextlib
import io
import json
import time
from collections.abc import Iterator
from typing import Any


def run_command(*words: str) -> dict[str, Any]:
    """Run a command in this process and return the JSON object that it prints."""
    from kf_calib.cli import cli

    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        cli.main(list(words), standalone_mode=False)
    return json.loads(printed.getvalue())


@contextlib.contextmanager
def cpu_time(times: dict[str, float], part: str) -> Iterator[None]:
    """Note the processor time of a block under the name of a part."""
    start = time.process_time()
    yield
    times[part] = time.process_time() - start
