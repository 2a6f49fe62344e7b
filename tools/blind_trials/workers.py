"""Processes that play trials."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import sys
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

from rich.console import Console
from rich.progress import track

from blind_trials.outcome import Outcome
from blind_trials.plays import play_trial
from blind_trials.task import Task
from blind_trials.trial_log import append_to


def play_trials(todo: Sequence[Task], jobs: int, path: Path | None = None) -> Iterator[Outcome]:
    """Yield outcomes as they come and write each to ``path``; a terminal shows a progress bar."""
    quiet = not sys.stderr.isatty()
    with _outcomes_of(todo, jobs) as made, append_to(path) as write:
        for outcome in track(made, "trials", len(todo), console=Console(stderr=True), disable=quiet):
            write(json.dumps(dataclasses.asdict(outcome)) + "\n")
            yield outcome


@contextlib.contextmanager
def _outcomes_of(todo: Sequence[Task], jobs: int) -> Iterator[Iterable[Outcome]]:
    """Give the outcomes of trials as they come, from ``jobs`` processes."""
    if jobs == 1:
        yield map(play_trial, todo)
        return
    with ProcessPoolExecutor(jobs) as pool:
        yield (done.result() for done in as_completed([pool.submit(play_trial, task) for task in todo]))
