"""All runs of a fleet through the workers and into the table, with a bounded number of them under way.

A worker fetches a run, evaluates it by the code of the single commands, and makes it a row. A run that never ends must
not keep the others from being evaluated: when its time is over, Python is told to stop in the thread that works, which
reaches it between two steps of the interpreter. What does not come to such a step, as a file system that does not
answer, is ended with its process, if this is a worker's.
"""

from __future__ import annotations

import ctypes
import hashlib
import json
import logging
import multiprocessing
import os
import platform
import signal
import stat
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Self, TypeVar

import dask.config
from distributed import Client, Future, KilledWorker, LocalCluster, Worker, WorkerPlugin, as_completed
from fsspec.core import url_to_fs
from fsspec.implementations.local import LocalFileSystem

from kf_calib.bench.arrays import one_blas_thread
from kf_calib.bench.streams import Source
from kf_calib.cli.command import values_of
from kf_calib.cli.failures import sentence
from kf_calib.cli.options import EvaluationOptions, ReadingOptions, opened
from kf_calib.diagnosis.missing_effect import diagnose
from kf_calib.diagnosis.refits import Refits
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.errors import InputError, KfCalibError
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.results import Calibration
from kf_calib.fleet import run_list
from kf_calib.fleet.run_factor import run_factor
from kf_calib.fleet.run_list import ListedRun, Row
from kf_calib.fleet.store import Known, Store
from kf_calib.sources.files.record_files import fingerprint
from kf_calib.sources.opening import run_date
from kf_calib.support.json_values import json_value
from kf_calib.views.diagnosis import diagnosis_object
from kf_calib.views.json import replay_object

_AHEAD = 4
"""Runs under way for each process, so that none waits for its next one; what is under way bounds the memory."""
_CONFIG = {
    "distributed.scheduler.allowed-failures": 2,  # so often may a run take its process with it and be tried again
    "distributed.scheduler.worker-saturation": 1.0,  # no run waits at a process that another one takes with it
    "distributed.deploy.lost-worker-timeout": "1d",  # a process takes its time to begin again on a busy machine
    "distributed.worker.profile.enabled": False,  # looks a hundred times a second at what a worker does
    # Dask would have free memory of 64 kB given back at once, and arrays of 128 kB fetched from the system each time.
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": 1 << 28,
    "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": 1 << 25,
}


@dataclass
class BatchProgress:
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
    evaluation: RunEvaluation,
    runs: Sequence[ListedRun],
    store: Store,
    on_progress: Callable[[BatchProgress], None] = lambda progress: None,
) -> BatchProgress:
    """Evaluate the runs that are not in the table yet, and write their rows as they come.

    Runs that failed because their file could not be fetched, or because their process ended, are tried again; others
    would fail again.
    """
    known, notes = store.checked()
    waiting = deque(run for run in runs if not _is_done(run, known.get(run.place), evaluation))
    progress = BatchProgress(len(runs), kept=len(runs) - len(waiting), notes=tuple(notes))
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


def _is_done(run: ListedRun, known: Known | None, evaluation: RunEvaluation) -> bool:
    """Tell without reading a run that its row in the table holds."""
    same = known and known.sha256 and run.version and known.version == run.version
    return bool(same and known and known.settings == evaluation.settings_of(run))


def _evaluated(
    client: Client, evaluation: RunEvaluation, waiting: deque[ListedRun], known: dict[str, Known]
) -> Iterator[tuple[list[Row], int]]:
    """Yield rows as they come, with the number of runs whose content turned out to be the same as before."""
    under_way, ready = dict[Future[Any], ListedRun](), as_completed(with_results=False)

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


def _row(future: Future[Any], run: ListedRun, evaluation: RunEvaluation) -> Row | None:
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


LIMIT_S = 3600.0
"""How long a run may take unless somebody says otherwise."""
_KINDS = {stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket", stat.S_IFCHR: "a device", stat.S_IFBLK: "a device"}
_AGAIN_S = 5.0  # what is told to stop may be caught on its way
_GRACE_S = 60.0  # at most, before a process is ended


T = TypeVar("T")


@dataclass(frozen=True)
class RunEvaluation:
    """How each run of a fleet is evaluated: as ``replay`` and ``diagnose`` do it with these options. Calling it
    evaluates one; it is sent to the workers by pickle.

    settings: checksum of all that numbers depend on besides the recording: options, the files they name, and the
    program. limit_s: how long a run may take.
    """

    reading: ReadingOptions
    evaluation: EvaluationOptions
    settings: str
    limit_s: float = LIMIT_S

    @classmethod
    def of(cls, reading: ReadingOptions, evaluation: EvaluationOptions, limit_s: float = LIMIT_S) -> Self:
        """The evaluation with these options; raises KfCalibError where every run would fail with them."""
        evaluation.settings()
        _ = reading.keys
        told = {key: _content(value) for key, value in sorted(values_of(reading, evaluation))}
        text = json.dumps(told | {"kf_calib": version("kf_calib")})
        return cls(reading, evaluation, hashlib.sha256(text.encode()).hexdigest(), limit_s)

    def replay(self, path: Path) -> tuple[Source, Calibration]:
        """What ``replay`` evaluates of a recording."""
        source, settings = opened(path, self.reading, self.evaluation)
        return source, calibrate(source, settings)

    def diagnose(self, source: Source, result: Calibration) -> Diagnosis:
        """What ``diagnose`` then does."""
        return diagnose(result, Refits(source))

    def settings_of(self, run: ListedRun) -> str:
        """Checksum of all that the row of a run depends on besides its recording: what a list says of it, too."""
        stated = [run.unit, run.bench, run.date.isoformat() if run.date else None]
        if not any(stated):
            return self.settings
        return hashlib.sha256(json.dumps([self.settings, *stated]).encode()).hexdigest()

    def __call__(self, run: ListedRun, known_sha256: str | None = None) -> Row | None:
        """The row of a run; None if its content is the one that ``known_sha256`` belongs to. Whatever goes wrong is a
        sentence in the row."""
        row, begun_s = begun(run, self.settings_of(run)), time.process_time()
        try:
            if not in_time(self.limit_s, lambda: self._changed(row, run, known_sha256)):
                return None
        except OverTime:
            said = f"was not evaluated in {self.limit_s:g} s, and stopped"
            row["error"] = f"{run.place}: {said}: give it more time (--limit-s), or leave it out."
            row["sha256"] = None  # with more time it may come to an end
        return row | {"cpu_s": time.process_time() - begun_s, "evaluated": datetime.now(UTC)}

    def _changed(self, row: Row, run: ListedRun, known_sha256: str | None) -> bool:
        """Fill in the row of a run, and tell whether its content is not the one that is known."""
        try:
            with local_copy(run) as path, one_blas_thread():
                row["sha256"] = fingerprint(path)
                if row["sha256"] == known_sha256:
                    return False
                try:
                    self._evaluate(row, path)
                except Exception as error:
                    row["error"] = sentence(error)
                _call_by_place(row, path, run)
        except Exception as error:  # could not be fetched
            row["error"] = sentence(error)
        return True

    def _evaluate(self, row: Row, path: Path) -> None:
        """Fill in the row as far as the evaluation comes."""
        source, result = self.replay(path)
        notes = result.bench.notes
        row["unit"] = row["unit"] or notes.get("block_serial")
        row["bench"] = row["bench"] or notes.get("bench")
        row["date"] = row["date"] or run_date(source)
        row |= run_list.of_replay(json_value(replay_object(result)))
        row |= run_list.of_factor(run_factor(result.fit))
        if result.bench.angles:  # without them there is no telling what depends on the attitude
            row |= run_list.of_diagnosis(json_value(diagnosis_object(self.diagnose(source, result))))


def _content(value: Any) -> Any:
    """Return an option as it counts: a file by what is in it."""
    if isinstance(value, Path):
        return hashlib.sha256(value.read_bytes()).hexdigest()
    return [_content(each) for each in value] if isinstance(value, tuple | list) else value


def begun(run: ListedRun, settings: str) -> Row:
    """The row of a run of which nothing is known yet."""
    stated = {"run": run.place, "unit": run.unit, "bench": run.bench, "date": run.date}
    known = {"bytes": run.size, "version": run.version, "settings": settings, "host": platform.node()}
    return dict.fromkeys(run_list.SCHEMA.names) | stated | known | {"evaluated": datetime.now(UTC)}


def _call_by_place(row: Row, path: Path, run: ListedRun) -> None:
    """Have all sentences call a recording by the name that it is known by, not by that of its copy here."""
    for key in run_list.SENTENCES:
        if isinstance(row[key], str):
            row[key] = row[key].replace(str(path), run.place)
    row["warnings"] = [each.replace(str(path), run.place) for each in row["warnings"] or ()]


@contextmanager
def local_copy(run: ListedRun) -> Iterator[Path]:
    """The path of the recording itself, or of a copy that is gone when the block ends. Raises InputError where it
    cannot be fetched."""
    if run.refused:
        raise InputError(run.refused)
    with run_list.refused_by_store(run.place, "looked up", "what is installed"):
        files, path = url_to_fs(run.place)
    if isinstance(files, LocalFileSystem):
        yield _plain(Path(str(path)))
        return
    with TemporaryDirectory(prefix="kf-calib-") as folder:
        target = Path(folder, Path(str(path)).name)
        with run_list.refused_by_store(run.place, "fetched"):
            files.get(str(path), str(target), recursive=run.folder)
        yield target


def _plain(path: Path) -> Path:
    """The path of a file or folder; InputError for what may be read for ever, as a pipe to which nobody writes."""
    try:
        kind = stat.S_IFMT(path.stat().st_mode)
    except OSError:  # whoever reads it says why it cannot be read
        return path
    if kind in (stat.S_IFREG, stat.S_IFDIR):
        return path
    raise InputError(f"{path}: is {_KINDS.get(kind, 'no file')}, which may never end: name a recording on a disk.")


class OverTime(BaseException):
    """The time is over; not an ``Exception``, so that nothing that goes on after a failure goes on after this."""


def in_time(limit_s: float, work: Callable[[], T]) -> T:
    """What ``work`` returns; raises OverTime in this thread if it takes longer. A process that does not obey is ended.

    No context manager: what comes while such a one is being left would not find it there any more.
    """
    watch = _Watch(limit_s, threading.get_ident())
    try:
        try:
            threading.Thread(target=watch.run, name="time limit", daemon=True).start()
            return work()
        finally:
            watch.end()
    except OverTime:
        watch.end()  # if it came while that was done
        raise


class _Watch:
    """Waits in a thread of its own until the block ends or its time is over."""

    def __init__(self, limit_s: float, thread: int) -> None:
        self._limit_s, self._thread = limit_s, ctypes.c_ulong(thread)
        self._ended, self._telling, self._told = threading.Event(), threading.RLock(), False

    def run(self) -> None:
        waited_s, patience_s = self._limit_s, min(self._limit_s, _GRACE_S)
        while not self._ended.wait(waited_s):
            if patience_s <= 0.0 and multiprocessing.parent_process() is not None:
                os._exit(1)
            with self._telling:
                if not self._ended.is_set():
                    self._tell()
            waited_s = min(_AGAIN_S, patience_s) or _AGAIN_S
            patience_s = max(patience_s - waited_s, 0.0)

    def end(self) -> None:
        """From now on nothing is raised, not even what was on its way.

        What was comes here: CPython 3.11 would go on looking for one that is called back, and never begin a function
        that a debugger traces.
        """
        with self._telling:
            self._ended.set()
        if self._told:
            with suppress(OverTime):
                self._tell()  # in place of what was on its way
                while True:
                    pass

    def _tell(self) -> None:
        self._told = True
        ctypes.pythonapi.PyThreadState_SetAsyncExc(self._thread, ctypes.py_object(OverTime))
