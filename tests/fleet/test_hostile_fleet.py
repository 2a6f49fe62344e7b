"""Runs that never end, pipes with names of recordings, and tables that somebody else wrote: the fleet goes on."""

import math
import os
import resource
import shutil
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from distributed import Client
from helpers.fleet_workers import evaluation, recorded, used
from helpers.long_runs import slow

import kf_calib
from kf_calib.cli.options import EvaluationOptions, ReadingOptions
from kf_calib.fleet import batch
from kf_calib.fleet.batch import OverTime, RunEvaluation, evaluate_all, in_time
from kf_calib.fleet.run_list import SCHEMA, ListedRun, runs_of
from kf_calib.fleet.store import Store

pytestmark = pytest.mark.xdist_group("fleet")


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs of two units."""
    return recorded(tmp_path_factory.mktemp("campaign"), runs=2, units=2, dwells=6)


@pytest.fixture
def runs(recordings: Path, tmp_path: Path) -> Path:
    return shutil.copytree(recordings, tmp_path / "runs")


class _Endless(RunEvaluation):
    """Never comes to an end with one of the runs."""

    def replay(self, path: Path) -> Any:
        while path.stem == "run-000001":
            time.sleep(0.01)
        return super().replay(path)


class _Deaf(RunEvaluation):
    """Waits in the system for what never comes, with one of the runs."""

    def replay(self, path: Path) -> Any:
        if path.stem == "run-000001":
            os.read(os.pipe()[0], 1)
        return super().replay(path)


def with_limit(kind: type[RunEvaluation], limit_s: float) -> RunEvaluation:
    return kind.of(ReadingOptions(), EvaluationOptions(), limit_s)


@pytest.mark.slow
def test_a_run_that_never_ends_is_a_row_that_says_so_and_is_tried_again(
    runs: Path, client: Client, store: Store, tmp_path: Path
) -> None:
    named = runs_of([str(runs)])
    progress = evaluate_all(client, with_limit(_Endless, 5.0), named, store)
    assert (progress.evaluated, progress.failed) == (2, 1)
    ((place, said),) = kf_calib.open_fleet(tmp_path / "fleet").failures().items()
    assert place.endswith("run-000001.mcap")
    assert said == f"{place}: was not evaluated in 5 s, and stopped: give it more time (--limit-s), or leave it out."
    again = evaluate_all(client, evaluation(), named, store)
    assert (again.evaluated, again.kept, again.failed) == (1, 1, 0)


@pytest.mark.slow
def test_a_run_that_waits_in_the_system_is_ended_with_its_process(runs: Path, store: Store, tmp_path: Path) -> None:
    with batch.cluster(1) as own:
        progress = evaluate_all(own, with_limit(_Deaf, 5.0), runs_of([str(runs)]), store)
    assert (progress.evaluated, progress.failed) == (2, 1)
    (said,) = kf_calib.open_fleet(tmp_path / "fleet").failures().values()
    assert "was ended 3 times: give the workers more memory, or the run more time (--limit-s)." in said


def test_work_that_ends_in_time_is_left_alone_and_work_that_does_not_is_stopped() -> None:
    before = threading.active_count()
    assert [in_time(30.0, lambda: 7) for _ in range(200)] == [7] * 200
    begun_s, swallowed = time.monotonic(), list[Exception]()

    def endless() -> None:
        while True:
            try:
                math.sqrt(time.monotonic())
            except Exception as error:
                swallowed.append(error)

    with pytest.raises(OverTime):
        in_time(0.2, endless)
    assert time.monotonic() - begun_s < 10.0 and not swallowed
    for _ in range(300):  # at the very moment at which it ends
        with suppress(OverTime):
            in_time(0.001, lambda: time.sleep(0.001))
        for _ in range(100):  # nothing comes late
            time.sleep(0.0)
    deadline_s = time.monotonic() + 20.0
    while threading.active_count() > before and time.monotonic() < deadline_s:
        time.sleep(0.01)
    assert threading.active_count() <= before


@pytest.mark.parametrize(("limit_s", "work_s"), [(30.0, 0.0), (0.001, 0.1), (0.001, 0.001)])
def test_after_work_with_a_limit_a_debugger_can_trace_what_follows(limit_s: float, work_s: float) -> None:
    """In a process of its own: a function that never begins takes all of its two seconds."""
    child = os.fork()
    if child == 0:
        resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(time.process_time()) + 2, resource.RLIM_INFINITY))
        for _ in range(20):
            with suppress(OverTime):
                in_time(limit_s, lambda: time.sleep(work_s))
        sys.settrace(lambda *_: None)
        math_of(2.0)
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def math_of(number: float) -> float:
    return math.sqrt(number)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes with names")
def test_a_pipe_with_the_name_of_a_recording_is_refused_and_the_others_are_evaluated(
    runs: Path, client: Client, run: Any, tmp_path: Path
) -> None:
    pipes = [runs / "live.mcap", runs / "table.csv", tmp_path / "list.txt"]
    bag = runs / "bag"
    bag.mkdir()
    for pipe in [*pipes, bag / "metadata.yaml", bag / "part_0.mcap"]:
        os.mkfifo(pipe)
    (runs / "zeros.mcap").symlink_to("/dev/zero")
    with used(client):
        code, _, err = run("fleet", runs, *pipes, "-o", tmp_path / "fleet", "--no-pooled")
    assert code == 0, err
    table = kf_calib.open_fleet(tmp_path / "fleet")
    failures = {Path(place).name: said for place, said in table.failures().items()}
    assert len(table) == 7 and set(failures) == {*(pipe.name for pipe in pipes), "zeros.mcap", "bag"}
    for pipe in pipes:
        assert failures[pipe.name] == f"{pipe}: is a pipe, which may never end: name a recording on a disk."
    assert "zeros.mcap: is a device, which may never end" in failures["zeros.mcap"]
    assert "holds no .mcap and no .db3 file" in failures["bag"]


CHANGES: dict[str, Callable[[dict[str, Any]], Any]] = {
    "short": lambda row: row["factor"].update(upper=row["factor"]["upper"][:-3]),
    "not finite": lambda row: row["factor"]["upper"].__setitem__(5, math.nan),
    "without columns": lambda row: row["factor"].update(columns=None),
    "nameless": lambda row: row.update(run=None),
    "undated": lambda row: row.update(evaluated=None),
}
"""Of a row of the table, as somebody else might make them."""


@pytest.mark.parametrize("change", ["short", *slow(*list(CHANGES)[1:])])
def test_a_row_that_is_not_whole_is_evaluated_again_and_the_fleet_goes_on(
    change: str, runs: Path, client: Client, store: Store, tmp_path: Path
) -> None:
    named = runs_of([str(runs)])
    evaluate_all(client, evaluation(), named, store)
    (file,) = store.folder.glob("*.parquet")
    rows = pq.read_table(file).to_pylist()
    CHANGES[change](rows[0])
    pq.write_table(pa.Table.from_pylist(rows, SCHEMA), file)
    again = evaluate_all(client, evaluation(), named, store)
    assert (again.evaluated, again.kept, again.failed) == (1, 1, 0)
    assert "1 row of the table is not whole: its run is evaluated again" in again.notes[0]
    table = kf_calib.open_fleet(tmp_path / "fleet")
    assert len(table) == 2 and len(list(table.factors())) == 2 and table.overview().pooled is not None
    last = evaluate_all(client, evaluation(), named, store)
    assert (last.evaluated, last.kept, last.notes) == (0, 2, ())


@pytest.mark.parametrize("columns", [{"run": ["x"], "evaluated": ["yesterday"]}, *slow({"run": [1, 2]}, {"a": ["b"]})])
def test_a_table_of_another_form_is_passed_over_and_stays(
    columns: dict[str, list[Any]], runs: Path, client: Client, run: Any, tmp_path: Path
) -> None:
    own = tmp_path / "fleet"
    (own / "runs").mkdir(parents=True)
    other = own / "runs" / "runs-00000000000000000001-1.parquet"
    pq.write_table(pa.table(columns), other)
    before = other.read_bytes()
    with used(client):
        code, out, err = run("fleet", runs, "-o", own, "--no-pooled")
    assert code == 0, err
    assert "has not the columns of a table of runs" in " ".join(out.split()) and other.read_bytes() == before
    assert len(kf_calib.open_fleet(own)) == 2


def test_a_row_of_another_run_without_a_factor_counts(store: Store, tmp_path: Path) -> None:
    """As of one that failed, which no pooled diagnosis can read."""
    row = dict.fromkeys(SCHEMA.names) | {"run": "gone.mcap", "evaluated": datetime.now(UTC) - timedelta(days=1)}
    store.append([row | {"error": "gone"}])
    known, notes = store.checked()
    assert set(known) == {"gone.mcap"} and notes == [] and ListedRun("gone.mcap").place in known
