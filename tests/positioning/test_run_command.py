"""kf-calib run: a rehearsal on the emulated bench, its lines, its recording, and how it ends where anything fails."""

import json
import os
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest
from helpers.full_disk import full_disk
from helpers.warm_command import warm

import kf_calib
from kf_calib.sources.files.record_files import END_RECORD, angles_of, decision_records

SIM = "sim://?seed=4&sample_hz=20"


def test_a_rehearsal_reaches_its_targets_and_the_recording_tells_every_decision(run: Any, tmp_path: Path) -> None:
    recording = tmp_path / "run.mcap"
    words = ("--record", recording, "--target", "K=16ppm", "--json", "--save", tmp_path / "cal.json")
    code, out, err = run("run", "--positioner", SIM, *words)
    assert code == 0, err
    lines = [json.loads(line) for line in out.splitlines()]
    final = lines[-1]
    assert final["final"] and final["run"]["ended"] == "targets" and final["run"]["stopped"]
    assert len(lines) >= 2 and all("run" in line for line in lines)
    decisions = final["run"]["decisions"]
    records = decision_records(recording)
    assert [record["why"] for record in records] == [decision["why"] for decision in decisions]
    assert [list(angles_of(record["gimbal_deg"])) for record in records] == [each["gimbal_deg"] for each in decisions]
    (end,) = decision_records(recording, END_RECORD)
    assert end["ended"] == "targets" and end["stopped"] == "true"
    again = kf_calib.calibrate(recording)
    sigmas = {row["symbol"]: row["sigma"] for row in final["parameters"]}
    assert {name: parameter.sigma for name, parameter in again.parameters.items()} == pytest.approx(sigmas, rel=1e-12)
    assert sigmas["K1"] <= 16e-6 and len(again.visits) == final["dwells"] == len(decisions) + 3  # first small moves
    assert kf_calib.open_calibration(tmp_path / "cal.json").correction() is not None


@pytest.mark.parametrize(("fault", "said"), [("stall", "instead of"), ("link", "MAY STILL MOVE")])
def test_a_fault_ends_the_run_with_a_sentence_and_a_whole_recording(
    fault: str, said: str, run: Any, tmp_path: Path
) -> None:
    recording = tmp_path / "run.mcap"
    url = f"{SIM}&fault={fault}&fault_s=14"
    code, _, err = run("run", "--positioner", url, "--record", recording, "--target", "K=8ppm", "--json")
    assert code == 2 and said in err, err
    assert "Traceback" not in err
    source = kf_calib.open_recording(recording)
    assert sum(len(batch.accel) for batch in source) > 200 and source.warnings == []
    (end,) = decision_records(recording, END_RECORD)
    assert end["ended"] == "halted" and end["stopped"] == str(fault != "link").lower()


@pytest.mark.parametrize(("number", "code", "said"), [(signal.SIGINT, 130, "Ctrl-C"), (signal.SIGTERM, 143, "SIGTERM")])
def test_a_signal_stops_the_table_first(number: signal.Signals, code: int, said: str, tmp_path: Path) -> None:
    recording = tmp_path / "run.mcap"
    words = ["run", "--positioner", f"{SIM}&speed=20", "--record", str(recording), "--target", "K=0.01ppm", "--json"]
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    process = subprocess.Popen(warm(*words), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)
    while not decision_records(recording) and process.poll() is None:
        time.sleep(0.1)
    process.send_signal(number)
    _, err = process.communicate(timeout=120)
    assert process.returncode == code and said in err and "The table was stopped and stands at" in err, err
    (end,) = decision_records(recording, END_RECORD)
    assert end["ended"] == "halted" and end["stopped"] == "true"


def test_a_full_disk_stops_the_table(tmp_path: Path) -> None:
    recording = tmp_path / "run.mcap"
    words = ["run", "--positioner", SIM, "--record", str(recording), "--target", "K=0.01ppm", "--json"]
    with full_disk(20_000):
        done = subprocess.run(warm(*words), capture_output=True, text=True, timeout=120)
    assert done.returncode == 2, done.stderr
    assert "nothing can be recorded any more" in done.stderr and "The table was stopped" in done.stderr
    assert sum(len(batch.accel) for batch in kf_calib.open_recording(recording)) > 0


def test_a_dry_run_moves_nothing_and_tells_ways_and_duration(run: Any, tmp_path: Path) -> None:
    bench = tmp_path / "bench.toml"
    bench.write_text('axes = "y z x"\ngravity_mps2 = 9.81\nforbidden_deg = "middle=80:100,inner=-15:15"\n')
    told = run.json("run", "--positioner", "acutrol3000", "--bench", bench, "--dry-run")
    assert len(told["gimbal_deg"]) == 12 and told["duration_s"] > 12 * 30.0
    assert [stations[-1] for stations in told["stations_deg"]] == told["gimbal_deg"]
    code, out, _ = run("run", "--positioner", "acutrol3000", "--bench", bench, "--dry-run")
    assert code == 0 and "Nothing was moved" in out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--positioner", "acutrol3000"), "--source is missing"),
        (("--positioner", SIM, "--source", "-"), "leave out --source"),
        (("--positioner", "sim://?fault=fire"), "fault 'fire' is not known"),
        (("--positioner", "sim://?speed=0"), "speed=0 is not positive"),
        (("--positioner", "sim://", "--target", "K"), "names no parameter"),
    ],
)
def test_what_cannot_be_run_is_refused_in_a_sentence(words: tuple[str, ...], said: str, run: Any) -> None:
    assert said in run.refused("run", *words)


def test_limits_of_the_bench_file_are_checked(run: Any, tmp_path: Path) -> None:
    bench = tmp_path / "bench.toml"
    bench.write_text('axes = "y z x"\ngravity_mps2 = 9.81\nlimits_deg = "w=1:2"\n')
    assert "gimbal 'w' is not known" in run.refused("run", "--positioner", "sim://", "--bench", bench)
