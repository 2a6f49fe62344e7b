"""The command of the blind trial of the pooled diagnosis."""

from __future__ import annotations

import json
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from kf_calib.fleet.run_factor import RunFactor
from pooled_trials.campaigns import KINDS, UNITS
from pooled_trials.report import report
from pooled_trials.runs import simulated
from pooled_trials.trial import play

_POOL = 80  # runs of which each campaign takes some


@cache
def _pool(first: int) -> list[RunFactor]:
    return [simulated(first + k) for k in range(_POOL)]


def _play(kind: str, seed: int, first: int, units: int, through: bool) -> dict[str, Any]:
    return play(kind, seed, _pool(first), units, through)


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--campaigns", type=click.IntRange(min=1), default=20, show_default=True, help="Campaigns of each kind.")
@click.option("--units", type=click.IntRange(min=2, max=_POOL), default=UNITS, show_default=True, help="Units of each.")
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Seed of the first campaign.")
@click.option("--jobs", type=click.IntRange(min=1), default=2, show_default=True, help="Number of processes.")
@click.option("--only", multiple=True, type=click.Choice(KINDS), help="Play only this kind; repeatable.")
@click.option("--simulated", "through", is_flag=True, help="Simulate each run with the effect: the nonlinear truth.")
@click.option("--resume", type=click.Path(path_type=Path), help="Keep outcomes in this file (JSON lines).")
@click.option("--no-trials", is_flag=True, help="Play nothing; show the tables of --resume.")
def main(
    campaigns: int, units: int, seed: int, jobs: int, only: tuple[str, ...], through: bool, resume: Path | None,
    no_trials: bool,
) -> None:  # fmt: skip
    """Hide an effect in campaigns of many runs and count how often the pooled diagnosis is right."""
    outcomes = [json.loads(line) for line in resume.read_text().splitlines()] if resume and resume.exists() else []
    known = {(each["kind"], each["seed"], each["simulated"]) for each in outcomes}
    todo = [(kind, seed + k) for k in range(0 if no_trials else campaigns) for kind in only or KINDS]
    todo = [(kind, own) for kind, own in todo if (kind, own, through) not in known]
    with ProcessPoolExecutor(jobs) as workers:
        made = [workers.submit(_play, kind, own, 1000 * seed, units, through) for kind, own in todo]
        for each in made:
            outcomes.append(each.result())
            if resume:
                with resume.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(outcomes[-1]) + "\n")
    Console(width=120).print(report(outcomes))
