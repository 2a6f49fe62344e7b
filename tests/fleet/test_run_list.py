"""Which recordings the words of a fleet lead to, here and in an object store."""

import socket
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kf_calib.errors import InputError
from kf_calib.fleet.batch import local_copy
from kf_calib.fleet.run_list import _STORES, ListedRun, runs_of


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
def bucket(folder: Path, lab: Any) -> str:
    """The folder in an object store."""
    lab.put(str(folder), "lab/2026", recursive=True)
    return "s3://lab/2026"


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


@pytest.mark.parametrize(
    "line",
    [
        "dask://127.0.0.1:9::file:///x/a.mcap", "http://127.0.0.1:1/a.mcap", "reference://::data:,x", "dask://",
        "simplecache::s3://bucket/a.mcap", "zip://*.mcap::file:///x.zip", "memory://a.mcap", "ftp://host/a.mcap",
        "DASK://host:1/a", "a\x1b[2Jb.mcap", "x" * 5000,
    ],
)  # fmt: skip
def test_a_list_opens_no_address_but_those_of_plain_stores(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is left of such a line is one row that says so; the other runs are evaluated."""

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("a connection was opened")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)
    (tmp_path / "a.mcap").write_bytes(b"")
    (tmp_path / "list.txt").write_text(f"a.mcap\n{line}\n", encoding="utf-8")
    good, bad = runs_of([str(tmp_path / "list.txt")])
    assert good.place.endswith("a.mcap") and not good.refused and bad.refused
    assert "list.txt: '" in bad.refused and "\x1b" not in bad.refused and len(bad.refused) < 5000
    with pytest.raises(InputError, match="list"), local_copy(bad):
        pass


def test_a_date_that_is_none_costs_one_row(tmp_path: Path) -> None:
    for name in "ab":
        (tmp_path / f"{name}.mcap").write_bytes(b"")
    (tmp_path / "list.csv").write_text("run,date\na.mcap,yesterday\nb.mcap,2026-05-31\n")
    bad, good = runs_of([str(tmp_path / "list.csv")])
    assert "is no date" in bad.refused and good.date is not None and not good.refused


LINES = st.text(alphabet=st.characters(exclude_characters="\r\n"), max_size=40).filter(
    lambda line: not line.startswith("/")  # "/" is every recording of the machine
)


@settings(max_examples=200, deadline=None)
@given(st.lists(LINES, max_size=6))
def test_whatever_stands_in_a_list_is_a_row_each(tmp_path_factory: pytest.TempPathFactory, lines: list[str]) -> None:
    folder = tmp_path_factory.mktemp("list")
    (folder / "list.txt").write_text("\n".join(["://".join(lines[:2]), *lines]), encoding="utf-8", errors="replace")
    try:
        for run in runs_of([str(folder / "list.txt")]):
            assert run.refused or "://" not in run.place or run.place.partition("://")[0].lower() in _STORES
    except InputError as error:
        assert "list.txt" in str(error)
