"""Nothing of the user's is harmed: what a command may write, when it does, and what it says where it cannot."""

import errno
import json
import multiprocessing
import os
import random
import signal
import subprocess
import sys
import time
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from helpers.full_disk import full_disk
from helpers.long_runs import slow
from helpers.own_effect import TEN_LINES
from helpers.warm_command import warm

from kf_calib import effects
from kf_calib.bench.bench import Bench, parse_axes
from kf_calib.bench.streams import Batch, Stream
from kf_calib.cli import cli
from kf_calib.cli.files import OutputFile
from kf_calib.errors import InputError, KfCalibError
from kf_calib.sources.files.recorder import Recorder
from kf_calib.sources.files.recording import Recording
from kf_calib.support.output_files import Growing, Outputs, whole, write_whole

QUICK = ["--orientations", "12", "--dwell-s", "6", "--slew-degps", "360", "--sample-hz", "50", "--seed", "3"]
MINE = b"the user's own"
BENCH = Bench(parse_axes("y z x"), 9.81)


@pytest.fixture(scope="module")
def original(run, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("outputs") / "run.mcap"
    assert run("simulate", path, *QUICK)[0] == 0
    return path.read_bytes()


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, original: bytes) -> Path:
    """A folder with a file of each kind that commands read, and in it."""
    monkeypatch.chdir(tmp_path)
    Path("run.mcap").write_bytes(original)
    rows = "".join(f"{k}.0,0,0,1,0,0,0\n" for k in range(40))
    Path("lines.csv").write_text("time_s,ax_g,ay_g,az_g,outer_deg,middle_deg,inner_deg\n" + rows)
    Path("bench.toml").write_text("gravity_mps2 = 9.81\n")
    Path("model.toml").write_text('effects = []\neffects_from = ["own.py"]\n')
    Path("own.py").write_text(TEN_LINES)
    monkeypatch.setattr(effects, "_registered", {})  # what own.py defines is for one test
    Path("angles.csv").write_text("0,0,0\n90,0,0\n0,90,0\n0,0,90\n90,90,0\n0,90,90\n")
    return tmp_path


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def batch(start_s: int = 1, count: int = 100) -> Batch:
    stamps = start_s * 10**9 + np.arange(count) * 10**7
    values = np.random.default_rng(start_s).normal(9.81, 1.0, (count, 3))
    return Batch(Stream(stamps, values), Stream(stamps[:1], np.zeros((1, 3))))


ITS_INPUT = [
    "replay run.mcap --rrd run.mcap",
    "replay run.mcap --png ./run.mcap",
    "replay run.mcap --save-model hard.mcap",
    "replay run.mcap --rrd soft.mcap",
    "replay run.mcap --bench bench.toml --save-model bench.toml",
    "replay run.mcap --model model.toml --save-model model.toml",
    "replay run.mcap --model model.toml --save-model own.py",
    "replay run.mcap --effects-from own.py --save-model own.py",
    "improve run.mcap --journal run.mcap",
    "improve run.mcap --save-model run.mcap",
    "improve run.mcap --model model.toml --journal model.toml",
    "plan --recording run.mcap --csv run.mcap",
    "plan --positions angles.csv --csv angles.csv",
    "record lines.csv lines.csv",
    "record run.mcap run.mcap",
    "simulate angles.csv --plan angles.csv",
    "live run.mcap --record run.mcap",
    "live run.mcap --record hard.mcap",
    "live . --record run.mcap",
    "live tail:lines.csv?idle=1 --rrd lines.csv",
    "live sim://?plan=angles.csv --save-model angles.csv",
]


@pytest.mark.parametrize("words", ITS_INPUT)
def test_an_input_is_never_written(run, here: Path, words: str) -> None:
    Path("hard.mcap").hardlink_to("run.mcap")
    Path("soft.mcap").symlink_to("run.mcap")
    before = contents(here)
    assert "read by this very command" in run.refused(*words.split(), "--overwrite")
    assert contents(here) == before


@pytest.mark.parametrize("words, stream", [
    ("record lines.csv -", {"stdin": "lines.csv"}), ("plan --csv angles.csv", {"stdout": "angles.csv"}),
])  # fmt: skip
def test_the_file_of_a_standard_stream_is_not_written(here: Path, words: str, stream: dict[str, str]) -> None:
    before = Path("lines.csv").read_bytes()
    ((name, path),) = stream.items()
    command = warm(*words.split(), "--overwrite")
    with Path(path).open("r+b") as file:
        done = subprocess.run(command, **{name: file}, stderr=subprocess.PIPE, timeout=120)
    assert done.returncode == 2 and b"of this very command" in done.stderr
    assert Path("lines.csv").read_bytes() == before


FIGURES = ["--png", "--svg", "--pdf"]
PICTURES = ["--rrd", *FIGURES]
WRITING = [
    ("replay run.mcap", [*PICTURES, "--save", "--save-model"]),
    ("diagnose run.mcap", PICTURES),
    ("compare run.mcap", [*FIGURES, "--report"]),
    ("improve run.mcap", [*PICTURES, "--save", "--save-model", "--journal", "--report"]),
    ("report run.mcap", ["-o", "--certificate"]),
    ("apply cal.json run.mcap", ["-o"]),
    ("export cal.json --to csv", ["-o"]),
    ("certificate cal.json", ["-o"]),
    ("certificate cal.json -o new.pdf", ["--xml"]),
    ("plan", ["--csv", *FIGURES]),
    ("paper --repetitions 1", FIGURES),
    ("live sim://?speed=100", ["--record", "--rrd", "--save-model", "--save"]),
    ("run --positioner sim://", ["--record", "--save-model", "--save"]),
    ("history cal.json", FIGURES),
    ("noise run.mcap", [*FIGURES, "--save"]),
    ("fleet run.mcap -o fleet", [*FIGURES, "--report"]),
    ("record", [""]),
    ("simulate", [""]),
]
OUTPUTS = [(words, option) for words, options in WRITING for option in options]


def test_every_output_is_among_them_and_can_be_replaced() -> None:
    ctx = click.Context(cli)
    for name in cli.list_commands(ctx):
        command = cli.get_command(ctx, name)
        assert command is not None
        asked = [param for param in command.params if isinstance(param.type, OutputFile)]
        if name in ("effects", "demo", "info", "verify"):
            assert not asked
            continue
        listed = [option for words, options in WRITING if words.split()[0] == name for option in options]
        assert {option for option in listed if option} == {p.opts[0] for p in asked if p.param_type_name == "option"}
        assert any("--overwrite" in param.opts for param in command.params)


@pytest.fixture
def idle(monkeypatch: pytest.MonkeyPatch) -> None:
    """No work is done: where it would begin it fails."""

    def begun(*_: object, **__: object) -> None:
        pytest.fail("the work began")

    for place in ("kf_calib.estimation.calibration.calibrate", "kf_calib.design.orientation_plan.plan",
                  "kf_calib.reproduction.grebenkin2019.repeat", "kf_calib.noise.rest_noise.noise_at_rest",
                  "kf_calib.sources.live.open_live", "kf_calib.sources.text.lines.Lines.__iter__",
                  "kf_calib.sources.simulation.simulator.Simulation.__iter__"):  # fmt: skip
        monkeypatch.setattr(place, begun)


@pytest.mark.usefixtures("idle")
@pytest.mark.parametrize("words, option", OUTPUTS)
def test_nothing_is_replaced_unasked(run, here: Path, words: str, option: str) -> None:
    Path("there").write_bytes(MINE)
    after = ["lines.csv"] if words == "record" else []
    err = run.refused(*words.split(), *option.split(), "there", *after)
    assert "there exists already" in err and "--overwrite" in err
    assert Path("there").read_bytes() == MINE


@pytest.mark.usefixtures("idle")
@pytest.mark.parametrize("words, option", OUTPUTS)
@pytest.mark.parametrize("path, says", [
    ("/dev/null", "device"), (".", "is a folder"), ("none/x", "there is no folder"), ("n" * 300, "too long"),
    ("device", "device"), ("shut", "protected"),
])  # fmt: skip
def test_what_cannot_be_written_is_told_before_the_work(
    run, here: Path, words: str, option: str, path: str, says: str
) -> None:
    Path("device").symlink_to("/dev/null")
    Path("shut").write_bytes(MINE)
    Path("shut").chmod(0o444)
    after = ["lines.csv"] if words == "record" else []
    assert says in run.refused(*words.split(), *option.split(), path, *after, "--overwrite")
    assert Path("device").is_symlink() and Path("shut").read_bytes() == MINE


def test_the_truth_of_a_simulation_is_an_output(run, here: Path) -> None:
    Path("sim.truth.json").write_bytes(MINE)
    assert "sim.truth.json exists already" in run.refused("simulate", "sim.mcap", *QUICK)
    assert not Path("sim.mcap").exists()
    assert Path("sim.truth.json").read_bytes() == MINE


def test_two_outputs_are_two_files(run, here: Path) -> None:
    Path("link").symlink_to("new.rrd")
    err = run.refused("replay", "run.mcap", "--rrd", "new.rrd", "--save-model", "link")
    assert "name the same file" in err and not Path("new.rrd").exists()


def test_a_link_stays_and_what_it_points_to_is_replaced(run, here: Path) -> None:
    (here / "far").mkdir()
    Path("far/kept.toml").write_bytes(MINE)
    Path("far/kept.toml").chmod(0o600)
    Path("link.toml").symlink_to("far/kept.toml")
    code, out, err = run("replay", "run.mcap", "--save-model", "link.toml", "--overwrite")
    assert code == 0 and "saved link.toml" in out, err
    assert Path("link.toml").is_symlink() and b"effects" in Path("far/kept.toml").read_bytes()
    assert Path("far/kept.toml").stat().st_mode & 0o777 == 0o600
    assert [path.name for path in Path("far").iterdir()] == ["kept.toml"]


def test_a_file_that_comes_to_be_meanwhile_is_left_alone(here: Path) -> None:
    outputs = Outputs({"--rrd": here / "new"})
    (here / "new").write_bytes(MINE)
    with pytest.raises(InputError, match="came to be during the run"):
        outputs.write(here / "new", lambda path: path.write_bytes(b""))
    assert (here / "new").read_bytes() == MINE


def _write_at_once(path: Path, barrier: Any, results: Any) -> None:
    """In a process of its own: write a file that nobody has yet, at the same moment as others."""
    outputs, content = Outputs({"-o": path}), f"of process {os.getpid()}" * 1000
    barrier.wait()
    try:
        outputs.write(path, lambda path: write_whole(path, content.encode()))
        results.put((content, ""))
    except InputError as error:
        results.put(("", str(error)))


@pytest.mark.parametrize("links", [True, False])
def test_of_many_that_write_a_new_name_at_once_one_succeeds(
    tmp_path: Path, links: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The others say so, and their results take the place of none; also where a file system has no links."""
    if not links:
        monkeypatch.setattr(os, "link", _no_links)
    context = multiprocessing.get_context("fork")
    for number in range(10):
        path, barrier, results = tmp_path / f"{number}.json", context.Barrier(4), context.Queue()
        writers = [context.Process(target=_write_at_once, args=(path, barrier, results)) for _ in range(4)]
        for each in writers:
            each.start()
        told = [results.get(timeout=60) for _ in writers]
        for each in writers:
            each.join()
        (content,) = (content for content, _ in told if content)
        assert path.read_text() == content
        assert sum("came to be during the run and was left as it is" in said for _, said in told) == 3
    assert len(list(tmp_path.iterdir())) == 10


def _no_links(*_: object) -> None:
    raise OSError(errno.EPERM, "Operation not permitted")


@pytest.mark.timeout(120)
def test_what_a_killed_run_left_is_removed_by_the_next(tmp_path: Path) -> None:
    """And nothing else: not what a process writes that goes on, nor one of another machine."""
    program = (
        "import sys, time; from pathlib import Path; from kf_calib.support.output_files import whole\n"
        "with whole(Path(sys.argv[1])) as part: part.write_text('half'); print(flush=True); time.sleep(600)"
    )
    words = [sys.executable, "-c", program, str(tmp_path / "out.json")]
    begin = partial(subprocess.Popen, words, stdout=subprocess.PIPE)
    with begin() as killed, begin() as other:
        for child in (killed, other):
            child.stdout.read(1)
        killed.kill()
        killed.wait()
        elsewhere = tmp_path / f".kf-calib-00000000-{killed.pid}-00000000.part"
        elsewhere.write_text("half")
        assert len(list(tmp_path.glob(".kf-calib-*.part"))) == 3
        Outputs({"-o": tmp_path / "another.json"})
        assert {path.name.split("-")[3] for path in tmp_path.iterdir()} == {str(other.pid), str(killed.pid)}
        assert elsewhere.exists()
        other.kill()
    Outputs({"-o": tmp_path / "another.json"})
    assert list(tmp_path.iterdir()) == [elsewhere]


@pytest.mark.parametrize("name", ["device", "link"])
def test_no_device_is_replaced_by_whatever_writes(here: Path, name: str) -> None:
    os.mkfifo("device")
    Path("link").symlink_to("device")
    with pytest.raises(InputError, match="device"):
        write_whole(Path(name), b"x")
    assert Path("device").is_fifo() and Path("link").is_symlink() and not list(here.glob(".*"))


def test_what_fails_half_way_leaves_the_earlier_file(here: Path) -> None:
    (here / "old").write_bytes(MINE)
    with pytest.raises(RuntimeError), whole(here / "old") as part:
        part.write_bytes(b"half")
        raise RuntimeError
    assert (here / "old").read_bytes() == MINE and not list(here.glob(".*"))


FAST = "live sim://?speed=500&orientations=6&dwell_s=5&sample_hz=50&slew_degps=180&seed=3"


@pytest.mark.parametrize("words", [
    "replay run.mcap --rrd", "replay run.mcap --save-model", f"{FAST} --rrd", f"{FAST} --save-model",
    "replay run.mcap --png", *slow("plan --count 6 --pdf"),
])  # fmt: skip
def test_a_file_that_finds_no_room_is_told_after_the_result(run, here: Path, words: str) -> None:
    """It was waited for, for ever."""
    Path("old").write_bytes(MINE)
    with full_disk(50 if "model" in words else 20_000):
        code, out, err = run(*words.split(), "old", "--overwrite", "--json")
    assert code == 2 and json.loads(out.splitlines()[-1]) and "cannot be written (" in err, err
    assert Path("old").read_bytes() == MINE and not list(here.glob(".*"))


@pytest.mark.timeout(120)
def test_a_recording_that_finds_no_room_is_told_at_once(here: Path) -> None:
    """Though more readings would come."""
    words = ["record", "out.mcap", "-", "--axes", "y z x", "--gravity", "9.81"]
    with full_disk(3000):
        child = subprocess.Popen(warm(*words), stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    with child:
        child.stdin.write(Path("lines.csv").read_text())
        with suppress(BrokenPipeError):
            while child.poll() is None:
                child.stdin.write(f"{time.monotonic()},{random.random()},0,1,0,0,0\n")
                child.stdin.flush()
        with suppress(BrokenPipeError):
            child.stdin.close()
        assert child.stderr.readline().startswith("kf-calib: out.mcap cannot be written on (File too large)")
    assert child.returncode == 2


def test_one_file_that_fails_does_not_keep_others_from_being_written(
    run, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise InputError("no room for the journal.")

    monkeypatch.setattr("kf_calib.diagnosis.selection_journal.write_journal", refuse)
    code, out, err = run("improve", "run.mcap", "--journal", "j.toml", "--save-model", "m.toml", "--unattended")
    assert code == 2 and err.count("no room") == 1 and "Stopped" in out and "saved m.toml" in out
    assert Path("m.toml").exists() and "saved j.toml" not in out


def test_files_are_written_where_nobody_reads_the_result(here: Path) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    command = warm("replay", "run.mcap", "--save-model", "m.toml")
    done = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, timeout=120)
    os.close(writing)
    assert (done.returncode, done.stderr) == (0, b"") and Path("m.toml").exists()


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("text", [
    "", "time_s,ax_g,ay_g,az_g,outer_deg,middle_deg,inner_deg\n", "a,b,c\n1,2,3\n",
    "time_s,ax_g,ay_g,az_g,outer_deg,middle_deg,inner_deg\n" + "1,,,,0,0,0\n" * 20,
], ids=["nothing", "header", "columns", "no readings"])  # fmt: skip
def test_a_recording_that_fails_leaves_no_stub(run, here: Path, text: str, overwrite: bool) -> None:
    Path("bad.csv").write_text(text)
    if overwrite:
        Path("out.mcap").write_bytes(MINE)
    before = contents(here)
    run.refused("record", "out.mcap", "bad.csv", "--axes", "y z x", "--gravity", "9.81", "--overwrite")
    assert contents(here) == before


def test_a_live_run_without_a_reading_leaves_the_earlier_recording(run, here: Path) -> None:
    Path("poses.csv").write_text("time_s,ax_g,ay_g,az_g,outer_deg,middle_deg,inner_deg\n" + "1,,,,0,0,0\n" * 20)
    Path("out.mcap").write_bytes(MINE)
    words = ["--axes", "y z x", "--gravity", "9.81", "--idle-s", "0.5", "--record", "out.mcap", "--overwrite"]
    err = run.refused("live", "poses.csv", *words)
    assert "nothing was recorded: no reading came from poses.csv, but 20 angles" in err
    assert Path("out.mcap").read_bytes() == MINE and not list(here.glob(".*"))


@pytest.mark.parametrize("as_json", [[], ["--json"]])
@pytest.mark.parametrize(("text", "instead"), [
    (b"", ""), (b"time_s,ax_g,ay_g,az_g,outer_deg\n1,,,,0\n", ", but 1 angle"),
])  # fmt: skip
def test_a_live_run_to_which_nothing_came_says_so(here: Path, as_json: list[str], text: bytes, instead: str) -> None:
    words = ["live", "-", "--axes", "y", "--gravity", "9.81", "--record", "out.mcap", *as_json]
    done = subprocess.run(warm(*words), input=text, capture_output=True, timeout=120)
    said = f"kf-calib: nothing was recorded: no reading came from standard input{instead}: check that the bench is on"
    assert done.returncode == 2 and said in done.stderr.decode() and done.stderr.count(b"\n") == 1
    assert not done.stdout and not Path("out.mcap").exists()


def test_an_earlier_recording_stays_until_readings_of_the_new_one_are_on_the_disk(tmp_path: Path) -> None:
    path, backup = tmp_path / "run.mcap", tmp_path / "backup.mcap"
    path.write_bytes(MINE)
    backup.hardlink_to(path)
    with Recorder(path, BENCH, overwrite=True) as recorder:
        assert path.read_bytes() == MINE
        recorder.write(batch())
        recorder.end_dwell()
        assert sum(len(each.accel) for each in Recording(path)) == 100  # a kill from now on costs no more than ever
        recorder.write(batch(10))
    assert sum(len(each.accel) for each in Recording(path)) == 200
    assert backup.read_bytes() == MINE and {each.name for each in tmp_path.iterdir()} == {"run.mcap", "backup.mcap"}


@pytest.mark.parametrize("there", [False, True])
@pytest.mark.parametrize("words", [
    "record out.mcap lines.csv --axes yzx --gravity 9.81", "simulate out.mcap", "replay run.mcap --rrd out.mcap",
    "live sim://?speed=100 --record out.mcap",
])  # fmt: skip
@pytest.mark.parametrize("option", [[], ["--overwrite"]])
def test_a_file_that_is_being_recorded_is_for_no_other_run(
    run, here: Path, words: str, option: list[str], there: bool
) -> None:
    """Whether readings of the one that records are on the disk, or an earlier file is still there."""
    if there:
        Path("out.mcap").write_bytes(MINE)
    with Recorder("out.mcap", BENCH, overwrite=there) as recorder:
        for _ in range(2):
            before = contents(here)
            err = run.refused(*words.split(), *option)
            assert f"out.mcap is being written by another run (process {os.getpid()}): end that one first" in err
            assert contents(here) == before
            recorder.write(batch())
            recorder.end_dwell()
    assert sum(len(each.accel) for each in Recording("out.mcap")) == 200
    assert run("replay", "run.mcap", "--save-model", "out.mcap", "--overwrite")[0] == 0, "free again"


@pytest.mark.parametrize("there", [False, True])
def test_of_two_that_begin_at_once_one_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, there: bool) -> None:
    """Both have seen that the file is nobody's."""
    path = tmp_path / "run.mcap"
    if there:
        path.write_bytes(MINE)
    monkeypatch.setattr("kf_calib.sources.files.recorder.refuse_output", lambda *_: None)
    with Recorder(path, BENCH, overwrite=True) as recorder:
        second = Growing(path) if there else None
        with pytest.raises(InputError, match="being written by another run"):
            Recorder(path, BENCH, overwrite=True)
        recorder.write(batch())
        recorder.end_dwell()
        if second:
            with pytest.raises(InputError, match="being written by another run"):
                second.open()
    assert sum(len(each.accel) for each in Recording(path)) == 100 and len(list(tmp_path.iterdir())) == 1


@pytest.mark.timeout(120)
def test_a_killed_run_leaves_no_lock(here: Path) -> None:
    words = ["record", "out.mcap", "-", "--axes", "y z x", "--gravity", "9.81"]
    with subprocess.Popen([sys.executable, "-m", "kf_calib.cli", *words], stdin=subprocess.PIPE) as child:
        child.stdin.write(Path("lines.csv").read_bytes())
        child.stdin.flush()
        while not (Path("out.mcap").exists() and Path("out.mcap").stat().st_size):  # it is locked before it is written
            assert child.poll() is None
        with pytest.raises(InputError, match=f"process {child.pid}"):
            Recorder("out.mcap", BENCH, overwrite=True)
        child.kill()
    Recorder("out.mcap", BENCH, overwrite=True).close()


def test_a_disk_without_room_for_a_reading_leaves_the_earlier_recording(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(MINE)
    with Recorder(path, BENCH, overwrite=True) as recorder:
        recorder.write(batch(count=2000))
        with full_disk(recorder.size + 1000), pytest.raises(KfCalibError, match="nothing was recorded"):
            recorder.end_dwell()
    assert path.read_bytes() == MINE and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("signal_number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
@pytest.mark.timeout(120)
def test_a_recording_that_is_ended_early_keeps_its_readings(here: Path, signal_number: int) -> None:
    Path("out.mcap").write_bytes(MINE)
    words = ["record", "out.mcap", "-", "--overwrite", "--axes", "y z x", "--gravity", "9.81"]
    killed = signal_number == signal.SIGKILL  # which nobody passes on
    command = [sys.executable, "-m", "kf_calib.cli", *words] if killed else warm(*words)
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as child:
        child.stdin.write(Path("lines.csv").read_bytes())
        child.stdin.flush()
        while Path("out.mcap").read_bytes() == MINE:  # a line a moment: the clock, not the end, brings them to the disk
            child.stdin.write(b"100.0,0,0,1,0,0,0\n")
            child.stdin.flush()
            assert child.poll() is None
        child.send_signal(signal_number)
        assert child.wait(20) == (130 if signal_number != signal.SIGKILL else -signal_number)
    recording = Recording("out.mcap")
    assert sum(len(each.accel) for each in recording) >= 40
    assert bool(recording.warnings) == (signal_number == signal.SIGKILL), "else it is finished"


UNFORESEEN = [
    (np.linalg.LinAlgError("Singular\nmatrix"), "LinAlgError: Singular matrix"),
    (MemoryError("Unable to allocate 7 GiB"), "not memory enough (MemoryError: Unable to allocate 7 GiB)"),
    (RecursionError("maximum recursion depth exceeded"), "RecursionError"),
    (OSError(errno.ENOSPC, "No space left on device", "x"), "x: No space left on device"),
    (ZeroDivisionError(), "ZeroDivisionError"),
]


@pytest.mark.parametrize("error, says", UNFORESEEN, ids=lambda each: type(each).__name__)
def test_whatever_goes_wrong_is_one_sentence_and_exit_2(
    run, here: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, says: str
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr("kf_calib.views.console.summary", fail)
    err = run.refused("replay", "run.mcap")
    assert says in err
    assert "kf_calib/cli/replay.py:" in err or isinstance(error, MemoryError)
    monkeypatch.setenv("KF_CALIB_TRACEBACK", "1")
    code, _, err = run("replay", "run.mcap")
    assert code == 2 and "Traceback" in err and says in err.splitlines()[-1]


def test_ctrl_c_is_130(run, here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("kf_calib.views.console.summary", interrupt)
    assert run("replay", "run.mcap")[0] == 130


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device of Linux")
@pytest.mark.parametrize("words", ["replay run.mcap --json", "replay run.mcap", "--help", "plan --count 6"])
def test_an_output_that_takes_nothing_is_exit_2(here: Path, words: str) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(warm(*words.split()), stdout=full, stderr=-1, timeout=120)
    assert done.returncode == 2 and done.stderr.count(b"\n") == 1 and b"No space left" in done.stderr
