"""How a trial of each kind is played."""

from __future__ import annotations

import contextlib
import tempfile
import traceback
from collections.abc import Callable
from pathlib import Path

from blind_trials.advice import compare_advice
from blind_trials.diagnosis import compare_invisible, diagnose_outside, diagnose_pair, diagnose_trial
from blind_trials.ideal import compute_ideal
from blind_trials.improvement import improve_trial
from blind_trials.outcome import Outcome
from blind_trials.power import notice_stated_size
from blind_trials.task import Task
from kf_calib.errors import KfCalibError
from kf_calib.sources.simulation.injected import NoSizeError

PLAYS: dict[str, Callable[[Task], Outcome]] = {
    "diagnose": diagnose_trial, "outside": diagnose_outside, "unstated-outside": diagnose_outside,
    "pair": diagnose_pair, "power": notice_stated_size,
    "invisible": compare_invisible, "improve": improve_trial, "advice": compare_advice, "ideal": compute_ideal,
}  # fmt: skip


def play_trial(task: Task) -> Outcome:
    """Return the outcome of a trial; its files are deleted."""
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
        try:
            with contextlib.chdir(folder):
                return PLAYS[task.play](task)
        except NoSizeError as error:
            return Outcome(task, task.names, error=str(error))
        except KfCalibError as error:
            return Outcome(task, task.names, error=str(error), refused=True)
        except Exception as error:  # a failure of the program must not end the other trials
            where = traceback.extract_tb(error.__traceback__)[-1]
            text = f"{type(error).__name__}: {error} ({Path(where.filename).name}, line {where.lineno})"
            return Outcome(task, task.names, error=text, refused=True)
