"""Trials of ``diagnose``."""

from __future__ import annotations

import dataclasses
import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np

from blind_trials.catalogue import known_kinds, largest_size
from blind_trials.columns import candidates, scan_columns
from blind_trials.equivalence import equivalent_names, exact_sets
from blind_trials.outcome import Hypothesis, Outcome
from blind_trials.physical_families import families_of
from blind_trials.program import cpu_time, run_command
from blind_trials.recording import simulate_trial
from blind_trials.task import LARGE, Task

_UNLIKELY = 1e-3  # probability of an explanation below which it does not matter what its names mean


def diagnose_trial(task: Task) -> Outcome:
    """Simulate a run, diagnose it, and compare the answer with the truth in the side file."""
    path, times = Path("trial.mcap"), dict[str, float]()
    effects = simulate_trial(task, path, times)["effects"]
    with cpu_time(times, "diagnose"):
        said = run_command("diagnose", str(path), "--json")
    missing = said["missing"]
    names = tuple(said.get("all_missing") or ([missing] if missing not in (None, "unknown", "noise") else []))
    hypotheses = _hypotheses(said)
    likely = [each.effects for each in hypotheses if each.probability > _UNLIKELY]
    outside = [effect for effect in effects if not effect["in_catalogue"]]
    with cpu_time(times, "judge"):
        given = {*names, *said["ambiguity_set"], *itertools.chain.from_iterable(likely)}
        same = equivalent_names(task, path, effects, given)
        alike = exact_sets(task, outside[0], [*likely, names]) if len(effects) == len(outside) == 1 else ()
    return Outcome(
        task, tuple(effect["name"] for effect in effects), missing, names, tuple(said["ambiguity_set"]), same,
        said["consistent"], said["p_value"], tuple(said["invisible"]),
        {
            "verdict": said["verdict"],
            "driver": (said["unknown"] or {}).get("driver"),
            "may_be_scatter": said["may_be_scatter"],
            "replicates": said.get("replicates"),
            "true_drivers": [effect["driver"] for effect in effects],
            "sizes": [effect["size_sigma"] for effect in effects],
        },
        times, alike=alike, outside=tuple(effect["name"] for effect in outside),
        true_families=families_of(path, effects, same), hypotheses=hypotheses,
        families=tuple((each["family"], each["probability"]) for each in said.get("families", [])),
    )  # fmt: skip


def _hypotheses(said: dict[str, Any]) -> tuple[Hypothesis, ...]:
    """Return the explanations that the program weighed."""
    return tuple(
        Hypothesis(tuple(each["effects"]), each["formula"] or "", tuple(each["families"]), each["probability"])
        for each in said.get("hypotheses", [])
    )


def diagnose_outside(task: Task) -> Outcome:
    """Diagnose an effect that is in no catalogue, and add its overlap: the part that one known effect can mimic.

    The overlap is measured on an effect of 100 sigma, so that noise does not matter. It is a part of all 100 sigma,
    although the means of the dwells show less where the effect changes within dwells. The noise is that of the truth,
    because so large an effect spoils the estimate of it.
    """
    large = dataclasses.replace(task.stated, hidden=tuple(f"{name}={LARGE}sigma" for name in task.names))
    truth = simulate_trial(large, Path("large.mcap"))
    spaces, residual = scan_columns(Path("large.mcap"), None, truth["noise"]["white_mps2"])
    falls = {name: max(float(np.sum((each.basis.T @ residual) ** 2)) for each in own) for name, own in spaces.items()}
    nearest = max(falls, key=lambda name: falls[name])
    overlap = min(1.0, math.sqrt(falls[nearest]) / truth["effects"][0]["size_sigma"])
    outcome = diagnose_trial(task)
    outcome.extra.update(overlap=overlap, nearest=nearest)
    return outcome


def diagnose_pair(task: Task) -> Outcome:
    """Diagnose two effects at once, and add their overlap: the cosine of the smallest angle between their spaces."""
    outcome = diagnose_trial(task)
    spaces = candidates(Path("trial.mcap"), outcome.truth)
    one, other = (
        spaces.get(name, []) for name in outcome.truth
    )  # empty for an effect without columns, such as a random walk
    outcome.extra["overlap"] = max((a.overlap(b) for a, b in itertools.product(one, other)), default=0.0)
    return outcome


def compare_invisible(task: Task) -> Outcome:
    """Compare the effects called invisible in a clean run with those that add no rank to the true Jacobian."""
    path = Path("clean.mcap")
    simulate_trial(task, path)
    said = run_command("diagnose", str(path), "--json")
    kinds = [kind for kind in known_kinds() if kind.counted is None]
    texts = tuple(f"{kind.name}={largest_size(kind)!r}" for kind in kinds)
    truth = simulate_trial(dataclasses.replace(task, hidden=texts), Path("all.mcap"))["effects"]
    unseen = {effect["name"] for effect in truth if effect["size_sigma"] is None}
    known = {each["effect"] for each in run_command("effects", "--json")["effects"]} & {
        effect["name"] for effect in truth
    }
    differ = sorted((unseen & known) ^ (set(said["invisible"]) & known))
    return Outcome(task, invisible=tuple(said["invisible"]), extra={"differ": differ, "unseen": sorted(unseen)})
