"""Names that mean the same in a run: no reading of it can tell them apart."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from blind_trials.columns import candidates, scan_columns, span_the_same
from blind_trials.recording import simulate_trial, with_size
from blind_trials.task import Task

_ALONE_SIGMA = 1000  # of an effect that is hidden alone, so that noise does not matter
_LEFT = 0.01  # part of a hidden effect that an exact mimic may leave


def equivalent_names(
    task: Task, path: Path, effects: Sequence[dict[str, Any]], given: Iterable[str]
) -> tuple[tuple[str, str], ...]:
    """Return the pairs of a hidden name and a given name that mean the same readings beside the twelve parameters.

    Two effects mean the same if they span the same space in this run, or if the given one is simpler and explains every
    reading of what was hidden: a magnetic sensitivity that is the same for all three accelerometers is a tilt of the
    base.
    """
    truth = [effect["name"] for effect in effects]
    others = sorted(set(given) - set(truth))
    pairs = {(name, name) for name in truth}
    if truth and others:
        spaces = candidates(path, [*truth, *others])
        pairs |= {
            (true, other)
            for true, other in itertools.product(truth, others)
            if any(span_the_same(a, b) for a, b in itertools.product(spaces.get(true, []), spaces.get(other, [])))
        }
        for effect in effects:
            most = max((each.dof for each in spaces.get(effect["name"], [])), default=0)
            simpler = [name for name in others if any(each.dof < most for each in spaces.get(name, []))]
            if simpler and effect["size_sigma"]:
                pairs |= {(effect["name"], other) for other in _exact_mimics(task, effect, simpler)}
    return tuple(sorted(pairs))


def exact_sets(task: Task, effect: dict[str, Any], given: Iterable[Sequence[str]]) -> tuple[tuple[str, ...], ...]:
    """Return the sets of names, each in order, that together explain an effect outside the catalogue to a hundredth.

    It is large and alone, in stated noise; each name has the constant at which it explains most. So two errors of a
    gimbal are what an effect is that makes both.
    """
    path, sets = Path("alone.mcap"), sorted({tuple(sorted(names)) for names in given if names})
    if not sets or not effect["size_sigma"]:
        return ()
    noise = simulate_trial(with_size(task.stated, effect, _ALONE_SIGMA / effect["size_sigma"]), path)["noise"]
    spaces, residual = scan_columns(path, None, noise["white_mps2"])
    best = {name: max(own, key=lambda each: np.sum((each.basis.T @ residual) ** 2)) for name, own in spaces.items()}

    def left(names: Sequence[str]) -> float:
        """Return what the columns of all names leave of the sum of squares, beside the noise."""
        columns = np.hstack([best[name].basis for name in names])
        unexplained = residual - columns @ np.linalg.lstsq(columns, residual, rcond=None)[0]
        return float(np.sum(unexplained**2)) - len(residual)

    most = (_LEFT * _ALONE_SIGMA) ** 2
    return tuple(names for names in sets if best.keys() >= set(names) and left(names) < most)


def _exact_mimics(task: Task, effect: dict[str, Any], others: Sequence[str]) -> list[str]:
    """Return the names that explain a hidden effect to a hundredth of its size, where it is large and alone, in stated
    noise: what is not stated is estimated, and would be as large as the effect."""
    path = Path("alone.mcap")
    simulate_trial(with_size(task.stated, effect, _ALONE_SIGMA / effect["size_sigma"]), path)
    spaces, residual = scan_columns(path, [effect["name"], *others])
    falls = {name: max(float(np.sum((each.basis.T @ residual) ** 2)) for each in own) for name, own in spaces.items()}
    return [name for name in others if falls[name] > (1.0 - _LEFT**2) * falls[effect["name"]]]
