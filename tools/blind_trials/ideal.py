"""The best possible share of right names, for comparison."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np

from blind_trials.best_possible import (
    Columns,
    Effect,
    Process,
    best_possible,
    best_possible_pairs,
    best_possible_probability,
    probability_where_two_are_possible,
)
from blind_trials.columns import column_effects, group_by_name, span_the_same
from blind_trials.criteria import APART
from blind_trials.outcome import Outcome
from blind_trials.recording import simulate_trial
from blind_trials.task import PAIR_SIGMA, SIZES_SIGMA, Task
from kf_calib.effects import effect_named
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.candidate_scan import Candidate
from kf_calib.estimation.score_test import scan
from kf_calib.sources.files.recording import Recording
from kf_calib.sources.simulation.injected import catalogue

WALK = "bias-walk"
SCATTER_ALLOWED = ", where dwells may scatter, too"


def compute_ideal(task: Task) -> Outcome:
    """Compute how often the likeliest effect is right for a chooser that knows all but the readings beforehand.

    It is done twice: with scatter of the dwells as stated, and with scatter that may be larger, as a rival.
    """
    path = Path("clean.mcap")
    simulate_trial(task, path)
    spaces, constants, walk, scatter = _candidate_signals(path)
    alike = {
        (a, b)
        for a, b in itertools.product(spaces, spaces)
        if a == b or any(itertools.starmap(span_the_same, itertools.product(spaces[a], spaces[b])))
    }
    same = {name: {b for a, b in alike if a == name} for name in spaces} | {WALK: {WALK}}
    effects: dict[str, Effect] = {
        name: Columns([each.basis for each in own], [constants[name].basis] if name in constants else [])
        for name, own in spaces.items()
    }
    effects[WALK] = walk
    apart = [
        (a, b)
        for a, b in itertools.combinations(spaces, 2)
        if max(itertools.starmap(Candidate.overlap, itertools.product(spaces[a], spaces[b]))) < APART
    ]
    apart += [(name, WALK) for name in spaces]
    extra: dict[str, Any] = {
        f"{size}{words}": best_possible(effects, same, size, seed=task.seed, rivals=rivals)
        for size in SIZES_SIGMA
        for words, rivals in (("", {}), (SCATTER_ALLOWED, {"scatter": scatter}))
    }
    extra["probability"] = {
        str(size): best_possible_probability(effects, same, size, seed=task.seed) for size in SIZES_SIGMA
    }
    extra["probability, two possible"] = {
        str(size): probability_where_two_are_possible(effects, same, size, seed=task.seed) for size in SIZES_SIGMA
    }
    extra["pairs"] = best_possible_pairs(effects, same, PAIR_SIGMA, apart, seed=task.seed)
    return Outcome(task, extra=extra)


def _candidate_signals(path: Path) -> tuple[dict[str, list[Candidate]], dict[str, Candidate], Process, Process]:
    """Return what may be in the readings of a run, all in one orthonormal frame.

    The results are the columns of the visible effects by name; the same at the constant with which an effect is hidden,
    where it has one; a random walk of the biases from dwell to dwell; and scatter of the dwells.
    """
    result = calibrate(Recording(path))
    bench, middles_s = result.model.bench, np.array([0.5 * (d.start_s + d.end_s) for d in result.fit.dwells])
    steps = [effect_named(f"step = t > {at:.3f}*s", bench) for at in 0.5 * (middles_s[1:] + middles_s[:-1])]
    grids = column_effects(result)
    inner = {name: catalogue()[name.split(":")[0]].inner for name in dict.fromkeys(map(str, grids))}
    constants = [effect_named(name, bench).at(own["tau"]) for name, own in inner.items() if "tau" in own]
    found = scan(result.fit.linearised, result.noise.for_goodness_of_fit, [*grids, *constants, *steps]).candidates
    seen = [each for each in found[: len(grids)] if each.dof]
    hidden = {str(each.effect): each for each in found[len(grids) : -len(steps)] if each.dof}
    after = np.array(
        [each.columns for each in found[-len(steps) :]]
    )  # (D - 1, d, 3): a step of each channel at each dwell
    walk = after * np.sqrt(np.diff(middles_s))[:, None, None]
    none = np.zeros_like(after[:1])  # a step at the first dwell is a bias
    alone = np.concatenate([none, after]) - np.concatenate([after, none])
    walks, scatters = (Process(np.concatenate(list(each), axis=1)) for each in (walk, alone))
    return group_by_name(seen), hidden, walks, scatters
