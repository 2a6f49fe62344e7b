"""One run of a fleet on a worker: fetched, evaluated by the code of the single commands, and made a row.

The time that one run may take: a run that never ends must not keep the others from being evaluated.

Python is told to stop where it is, in the thread that works; that reaches it between two steps of the interpreter. What
does not come to such a step, as a file system that does not answer, is ended with its process, if this is a worker's.
"""

from __future__ import annotations

import ctypes
import hashlib
import json
import multiprocessing
import os
import platform
import stat
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol, TypeVar

from fsspec.core import url_to_fs
from fsspec.implementations.local import LocalFileSystem

from kf_calib.bench.streams import Source
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.errors import InputError
from kf_calib.estimation.results import Calibration
from kf_calib.fleet import run_row
from kf_calib.fleet.run_factor import run_factor
from kf_calib.fleet.run_list import Run
from kf_calib.fleet.run_row import Row
from kf_calib.sources.files.bags import fingerprint
from kf_calib.sources.run_date import run_date
from kf_calib.support.threads import one_blas_thread

LIMIT_S = 3600.0
"""How long a run may take unless somebody says otherwise."""
_KINDS = {stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket", stat.S_IFCHR: "a device", stat.S_IFBLK: "a device"}
_AGAIN_S = 5.0  # what is told to stop may be caught on its way
_GRACE_S = 60.0  # at most, before a process is ended


T = TypeVar("T")


class Commands(Protocol):
    """What the single commands do with a recording, and how they say what failed.

    They are given to a fleet from above, because it knows neither their options nor their documents; they are sent to
    the workers by pickle.
    """

    def replay(self, path: Path) -> tuple[Source, Calibration]: ...

    def diagnose(self, source: Source, result: Calibration) -> Diagnosis: ...

    def replay_document(self, result: Calibration) -> dict[str, Any]: ...

    def diagnosis_document(self, diagnosis: Diagnosis) -> dict[str, Any]: ...

    def sentence(self, error: BaseException) -> str: ...


@dataclass(frozen=True)
class Evaluation:
    """How each run of a fleet is evaluated; calling it evaluates one.

    settings: checksum of all that the numbers depend on besides the recording. limit_s: how long a run may take.
    """

    commands: Commands
    settings: str
    limit_s: float = LIMIT_S

    def settings_of(self, run: Run) -> str:
        """Checksum of all that the row of a run depends on besides its recording: what a list says of it, too."""
        stated = [run.unit, run.bench, run.date.isoformat() if run.date else None]
        if not any(stated):
            return self.settings
        return hashlib.sha256(json.dumps([self.settings, *stated]).encode()).hexdigest()

    def __call__(self, run: Run, known_sha256: str | None = None) -> Row | None:
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

    def _changed(self, row: Row, run: Run, known_sha256: str | None) -> bool:
        """Fill in the row of a run, and tell whether its content is not the one that is known."""
        try:
            with local_copy(run) as path, one_blas_thread():
                row["sha256"] = fingerprint(path)
                if row["sha256"] == known_sha256:
                    return False
                try:
                    self._evaluate(row, path)
                except Exception as error:
                    row["error"] = self.commands.sentence(error)
                _call_by_place(row, path, run)
        except Exception as error:  # could not be fetched
            row["error"] = self.commands.sentence(error)
        return True

    def _evaluate(self, row: Row, path: Path) -> None:
        """Fill in the row as far as the evaluation comes."""
        source, result = self.commands.replay(path)
        notes = result.bench.notes
        row["unit"] = row["unit"] or notes.get("block_serial")
        row["bench"] = row["bench"] or notes.get("bench")
        row["date"] = row["date"] or run_date(source)
        row |= run_row.of_replay(self.commands.replay_document(result))
        row |= run_row.of_factor(run_factor(result.fit))
        if result.bench.angles:  # without them there is no telling what depends on the attitude
            document = self.commands.diagnosis_document(self.commands.diagnose(source, result))
            row |= run_row.of_diagnosis(document)


def begun(run: Run, settings: str) -> Row:
    """The row of a run of which nothing is known yet."""
    stated = {"run": run.place, "unit": run.unit, "bench": run.bench, "date": run.date}
    known = {"bytes": run.size, "version": run.version, "settings": settings, "host": platform.node()}
    return dict.fromkeys(run_row.SCHEMA.names) | stated | known | {"evaluated": datetime.now(UTC)}


def _call_by_place(row: Row, path: Path, run: Run) -> None:
    """Have all sentences call a recording by the name that it is known by, not by that of its copy here."""
    for key in run_row.SENTENCES:
        if isinstance(row[key], str):
            row[key] = row[key].replace(str(path), run.place)
    row["warnings"] = [each.replace(str(path), run.place) for each in row["warnings"] or ()]


@contextmanager
def local_copy(run: Run) -> Iterator[Path]:
    """The path of the recording itself, or of a copy that is gone when the block ends. Raises InputError where it
    cannot be fetched."""
    try:
        files, path = url_to_fs(run.place)
    except (ValueError, ImportError) as error:
        raise InputError(f"{run.place}: cannot be looked up ({error}): check the name and what is installed.") from None
    if isinstance(files, LocalFileSystem):
        yield _plain(Path(str(path)))
        return
    with TemporaryDirectory(prefix="kf-calib-") as folder:
        target = Path(folder, Path(str(path)).name)
        try:
            files.get(str(path), str(target), recursive=run.folder)
        except Exception as error:  # each store has errors of its own
            said = " ".join(str(error).split()) or type(error).__name__
            raise InputError(f"{run.place}: cannot be fetched ({said}): check the name and the access.") from None
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
        self._ended, self._telling = threading.Event(), threading.RLock()

    def run(self) -> None:
        waited_s, patience_s = self._limit_s, min(self._limit_s, _GRACE_S)
        while not self._ended.wait(waited_s):
            if patience_s <= 0.0 and multiprocessing.parent_process() is not None:
                os._exit(1)
            with self._telling:
                if not self._ended.is_set():
                    ctypes.pythonapi.PyThreadState_SetAsyncExc(self._thread, ctypes.py_object(OverTime))
            waited_s = min(_AGAIN_S, patience_s) or _AGAIN_S
            patience_s = max(patience_s - waited_s, 0.0)

    def end(self) -> None:
        """From now on nothing is raised, not even what was on its way."""
        with self._telling:
            self._ended.set()
            ctypes.pythonapi.PyThreadState_SetAsyncExc(self._thread, None)
