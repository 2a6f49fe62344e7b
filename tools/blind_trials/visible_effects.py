"""Effects that a run of the trial can show."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import tempfile
from collections.abc import Sequence
from pathlib import Path

from blind_trials.catalogue import known_kinds
from blind_trials.columns import candidates
from blind_trials.plays import play_trial
from blind_trials.program import run_command
from blind_trials.recording import simulate_through, simulate_trial
from blind_trials.task import FEW_ORIENTATIONS, Task
from kf_calib.sources.simulation.visit_plans import spread_plan

_LIKE_OVERLAP = 0.9  # from here on, two effects of 8 sigma may be confused
_SAME_OVERLAP = 1.0 - 1e-6  # from here on, they are the same


def visible_effects(options: tuple[str, ...] = ()) -> list[str]:
    """Return the names of the effects that can be hidden and that such a run shows, by what the program says of it.

    An effect whose size nature sets, as the rate of the Earth, has no other size in sigma and is left out.
    """
    clean = Task("", "", 1, (), options)
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        simulate_trial(clean, Path("clean.mcap"))
        unseen = set(run_command("diagnose", "clean.mcap", "--json")["invisible"])
    hideable = {kind.name: kind for kind in known_kinds() if len(set(kind.typical("navigation"))) > 1}
    names = [each["effect"] for each in run_command("effects", "--json")["effects"]]
    kinds = {name: hideable[name.split(":")[0]] for name in names if name.split(":")[0] in hideable}
    return [n for n, kind in kinds.items() if n not in unseen or (kind.counted and _is_visible_itself(clean, n))]


def _is_visible_itself(task: Task, name: str) -> bool:
    """Tell whether an effect changes the run so that it becomes visible, as a setting of the bench may."""
    return not play_trial(dataclasses.replace(task, play="diagnose", hidden=(f"{name}=10sigma",))).error


def confusable(names: Sequence[str]) -> list[str]:
    """Return those of the effects that another one nearly mimics in a dozen orientations."""
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        rows = [visit.gimbal_deg for visit in spread_plan(FEW_ORIENTATIONS, seed=1)]
        simulate_through(Task("", "", 1), rows, Path("few.mcap"))
        spaces = {name: own for name, own in candidates(Path("few.mcap")).items() if name in names}
    pairs = itertools.permutations(spaces, 2)
    near = {
        a
        for a, b in pairs
        if _LIKE_OVERLAP < max(p.overlap(q) for p, q in itertools.product(spaces[a], spaces[b])) < _SAME_OVERLAP
    }
    return [name for name in names if name in near]
