"""Paths and fixtures shared by the tests."""

import functools
import gc
import math
import os
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers.browser import chromium
from helpers.slow_share import Share, SlowShare
from hypothesis import settings

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy: a process a core is enough
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # the program is started often: what one start compiles, others read
os.environ.pop("PYTHONUNBUFFERED", None)  # streams keep what they are to write, as users have them
os.environ["COLUMNS"] = ""
del os.environ["COLUMNS"]  # readline sets it behind Python's back, and a child would print tables that narrow

from helpers.command_line import CommandLine

import kf_calib.views.diagnosis  # noqa: F401 (with it results print themselves, as with the public names)

settings.register_profile("fixed", derandomize=True)  # what is tried is the same on every machine, every day
settings.load_profile("fixed")

SHARED = Path(__file__).resolve().parents[2] / "shared" / "recordings"


def pytest_addoption(parser: pytest.Parser) -> None:
    group, words = parser.getgroup("slow tests"), "of the slow tests (-m slow), those whose turn it is at this commit"
    group.addoption("--slow-share", metavar="COMMIT", help=words)
    words = "begin no test of a share after so many minutes"
    group.addoption("--slow-minutes", type=float, default=math.inf, metavar="N", help=words)


def pytest_configure(config: pytest.Config) -> None:
    sys.dont_write_bytecode = False
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        signal.signal(signal.SIGHUP, lambda *_: None)  # under nohup: unlike "ignored", children do not inherit it
    if commit := config.getoption("slow_share"):
        share = Share.of_commit(config.rootpath, commit)
        config.pluginmanager.register(SlowShare(share, config.getoption("slow_minutes")))


def pytest_collection_finish() -> None:
    """What is loaded now lives to the end: the garbage collector need not walk it again for every figure drawn."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000)


@pytest.fixture(autouse=True)
def _goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """This process is not at its end where ``main`` returns."""
    monkeypatch.setattr(gc, "freeze", lambda: None)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """The graphics driver is hidden from a test that does not say that it draws: it would fail where there is none."""
    with pytest.MonkeyPatch.context() as patch:
        if item.get_closest_marker("draws") is None:
            for name in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES"):
                patch.setenv(name, os.devnull)
        return (yield)


def pytest_runtest_setup(item: pytest.Item) -> None:
    """A test that draws is skipped where there is no graphics driver."""
    if item.get_closest_marker("draws") is not None and (reason := _why_nothing_is_drawn()):
        pytest.skip(reason)


@functools.cache
def _why_nothing_is_drawn() -> str:
    """What the viewer says for want of a graphics driver; empty where it draws."""
    import rerun as rr
    from screenshot import ScreenshotError, screenshot

    with tempfile.TemporaryDirectory() as folder:
        rrd = Path(folder, "empty.rrd")
        with rr.RecordingStream("empty") as stream:
            stream.save(rrd)
            stream.log("nothing", rr.TextDocument(""), static=True)
            stream.disconnect()
        try:
            screenshot(rrd, rrd.with_suffix(".png"), (64, 64))
        except ScreenshotError as error:
            if "graphics driver" in str(error):
                return str(error)
            raise
    return ""


@pytest.fixture
def ferraris() -> Path:
    """A real recording made by others; kept beside the project, not in it."""
    path = SHARED / "ferraris_hand.mcap"
    if not path.exists():
        pytest.skip(f"{path} is not there: the recordings of others are kept outside the project")
    return path


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures of a page are blank: to draw them takes most of the time, and tests/report/test_report.py does."""
    from matplotlib.figure import Figure

    from kf_calib.report import contents

    def blank(result: object) -> dict[str, Callable[[], Figure]]:
        return dict.fromkeys(drawn(result), lambda: Figure((1.0, 1.0)))

    drawn = contents.figures
    blank.dispatch = drawn.dispatch
    monkeypatch.setattr(contents, "figures", blank)


@pytest.fixture
def unmeasured(monkeypatch: pytest.MonkeyPatch) -> None:
    """``compare`` does not measure memory, for which it does all of it again, and slowly; tests/cli/test_cli.py and
    tests/views/test_run_figures.py have it measured."""
    from kf_calib.estimation import engine_comparison

    monkeypatch.setattr(engine_comparison, "_peak_mb", lambda run: 1.0)


@pytest.fixture(scope="session")
def run() -> CommandLine:
    """The command line: exit code, what it prints, what it prints to the error stream."""
    return CommandLine()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as opened:
        yield opened
