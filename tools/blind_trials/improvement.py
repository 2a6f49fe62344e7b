"""Trials of ``improve``."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from blind_trials.equivalence import equivalent_names
from blind_trials.outcome import Outcome
from blind_trials.program import cpu_time, run_command
from blind_trials.recording import simulate_trial
from blind_trials.task import SECOND_RUN, Task
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.settings import Settings
from kf_calib.sources.files.recording import Recording


def improve_trial(task: Task) -> Outcome:
    """Improve a model, fit it to a second run, and compare the twelve parameters and their sigmas with the truth.

    The second run has other sensors, orientations and noise, and the selection knows nothing of it.
    """

    path, again, times = Path("trial.mcap"), Path("again.mcap"), dict[str, float]()
    effects = simulate_trial(task, path, times)["effects"]
    with cpu_time(times, "improve"):
        said = run_command("improve", str(path), "--json")
    known, model = tuple(effect["name"] for effect in effects), tuple(said["model"])
    same = equivalent_names(task, path, effects, model)
    second = simulate_trial(dataclasses.replace(task, seed=task.seed + SECOND_RUN), again)
    truth = second.get("parameters_at_end", second["parameters"])  # biases that walk are estimated at the end
    estimate = calibrate(Recording(again), Settings(effects=model)).estimate
    error = estimate.parameters - np.array(list(truth.values()))
    held_out, floor = said["held_out_rms_mps2"], said["held_out_floor_mps2"]
    extra = {
        "stopped": said["stopped_because"],
        "nees": float(error @ np.linalg.solve(estimate.parameter_covariance, error)),
        "inside": int(np.sum(np.abs(error) < 1.96 * estimate.sigma)),
        "held_out": held_out / floor if held_out and floor else None,
    }
    first = model[0] if model else "unknown" if said["stopped_because"] == "unknown" else None
    return Outcome(task, known, first, model, (), same, extra=extra, seconds=times)
