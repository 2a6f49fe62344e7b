"""One run of a fleet on a worker: fetched, evaluated by the code of the single commands, and made a row."""

from __future__ import annotations

import hashlib
import json
import platform
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

from kf_calib.bench.streams import Source
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.estimation.results import Calibration
from kf_calib.fleet import run_row
from kf_calib.fleet.local_copy import local_copy
from kf_calib.fleet.run_factor import run_factor
from kf_calib.fleet.run_list import Run
from kf_calib.fleet.run_row import Row
from kf_calib.fleet.time_limit import OverTime, in_time
from kf_calib.sources.files.bags import fingerprint
from kf_calib.sources.run_date import run_date
from kf_calib.support.threads import one_blas_thread

LIMIT_S = 3600.0
"""How long a run may take unless somebody says otherwise."""


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
