"""What a person who waits is told: that work goes on, how far it is where that is known, and nothing in a pipe."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from synthetic import Run

from kf_calib import stage
from kf_calib.calibration import calibrate
from kf_calib.comparison import compare
from kf_calib.diagnosis import diagnose
from kf_calib.improvement import improve

RECORDING = Path(__file__).resolve().parents[1] / "recordings" / "hidden.mcap"
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


def test_a_diagnosis_and_an_improvement_say_what_they_try() -> None:
    run = calibrate(Run(dwells=8, count=100))
    said = heard(lambda: diagnose(run))
    assert re.fullmatch(r"scanning [3-9]\d effects", said[0])
    assert heard(lambda: improve(run)) == said  # nothing is missing


def test_whoever_does_not_listen_any_more_hears_nothing() -> None:
    said = heard(lambda: stage.say("one"))
    stage.say("two")
    assert said == ["one"]


class Terminal(io.StringIO):
    """What a terminal would be sent."""

    def isatty(self) -> bool:
        return True


def watched(run, monkeypatch: pytest.MonkeyPatch, *words: object) -> list[tuple[str, str]]:
    """Percentage and text of each frame that a command shows on a terminal of 80 columns."""
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr("sys.stderr", terminal := Terminal())  # here: pytest sets its own before it calls a test
    assert run(*words)[0] == 0
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", terminal.getvalue())
    return [(found[1] or "", found[2]) for line in re.split(r"[\r\n]+", plain) if (found := FRAME.search(line))]


def test_on_a_terminal_a_share_grows_where_it_is_known(run, monkeypatch) -> None:
    frames = watched(run, monkeypatch, "compare", RECORDING)
    shares = [int(share) for share, text in frames if share and "filterpy" in text]
    assert len(set(shares)) > 2 and max(shares) < 100


def test_on_a_terminal_the_stage_is_said_where_no_share_is_known(run, monkeypatch) -> None:
    frames = watched(run, monkeypatch, "diagnose", RECORDING)
    texts = {text for _, text in frames}
    assert len(texts) > 4 and all(text.startswith("diagnosing hidden.mcap") for text in texts)
    assert any("refitting with" in text for text in texts)
    assert not any(share for share, text in frames if "refitting" in text or "scanning" in text)


def test_where_the_error_stream_is_no_terminal_there_is_none(run) -> None:
    code, _, err = run("diagnose", RECORDING)
    assert code == 0 and not err
