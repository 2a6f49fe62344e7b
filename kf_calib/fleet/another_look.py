"""Which units need another look first: those of which noise, or the spread of the other units, explains least."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

from kf_calib.fleet.pooled_diagnosis import PooledDiagnosis
from kf_calib.fleet.pooled_terms import Attribution
from kf_calib.fleet.track import Track
from kf_calib.support.tail_probabilities import sidak

_LEVEL = 0.01
"""Chance below which a unit is named."""


@dataclass(frozen=True)
class Look:
    """A unit to look at; chance: that the strongest of the reasons is nothing but noise, given how many were tried.

    reasons: in words, the strongest first.
    """

    unit: str
    chance: float
    reasons: tuple[str, ...]


def looks(
    rows: Sequence[Mapping[str, Any]], units: Sequence[str], tracks: Sequence[Track], pooled: PooledDiagnosis | None
) -> tuple[Look, ...]:
    """The units that need another look, first those that need it most."""
    reasons = dict[str, list[tuple[float, str]]]()
    for unit, chance, said in [*_of_runs(rows), *_of_parameters(units, tracks), *_of_effects(pooled)]:
        if chance < _LEVEL:
            reasons.setdefault(unit, []).append((chance, said))
    ordered = {unit: sorted(own, key=lambda each: each[0]) for unit, own in reasons.items()}
    found = [Look(unit, own[0][0], tuple(said for _, said in own)) for unit, own in ordered.items()]
    return tuple(sorted(found, key=lambda look: (look.chance, -len(look.reasons), look.unit)))


_Reason = tuple[str, float, str]


def _of_runs(rows: Sequence[Mapping[str, Any]]) -> list[_Reason]:
    """Return the runs that failed, and those that their model does not explain."""
    reasons = list[_Reason]()
    for row in rows:
        name = PurePosixPath(row["run"]).name
        if row["error"] is not None:
            reasons.append((row["unit"], 0.0, f"{name} failed"))
        elif row["consistent"] is False and row["p_value"] is not None:
            missing = f"shows {row['missing']}" if row["missing"] else "does not fit its model"
            reason = f"{name} {missing} (p = {row['p_value']:.1g})"
            reasons.append((row["unit"], sidak(row["p_value"], len(rows)), reason))
    return reasons


def _of_parameters(units: Sequence[str], tracks: Sequence[Track]) -> list[_Reason]:
    """Return the units of which a parameter lies outside the population of the others."""
    return [
        (unit, chance, f"{track.symbol} is {abs(distance):.1f} spreads from the median of the units")
        for track in tracks
        for unit, chance, distance in zip(units, track.chances.tolist(), track.distances.tolist(), strict=True)
    ]


def _of_effects(pooled: PooledDiagnosis | None) -> list[_Reason]:
    """Return the units that have an effect which other units do not have."""
    findings = () if pooled is None else pooled.findings
    return [
        (figures.unit, max(1.0 - figures.probability, 0.0), f"has {finding.effect}, which others have not")
        for finding in findings
        if finding.attribution is Attribution.SOME
        for figures in finding.units
    ]
