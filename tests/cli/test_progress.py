"""What a person who waits is told: that work goes on, how far it is where that is known, and nothing in a pipe."""

import io
import re
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.long_runs import slow
from helpers.synthetic import Run

from kf_calib.cli import cli
from kf_calib.cli.echo import progress
from kf_calib.diagnosis.missing_effect import diagnose
from kf_calib.diagnosis.refits import Refits
from kf_calib.diagnosis.stepwise_selection import improve
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.engine_comparison import compare
from kf_calib.support import stage

pytestmark = pytest.mark.usefixtures("unmeasured")

FRAME = re.compile(r"[━╺] +(?:(\d+)% )?\d:\d\d:\d\d (.+?) *$")


def heard(run: Callable[[], object]) -> list[str]:
    """The stages of a computation, in order."""
    said = list[str]()
    with stage.listener(said.append):
        run()
    return said


def test_a_comparison_says_which_way_it_is_at_and_how_far_filterpy_is() -> None:
    told = list[float | str]()
    run = Run(dwells=8, count=100)
    with stage.listener(told.append):
        compare(run, None, told.append)
    assert [each for each in told if isinstance(each, str) and each != "estimating"] == [
        "block engine", "filterpy, reading by reading", "batch least squares", "memory of each",
    ]  # fmt: skip
    first, last = (told.index(text) for text in ("filterpy, reading by reading", "batch least squares"))
    shares = told[first + 1 : last]
    assert shares == sorted(shares) and len(set(shares)) >= 8 and shares[-1] == 1.0 and shares[0] < 0.2


@pytest.mark.slow
def test_a_diagnosis_and_an_improvement_say_what_they_try() -> None:
    run = calibrate(Run(dwells=8, count=100))
    refits = Refits()
    said = heard(lambda: diagnose(run, refits))
    assert re.fullmatch(r"scanning [3-9]\d effects", said[0])
    assert not heard(lambda: improve(run, refits=refits))  # its columns are known


@pytest.mark.slow
def test_an_improvement_says_what_a_diagnosis_says() -> None:
    """Where nothing is missing."""
    run = calibrate(Run(dwells=8, count=100))
    assert heard(lambda: improve(run)) == heard(lambda: diagnose(run))


def test_whoever_does_not_listen_any_more_hears_nothing() -> None:
    said = heard(lambda: stage.say("one"))
    stage.say("two")
    assert said == ["one"]


class Terminal(io.StringIO):
    """What a terminal would be sent."""

    def isatty(self) -> bool:
        return True


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Callable[[], list[tuple[str, str]]]:
    """From the first call on the error stream is a terminal; a call gives percentage and text of each frame so far."""
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "80")
    screen = Terminal()

    def frames() -> list[tuple[str, str]]:
        monkeypatch.setattr("sys.stderr", screen)  # in the test: pytest sets its own before it calls one
        plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", screen.getvalue())
        return [(found[1] or "", found[2]) for line in re.split(r"[\r\n]+", plain) if (found := FRAME.search(line))]

    return frames


def test_a_share_is_shown_where_it_is_known_and_else_what_is_done(terminal) -> None:
    terminal()
    with progress("reading") as tick:
        for share in (0.3, 0.6, 1.0):
            time.sleep(0.25)
            tick(share)
        stage.say("estimating")
        time.sleep(0.25)
    assert list(dict.fromkeys(terminal())) == [
        ("", "reading"), ("30", "reading"), ("60", "reading"), ("", "reading: estimating"),
    ]  # fmt: skip


@pytest.fixture(scope="module")
def recording(run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("progress") / "run.mcap"
    words = "--hide second-order=40sigma --orientations 9 --dwell-s 4 --slew-degps 180"
    assert run("simulate", out, *words.split())[0] == 0
    return out


def test_a_terminal_sees_what_a_command_does(terminal, recording: Path) -> None:
    terminal()
    cli.main(["diagnose", str(recording)], standalone_mode=False)
    texts = {text for _, text in terminal()}
    assert len(texts) > 2 and all(text.startswith("diagnosing run.mcap") for text in texts)
    assert any("refitting with" in text or "scanning" in text for text in texts)


@pytest.mark.parametrize("command", ["compare", *slow("diagnose")])
def test_where_the_error_stream_is_no_terminal_there_is_none(run, recording: Path, command: str) -> None:
    code, _, err = run(command, recording)
    assert code == 0 and not err
