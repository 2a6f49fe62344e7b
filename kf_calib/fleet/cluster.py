"""The processes that evaluate the runs of a fleet: those of this machine, or of a scheduler somewhere."""

from __future__ import annotations

import logging
import signal
from collections.abc import Iterator
from contextlib import contextmanager

import dask.config
from distributed import Client, LocalCluster, Worker, WorkerPlugin

from kf_calib.errors import InputError

_CONFIG = {
    "distributed.scheduler.allowed-failures": 2,  # so often may a run take its process with it and be tried again
    "distributed.scheduler.worker-saturation": 1.0,  # no run waits at a process that another one takes with it
    "distributed.worker.profile.enabled": False,  # looks a hundred times a second at what a worker does
    # Dask would have free memory of 64 kB given back at once, and arrays of 128 kB fetched from the system each time.
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": 1 << 28,
    "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": 1 << 25,
}


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
