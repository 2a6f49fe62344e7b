"""Simulated recordings of trials."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from blind_trials.program import cpu_time, run_command
from blind_trials.task import SPREAD_PLANS, Task
from kf_calib.sources.simulation.visit_plans import spread_plan


def simulate_trial(task: Task, path: Path, times: dict[str, float] | None = None) -> dict[str, Any]:
    """Make the recording, and its plan beside it; return the truth of its side file."""
    with cpu_time({} if times is None else times, "simulate"):
        if task.plan:
            kind, _, number = task.plan.removesuffix(".csv").partition("-")
            np.savetxt(task.plan, visit_angles(kind, int(number)), delimiter=",")
        run_command(*task.simulate(path, "--overwrite"))
    return json.loads(path.with_suffix(".truth.json").read_text())


@lru_cache(maxsize=2 * SPREAD_PLANS)
def visit_angles(kind: str, seed: int) -> list[tuple[float, ...]]:
    """Return gimbal angles, deg, spread over the sphere; ``monotone``: sorted by the middle gimbal."""
    rows = [visit.gimbal_deg for visit in spread_plan(24, seed=seed)]
    return rows if kind == "spread" else sorted(rows, key=lambda row: row[1])


def simulate_through(task: Task, rows: Sequence[Sequence[float]], path: Path) -> dict[str, Any]:
    """Make a recording through given orientations, deg; return the truth of its side file."""
    np.savetxt("plan.csv", rows, delimiter=",")
    return simulate_trial(dataclasses.replace(task, options=("--plan", "plan.csv")), path)


def with_size(task: Task, truth: dict[str, Any], factor: float) -> Task:
    """Return the task with its effect of the same coefficients times ``factor``, whatever the orientations are."""
    sizes = ",".join(repr(factor * size) for size in truth["sizes"].values())
    return dataclasses.replace(task, hidden=(f"{truth['name']}={sizes}",))
