"""Trials of the advised next orientation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from blind_trials.columns import scan_columns
from blind_trials.outcome import Outcome
from blind_trials.program import run_command
from blind_trials.recording import simulate_through, with_size
from blind_trials.task import DWELL_S, FEW_ORIENTATIONS, LARGE, SECOND_RUN, Task
from kf_calib.sources.simulation.visit_plans import spread_plan


def compare_advice(task: Task, advised: int = 4, random: int = 12) -> Outcome:
    """Compare how well advised and random further orientations separate an ambiguous pair, in sigma.

    A run of twelve orientations comes first. advised: the most orientations that are advised; fewer where the program
    advises no more. random: number of random ones.
    """
    rows = [visit.gimbal_deg for visit in spread_plan(FEW_ORIENTATIONS, seed=task.seed)]
    truth, said = _diagnose_plan(task, rows)
    rivals = [name for name in said["ambiguity_set"] if name != truth["name"]]
    if said["missing"] in (None, "unknown", "noise") or not rivals or truth["name"] not in said["ambiguity_set"]:
        return Outcome(task, task.names, said["missing"], error="not ambiguous to begin with")
    fixed, here, more = with_size(task, truth, 1.0), said, list(rows)
    count = 0
    while count < advised and here["next_orientation"] is not None:
        next_ = here["next_orientation"]
        more += [tuple(next_["gimbal_deg"])] * max(1, round((next_["stay_s"] or 0.0) / DWELL_S))
        count += 1
        _, here = _diagnose_plan(fixed, more)
    others = [visit.gimbal_deg for visit in spread_plan(random, seed=task.seed + SECOND_RUN)]
    plans = {"before": rows, "advised": more, "random": [*rows, *others]}
    apart = {which: _separation(task, truth, rivals, plan) for which, plan in plans.items()}
    if not apart["random"]:
        return Outcome(task, task.names, said["missing"], error="only process noise to be told from: it has no columns")
    extra = {**apart, "rivals": rivals, "count": count, "dwells": len(more) - len(rows)}
    return Outcome(task, task.names, said["missing"], ambiguity=tuple(said["ambiguity_set"]), extra=extra)


def _diagnose_plan(task: Task, rows: Sequence[Sequence[float]]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the one hidden effect and the diagnosis of a run through given orientations, deg."""
    truth = simulate_through(task, rows, Path("few.mcap"))
    return truth["effects"][0], run_command("diagnose", "few.mcap", "--json")


def _separation(task: Task, truth: dict[str, Any], rivals: Sequence[str], rows: Sequence[Sequence[float]]) -> float:
    """Return the part of the hidden effect that neither the twelve parameters nor a rival explain, in sigma.

    It is the smallest over the rivals, measured on an effect a hundred times as large, so that noise does not matter.
    """
    noise = simulate_through(with_size(task, truth, LARGE), rows, Path("large.mcap"))["noise"]
    spaces, signal = scan_columns(Path("large.mcap"), [truth["name"], *rivals], noise["white_mps2"], slow_lines=True)
    others = [each.basis for name in rivals for each in spaces.get(name, [])]  # a random walk has none
    return min((float(np.linalg.norm(signal - basis @ (basis.T @ signal))) for basis in others), default=0.0) / LARGE
