"""Workers of the command fleet that are threads of this process, which start at once, and what they evaluate."""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from distributed import Client, LocalCluster
from fleet_generator import Campaign, record

from kf_calib.bench.streams import Source
from kf_calib.cli.options import EvaluationOptions, ReadingOptions, opened
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.estimation.results import Calibration
from kf_calib.fleet import batch
from kf_calib.fleet.batch import RunEvaluation

_calibrations = dict[tuple[str, str], Calibration]()
_diagnoses = dict[int, Diagnosis]()


class RememberingEvaluation(RunEvaluation):
    """Evaluates the same content with the same options once a process: most tests of a fleet are about its table, and
    evaluate the same few recordings."""

    def replay(self, path: Path) -> tuple[Source, Calibration]:
        key = hashlib.sha256(path.read_bytes()).hexdigest(), self.settings
        if key not in _calibrations:
            source, _calibrations[key] = super().replay(path)
            return source, _calibrations[key]
        return opened(path, self.reading, self.evaluation)[0], _calibrations[key]

    def diagnose(self, source: Source, result: Calibration) -> Diagnosis:
        if id(result) not in _diagnoses:  # of calibrations that live as long as the process
            _diagnoses[id(result)] = super().diagnose(source, result)
        return _diagnoses[id(result)]


@contextmanager
def threads() -> Iterator[Client]:
    with (
        LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0") as own,
        Client(own) as client,
    ):
        yield client


@contextmanager
def used(client: Client) -> Iterator[None]:
    """The command uses these workers, however many it asks for, and remembers what it evaluated."""

    @contextmanager
    def running(workers: int, scheduler: str | None = None) -> Iterator[Client]:
        yield client

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(batch, "cluster", running)
        patch.setattr(batch, "RunEvaluation", RememberingEvaluation)
        yield


def recorded(folder: Path, **given: Any) -> Path:
    """The folder of the recordings of a campaign on one bench."""
    own = Campaign(folder, benches=1, dwell_s=3.0, **given)
    for run in range(own.runs):
        record(own, run)
    return own.folder / "runs"


def evaluation(**given: Any) -> RunEvaluation:
    """What ``kf-calib fleet`` does with each run, with some options."""
    return RememberingEvaluation.of(ReadingOptions(), EvaluationOptions(**given))
