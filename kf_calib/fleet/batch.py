"""All runs of a fleet through the workers and into the table, with a bounded number of them under way."""

from __future__ import annotations

import logging
import signal
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import dask.config
from distributed import Client, Future, KilledWorker, LocalCluster, Worker, WorkerPlugin, as_completed

from kf_calib.errors import InputError, KfCalibError
from kf_calib.fleet.evaluation import Evaluation, begun
from kf_calib.fleet.run_list import Run
from kf_calib.fleet.run_row import Row
from kf_calib.fleet.store import Known, Store

_AHEAD = 4
"""Runs under way for each process, so that none waits for its next one; what is under way bounds the memory."""
_CONFIG = {
    "distributed.scheduler.allowed-failures": 2,  # so often may a run take its process with it and be tried again
    "distributed.scheduler.worker-saturation": 1.0,  # no run waits at a process that another one takes with it
    "distributed.worker.profile.enabled": False,  # looks a hundred times a second at what a worker does
    # Dask would have free memory of 64 kB given back at once, and arrays of 128 kB fetched from the system each time.
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": 1 << 28,
    "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": 1 << 25,
}


@dataclass
class Progress:
    """How far a fleet has come.

    total: runs named. kept: of these, runs that were in the table with the same content and settings. evaluated: runs
    that were evaluated now, failed: those of them that failed. cpu_s: processor time that they took. notes: sentences
    on rows of the table that are of no use.
    """

    total: int
    kept: int = 0
    evaluated: int = 0
    failed: int = 0
    cpu_s: float = 0.0
    notes: tuple[str, ...] = ()

    @property
    def done(self) -> int:
        """Runs that need nothing more."""
        return self.kept + self.evaluated


def evaluate_all(
    client: Client,
    evaluation: Evaluation,
    runs: Sequence[Run],
    store: Store,
    on_progress: Callable[[Progress], None] = lambda progress: None,
) -> Progress:
    """Evaluate the runs that are not in the table yet, and write their rows as they come.

    Runs that failed because their file could not be fetched, or because their process ended, are tried again; others
    would fail again.
    """
    known, notes = store.checked()
    waiting = deque(run for run in runs if not _is_done(run, known.get(run.place), evaluation))
    progress = Progress(len(runs), kept=len(runs) - len(waiting), notes=tuple(notes))
    on_progress(progress)
    for rows, kept in _evaluated(client, evaluation, waiting, known):
        store.append(rows)
        progress.kept += kept
        progress.evaluated += len(rows)
        progress.failed += sum(row["error"] is not None for row in rows)
        progress.cpu_s += sum(row["cpu_s"] or 0.0 for row in rows)
        on_progress(progress)
    store.compact()
    return progress


def _is_done(run: Run, known: Known | None, evaluation: Evaluation) -> bool:
    """Tell without reading a run that its row in the table holds."""
    same = known and known.sha256 and run.version and known.version == run.version
    return bool(same and known and known.settings == evaluation.settings_of(run))


def _evaluated(
    client: Client, evaluation: Evaluation, waiting: deque[Run], known: dict[str, Known]
) -> Iterator[tuple[list[Row], int]]:
    """Yield rows as they come, with the number of runs whose content turned out to be the same as before."""
    under_way, ready = dict[Future[Any], Run](), as_completed(with_results=False)

    def begin() -> None:
        run = waiting.popleft()
        before = known.get(run.place)
        same = before.sha256 if before and before.settings == evaluation.settings_of(run) else None
        future = client.submit(evaluation, run, same, pure=False)
        under_way[future] = run
        ready.add(future)

    threads: Any = client.nthreads()
    most = _AHEAD * max(sum(threads.values()), 1)
    while waiting and len(under_way) < most:
        begin()
    for futures in ready.batches():
        rows = [_row(future, under_way.pop(future), evaluation) for future in futures]
        for _ in range(min(len(futures), len(waiting))):
            begin()
        yield [row for row in rows if row is not None], sum(row is None for row in rows)


def _row(future: Future[Any], run: Run, evaluation: Evaluation) -> Row | None:
    """Return what a worker found; where it was lost with its process, a row that says so."""
    error: Any = future.exception()
    if error is None:
        return future.result()
    if isinstance(error, KilledWorker):
        times = error.allowed_failures + 1
        more = "give the workers more memory, or the run more time (--limit-s)"
        said = f"{run.place}: the process that evaluated it was ended {times} times: {more}."
        return begun(run, evaluation.settings_of(run)) | {"error": said}
    raise KfCalibError(f"{run.place}: no worker could evaluate it ({' '.join(str(error).split())}).") from error


class _LeftToTheClient(WorkerPlugin):
    """Ctrl-C reaches all processes of a terminal; workers go on until the client, which stops for it, ends them."""

    def setup(self, worker: Worker) -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def cluster(workers: int, scheduler: str | None = None) -> Iterator[Client]:
    """A client of a scheduler: of ``workers`` processes of this machine, which end with the block, or of one that is
    running, for example ``tcp://host:8786``. Raises InputError where that one cannot be reached."""
    with dask.config.set(_CONFIG):
        if scheduler is None:
            with (
                LocalCluster(
                    n_workers=workers, threads_per_worker=1, processes=True, memory_limit=0,
                    dashboard_address="127.0.0.1:0", silence_logs=logging.CRITICAL,
                ) as local,
                Client(local) as client,
            ):  # fmt: skip
                client.register_plugin(_LeftToTheClient())
                yield client
            return
        try:
            client = Client(scheduler)
        except (OSError, ValueError) as error:
            said = " ".join(str(error).split()) or type(error).__name__
            raise InputError(
                f"no scheduler answers at {scheduler} ({said}): start one there (dask scheduler), or name another."
            ) from None
        with client:
            yield client
