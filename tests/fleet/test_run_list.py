"""Which recordings the words of a fleet lead to, here and in an object store."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from kf_calib.errors import InputError
from kf_calib.fleet.batch import local_copy
from kf_calib.fleet.run_list import ListedRun, runs_of


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two recordings, a bag of two files, and what is no recording."""
    for name in (
        "a.mcap",
        "deep/b.db3",
        "deep/notes.txt",
        "bag/metadata.yaml",
        "bag/bag_0.mcap",
        "bag/bag_1.mcap",
        "a.truth.json",
    ):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(name)
    return tmp_path


def names(runs: list[ListedRun], folder: Path) -> list[str]:
    return [run.place.removeprefix(f"{folder}/") for run in runs]


def test_a_folder_is_its_recordings_and_a_bag_is_one(folder: Path) -> None:
    found = runs_of([str(folder)])
    assert names(found, folder) == ["bag", "a.mcap", "deep/b.db3"]
    assert [run.folder for run in found] == [True, False, False]
    assert found[0].size == sum(path.stat().st_size for path in (folder / "bag").iterdir())


def test_words_name_each_run_once_in_their_order(folder: Path) -> None:
    words = [folder / "deep" / "*.db3", folder / "a.mcap", folder]
    assert names(runs_of(map(str, words)), folder) == ["deep/b.db3", "a.mcap", "bag"]


def test_a_folder_that_a_pattern_finds_is_its_recordings(folder: Path) -> None:
    assert names(runs_of([str(folder / "dee*")]), folder) == ["deep/b.db3"]


def test_a_list_says_whose_runs_they_are(folder: Path) -> None:
    (folder / "list.csv").write_text("run,unit,date\na.mcap,7,2026-05-31\ngone.mcap,8,\ndeep/*.db3,9,\n")
    found = runs_of([str(folder / "list.csv")])
    assert [(name, run.unit) for name, run in zip(names(found, folder), found, strict=True)] == [
        ("a.mcap", "7"), ("gone.mcap", "8"), ("deep/b.db3", "9"),
    ]  # fmt: skip
    assert found[0].date is not None and found[0].date.isoformat() == "2026-05-31T00:00:00+00:00"
    (folder / "semicolons.csv").write_text("run;unit\na.mcap;7, new\n")
    assert [run.unit for run in runs_of([str(folder / "semicolons.csv")])] == ["7, new"]
    (folder / "wrong.csv").write_text("file,unit\na.mcap,7\n")
    with pytest.raises(InputError, match=r"wrong\.csv: has no column run"):
        runs_of([str(folder / "wrong.csv")])
    (folder / "list.txt").write_text("# of May\n\na.mcap  # the first\n")
    assert names(runs_of([str(folder / "list.txt")]), folder) == ["a.mcap"]


@pytest.mark.parametrize(("word", "said"), [
    ("nothing-*.mcap", "leads to no recording"), ("gone.mcap", "is not there"), ("nowhere://x", "cannot be looked up"),
])  # fmt: skip
def test_a_word_that_leads_nowhere_is_refused(folder: Path, word: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        runs_of([word if "://" in word else str(folder / word)])


@pytest.fixture
def bucket(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The folder in a store with the interface of S3: a server of its own, which is asked over TCP."""
    server = pytest.importorskip("moto.server", reason="moto is not there: no object store is asked")
    s3fs = pytest.importorskip("s3fs", reason="s3fs is not there: no object store is asked")
    running = server.ThreadedMotoServer(ip_address="127.0.0.1", port=0)
    running.start()
    host, port = running.get_host_and_port()
    for name, value in (
        ("AWS_ENDPOINT_URL", f"http://{host}:{port}"), ("AWS_ACCESS_KEY_ID", "test"), ("AWS_SECRET_ACCESS_KEY", "test"),
    ):  # fmt: skip
        monkeypatch.setenv(name, value)
    s3fs.S3FileSystem.clear_instance_cache()
    files = s3fs.S3FileSystem()
    files.mkdir("lab")
    files.put(str(folder), "lab/2026", recursive=True)
    yield "s3://lab/2026"
    s3fs.S3FileSystem.clear_instance_cache()
    running.stop()


def test_an_object_store_is_read_as_a_folder_is(bucket: str, folder: Path) -> None:
    found = runs_of([bucket])
    assert [run.place.removeprefix(f"{bucket}/") for run in found] == ["bag", "a.mcap", "deep/b.db3"]
    assert all(run.version for run in found)
    with local_copy(found[0]) as bag, local_copy(found[1]) as file:
        assert {file.name for file in bag.iterdir()} == {file.name for file in (folder / "bag").iterdir()}
        assert file.read_text() == "a.mcap"
    assert not file.exists()
    with (
        pytest.raises(InputError, match=r"^s3://lab/2026/gone\.mcap: cannot be fetched"),
        local_copy(ListedRun(f"{bucket}/gone.mcap")),
    ):
        pass
