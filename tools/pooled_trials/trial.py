"""One trial: a campaign is diagnosed, and the diagnosis compared with the truth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from kf_calib.fleet.pooled_diagnosis import Finding, PooledDiagnosis, pooled_diagnosis
from kf_calib.fleet.run_factor import RunFactor
from pooled_trials.campaigns import Truth, draw, fitting, linear, nonlinear, signal

_NOT_APART = 3.0  # sigma of all runs together that two effects differ by: less is noise


def play(kind: str, seed: int, pool: Sequence[RunFactor], units: int, simulated: bool = False) -> dict[str, Any]:
    """Play one trial with runs drawn from a pool; simulated: simulate each run anew with the effect in it."""
    rng = np.random.default_rng([seed, len(kind), *map(ord, kind)])
    names = fitting(kind, pool)
    chosen = rng.permutation(len(pool))[:units]
    runs = [pool[k] for k in chosen]
    truth = draw(kind, names[int(rng.integers(len(names)))], runs, rng)
    made = nonlinear(chosen.tolist(), truth) if simulated else linear(runs, truth, rng)
    found = pooled_diagnosis(made)
    return {"kind": kind, "seed": seed, "simulated": simulated, **outcome(truth, found, made)}


def outcome(truth: Truth, found: PooledDiagnosis, runs: Sequence[RunFactor]) -> dict[str, Any]:
    """Compare a diagnosis with the truth."""
    meant = [each for each in found.findings if truth.effect and _means(truth, each, runs)]
    first = meant[0] if meant else None
    out: dict[str, Any] = {
        "effect": truth.effect, "sigmas": truth.sigmas, "found": [each.effect for each in found.findings],
        "attributions": [str(each.attribution) for each in found.findings], "named": first is not None,
        "exactly": first is not None and first.effect == truth.effect, "more": len(found.findings) - len(meant[:1]),
        "no_more": found.no_more,
    }  # fmt: skip
    if first is not None:
        of_bench = sum(first.probabilities[key] for key in first.probabilities if key.startswith("bench"))
        whole = sum(first.probabilities.values())
        out |= {
            "right_side": first.attribution.common == truth.common, "of_bench": of_bench / whole, "probability": whole,
            "attribution": str(first.attribution), "shares": dict(first.probabilities),
        }  # fmt: skip
        out |= _of_members(truth, first) | _of_repair(truth, first)
    return out


def _means(truth: Truth, finding: Finding, runs: Sequence[RunFactor]) -> bool:
    """Tell whether a finding is the hidden effect, or one that no more than noise tells from it in all these runs."""
    if finding.effect == truth.effect:
        return True
    places = [[run.places[column] for column in run.effects[finding.effect]] for run in runs]
    columns = [run.factor[run.width :, own] for run, own in zip(runs, places, strict=True)]
    hidden = [signal(run, truth.effect, own) for run, own in zip(runs, truth.coefficients, strict=True)]
    if truth.alike:
        first = truth.repaired or 0
        parts = [(np.vstack(columns[first:]), np.concatenate(hidden[first:]))]
    else:
        parts = list(zip(columns, hidden, strict=True))
    left = [own - rows @ np.linalg.lstsq(rows, own, rcond=None)[0] for rows, own in parts]
    return float(np.linalg.norm(np.concatenate(left))) < _NOT_APART


def _of_members(truth: Truth, finding: Finding) -> dict[str, Any]:
    """Return how well the units that have it were told."""
    if not truth.kind.startswith("half") or not finding.units:
        return {}
    having = truth.units
    right = [(each.probability > 0.5) == (each.unit in having) for each in finding.units]
    out: dict[str, Any] = {
        "units_right": float(np.mean(right)),
        "units": [[round(each.probability, 4), each.unit in having] for each in finding.units],
    }
    if finding.share_interval is not None:
        low, high = finding.share_interval
        share = len(having) / len(finding.units)
        out |= {"share": finding.share, "interval": [low, high], "covers": low <= share <= high}
    return out


def _of_repair(truth: Truth, finding: Finding) -> dict[str, Any]:
    """Return how well the date of a repair was told."""
    if truth.repaired is None or finding.repair is None:
        return {}
    places = [int(gap.before_run.removeprefix("run")) for gap in finding.repair.gaps]
    return {
        "date_off": abs(places[0] - truth.repaired), "date_within": truth.repaired in places, "dates": len(places),
        "date_probability": finding.repair.gaps[0].probability,
    }  # fmt: skip
