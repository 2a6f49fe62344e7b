"""Workers of the command fleet that are threads of this process: they start at once."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from distributed import Client, LocalCluster

from kf_calib.fleet import cluster


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
        patch.setattr(cluster, "cluster", running)
        yield
