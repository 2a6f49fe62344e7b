"""Workers, a table and an object store for the tests of fleets."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from distributed import Client
from helpers.fleet_workers import threads, used

from kf_calib.fleet.store import Store


@pytest.fixture(scope="module")
def client() -> Iterator[Client]:
    with threads() as own:
        yield own


@pytest.fixture
def at_once(client: Client) -> Iterator[None]:
    """The command uses the workers of the client."""
    with used(client):
        yield


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    own = Store(tmp_path / "fleet")
    with own.taken():
        yield own


@pytest.fixture
def lab(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Files of a server with the interface of S3, with the bucket ``lab``, which is asked over TCP."""
    moto = pytest.importorskip("moto.server", reason="moto is not there: no object store is asked")
    s3fs = pytest.importorskip("s3fs", reason="s3fs is not there: no object store is asked")
    server = moto.ThreadedMotoServer(ip_address="127.0.0.1", port=0)
    server.start()
    host, port = server.get_host_and_port()
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "test")
    s3fs.S3FileSystem.clear_instance_cache()
    files = s3fs.S3FileSystem()
    files.mkdir("lab")
    yield files
    s3fs.S3FileSystem.clear_instance_cache()
    server.stop()
