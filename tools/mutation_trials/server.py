"""Runs tests of a copy of the checkout against changed functions, in forks of a process that has all of it loaded.

usage: python server.py ROOT MAP [TEST_FILE...]

The tests are collected once, and mapped (``test_map``) where the file MAP is not there yet. Then each line of standard
input, a request, is answered by a line, the fields of an ``Outcome``: which test failed, or took too long.
A request is a JSON object: ``tests`` in the order to run them; ``usual_s``, the usual processor time of each of their
files; ``budget_s``, after how much processor time no further test is begun; ``path``, the module that was changed in
the copy; ``function``, the one that was changed, or "" for a change outside of functions: then all is loaded anew.

A child process reports by lines of JSON: ``{"at": TEST}`` when a test begins, ``{"failed": TEST}`` at its end.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import itertools
import json
import math
import os
import resource
import select
import signal
import sys
import time
import traceback
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

import pytest

QUIET = ("-n", "0", "-q", "-m", "not slow", "-p", "no:cacheprovider", "--no-header", "--tb=no")
_SLOWER, _LEAST_S = 10.0, 20.0
"""Processor time that the tests of a file may take, in their usual time, and at least."""
_LONGEST_S = 300.0
"""Time of the clock that one test may take; one that waits for ever takes no processor time."""


@dataclass(frozen=True)
class Outcome:
    """failed: the first test that failed, or ""; late: the test that was stopped because it took too long, or ""."""

    failed: str = ""
    late: str = ""

    @property
    def passed(self) -> bool:
        """Whether all tests passed."""
        return not (self.failed or self.late)

    def __str__(self) -> str:
        return f"{self.late} (takes too long)" if self.late else self.failed


class FirstFailure:
    """A plugin of pytest: ``test`` is the first that failed, or ""; a file that takes too long ends the process.

    answer: the pipe to which the name of a test is written when it begins.
    """

    def __init__(self, asked: Mapping[str, Any], answer: int) -> None:
        self.test, self._usual_s, self._file, self._answer = "", asked["usual_s"], "", answer
        self._end_s, self._session = time.process_time() + asked["budget_s"], None

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        report(self._answer, at=nodeid)
        file = nodeid.partition("::")[0]
        if file != self._file:
            self._file = file
            limit_s = time.process_time() + max(_SLOWER * self._usual_s.get(file, 0.0), _LEAST_S)
            resource.setrlimit(resource.RLIMIT_CPU, (int(limit_s) + 1, resource.RLIM_INFINITY))

    def pytest_sessionstart(self, session: pytest.Session) -> None:
        self._session = session

    def pytest_runtest_logfinish(self) -> None:
        if self._session is not None and self.ended():
            self._session.shouldstop = "a test failed, or the budget is spent"

    def ended(self) -> bool:
        return bool(self.test) or time.process_time() > self._end_s

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.test = self.test or report.nodeid

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        if report.failed:
            self.test = self.test or f"{report.nodeid} (does not load)"


class Server:
    """A plugin of pytest that answers requests once the tests are collected."""

    def __init__(self, root: Path, map_file: Path) -> None:
        self._root, self._map_file = root, map_file
        self._requests = os.fdopen(os.dup(0), "r")  # pytest closes the streams to its tests
        self._answers = os.fdopen(os.dup(1), "w")

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        if not self._map_file.exists():
            outcome = in_child(lambda _: self._map(session), math.inf)
            if outcome != Outcome():
                raise RuntimeError(f"the tests were not mapped: {outcome}")
        print("ready", file=self._answers, flush=True)
        for line in self._requests:
            asked = json.loads(line)
            work = functools.partial(self._answer, named(asked["tests"], session.items), asked)
            print(json.dumps(asdict(in_child(work))), file=self._answers, flush=True)
        return True

    def _map(self, session: pytest.Session) -> None:
        from mutation_trials.test_map import Mapper

        mapper = Mapper(self._root, Path("kf_calib"))
        session.config.pluginmanager.register(mapper)
        _run(session.items, lambda: False)
        mapper.write(self._map_file)

    def _answer(self, items: Sequence[pytest.Item], asked: Mapping[str, Any], answer: int) -> None:
        if not (asked["function"] and replace_code(self._root / asked["path"])):
            self._load_anew(asked, answer)
        plugin = FirstFailure(asked, answer)
        if items:
            items[0].config.pluginmanager.register(plugin)
        _run(items, plugin.ended)
        report(answer, failed=plugin.test)

    def _load_anew(self, asked: Mapping[str, Any], answer: int) -> None:
        """In a process that takes the place of this one."""
        told = self._map_file.with_suffix(".request")
        told.write_text(json.dumps(dict(asked)))
        os.set_inheritable(answer, True)
        os.execv(sys.executable, [sys.executable, __file__, "--anew", str(told), str(answer)])


def named(names: Sequence[str], items: Sequence[pytest.Item]) -> list[pytest.Item]:
    """The tests of these names, in this order; the name of a file stands for all of its tests."""
    places = {name: place for place, name in enumerate(names)}
    place_of = {item: places.get(item.nodeid, places.get(item.nodeid.partition("::")[0], -1)) for item in items}
    return sorted((item for item in items if place_of[item] >= 0), key=lambda item: place_of[item])


def replace_code(module: Path) -> bool:
    """Give the functions of a loaded module the code that its file has now; False where two cannot be told apart.

    What they have returned to caches is forgotten; what they returned when modules were loaded stays.
    """
    codes = defaultdict[tuple[str, int], list[CodeType]](list)
    for code in _codes_in(compile(module.read_bytes(), str(module), "exec")):
        codes[code.co_qualname, code.co_firstlineno].append(code)
    gc.unfreeze()
    for thing in gc.get_objects():
        if type(thing) is FunctionType and thing.__code__.co_filename == str(module):
            fitting = codes[thing.__code__.co_qualname, thing.__code__.co_firstlineno]
            if len(fitting) > 1:
                return False
            thing.__code__ = fitting[0] if fitting else thing.__code__
        elif isinstance(thing, functools._lru_cache_wrapper):  # pyright: ignore[reportPrivateUsage]
            thing.cache_clear()
    return True


def _codes_in(code: CodeType) -> Iterator[CodeType]:
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield constant
            yield from _codes_in(constant)


def _run(items: Sequence[pytest.Item], ended: Callable[[], bool]) -> None:
    for item, following in itertools.zip_longest(items, items[1:]):
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
        if ended():
            return


def in_child(work: Callable[[int], None], longest_s: float = _LONGEST_S) -> Outcome:
    """What a child process reports through the pipe that some work is given.

    It is stopped, and what it has started with it, where it takes too much processor time, or reports nothing for
    ``longest_s``.
    """
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.setpgid(0, 0)
            os.close(reading)
            silent = os.open(os.devnull, os.O_RDWR)
            for stream in (0, 1, 2):
                os.dup2(silent, stream)
            work(writing)
        except BaseException:
            report(writing, failed=f"the tests were not run: {traceback.format_exc()}")
        os._exit(0)
    os.close(writing)
    reported = _reported(reading, longest_s)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)
    status = os.waitpid(child, 0)[1]
    if "failed" not in reported and os.WIFSIGNALED(status):
        return Outcome(late=reported.get("at", "a test"))
    return Outcome(failed=reported.get("failed", ""))


def report(answer: int, **fields: str) -> None:
    """Write a line of JSON to a pipe."""
    os.write(answer, (json.dumps(fields) + "\n").encode())


def _reported(pipe: int, longest_s: float) -> dict[str, str]:
    """The last of each field that is reported, up to the end of the tests, or until nothing comes for so long."""
    fields, rest, wait_s = dict[str, str](), b"", None if math.isinf(longest_s) else longest_s
    while "failed" not in fields and select.select([pipe], [], [], wait_s)[0] and (part := os.read(pipe, 2**16)):
        *lines, rest = (rest + part).split(b"\n")
        for line in lines:
            fields |= json.loads(line)
    os.close(pipe)
    return fields


def load_anew(request: Path, answer: int) -> None:
    """Answer a request in this process, which has loaded nothing yet."""
    asked = json.loads(request.read_text())

    class Ordered:
        def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
            items[:] = named(asked["tests"], items)

    plugin = FirstFailure(asked, answer)
    code = pytest.main([*QUIET, *asked["usual_s"]], plugins=[plugin, Ordered()])
    sound = code in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED) or plugin.ended()
    report(answer, failed=plugin.test or ("" if sound else "does not load"))


def main(root: Path, map_file: Path, files: Sequence[str]) -> None:
    """Collect, map, and answer."""
    sys.dont_write_bytecode = False
    folder = map_file.parent / "tests"
    plugin = Server(root, map_file)
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 1)
    pytest.main([*QUIET, "--basetemp", str(folder), *files], plugins=[plugin])


if __name__ == "__main__":
    if sys.argv[1] == "--anew":
        load_anew(Path(sys.argv[2]), int(sys.argv[3]))
    else:
        main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3:])
