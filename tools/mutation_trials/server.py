"""Runs tests of a copy of the checkout in processes that need not load numpy and its like again.

usage: python server.py ROOT PACKAGE MAP TEST_FILE...

First the tests are mapped (``test_map``). Then each line of standard input, a JSON object with ``files``, ``tests``
(in the order to run them; empty: all) and ``limit_s`` of processor time, is answered by a line: the first test that
failed, "" if none did, or "time" if they were not through in time.
"""

from __future__ import annotations

import importlib
import json
import os
import resource
import sys
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import pytest

_FRESH = ("kf_calib", "tests", "helpers", "conftest", "test_", "mutation_trials", "hypothesis", "_hypothesis", "xdist")
"""What each run loads itself: the program, its tests, and what pytest wants to load."""
_QUIET = ["-n", "0", "-q", "-x", "-m", "not slow", "-p", "no:cacheprovider", "--no-header", "--tb=no"]


class Ordered:
    """A plugin of pytest: the given tests in the given order, or all; ``failed`` is the first that failed."""

    def __init__(self, tests: Sequence[str]) -> None:
        self._places, self.failed = {test: place for place, test in enumerate(tests)}, ""

    def pytest_collection_modifyitems(self, config: pytest.Config, items: list[pytest.Item]) -> None:
        if self._places:
            items[:] = sorted((i for i in items if i.nodeid in self._places), key=lambda i: self._places[i.nodeid])

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.failed = self.failed or report.nodeid

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        if report.failed:
            self.failed = self.failed or f"{report.nodeid} (does not load)"


def run(files: Sequence[str], tests: Sequence[str], answer: int) -> None:
    """Run tests in this process, and write the first that failed to a pipe."""
    plugin = Ordered(tests)
    code = pytest.main([*_QUIET, *files], plugins=[plugin])
    failed = plugin.failed or ("does not load" if code not in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED)
                               else "")  # fmt: skip
    os.write(answer, failed.encode())


def map_tests(root: Path, package: Path, place: Path, files: Sequence[str]) -> None:
    """Map tests in this process, and write which other modules they load, to be loaded once for all."""
    from mutation_trials.test_map import Mapper

    mapper = Mapper(root, package)
    pytest.main([word for word in _QUIET if word != "-x"] + [*files], plugins=[mapper])
    sys.settrace(None)
    mapper.write(place)
    loaded = [name for name in sys.modules if not name.startswith(_FRESH)]
    place.with_suffix(".modules").write_text(json.dumps(loaded))


def in_child(work: Callable[[int], None], limit_s: float) -> str:
    """What a child process says of some work; "time" if it took more processor time than the limit."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.close(reading)
            silent = os.open(os.devnull, os.O_RDWR)
            for stream in (0, 1, 2):
                os.dup2(silent, stream)
            resource.setrlimit(resource.RLIMIT_CPU, (int(limit_s) + 1, int(limit_s) + 5))
            work(writing)
        except BaseException:
            os.write(writing, f"the tests were not run: {traceback.format_exc()}".encode())
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading, "rb") as answer:
        said = answer.read().decode()
    status = os.waitpid(child, 0)[1]
    return "time" if os.WIFSIGNALED(status) and not said else said


def main(root: Path, package: Path, place: Path, files: Sequence[str]) -> None:
    """Map, load, and answer."""
    in_child(lambda _: map_tests(root, package, place, files), 3600.0)
    sys.dont_write_bytecode = True
    for name in json.loads(place.with_suffix(".modules").read_text()):
        if name not in sys.modules and not name.startswith("__"):
            with suppress(BaseException):
                importlib.import_module(name)
    print("ready", flush=True)
    for line in sys.stdin:
        asked = json.loads(line)
        said = in_child(lambda answer, asked=asked: run(asked["files"], asked["tests"], answer), asked["limit_s"])
        print(json.dumps(said), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3]), sys.argv[4:])
