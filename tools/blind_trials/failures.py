"""Trials that went wrong, and how to see them again."""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from blind_trials.criteria import is_failure
from blind_trials.outcome import Outcome
from blind_trials.recording import simulate_trial, visit_angles
from blind_trials.task import Task


def save_failures(outcomes: Sequence[Outcome], path: Path) -> None:
    """Write a paragraph for each trial that went wrong, with the command that repeats it, and their plans beside it."""
    lines = list[str]()
    for each in filter(is_failure, outcomes):
        rest = {key: value for key, value in each.extra.items() if key not in ("verdict", "true_drivers") and value}
        lines += [
            f"[{each.task.figure}] hidden {' + '.join(each.truth) or 'nothing'}; first {each.first}; "
            f"all {list(each.names)}; set {list(each.ambiguity)}; p {each.p_value}; wrong {each.wrong}; {rest}",
            f"    {each.error or each.extra.get('verdict', '')}",
            f"    {each.task.command}",
        ]
        if each.task.plan:
            kind, _, number = each.task.plan.removesuffix(".csv").partition("-")
            np.savetxt(path.parent / each.task.plan, visit_angles(kind, int(number)), delimiter=",")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def keep(task: Task, folder: Path) -> None:
    """Make the recording of a trial and its plan again."""
    name = f"{task.figure}-{task.seed}".replace(" ", "_").replace("/", "")
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as work, contextlib.chdir(work):
        simulate_trial(task, Path("trial.mcap"))
        for made in Path().glob("trial.*"):
            shutil.move(made, folder / made.name.replace("trial", name, 1))
