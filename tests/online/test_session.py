"""A run evaluated while it goes on: what replay gives, to the bit; nobody who looks on can hold it up."""

import gc
import itertools
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from urllib.request import urlopen

import numpy as np
import pytest
from helpers.command_line import CommandLine
from helpers.full_disk import full_disk
from helpers.hidden_effects import BENCH
from helpers.long_runs import slow
from helpers.paths import ROOT
from helpers.synthetic import Run, plan_of
from helpers.warm_command import warm

from kf_calib.bench.streams import Batch
from kf_calib.cli.echo import Printer
from kf_calib.diagnosis.missing_effect import diagnose
from kf_calib.diagnosis.refits import Refits
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.dwells.folding import Folder
from kf_calib.dwells.pieces import MOST_PIECES, Pieces
from kf_calib.errors import InputError
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.dwell_pass import Pass
from kf_calib.estimation.intervals import NORMAL
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.settings import Settings
from kf_calib.online import status
from kf_calib.online.evaluation import targets
from kf_calib.online.session import Session
from kf_calib.online.status import Judgement, RunStatus, current, judge_so_far
from kf_calib.sources.files.recording import Recording
from kf_calib.sources.live import Status
from kf_calib.sources.simulation.detectability import sized
from kf_calib.sources.simulation.injected import parse
from kf_calib.sources.simulation.sensors import GRADES, TrueNoise
from kf_calib.sources.simulation.simulator import Simulation
from kf_calib.support.json_values import json_value
from kf_calib.views.console import plain
from kf_calib.views.json import replay_object
from kf_calib.views.live import objects
from kf_calib.views.live.content import Doing, content_of
from kf_calib.views.live.screen import screen
from kf_calib.views.rerun.growing import GrowingView


def bench(*hidden: str, orientations: int = 12, batch: int = 40, seed: int = 5) -> Simulation:
    base = Simulation(
        BENCH, GRADES["navigation"].sensors(seed), TrueNoise(white_mps2=5e-5),
        plan_of(orientations, dwell_s=6.0, seed=seed), sample_hz=50.0, angle_hz=20.0, slew_rate_degps=180.0, seed=seed,
        batch_samples=batch,
    )  # fmt: skip
    return base.hiding(parse(hidden, BENCH.axes, seed=seed, sized=partial(sized, base)))


class Told:
    """A source that does something between batches: ``before`` (number of the batch)."""

    def __init__(self, source: Simulation | Run, before: Callable[[int], None]) -> None:
        self.source, self.before = source, before
        self.bench, self.warnings, self.fraction = source.bench, list[str](), 0.0

    def __iter__(self) -> Iterator[Batch]:
        for number, batch in enumerate(self.source):
            self.before(number)
            yield batch


def judgements(session: Session) -> list[Judgement]:
    out = list[Judgement]()
    session.listeners.append(out.append)
    final = session.run()
    assert out[-1] is final and final.final and not any(each.final for each in out[:-1])
    assert "could not be judged" not in session.standing.notice
    return out


def diagnosed_once(monkeypatch: pytest.MonkeyPatch, is_once: bool = True) -> list[int]:
    """The numbers of dwells with which a session asks for a diagnosis, as it asks.

    Diagnoses take most of its time: with ``is_once`` the first is made and that of the whole run, and the others say
    what the first did.
    """
    asked, diagnoses = list[int](), list[Diagnosis]()

    def told(result: Calibration, whole: Refits | None = None) -> Diagnosis:
        asked.append(len(result.visits))
        if not diagnoses or whole is not None or not is_once:
            diagnoses.append(diagnose(result, whole))
        return replace(diagnoses[-1], before=result)

    monkeypatch.setattr(status, "diagnose", told)
    return asked


def equal(one: Judgement, settings: Settings, source: Simulation | Run) -> None:
    """The same bits as a replay's, the same verdict as a diagnosis'."""
    replayed = calibrate(source, settings)
    for name in ("state", "covariance"):
        np.testing.assert_array_equal(getattr(one.result.estimate, name), getattr(replayed.estimate, name))
    assert json_value(replay_object(one.result)) == json_value(replay_object(replayed))
    assert one.diagnosis.verdict == diagnose(replayed).verdict


def test_live_is_replay_to_the_bit_and_a_judgement_a_dwell() -> None:
    session = Session(bench(orientations=7))
    found = judgements(session)
    equal(found[-1], Settings(), bench(orientations=7, batch=1 << 16))
    assert [len(each.result.visits) for each in found] == [1, 2, 3, 4, 5, 6, 7, 7]
    assert [each.consistent for each in found[:4]] == [None] * 4 and found[-1].consistent is True
    assert session.standing.samples == found[-1].result.counts.read and session.standing.dwells == 7


@pytest.mark.slow
def test_a_missing_effect_is_told_while_the_run_goes_on_and_accepted_without_a_restart() -> None:
    session = Session(bench("hysteresis=40sigma", orientations=10), auto=True)
    found = judgements(session)
    alarmed = next(each for each in found if each.alarm)
    assert len(alarmed.result.visits) < 10 and "disagrees: accelerometer" in alarmed.verdict
    told = next(each for each in found if each.diagnosis.missing)
    going = told.next_orientation
    assert going is not None and len(going[0]) == 3 and re.match("(shows|tells) hysteresis .*: by ", going[1])
    after = [each for each in found if each.result.model.effects]
    assert after and not after[0].final and all(each.consistent for each in after)
    assert after == found[-len(after) :], "once in, in all that follows"
    equal(found[-1], Settings(effects=("hysteresis",)), bench("hysteresis=40sigma", orientations=10))


def test_accepting_by_hand_joins_the_model_at_once() -> None:
    source = Told(bench(orientations=6), lambda number: session.accept("second-order") if number == 20 else None)
    session = Session(source)
    found = judgements(session)
    assert [str(effect) for effect in found[-1].result.model.effects] == ["second-order"]
    assert session.standing.model == ("second-order",) and session.standing.notice == "second-order accepted"
    equal(found[-1], Settings(effects=("second-order",)), bench(orientations=6))
    with pytest.raises(InputError):
        session.accept("second-order")  # is in already
    for name, why in (("sinusoid", "second pass"), ("latency", "slews")):
        with pytest.raises(InputError, match=why):
            session.accept(name)


def test_the_look_into_a_dwell_takes_nothing_from_it() -> None:
    """The sigma within a dwell ends where the judgement of the dwell begins, and staying does what it says."""
    run = calibrate(Run(dwells=9, count=400, white_mps2=1e-3))
    before = judged_of(run.fit.dwells[:8])
    last = run.fit.dwells[8]
    here = current(last, before)
    np.testing.assert_allclose(here.sigma, judged_of(run.fit.dwells).result.estimate.sigma, rtol=0.05)
    assert (here.sigma < before.result.estimate.sigma).all()
    longer = current(last.repeat(2.0), before)
    assert (longer.sigma < here.sigma).all() and longer.readings == 2 * here.readings
    assert here.enough is False, "white noise only, and no longer than the others"
    assert current(last.repeat(400.0), before).enough is True
    wider = before.result.interval_sigmas[:12] / NORMAL  # noise that eight dwells tell
    wanted = judged_of(run.fit.dwells[:8], longer.sigma * 1.0001 * wider)
    assert (current(last, wanted).stay_s == last.end_s - last.start_s).all()


@pytest.mark.parametrize(
    "orientations, sigmas, spared, is_once", [(16, 9, 1, True), *slow((16, 9, 1, False), (24, 15, 3, False))]
)
def test_candidates_are_tried_again_only_where_that_may_say_something_else(
    monkeypatch: pytest.MonkeyPatch, orientations: int, sigmas: int, spared: int, is_once: bool
) -> None:
    """Where nothing is beyond chance only if somebody asks; then until three diagnoses agree, and as the run grows.

    is_once: whether all diagnoses say what the first does.
    """
    diagnosed = diagnosed_once(monkeypatch, is_once)
    monkeypatch.setattr(status, "assess_candidates", lambda *_: pytest.fail("nobody has asked"))
    judgements = judged_one_by_one(bench(f"second-order={sigmas}sigma", orientations=orientations, seed=9))
    alarmed = [
        k for k, each in judgements.items() if each.sequential is not None and each.sequential.alarmed is not None
    ]
    assert 5 < alarmed[0], (alarmed, diagnosed)
    assert alarmed[0] == diagnosed[0]
    if not is_once and len(diagnosed) == len(alarmed):
        pytest.xfail("what is likeliest changes from dwell to dwell, so that each is asked")
    assert len(diagnosed) < len(alarmed) - spared
    for k, each in judgements.items():
        assert len(each.result.visits) == k
        if k in alarmed:
            assert k in diagnosed or (each.snapshot.settled and k < 1.25 * len(each.snapshot.result.visits))
            assert (
                each.alarm and "second-order" in each.suspects and f"look {each.sequential.looks}" not in each.verdict
            )


def judged_one_by_one(source: Simulation) -> dict[int, Judgement]:
    passed, out, before = Pass(source, Settings()), dict[int, Judgement](), None
    dwells = passed.fold()
    for count in range(1, len(dwells) + 1):
        folder = Folder()
        folder.dwells = list(dwells[:count])
        out[count] = before = judge_so_far(replace(passed, folder=folder), targets({}), before)
    return out


def judged_of(dwells: list, wanted: np.ndarray | None = None) -> Judgement:
    passed = Pass(Run(dwells=9, count=400, white_mps2=1e-3), Settings())
    passed.fold()
    passed.folder.dwells = list(dwells)
    return judge_so_far(passed, targets({}) if wanted is None else wanted)


def test_setting_error_makes_a_dwell_enough() -> None:
    source = Run(dwells=14, count=300, white_mps2=1e-4, setting_deg=0.01)
    run = calibrate(source)
    found = judge_so_far(folded(source), targets({}))
    assert current(run.fit.dwells[-1], found).enough is True


def folded(source: Run):
    passed = Pass(source, Settings())
    passed.fold()
    return passed


def test_time_to_a_target_is_the_time_it_takes() -> None:
    """Random orientations are worse than advised ones, and not much: within the factor of two."""
    source = Run(dwells=24, count=200, white_mps2=1e-3)
    whole, passed = calibrate(source), folded(source)
    passed.folder.dwells = passed.folder.dwells[:8]
    first = judge_so_far(passed, whole.estimate.sigma)
    needed = whole.fit.dwells[-1].end_s - whole.fit.dwells[7].end_s
    left = first.left_s
    assert np.isfinite(left).all() and 0.25 * needed < np.median(left) <= 1.2 * needed
    assert first.forecast is not None and (first.forecast.sigma[-1] < first.result.estimate.sigma).all()


@pytest.mark.slow
def test_noise_raises_no_alarm_and_unstated_noise_is_waited_for() -> None:
    source = Run(seed=3, dwells=14, count=60, setting_deg=0.005, stated=False)
    found = judgements(Session(source))
    assert not any(each.alarm for each in found)
    assert [each.consistent for each in found[:11]] == [None] * 11 and found[11].consistent is True


def test_a_run_in_g_is_told_at_the_first_dwell_and_one_with_nothing_ends_in_a_sentence() -> None:
    source = Run(dwells=5, count=100)
    source.accel.values[:] /= 9.80665
    problems = set[str]()
    session = Session(Told(source, lambda number: problems.add(session.standing.problem)))
    with pytest.raises(InputError, match="--accel-unit g"):
        session.run()
    assert "--accel-unit g" in session.standing.problem
    with pytest.raises(InputError, match="no accelerometer readings"):
        _empty().run()


def _empty() -> Session:
    class Empty(Told):
        def __iter__(self) -> Iterator[Batch]:
            return iter(())

    return Session(Empty(Run(dwells=1, count=8), lambda number: None))


def test_a_failing_evaluation_still_reads_the_source_to_its_end() -> None:
    """A source that records must not be left alone with its queue."""
    read = list[int]()
    source = Told(bench(orientations=5), read.append)
    session = Session(source)
    session._segmenter.push = lambda batch: 1 / 0  # type: ignore[method-assign]
    with pytest.raises(ZeroDivisionError):
        session.run()
    assert len(read) == len(list(bench(orientations=5))) and "the evaluation stopped" in session.standing.notice


@pytest.mark.parametrize("hours", [6, *slow(30)])
def test_memory_of_a_bench_that_stands_for_hours_is_flat(hours: int) -> None:
    """What is kept of a dwell does not grow with its length: pieces are merged, and its trace ends."""
    batches = 20 * hours
    session = Session(Run(dwells=1, count=1800 * batches, rate_hz=10.0, batch=1800))
    kept = list[int]()
    tracemalloc.start()
    for number, batch in enumerate(session.source):
        session._take(batch)
        if number in (100, batches - 1):  # after five hours, and at the end
            dwells = session._passed.folder.dwells
            kept.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    assert len(dwells) == 1 and len(dwells[0].pieces) <= MOST_PIECES and dwells[0].count > 0.9 * 1800 * batches
    assert kept[1] < kept[0] + 300_000


@pytest.mark.slow
def test_memory_of_a_run_of_days_is_flat() -> None:
    """What is kept of a dwell of an hour is its spectrum and some sixteen pieces, once there are many dwells."""
    kept = list[float]()
    source = Simulation(
        BENCH, GRADES["navigation"].sensors(5), TrueNoise(white_mps2=5e-5), plan_of(59, dwell_s=3700.0, seed=5),
        sample_hz=5.0, angle_hz=1.0, slew_rate_degps=180.0, seed=5, batch_samples=4000,
    )  # fmt: skip
    session = Session(source)

    def measured(_: object) -> None:
        gc.collect()  # what waits to be collected is not kept
        kept.append(tracemalloc.get_traced_memory()[0] / 1e6)

    session.listeners.append(measured)
    tracemalloc.start()
    try:
        session.run()
    finally:
        tracemalloc.stop()
    assert len(kept) == 60
    # the readings of a dwell are 0.6 MB; what two threads just work on differs by up to 7 MB on a busy machine
    assert min(kept[45:59]) - min(kept[16:30]) < 0.3 * 29.0, kept


def test_pieces_that_are_merged_do_not_depend_on_how_readings_come() -> None:
    """However often a run is looked at, and in whatever batches it comes."""
    folded = list[Pieces]()
    for batch, looks in ((1800, 1), (777, 10_000)):
        session = Session(Run(dwells=1, count=300_000, rate_hz=10.0, batch=batch))
        for number, each in enumerate(session.source):
            session._take(each)
            if number % looks == 0:
                assert session._passed.folder.dwells is not None
        session._finish()
        (dwell,) = session._passed.folder.dwells
        folded.append(dwell.pieces)
    assert len(folded[0]) == len(folded[1]) <= MOST_PIECES
    for name in ("counts", "triangles", "spans_s"):
        np.testing.assert_array_equal(getattr(folded[0], name), getattr(folded[1], name), name)


def seen(
    standing: RunStatus, status: Status | None = None, recording: str = "", hint: str = "",
    doing: Doing | None = None, width: int = 80,
) -> str:  # fmt: skip
    return plain(screen(content_of(standing, status, "sim://", recording, doing), hint), width=width)


def test_screen_lines_and_objects_of_a_standing(monkeypatch: pytest.MonkeyPatch) -> None:
    diagnosed_once(monkeypatch)
    session = Session(bench("second-order=60sigma", orientations=6), wanted={"theta1": 1e-6, "K1": 1e-9})
    found = judgements(session)
    shown = seen(session.standing, hint="q: end")
    for part in ("12 parameters", "reached", "disagrees: accelerometer", "HOLD STILL", "× noise"):
        assert part in shown
    assert len(shown.splitlines()) <= 24
    lost = Status(link="lost", trouble="nothing has come for 12 s, it is opened again.", gaps=1)
    small = seen(replace(session.standing, notice="taken"), lost, "run.mcap", width=60)
    assert "disagrees: accelerometer" in "\n".join(small.splitlines()[:16]) and "1 gap " in small
    last = session.standing.judgement
    done = replace(session.standing, judgement=replace(last, wanted=np.full(12, 1.0)))
    assert "STOP: EVERY TARGET IS REACHED" in seen(done)
    driven = seen(done, doing=Doing("THE BENCH STANDS AND MEASURES", "the bench, stay 7: resting"))
    assert "STOP" not in driven and "the bench ends the run by itself" in driven and "stay 7: resting" in driven
    told = objects.line(found[-1])
    assert told.startswith("dwell 6 to") and "worst sigma K1" in told and "\n" not in told
    empty = seen(Session(bench()).standing)
    assert "0 readings" in empty and len(empty.splitlines()) <= 24


@pytest.mark.slow
def test_a_target_is_reached_when_its_sigma_says_so_and_not_when_the_predicted_time_is_over() -> None:
    session = Session(bench(orientations=8))
    last = judgements(session)[-1]
    wanted = 0.9 * last.result.estimate.sigma
    wanted[0] = 1.1 * last.result.estimate.sigma[0]
    late = replace(session.standing, judgement=replace(last, wanted=wanted), current=None, elapsed_s=1e6)
    assert (late.left_s == 0.0).all()
    rows = [line for line in seen(late).splitlines() if line[:1] in "θφKbν"]
    assert ["reached" in row for row in rows] == [True] + [False] * 11
    assert ["soon" in row for row in rows] == [False] + [True] * 11


REPLAY_KEYS = {"samples", "dwells", "model", "parameters", "noise", "consistency", "residual_rms_mps2",
               "held_out_rms_mps2", "held_out_floor_mps2", "warnings"}  # fmt: skip
DIAGNOSE_KEYS = {"consistent", "p_value", "verdict", "missing", "suspects", "ambiguity_set", "may_be_scatter",
                 "invisible", "detectable", "unknown", "next_orientation"}  # fmt: skip
URL = "sim://?speed=500&orientations=6&dwell_s=5&sample_hz=50&slew_degps=180&seed=3"
SLOW = URL.replace("speed=500", "speed=30").replace("orientations=6", "orientations=30")


COMMAND = CommandLine()


def finished(found: dict[str, Any]) -> bool:
    """Whether the file of a replay has its end; it may warn of readings where a run was ended in a motion."""
    return not any("was not finished" in each for each in found["warnings"])


def live(*words: str, **kwargs: Any) -> subprocess.Popen[str]:
    streams = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | kwargs
    return subprocess.Popen(warm("live", *words), cwd=ROOT, text=True, **streams)


def until(is_so: Callable[[], bool], patience_s: float = 60.0) -> None:
    began = time.monotonic()
    while not is_so():
        assert time.monotonic() - began < patience_s, "waited in vain"
        time.sleep(0.01)


def test_json_has_an_object_a_dwell_and_ends_with_what_replay_and_diagnose_say(tmp_path: Path) -> None:
    out = tmp_path / "run.mcap"
    with live(URL, "--json", "--record", str(out), "--rrd", str(tmp_path / "run.rrd")) as process:
        said, errors = process.communicate(timeout=240)
    assert process.returncode == 0, errors
    objects = [json.loads(line) for line in said.splitlines()]
    assert [each["dwells"] for each in objects] == [1, 2, 3, 4, 5, 6, 6]
    assert [each["final"] for each in objects] == [False] * 6 + [True]
    assert all(each.keys() >= REPLAY_KEYS | DIAGNOSE_KEYS for each in objects)
    last = objects[-1]
    assert last["source"]["link"] == "ended" and last["source"]["dropped"] == 0
    as_replayed(last, out)
    assert (tmp_path / "run.rrd").stat().st_size > 10_000


def as_replayed(last: dict, recording: Path) -> None:
    """All that replay and diagnose say of the recording, to the last bit; warnings are of the source, too."""
    for command in ("diagnose", "replay"):
        found = COMMAND.json(command, recording)
        same = {key: last[key] for key in found if key != "warnings"}
        assert same == {key: found[key] for key in same}


def lines_of(source: Simulation) -> list[str]:
    """A run as JSON lines in the order of time, the angles on lines of their own, a header first."""
    first = {"bench": source.bench.to_metadata()}
    lines = list[tuple[int, str]]()
    for batch in source:
        for key, stream in (("accel_mps2", batch.accel), ("angles_rad", batch.pose)):
            for stamp, values in zip(stream.time_ns.tolist(), stream.values.tolist(), strict=True):
                lines.append((stamp, json.dumps({"time_ns": stamp, key: values})))
    return [json.dumps(first), *(text for _, text in sorted(lines, key=lambda line: line[0]))]


def late(lines: list[str], first: int, last: int, by: int) -> list[str]:
    """The same lines, the readings among some of them later by so many: a link that lets the angles ahead."""
    part = lines[first:last]
    ahead = [line for line in part[by:] if "angles" in line]
    return [*lines[:first], *ahead, *(line for line in part if line not in ahead), *lines[last:]]


@pytest.mark.parametrize("way", ["pause and end", "Ctrl-C amid a dwell", *slow("pause", "idle", "Ctrl-C in a pause")])
def test_the_last_object_is_what_replay_and_diagnose_say_whichever_way_a_run_ends(tmp_path: Path, way: str) -> None:
    """A pause comes at the end of a dwell, with the angles a second ahead of the readings."""
    out, lines = tmp_path / "run.mcap", lines_of(bench(orientations=8))
    at = len(lines) * 3 // 4
    lines = late(lines, at - 200, at + 200, 70)
    command = ["-", "--json", "--record", str(out), *(["--idle-s", "1"] if way == "idle" else [])]
    with live(*command, stdin=subprocess.PIPE) as process:
        assert process.stdin is not None and process.stdout is not None
        said = threading.Thread(target=lambda: objects.extend(map(json.loads, process.stdout)))
        objects = list[dict]()
        said.start()
        process.stdin.write("\n".join([*lines[:at], ""]))
        process.stdin.flush()
        until(lambda: len(objects) >= 4)
        time.sleep(0.6)
        if way == "Ctrl-C in a pause":
            process.send_signal(signal.SIGINT)
        elif way not in ("pause and end", "idle"):
            process.stdin.write("\n".join([*lines[at : None if way == "pause" else -150], ""]))
            process.stdin.flush()
            until(lambda: len(objects) >= 6)
            time.sleep(0.6)
        if way == "Ctrl-C amid a dwell":
            process.send_signal(signal.SIGINT)
        if way != "idle":
            process.stdin.close()
        assert process.wait(120) == 0
        said.join()
    assert objects[-1]["final"] and [each["final"] for each in objects].count(True) == 1
    as_replayed(objects[-1], out)


@pytest.mark.parametrize("how", [signal.SIGTERM, *slow(signal.SIGINT, signal.SIGHUP)])
def test_a_signal_finishes_the_file_and_prints_the_summary(tmp_path: Path, how: signal.Signals) -> None:
    out = tmp_path / "run.mcap"
    with live(SLOW, "--record", str(out)) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if line.startswith("dwell 5 "):
                break
        process.send_signal(how)
        said, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    assert "Parameters (1σ)" in said and "The model agrees with the measurements" in said
    assert finished(COMMAND.json("replay", out))


@pytest.mark.parametrize("form", [["--json"], *slow([])])
def test_a_full_log_disk_ends_nothing(tmp_path: Path, form: list[str]) -> None:
    out, model = tmp_path / "run.mcap", tmp_path / "model.toml"
    words = [URL, *form, "--record", str(out), "--save-model", str(model)]
    with Path("/dev/full").open("w") as full, live(*words, stdout=full) as process:
        errors = process.communicate(timeout=240)[1].splitlines()
    assert process.returncode == 2 and len(errors) == 2, errors
    assert "standard output cannot be written to (No space left on device): the run goes on" in errors[0]
    assert errors[1] == "kf-calib: 7 outputs could not be written to standard output: they are lost."
    found = COMMAND.json("replay", out)
    assert found["dwells"] == 6 and found["warnings"] == [] and model.exists()


def test_a_log_goes_on_when_there_is_room_again(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Not with the lines that found none, nor in the middle of one."""
    with (tmp_path / "log").open("w") as log:
        monkeypatch.setattr(sys, "stdout", log)
        out = Printer()
        out("one")
        with full_disk(6):
            out("two")
            out("three")
        out("four")
    assert (tmp_path / "log").read_text() == "one\ntw\nfour\n" and out.lost == 2


@pytest.mark.parametrize("form", [[], *slow(["--json"])])
def test_a_recording_that_stops_is_told_at_once_and_by_the_exit_code(tmp_path: Path, form: list[str]) -> None:
    out = tmp_path / "run.mcap"
    with full_disk(40_000):
        process = live(SLOW, *form, "--record", str(out))
    with process:
        assert process.stderr is not None and process.stdout is not None
        first = process.stderr.readline()
        assert process.poll() is None, "while the run goes on"
        assert first.startswith(f"kf-calib: RECORDING HAS STOPPED: {out} cannot be written on (File too large)"), first
        process.stdout.readline()
        process.send_signal(signal.SIGTERM)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 2
    assert errors.splitlines()[-1].startswith("kf-calib: the run was not recorded to its end:")
    recording = Recording(out)
    assert sum(len(batch.accel) for batch in recording) > 300 and recording.warnings == [], "finished all the same"


def test_a_recording_that_stops_is_loud_on_the_screen() -> None:
    shown = seen(Session(bench()).standing, Status(recording_trouble="no room left."), "run.mcap")
    assert "RECORDING HAS STOPPED: no room left." in shown


def test_nohup_keeps_a_run_alive(tmp_path: Path) -> None:
    out = tmp_path / "run.mcap"
    process = live(SLOW.replace("orientations=30", "orientations=8"), "--record", str(out),
                   preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN))  # fmt: skip
    with process:
        assert process.stdout is not None and process.stdout.readline()
        process.send_signal(signal.SIGHUP)
        assert process.wait(120) == 0
    assert COMMAND.json("replay", out)["dwells"] == 8


@pytest.mark.parametrize("how", [None, signal.SIGHUP])
def test_a_terminal_that_is_closed_costs_the_screen_only(tmp_path: Path, how: signal.Signals | None) -> None:
    """With SIGHUP the run ends as it would by SIGTERM; without it goes on to its end."""
    import pty

    out, model = tmp_path / "run.mcap", tmp_path / "model.toml"
    leader, follower = pty.openpty()
    source = SLOW.replace("orientations=30", "orientations=100" if how else "orientations=10")
    process = live(source, "--record", str(out), "--save-model", str(model), stdin=follower, stdout=follower,
                   stderr=follower, env={**os.environ, "TERM": "xterm"}, start_new_session=True)  # fmt: skip
    os.close(follower)
    seen = b""
    while not re.search(rb"orientation ([5-9]|\d\d)" if how else rb"orientation [1-9]", seen):  # it may leave some out
        seen += os.read(leader, 65536)
    os.close(leader)
    for _ in range(3 if how else 0):  # from the terminal, and from the shell
        process.send_signal(how or 0)
        time.sleep(0.1)
    assert process.wait(120) == 2, "what it had to say could not be written"
    found = COMMAND.json("replay", out)
    assert finished(found) and (found["dwells"] < 100 if how else found["dwells"] == 10) and model.exists()


def test_nobody_reading_ends_a_run_that_is_not_recorded() -> None:
    with live(SLOW.replace("orientations=30", "orientations=10")) as process:
        assert process.stdout is not None and process.stdout.readline()
        process.stdout.close()
        assert process.wait(timeout=120) == 0


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--engine", "filterpy"], "leave out --engine"),
        (["--target", "theta4=1arcsec"], "names no parameter"),
        (["--target", "K1=1arcsec"], "give a number in one of 1, ppm"),
        (["--with", "sinusoid"], "needs a second pass"),
        (["--with", "nonsense"], "nonsense"),
    ],
)
def test_what_cannot_be_is_refused_in_a_sentence(run: Any, words: list[str], sentence: str) -> None:
    assert sentence in run.refused("live", URL, *words)


def test_a_viewer_that_hangs_holds_up_nothing() -> None:
    """A port that takes connections and never answers; more data than its pipe and its sockets hold."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        view = GrowingView(port=listener.getsockname()[1], waiting=1)
        result = calibrate(Run(dwells=40, count=60))
        began, offered = time.monotonic(), 30
        for _ in range(offered):
            view.offer(result)
        assert time.monotonic() - began < 1.0, "offering waits for nobody"
        view.close(patience_s=3.0)
    assert 0 < view.dropped < offered and "does not answer" in view.trouble
    assert not any(thread.name == "rerun" for thread in threading.enumerate())


def test_a_slow_view_shows_in_the_end_what_it_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from kf_calib.views.rerun import growing

    grown, go = list[tuple[int, int]](), threading.Event()

    def slow(result: object, stream: object, shown: int, lay_out: bool, judgement: object) -> None:
        go.wait(30.0)
        grown.append((shown, len(result.visits)))  # type: ignore[attr-defined]

    monkeypatch.setattr(growing, "grow", slow)
    source = Run(dwells=10, count=40)
    results = [calibrate(Run(dwells=n, count=40)) for n in range(4, 11)]
    view = GrowingView(tmp_path / "slow.rrd", None, waiting=2)
    for result in results[:-1]:
        view.offer(result)
    go.set()
    while view._results.qsize():
        time.sleep(0.01)
    view.offer(results[-1])
    view.close(30.0)
    assert view.dropped == 6 - len(grown) + 1 and view.dropped >= 3
    assert grown[-1][1] == 10 and all(a[1] == b[0] for a, b in itertools.pairwise(grown)), grown
    assert source.bench is not None and view.trouble == ""


def test_a_viewer_that_cannot_open_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from kf_calib.views.rerun import growing

    broken = tmp_path / "rerun"
    broken.write_text("#!/bin/sh\necho no display >&2\nexit 1\n")
    broken.chmod(0o755)
    monkeypatch.setattr(growing, "binary", lambda: str(broken))
    view = GrowingView(port=9)
    result = calibrate(Run(dwells=5, count=60))
    time.sleep(0.5)
    view.offer(result)
    view.close(30.0)
    assert "no display" in view.trouble


def test_the_viewer_in_a_browser_is_served_while_the_run_goes_on_and_needs_a_port_of_its_own(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        with pytest.raises(InputError, match="is taken by another Rerun viewer: close it, or add --rerun-port"):
            GrowingView(port=port, web=True)
    view = GrowingView(port=port, web=True)
    address = urlsplit(view.url)
    assert address.hostname == "127.0.0.1" and address.query.endswith(f"127.0.0.1%3A{port}%2Fproxy")
    view.offer(calibrate(Run(dwells=5, count=60)))

    def answers() -> bool:
        try:
            return b"web viewer" in urlopen(f"http://127.0.0.1:{address.port}/", timeout=5.0).read()
        except OSError:
            return False

    until(answers)
    view.close(30.0)
    assert view.trouble == "" and not answers()


@pytest.mark.timeout(120)
def test_a_screen_on_a_terminal() -> None:
    """A pseudo-terminal: the screen is drawn, ``q`` ends the run, the summary stays."""
    import pty

    leader, follower = pty.openpty()
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "80", "LINES": "24"}
    process = subprocess.Popen(
        warm("live", SLOW), cwd=ROOT, stdin=follower, stdout=follower, stderr=follower, env=environment,
        start_new_session=True,
    )  # fmt: skip
    os.close(follower)
    seen = b""
    while b"K1" not in seen or not re.search(rb"orientation ([6-9]|\d\d)", seen):
        seen += os.read(leader, 65536)
    os.write(leader, b"q")
    try:
        while data := os.read(leader, 65536):
            seen += data
    except OSError:  # the other end is closed
        pass
    os.close(leader)
    assert process.wait(60) == 0
    text = seen.decode(errors="replace")
    assert "a: accept what is missing" in text and "The model agrees with the measurements" in text
