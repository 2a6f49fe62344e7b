"""What a fleet costs beside replay and diagnose alone: processor time of a run, and what the client takes.

usage: .venv/bin/python tools/bench_fleet.py FOLDER [--runs 100] [--rows 2000] [--workers 1,2] [--json]

FOLDER has recordings (tools/fleet_generator.py). Times are processor time, so that they mean something on a busy
machine. alone: replay and diagnose with their JSON documents, in one process, as the commands do them. as a row: the
same with all that makes it a row of the table (checksum, factor, columns), in the same process, run by run beside it.
workers: the same runs through the command's own code on so many processes. client: rows of the usual size, computed
before and only handed over by the workers, through scheduler, client and table, to see how many these bear.
scheduler: tasks that do nothing.
"""

from __future__ import annotations

import argparse
import json
import pickle
import resource
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from kf_calib.cli.options import EvaluationOptions, ReadingOptions
from kf_calib.fleet.batch import RunEvaluation, cluster, evaluate_all
from kf_calib.fleet.run_list import ListedRun, Row, runs_of
from kf_calib.fleet.store import Store
from kf_calib.support.json_values import json_value
from kf_calib.views.diagnosis import diagnosis_object
from kf_calib.views.json import replay_object


@dataclass(frozen=True)
class HandedOver:
    """Stands in the place of an evaluation whose row is known, and in a file."""

    row: Path
    settings: str = ""

    def __call__(self, run: ListedRun, known_sha256: str | None = None) -> Row:
        return pickle.loads(self.row.read_bytes()) | {"run": run.place, "evaluated": datetime.now(UTC), "cpu_s": 0.0}


def evaluation() -> RunEvaluation:
    return RunEvaluation.of(ReadingOptions(), EvaluationOptions())


def cost_of_a_row(runs: Sequence[ListedRun]) -> dict[str, float]:
    """Processor time of a run alone and as a row, s."""
    how = evaluation()

    def alone(run: ListedRun) -> None:
        source, result = how.replay(Path(run.place))
        json.dumps(json_value([replay_object(result), diagnosis_object(how.diagnose(source, result))]))

    alone(runs[0])
    how(runs[0])
    spent = [0.0, 0.0]
    for run in runs:
        for k, do in enumerate((alone, how)):
            begun_s = time.process_time()
            do(run)
            spent[k] += time.process_time() - begun_s
    own, row = (seconds / len(runs) for seconds in spent)
    return {"alone_s": own, "as_a_row_s": row, "ratio": row / own}


def on_workers(runs: Sequence[ListedRun], workers: int) -> dict[str, float]:
    """The runs on so many processes: processor time of a run in them, and elapsed time of all, s."""
    with tempfile.TemporaryDirectory() as folder, cluster(workers) as client:
        store, begun_s = Store(Path(folder)), time.monotonic()
        with store.taken():
            done = evaluate_all(client, evaluation(), runs, store)
        return {"workers": workers, "cpu_s_a_run": done.cpu_s / done.evaluated, "elapsed_s": time.monotonic() - begun_s}


def cost_of_the_client(run: ListedRun, rows: int) -> dict[str, float]:
    """What client and scheduler, which are in this process, take for rows of the usual size."""
    row = evaluation()(run)
    assert row is not None and row["error"] is None
    runs = [replace(run, place=f"{run.place}?{k}") for k in range(rows)]
    with tempfile.TemporaryDirectory() as folder, cluster(1) as client:
        store, known = Store(Path(folder)), Path(folder, "row.pickle")
        known.write_bytes(pickle.dumps(row))
        with store.taken():
            begun_s, cpu_s = time.monotonic(), time.process_time()
            evaluate_all(client, HandedOver(known), runs, store)  # type: ignore[arg-type]
            elapsed_s, cpu_s = time.monotonic() - begun_s, time.process_time() - cpu_s
        size = sum(file.stat().st_size for file in store.folder.glob("*.parquet"))
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1 << (20 if sys.platform == "darwin" else 10))
    return {
        "rows": rows, "cpu_s_a_row": cpu_s / rows, "rows_a_second": rows / elapsed_s, "peak_mb": peak_mb,
        "bytes_a_row": size / rows,
    }  # fmt: skip


def cost_of_a_task(tasks: int) -> dict[str, float]:
    """What client and scheduler take for a task that does nothing."""
    with cluster(1) as client:
        client.submit(int, 0).result()
        begun_s, cpu_s = time.monotonic(), time.process_time()
        client.gather(client.map(int, range(1, tasks + 1)))
        elapsed_s, cpu_s = time.monotonic() - begun_s, time.process_time() - cpu_s
    return {"tasks": tasks, "cpu_s_a_task": cpu_s / tasks, "tasks_a_second": tasks / elapsed_s}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder")
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--rows", type=int, default=2000)
    parser.add_argument("--workers", default="1,2")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    every = runs_of([options.folder])
    runs = every[:: max(len(every) // max(options.runs, 1), 1)][: options.runs]
    found: dict[str, Any] = {}
    if options.rows:
        found["scheduler"] = cost_of_a_task(options.rows)
        found["client"] = cost_of_the_client(every[0], options.rows)
    if runs:
        found["one process"] = cost_of_a_row(runs)
        found["workers"] = [on_workers(runs, int(workers)) for workers in options.workers.split(",") if workers]
    print(json.dumps(found, indent=None if options.json else 1))


if __name__ == "__main__":
    main()
