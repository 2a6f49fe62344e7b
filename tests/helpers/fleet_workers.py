"""Workers of the command fleet that are threads of this process, which start at once, and what they evaluate."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from distributed import Client, LocalCluster

from kf_calib.cli.fleet import SingleCommands
from kf_calib.cli.options import EvaluationOptions, ReadingOptions
from kf_calib.fleet import batch
from kf_calib.fleet.batch import RunEvaluation


@contextmanager
def threads() -> Iterator[Client]:
    with (
        LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0") as own,
        Client(own) as client,
    ):
        yield client


@contextmanager
def used(client: Client) -> Iterator[None]:
    """The command uses these workers, however many it asks for."""

    @contextmanager
    def running(workers: int, scheduler: str | None = None) -> Iterator[Client]:
        yield client

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(batch, "cluster", running)
        yield


def evaluation(**given: Any) -> RunEvaluation:
    """What ``kf-calib fleet`` does with each run, with some options."""
    commands = SingleCommands(ReadingOptions(), EvaluationOptions(**given))
    return RunEvaluation(commands, commands.checksum)
