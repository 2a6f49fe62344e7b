"""Many recordings into one table: the same numbers as alone, whatever fails on the way, nothing done twice or lost."""

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import dask.config
import pytest
from distributed import Client
from helpers.fleet_workers import evaluation, recorded

import kf_calib
from kf_calib.cli.options import EvaluationOptions, ReadingOptions
from kf_calib.errors import InputError
from kf_calib.fleet import batch
from kf_calib.fleet.batch import RunEvaluation, evaluate_all
from kf_calib.fleet.run_list import ListedRun, runs_of
from kf_calib.fleet.store import Store

PAGE = Path(__file__).resolve().parents[2] / "docs" / "fleet.md"
pytestmark = pytest.mark.xdist_group("fleet")  # recorded once


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four runs of two units."""
    return recorded(tmp_path_factory.mktemp("campaign"), runs=4, units=2, dwells=6)


@pytest.mark.slow
@pytest.mark.usefixtures("at_once")
def test_each_run_has_the_numbers_that_it_has_alone(campaign: Path, run: Any, tmp_path: Path) -> None:
    bad = tmp_path / "bad.mcap"
    bad.write_text("no recording")
    code, out, _ = run("fleet", campaign, bad, "-o", tmp_path / "fleet", "--json")
    printed = json.loads(out)
    assert (code, printed["runs"], printed["failed"], printed["evaluated"], printed["units"]) == (0, 5, 1, 5, 2)
    assert printed["failures"][0]["run"] == str(bad) and "is not an MCAP file" in printed["failures"][0]["error"]
    rows = {row["run"]: row for row in kf_calib.open_fleet(tmp_path / "fleet").rows(
        ["run", "unit", "bench", "date", "replay", "diagnosis", "parameters", "error"]).to_pylist()}  # fmt: skip
    alone = campaign / "bench-1" / "unit-0002" / "run-000002.mcap"
    row = rows[str(alone)]
    for command in ("replay", "diagnose"):
        assert run.json(command, alone) == json.loads(row[{"diagnose": "diagnosis"}.get(command, command)])
    whole = json.loads(row["replay"])["parameters"]
    assert row["parameters"] == [{key: own[key] for key in own if key not in ("low", "high")} for own in whole]
    assert (row["unit"], row["bench"], row["error"]) == ("unit-0002", "bench-1", None)
    assert row["date"].isoformat(timespec="seconds") == "2025-10-15T07:06:40+00:00"  # a third of a year after the first


@pytest.mark.slow
def test_a_run_is_evaluated_again_only_if_it_or_the_settings_changed(
    campaign: Path, client: Client, store: Store, tmp_path: Path
) -> None:
    own = shutil.copytree(campaign, tmp_path / "runs")
    first = evaluate_all(client, evaluation(), runs_of([str(own)]), store)
    assert (first.evaluated, first.kept) == (4, 0)
    some, other, *_ = sorted(own.rglob("*.mcap"))
    os.utime(some, (0, 0))  # another date of the same content
    shutil.copy(other, some.with_name("new.mcap"))
    shutil.copy(some, other)
    again = evaluate_all(client, evaluation(), runs_of([str(own)]), store)
    assert (again.evaluated, again.kept) == (2, 3)
    changed = evaluate_all(client, evaluation(effects=("second-order",)), runs_of([str(some)]), store)
    assert changed.evaluated == 1
    (named,) = runs_of([str(other)])
    named = replace(named, unit="B")
    assert [evaluate_all(client, evaluation(), [named], store).evaluated for _ in range(2)] == [1, 0]
    table = kf_calib.open_fleet(tmp_path / "fleet").rows()
    assert [row["unit"] for row in table.to_pylist() if row["run"] == str(other)] == ["B"]
    assert sorted(table["run"].to_pylist()) == sorted(map(str, own.rglob("*.mcap")))
    assert [row["model"] for row in table.to_pylist() if row["run"] == str(some)] == [["second-order"]]
    assert len(list((tmp_path / "fleet" / "runs").glob("*.parquet"))) == 1


def test_what_could_not_be_fetched_is_tried_again(campaign: Path, client: Client, store: Store, tmp_path: Path) -> None:
    gone = ListedRun(str(tmp_path / "gone.mcap"))
    progress = evaluate_all(client, evaluation(), [gone], store)
    assert progress.failed == 1
    assert "cannot be read" in kf_calib.open_fleet(tmp_path / "fleet").failures()[gone.place]
    shutil.copy(next(campaign.rglob("*.mcap")), gone.place)
    assert evaluate_all(client, evaluation(), [gone], store).failed == 0
    assert kf_calib.open_fleet(tmp_path / "fleet").failures() == {}


def test_finished_runs_are_in_the_table_before_the_end(
    campaign: Path, client: Client, store: Store, tmp_path: Path
) -> None:
    """A client that is killed loses nothing that was finished."""
    seen = list[int]()

    def killed(progress: Any) -> None:
        seen.append(progress.evaluated)
        if progress.evaluated:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evaluate_all(client, evaluation(), runs_of([str(campaign)]), store, killed)
    (store.folder / ".kf-calib-0000.part").write_bytes(b"half a file")
    found = kf_calib.open_fleet(tmp_path / "fleet")
    assert len(found) == seen[-1] > 0
    assert evaluate_all(client, evaluation(), runs_of([str(campaign)]), store).kept == seen[-1]
    assert len(kf_calib.open_fleet(tmp_path / "fleet")) == 4


def test_other_files_in_the_folder_of_the_table_stay_and_are_not_read(
    campaign: Path, client: Client, store: Store, tmp_path: Path
) -> None:
    some, *more = runs_of([str(campaign)])
    evaluate_all(client, evaluation(), [some], store)
    (own,) = store.folder.glob("*.parquet")
    others = [store.folder / name for name in ("mine.parquet", "mine.arrow", f"{own.stem} (copy).parquet")]
    for path in others:
        path.write_text("mine")
    (store.folder / "folder.arrow").mkdir()
    evaluate_all(client, evaluation(), [some, *more], store)
    shutil.copy(own, others[0])  # of the same form
    evaluate_all(client, evaluation(effects=("second-order",)), [some], store)
    assert len(kf_calib.open_fleet(tmp_path / "fleet")) == 4 and not own.exists()
    assert all(path.exists() for path in others) and (store.folder / "folder.arrow").is_dir()
    (kept,) = set(store.folder.glob("runs-*.parquet")) - {*others}
    kept.write_bytes(kept.read_bytes()[:1000])
    with pytest.raises(InputError, match=r"a file of the table is damaged \(.*runs-.*: move it away"):
        store.known()


class _Deadly(RunEvaluation):
    """Ends its process: at one run each time, at the others the first time."""

    def replay(self, path: Path) -> Any:
        mark = path.with_suffix(".tried")
        if path.stem == "run-000001" or not mark.exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().replay(path)


def test_the_questions_of_the_page_have_answers(
    campaign: Path, client: Client, store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    duckdb = pytest.importorskip("duckdb", reason="duckdb is not there: the table is asked nothing")
    evaluate_all(client, evaluation(), runs_of([str(campaign)]), store)
    monkeypatch.chdir(tmp_path)
    queries = re.findall(r"^```sql\n(.*?)^```", PAGE.read_text(), re.DOTALL | re.MULTILINE)
    months, scales, _, parts = (duckdb.sql(query).to_arrow_table().to_pylist() for query in queries)
    assert sum(row["runs"] for row in months) == len(parts) == 4
    assert [(row["unit"], row["symbol"], row["runs"]) for row in scales] == [
        (f"unit-000{unit}", f"K{i}", 2) for unit in (1, 2) for i in (1, 2, 3)
    ]


@pytest.mark.slow
def test_a_run_that_ends_its_process_is_tried_again_and_stops_no_other(
    campaign: Path, store: Store, tmp_path: Path
) -> None:
    own = shutil.copytree(campaign, tmp_path / "runs")
    deadly = _Deadly.of(ReadingOptions(), EvaluationOptions())
    runs = runs_of([str(path) for path in sorted(own.rglob("*.mcap"))[:2]])
    with batch.cluster(1) as client:
        progress = evaluate_all(client, deadly, runs, store)
    assert (progress.evaluated, progress.failed) == (2, 1)
    ((place, said),) = kf_calib.open_fleet(tmp_path / "fleet").failures().items()
    assert place.endswith("run-000001.mcap") and "the process that evaluated it was ended 3 times" in said


@pytest.mark.slow
def test_a_process_that_is_long_in_beginning_again_goes_on(
    campaign: Path, store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a busy machine: Dask gives one up after 15 s, and the run would wait for ever."""
    late, run = tmp_path / "late", shutil.copytree(campaign, tmp_path / "runs")
    (tmp_path / "sitecustomize.py").write_text(
        f"import os, time\nif os.path.exists({str(late)!r}):\n    time.sleep(20.0)\n"
    )
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")]))
    (path,) = run.rglob("run-000002.mcap")
    with batch.cluster(1) as client:
        late.touch()
        progress = evaluate_all(client, _Deadly.of(ReadingOptions(), EvaluationOptions()), runs_of([str(path)]), store)
    assert (progress.evaluated, progress.failed) == (1, 0)


@contextmanager
def running(*words: str) -> Iterator[None]:
    """A process of its own, ended with the block."""
    process = subprocess.Popen([sys.executable, "-m", *words], stderr=subprocess.DEVNULL)
    try:
        yield
    finally:
        process.terminate()
        process.wait(60)


@pytest.mark.slow
def test_a_scheduler_and_workers_elsewhere_read_an_object_store(
    campaign: Path, lab: Any, run: Any, tmp_path: Path
) -> None:
    """Separate processes over TCP, which fetch from a server with the interface of S3; one of them is killed."""
    lab.put(str(campaign), "lab/runs", recursive=True)
    with socket.create_server(("127.0.0.1", 0)) as free:
        url = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    scheduler = ("distributed.cli.dask_scheduler", "--host", url, "--dashboard-address", "127.0.0.1:0")
    worker = ("distributed.cli.dask_worker", url, "--nthreads", "1", "--dashboard-address", "127.0.0.1:0")
    with running(*scheduler), running(*worker), running(*worker):
        with Client(url, timeout=120) as client:
            client.wait_for_workers(2, 120)
            first, *_ = client.scheduler_info()["workers"]
            doomed = client.submit(os.getpid, workers=[first]).result()
            os.kill(doomed, signal.SIGKILL)
        code, out, err = run("fleet", "s3://lab/runs", "-o", tmp_path / "fleet", "--scheduler", url, "--json")
    assert code == 0, err
    printed = json.loads(out.splitlines()[-1])  # the server has a word to say before
    assert (printed["runs"], printed["failed"]) == (4, 0)
    rows = kf_calib.open_fleet(tmp_path / "fleet").rows(["run", "sha256"]).to_pylist()
    assert {row["run"] for row in rows} == {
        f"s3://lab/runs/{path.relative_to(campaign)}" for path in campaign.rglob("*.mcap")
    }


def test_a_scheduler_that_does_not_answer_is_one_sentence(campaign: Path, run: Any, tmp_path: Path) -> None:
    with dask.config.set({"distributed.comm.timeouts.connect": "1s"}):
        err = run.refused("fleet", campaign, "-o", tmp_path / "fleet", "--scheduler", "tcp://127.0.0.1:9")
    assert "no scheduler answers at tcp://127.0.0.1:9" in err
