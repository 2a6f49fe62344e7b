"""Trials of the smallest detectable sizes that the program states."""

from __future__ import annotations

import dataclasses
from functools import lru_cache
from pathlib import Path

import numpy as np

from blind_trials.columns import candidates
from blind_trials.outcome import Outcome
from blind_trials.program import cpu_time, run_command
from blind_trials.recording import simulate_trial
from blind_trials.task import Task
from kf_calib.diagnosis.candidate_tests import assess_candidates
from kf_calib.estimation.calibration import calibrate
from kf_calib.sources.files.recording import Recording
from kf_calib.sources.simulation.injected import catalogue


@lru_cache(maxsize=256)
def stated_sizes(task: Task) -> dict[str, tuple[float, int, int]]:
    """Return for each effect the smallest size stated for a run, which coefficient it is of, and their number."""
    path = Path("clean.mcap")
    simulate_trial(task, path)
    said = run_command("diagnose", str(path), "--json")["detectable"]
    spaces, out = candidates(path), dict[str, tuple[float, int, int]]()
    for each in said:
        own = spaces.get(each["effect"], [])  # empty for an oscillation: its frequency is on no grid
        if len(own) == 1:  # the program does not state for which value of an unknown constant a size holds
            lengths = np.linalg.norm(own[0].columns, axis=0)
            lengths[own[0].hidden | (lengths == 0.0)] = np.inf
            out[each["effect"]] = each["minimum"], int(np.argmin(lengths)), len(lengths)
    return out


def notice_stated_size(task: Task) -> Outcome:
    """Hide the worst coefficient at its stated size, the others zero, and ask whether the program notices anything.

    Only the test with which ``diagnose`` begins is done: naming the effect takes most of its time.
    """
    (name,) = task.hidden
    stated = stated_sizes(dataclasses.replace(task, hidden=()))
    if name not in stated:
        return Outcome(task, task.names, error=f"{name}: no smallest size of one coefficient is stated")
    size, worst, count = stated[name]
    if count != len(catalogue()[name.partition(":")[0]].coefficients):
        return Outcome(task, task.names, error=f"{name}: its coefficients are not those of the truth")
    sizes = [repr(size) if k == worst else "0" for k in range(count)]
    path, times = Path("trial.mcap"), dict[str, float]()
    effects = simulate_trial(dataclasses.replace(task, hidden=(f"{name}={','.join(sizes)}",)), path, times)["effects"]
    with cpu_time(times, "notice"):
        test = assess_candidates(calibrate(Recording(path)).fit)
    extra = {"sizes": [effect["size_sigma"] for effect in effects], "size": size, "worst": worst}
    return Outcome(task, task.names, consistent=test.consistent, p_value=test.p_value, extra=extra, seconds=times)
