"""The command of the trial: seeds to processes or machines by Dask, rows to Parquet, and the report."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import click
import pyarrow as pa
import pyarrow.parquet as pq
from distributed import Client, as_completed
from rich.console import Console
from rich.progress import track

from kf_calib.fleet.batch import cluster
from prior_trials.play import play
from prior_trials.report import Report

_TOGETHER = 50  # rows of a file

SCHEMA = pa.schema([
    ("seed", pa.int64()), ("dwells", pa.int64()), ("stated", pa.bool_()), ("truth", pa.string()),
    ("labels", pa.list_(pa.string())), ("probabilities", pa.list_(pa.float64())), ("p", pa.float64()),
    ("verdict", pa.string()), ("missing", pa.string()), ("ranks", pa.list_(pa.float64())), ("refused", pa.string()),
    ("seconds", pa.float64()),
])  # fmt: skip


def played(folder: Path) -> pa.Table:
    """All rows that a folder has."""
    files = sorted(folder.glob("rows-*.parquet"))
    return pa.concat_tables([pq.read_table(file, schema=SCHEMA) for file in files]) if files else SCHEMA.empty_table()


def _write(folder: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write rows as one file, whole or not at all."""
    path = folder / f"rows-{min(row['seed'] for row in rows):07d}.parquet"
    partial = path.with_suffix(".partial")
    pq.write_table(pa.Table.from_pylist(list(rows), schema=SCHEMA), partial)
    partial.replace(path)


def _rows(client: Client, seeds: Sequence[int]) -> Iterator[dict[str, Any]]:
    """Yield the rows of all seeds as they are played; few are handed out at a time."""
    waiting = iter(seeds)
    going = as_completed(client.map(play, list(itertools.islice(waiting, 4 * _TOGETHER)), pure=False))
    for future in going:
        yield future.result()
        for seed in itertools.islice(waiting, 1):
            going.add(client.submit(play, seed, pure=False))


@click.command(help=__doc__)
@click.argument("folder", type=click.Path(path_type=Path, file_okay=False))
@click.option("--runs", default=2000, help="Runs in all, those that are there among them.")
@click.option("--first", default=0, help="Seed of the first run.")
@click.option("--jobs", default=2, help="Processes on this machine.")
@click.option("--scheduler", help="Address of a Dask scheduler in place of these processes.")
def main(folder: Path, runs: int, first: int, jobs: int, scheduler: str | None) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    known = {*played(folder)["seed"].to_pylist()}
    seeds = [seed for seed in range(first, first + runs) if seed not in known]
    if seeds:
        with cluster(jobs, scheduler) as client:
            rows = track(_rows(client, seeds), "playing", total=len(seeds), console=Console(stderr=True))
            for some in _batched(iter(rows)):
                _write(folder, some)
    Console().print(Report(played(folder).to_pylist()))


def _batched(rows: Iterator[dict[str, Any]]) -> Iterator[list[dict[str, Any]]]:
    """Yield a few rows at a time; itertools has it from Python 3.12."""
    while some := list(itertools.islice(rows, _TOGETHER)):
        yield some
