"""Which tests execute which lines of a package."""

from __future__ import annotations

import ast
import json
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

import pytest


@dataclass
class TestMap:
    """Tests by the lines that they execute.

    lines: of each test, ``path:line`` of the package. seconds: of each test. failed: those that fail unchanged.
    """

    __test__ = False  # no test itself

    lines: dict[str, list[str]] = field(default_factory=dict[str, list[str]])
    seconds: dict[str, float] = field(default_factory=dict[str, float])
    failed: list[str] = field(default_factory=list[str])

    def tests_of(self, path: Path, line: int) -> list[str]:
        """The tests that execute a line, and then the others of their files, which may share what one has made once;
        files that take little time first. Of a line that is executed when its module is loaded, those of the module."""
        place, module = f"{path}:{line}", f"{path}:"
        hits = {test for test, places in self.lines.items() if place in places}
        hits = hits or {test for test, places in self.lines.items() if any(one.startswith(module) for one in places)}
        hits -= {*self.failed}
        files = {test.partition("::")[0] for test in hits}
        others = {test for test in self.seconds if test.partition("::")[0] in files} - hits - {*self.failed}
        cost = {name: sum(self.seconds[t] for t in hits if t.startswith(f"{name}::")) for name in files}
        return sorted(hits | others, key=lambda test: (test in others, cost[test.partition("::")[0]]))

    @classmethod
    def read(cls, path: Path) -> TestMap:
        """A map that a ``Mapper`` has written."""
        return cls(**json.loads(path.read_text()))


class Mapper:
    """A plugin of pytest that notes which lines of a folder each test executes.

    What a fixture of a module or a class executes counts for all tests of its file.
    """

    def __init__(self, root: Path, folder: Path) -> None:
        self._root, self._prefix = f"{root}/", f"{root / folder}/"
        self.map = TestMap()
        self._shared: dict[str, set[str]] = defaultdict(set)
        self._now: set[str] = set()
        threading.settrace(self._trace)
        sys.settrace(self._trace)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[Any]:
        self._now, begun_s = set(), time.process_time()
        result = yield
        self.map.lines[item.nodeid] = [*self._now]
        self.map.seconds[item.nodeid] = time.process_time() - begun_s
        return result

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any, request: pytest.FixtureRequest) -> Iterator[Any]:
        if fixturedef.scope == "function":
            return (yield)
        outer, self._now = self._now, self._shared[request.node.nodeid.partition("::")[0]]
        try:
            return (yield)
        finally:
            self._now = outer

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.map.failed.append(report.nodeid)

    def write(self, path: Path) -> None:
        """The map, with what fixtures execute."""
        for test, lines in self.map.lines.items():
            self.map.lines[test] = sorted({*lines, *self._shared[test.partition("::")[0]]})
        path.write_text(json.dumps(vars(self.map)))

    def _trace(self, frame: FrameType, event: str, _: Any) -> Any:
        name = frame.f_code.co_filename
        if not name.startswith(self._prefix):
            return None
        place = name.removeprefix(self._root)
        self._now.add(f"{place}:{frame.f_lineno}")
        return self._tracer_of(place)

    def _tracer_of(self, place: str) -> Any:
        def trace_line(frame: FrameType, event: str, _: Any) -> Any:
            self._now.add(f"{place}:{frame.f_lineno}")
            return trace_line

        return trace_line


def own_tests(root: Path, package: Path) -> list[Path]:
    """The files of tests in the folder that mirrors a package."""
    folder = root / "tests" / package.relative_to("kf_calib")
    return sorted(path.relative_to(root) for path in folder.rglob("test_*.py"))


def importing_tests(root: Path, module: Path) -> list[Path]:
    """The files of tests that import a module, the smallest first."""
    name = ".".join(module.with_suffix("").parts)
    files = [path for path in (root / "tests").rglob("test_*.py") if name in _imported(path)]
    return [path.relative_to(root) for path in sorted(files, key=lambda path: path.stat().st_size)]


def _imported(path: Path) -> set[str]:
    return {name for node in ast.walk(ast.parse(path.read_text())) for name in _names(node)}


def _names(node: ast.AST) -> Iterable[str]:
    if isinstance(node, ast.ImportFrom) and node.module:
        return [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
    return [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
