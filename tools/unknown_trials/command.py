"""The command of the trial on effects of no catalogue."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.table import Table
from scipy.stats import beta

import kf_calib
from kf_calib.bench.arrays import one_blas_thread
from kf_calib.bench.streams import Source
from unknown_trials.faulty_bench import FAULTS, faulty_run
from unknown_trials.hidden import HIDDEN, beside, cross_coupling, second_order
from unknown_trials.real_noise import KINDS, noisy_run
from unknown_trials.small_bench import hidden_run

_CREDIBLE = 0.99
_SURE = 0.9


GROUPS = {"none": HIDDEN, "beside": HIDDEN, "bench": FAULTS, "noise": KINDS}
_KNOWN = {"second-order": second_order, "cross-coupling-ip": cross_coupling}


def _run(group: str, name: str, sigmas: float, seed: int) -> tuple[Source, str]:
    """Return a run, and the effect of the catalogue that is hidden in it; "" for none."""
    if group == "none":
        return hidden_run(HIDDEN[name], sigmas, seed), ""
    if group == "bench":
        return faulty_run(name, sigmas, seed), ""
    if group == "noise":
        return noisy_run(name, sigmas, seed), "second-order" if sigmas else ""
    known = [*_KNOWN][seed % 2]
    return beside(_KNOWN[known], name, sigmas, seed), known


def play(group: str, name: str, sigmas: float, seed: int) -> dict[str, Any]:
    """What the diagnosis says of a run of this kind."""
    run, known = _run(group, name, sigmas, seed)
    began = time.process_time()
    with one_blas_thread():
        diagnosis = kf_calib.diagnose(run)
    rows = diagnosis.table.rows if diagnosis.table else ()
    names = sorted({effect for row in rows for effect in row.effects})
    shares = {effect: sum(row.probability for row in rows if effect in row.effects) for effect in names}
    return {
        "group": group, "effect": name, "known": known, "sigmas": sigmas, "seed": seed,
        "p": diagnosis.test.p_value, "verdict": diagnosis.verdict,
        "unknown": diagnosis.unknown or bool(diagnosis.unearned or (rows and rows[0].driver)), "noise": diagnosis.noise,
        "missing": list(diagnosis.missing), "names": {key: share for key, share in shares.items() if share > 0.01},
        "in_set": _in_set(rows), "seconds": time.process_time() - began,
        "rows": [[list(row.effects), row.driver, list(row.families), row.probability] for row in rows[:6]],
    }  # fmt: skip


def _in_set(rows: Sequence[Any]) -> bool:
    """Tell whether a cause of no catalogue is among the explanations that have 99 % together."""
    told = 0.0
    for row in rows:
        if row.driver and row.driver != "like a known effect":
            return True
        told += row.probability
        if told >= _CREDIBLE:
            return False
    return False


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--runs", type=click.IntRange(min=1), default=4, show_default=True, help="Runs of each effect and size.")
@click.option("--seed", type=int, default=1, show_default=True, help="Of the first run.")
@click.option("--sizes", multiple=True, type=float, default=(10.0, 15.0), show_default=True, help="In sigmas.")
@click.option(
    "--group",
    type=click.Choice([*GROUPS]),
    default="none",
    show_default=True,
    help="Effects of no catalogue; those beside one of the catalogue of twice the size; faults of a bench; noise as "
    "real sensors have it.",
)
@click.option(
    "--only", multiple=True, type=click.Choice([*HIDDEN, *FAULTS, *KINDS]), help="Play only this one; repeatable."
)
@click.option("--jobs", type=click.IntRange(min=1), default=2, show_default=True, help="Number of processes.")
@click.option("--resume", type=click.Path(path_type=Path), help="Keep outcomes in this file (JSON lines).")
def main(
    runs: int, seed: int, sizes: tuple[float, ...], group: str, only: tuple[str, ...], jobs: int, resume: Path | None
) -> None:
    """Hide what is in no catalogue, and count how often the diagnosis says unknown, and how often a wrong name."""
    lines = resume.read_text().splitlines() if resume and resume.exists() else []
    outcomes = [json.loads(line) for line in lines]
    known = {(each["group"], each["effect"], each["sigmas"], each["seed"]) for each in outcomes}
    tasks = [(group, name, size, seed + k) for k in range(runs) for size in sizes for name in only or GROUPS[group]]
    with ProcessPoolExecutor(jobs) as pool:
        for done in as_completed([pool.submit(play, *task) for task in tasks if task not in known]):
            outcomes.append(done.result())
            if resume is not None:
                with resume.open("a") as file:
                    file.write(json.dumps(outcomes[-1]) + "\n")
    Console(width=150).print(counted(outcomes))


def counted(outcomes: Sequence[dict[str, Any]]) -> Table:
    """How often a cause of no catalogue is first, or in the set, how often the one of the catalogue is named, and how
    often a wrong name has 90 %."""
    headings = ("hidden", "runs", "noticed", "unknown first", "unknown in the set", "noise", "known one named",
                "wrong name >= 90 %")  # fmt: skip
    table = Table(*headings, title="What is in no catalogue", title_justify="left")
    for name in [*dict.fromkeys(each["effect"] for each in outcomes), "all"]:
        chosen = [each for each in outcomes if name in ("all", each["effect"])]
        counts = [
            sum(each["p"] < 0.01 for each in chosen),
            sum(each["unknown"] for each in chosen),
            sum(each["unknown"] or each["in_set"] for each in chosen),
            sum(each["noise"] for each in chosen),
            sum(bool(each["known"]) and each["known"] in each["missing"] for each in chosen),
            sum(_wrong(each) >= _SURE for each in chosen),
        ]
        cells = [f"{k} ({k / len(chosen):.0%})" for k in counts]
        if name == "all":
            cells = [f"{cell}, {_limits(k, len(chosen))}" for cell, k in zip(cells, counts, strict=True)]
        table.add_row(name, str(len(chosen)), *cells)
    return table


def _wrong(outcome: dict[str, Any]) -> float:
    """Return the largest probability of a name that is wrong."""
    return max((share for name, share in outcome["names"].items() if name != outcome["known"]), default=0.0)


def _limits(count: int, trials: int) -> str:
    """Return the 95 % limits of a rate."""
    low = beta.ppf(0.025, count, trials - count + 1) if count else 0.0
    high = beta.ppf(0.975, count + 1, trials - count) if count < trials else 1.0
    return f"{low:.0%} to {high:.0%}"
