"""The command of the trial on real noise."""

from __future__ import annotations

import json
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import cache
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.table import Table
from scipy.stats import beta

import kf_calib
from kf_calib.bench.arrays import one_blas_thread
from real_trials.ideal import chosen, credible
from real_trials.injected import EFFECTS, alike, injected
from real_trials.recordings import FEWEST_POSES, RealRecording
from real_trials.turned import TurnedRecording

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = (ROOT.parent / "shared" / "real", ROOT.parent / "shared" / "recordings")


@cache
def _recording(path: str, angles: bool) -> RealRecording:
    return TurnedRecording(Path(path)) if angles else RealRecording(Path(path))


def play(path: str, angles: bool, name: str, sigmas: float, seed: int) -> dict[str, Any]:
    """What the diagnosis says of a recording with an effect injected, or unmodified where ``name`` is empty, and what
    the best chooser says."""
    recording = _recording(path, angles)
    task = {"recording": recording.name, "effect": name, "sigmas": sigmas, "seed": seed}
    with one_blas_thread():
        added = injected(recording, name, sigmas, seed) if name else None
        if name and added is None:
            return {**task, "visible": False}
        try:
            diagnosis = kf_calib.diagnose(recording.altered(added if added is not None else [0.0] * 3))  # type: ignore[arg-type]
        except kf_calib.KfCalibError as error:
            return {**task, "visible": True, "refused": str(error)}
    rows = diagnosis.table.rows if diagnosis.table else ()
    best = chosen(recording, added, sigmas, seed) if added is not None else {}
    return {
        **task, "visible": True, "best": credible(best), "best_probability": best.get(name, 0.0),
        "p": diagnosis.test.p_value, "missing": list(diagnosis.missing),
        "first": list(diagnosis.likeliest.effects) if diagnosis.likeliest else [], "noise": diagnosis.noise,
        "set": list(diagnosis.ambiguity), "verdict": diagnosis.verdict, "unearned": diagnosis.unearned,
        "probability": sum(row.probability for row in rows if name in row.effects),
        "rows": [[list(row.effects), row.probability] for row in rows if row.effects and row.probability > 0.01],
        "alike": sorted(alike(recording, added)) if added is not None else [],
    }  # fmt: skip


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--folder", multiple=True, type=click.Path(path_type=Path), help="Folders of recordings.")
@click.option("--sizes", multiple=True, type=float, default=(8.0, 10.0, 15.0), show_default=True, help="In sigmas.")
@click.option("--only", multiple=True, help="Recordings to take, by name; all where none is named.")
@click.option("--seed", type=int, default=1, show_default=True, help="Of the coefficients.")
@click.option("--jobs", type=click.IntRange(min=1), default=2, show_default=True, help="Number of processes.")
@click.option("--resume", type=click.Path(path_type=Path), help="Keep outcomes in this file (JSON lines).")
def main(
    folder: tuple[Path, ...], sizes: tuple[float, ...], only: tuple[str, ...], seed: int, jobs: int, resume: Path | None
) -> None:
    """Inject each visible effect into each real recording, diagnose it, and count how often the truth is named."""
    paths = [path for place in folder or FOLDERS if place.is_dir() for path in sorted(place.iterdir())]
    paths = [path for path in paths if path.name.endswith((".csv.gz", ".csv", ".mcap"))]
    paths = [path for path in paths if not only or path.name.partition(".")[0] in only]
    paths = [path for path in paths if _is_read(path)]
    outcomes = _read(resume)
    known = {(each["recording"], each["effect"], each["sigmas"], each["seed"]) for each in outcomes}
    many = [path for path in paths if len(_recording(str(path), False).dwells_s) >= FEWEST_POSES]
    turned = [path for path in many if TurnedRecording(path).still]
    places = [*((str(path), False) for path in paths), *((str(path), True) for path in turned)]
    tasks = [(*place, "", 0.0, 0) for place in places]
    tasks += [
        (*place, name, size, seed)
        for size in sizes for place in places if Path(place[0]) in many for name in EFFECTS
    ]  # fmt: skip
    tasks = [task for task in tasks if (_recording(*task[:2]).name, *task[2:]) not in known]
    with ProcessPoolExecutor(jobs) as pool:
        for done in as_completed([pool.submit(play, *task) for task in tasks]):
            outcomes.append(done.result())
            if resume is not None:
                with resume.open("a") as file:
                    file.write(json.dumps(outcomes[-1]) + "\n")
    console = Console(width=180)
    console.print(_unmodified(outcomes), _counted(outcomes, "sigmas"), _counted(outcomes, "recording"))
    console.print(_counted(outcomes, "effect"), _reliability(outcomes))


def _is_read(path: Path) -> bool:
    """Whether a recording can be calibrated without options; the reason is told where it cannot."""
    try:
        return len(_recording(str(path), False).dwells_s) > 0
    except kf_calib.KfCalibError as error:
        Console(stderr=True, width=180).print(f"{path.name} is left out: {error}", markup=False, highlight=False)
        return False


def _read(path: Path | None) -> list[dict[str, Any]]:
    if path is None or not path.exists():
        return []
    return [json.loads(line) for line in path.read_text().splitlines()]


def _unmodified(outcomes: Sequence[dict[str, Any]]) -> Table:
    """Return the verdicts on recordings as they are."""
    table = Table("recording", "p", "verdict", title="Unmodified", title_justify="left")
    for each in outcomes:
        if not each["effect"]:
            table.add_row(each["recording"], f"{each.get('p') or 1:.2g}", each.get("verdict") or each["refused"])
    return table


def _counted(outcomes: Sequence[dict[str, Any]], key: str) -> Table:
    """Return how often the truth is first, in the set, and named wrongly, by size, recording or effect."""
    headings = (
        key, "trials", "first", "first, or alike", "in the set", "wrong name", "mean probability",
        "best possible: first, or alike", "in the set", "mean probability",
    )  # fmt: skip
    table = Table(*headings, title=f"Injected, by {key}", title_justify="left")
    told = [each for each in outcomes if each["effect"] and each["visible"] and "refused" not in each]
    for value in dict.fromkeys(each[key] for each in told):
        own = [each for each in told if each[key] == value]
        counts = [
            sum(each["first"] == [each["effect"]] for each in own),
            sum(len(each["first"]) == 1 and each["first"][0] in {each["effect"], *each["alike"]} for each in own),
            sum(bool({each["effect"], *each["alike"]} & set(each["set"])) for each in own),
            sum(bool(each["missing"]) and not _right(each) for each in own),
            sum(each["best"][0] in {each["effect"], *each["alike"]} for each in own),
            sum(bool({each["effect"], *each["alike"]} & set(each["best"])) for each in own),
        ]
        mean, best = (f"{sum(each[of] for each in own) / len(own):.2f}" for of in ("probability", "best_probability"))
        shares = [f"{k} ({k / len(own):.0%})" for k in counts]
        table.add_row(str(value), str(len(own)), *shares[:4], mean, *shares[4:], best)
    return table


def _right(each: dict[str, Any]) -> bool:
    return bool({each["effect"], *each["alike"]} & set(each["missing"]))


def _reliability(outcomes: Sequence[dict[str, Any]]) -> Table:
    """Return how often statements of a probability are true, of all rows of one effect."""
    table = Table("stated", "statements", "true", "95 % limits", title="Reliability of names", title_justify="left")
    told = [each for each in outcomes if each["effect"] and each["visible"] and "refused" not in each]
    statements = [
        (share, bool(set(effects) & {each["effect"], *each["alike"]}))
        for each in told
        for effects, share in each["rows"]
    ]
    for low, high in ((0.01, 0.1), (0.1, 0.3), (0.3, 0.5), (0.5, 0.7), (0.7, 0.9), (0.9, 0.99), (0.99, 1.0)):
        true = [right for share, right in statements if low <= share < high]
        if true:
            count, right = len(true), sum(true)
            limits = (
                beta.ppf(0.025, right, count - right + 1) if right else 0.0,
                (beta.ppf(0.975, right + 1, count - right) if right < count else 1.0),
            )
            table.add_row(
                f"{low:.0%} to {high:.0%}", str(count), f"{right / count:.0%}", f"{limits[0]:.0%} to {limits[1]:.0%}"
            )
    return table
