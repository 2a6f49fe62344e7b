"""The command of the blind trial."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path

import click
import numpy as np
from rich.console import Console

from blind_trials.confusion import confusion, save_picture
from blind_trials.criteria import is_failure
from blind_trials.failures import keep, save_failures
from blind_trials.figures import figures
from blind_trials.reliability import save_reliability
from blind_trials.report import markdown, report
from blind_trials.schedule import tasks, thin
from blind_trials.task import FAMILIES, Task
from blind_trials.trial_log import read_outcomes
from blind_trials.workers import play_trials


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.option(
    "--runs", type=click.IntRange(min=1), default=4, show_default=True, help="Trials for each effect and size."
)
@click.option("--seed", type=click.IntRange(min=1), default=1, show_default=True, help="Seed of all trials.")
@click.option("--jobs", type=click.IntRange(min=1), default=2, show_default=True, help="Number of processes.")
@click.option(
    "--only", multiple=True, type=click.Choice(FAMILIES), help="Play only this family of figures; repeatable."
)
@click.option("--effect", "effects", multiple=True, help="Hide only this effect; repeatable.")
@click.option(
    "--setting",
    type=click.FloatRange(min=0),
    default=float(Task.setting),
    show_default=True,
    help="Setting error of an orientation, deg.",
)
@click.option("--limit", type=click.IntRange(min=1), help="Play at most so many trials of each figure.")
@click.option(
    "--resume",
    type=click.Path(path_type=Path),
    help="Keep outcomes in this file (JSON lines), and play only the trials that it lacks.",
)
@click.option(
    "--pool",
    "pooled",
    multiple=True,
    type=click.Path(path_type=Path, exists=True),
    help="Add the outcomes of another run to the tables; repeatable.",
)
@click.option("--no-trials", is_flag=True, help="Play nothing; show the tables of --resume and --pool.")
@click.option("--markdown", "page", type=click.Path(path_type=Path), help="Write the tables as Markdown.")
@click.option("--out", type=click.Path(path_type=Path), help="Write all outcomes and figures as JSON.")
@click.option("--picture", type=click.Path(path_type=Path), help="Draw the confusion matrix, PNG or SVG.")
@click.option("--reliability", type=click.Path(path_type=Path), help="Draw the reliability diagram, PNG or SVG.")
@click.option(
    "--failures", type=click.Path(path_type=Path), help="Write what went wrong, with commands that repeat it."
)
@click.option("--keep", "kept", type=click.Path(path_type=Path), help="Folder for the recordings of what went wrong.")
def main(
    runs: int,
    seed: int,
    jobs: int,
    only: tuple[str, ...],
    effects: tuple[str, ...],
    setting: float,
    limit: int | None,
    resume: Path | None,
    pooled: tuple[Path, ...],
    no_trials: bool,
    page: Path | None,
    out: Path | None,
    picture: Path | None,
    reliability: Path | None,
    failures: Path | None,
    kept: Path | None,
) -> None:
    """Hide effects in simulated recordings and count how often the program is right.

    ``simulate`` makes each recording by the nonlinear truth, ``diagnose --json`` or ``improve --json`` judges it, and
    the truth in the side file judges the answer. A name is right if it is that of the hidden effect, or of one that
    means the same readings in this run. A recording that the program refuses to judge counts as not right. Use small
    seeds in development, and for a release a new seed of six digits.
    """
    earlier = [
        each for path in [*pooled, *([resume] if resume and resume.exists() else [])] for each in read_outcomes(path)
    ]
    todo = [] if no_trials else thin(tasks(only or FAMILIES, runs, seed, effects, f"{setting:g}"), limit)
    outcomes = {each.task: each for each in earlier}
    left = [task for task in todo if task not in outcomes]
    np.random.default_rng(seed).shuffle(left)  # so that an interrupted trial already has some of everything
    outcomes |= {each.task: each for each in play_trials(left, jobs, resume)}
    outcomes = sorted(outcomes.values(), key=lambda each: each.task.seed)
    Console(width=None if sys.stdout.isatty() else 140).print(report(outcomes))
    if out:
        content = {
            "seed": seed, "runs": runs, "figures": [dataclasses.asdict(each) for each in figures(outcomes)],
            "confusion": confusion(outcomes), "outcomes": [dataclasses.asdict(each) for each in outcomes],
        }  # fmt: skip
        out.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    if page:
        page.write_text(markdown(outcomes), encoding="utf-8")
    if picture:
        save_picture(outcomes, picture)
    if reliability:
        save_reliability(outcomes, reliability)
    if failures:
        save_failures(outcomes, failures)
    if kept:
        for each in filter(is_failure, outcomes):
            keep(each.task, kept.absolute())
