"""Which tests execute which functions of the program, and how long they take."""

from __future__ import annotations

import ast
import functools
import json
import os
import sys
import threading
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import pytest

LOCAL = ".<locals>"
_BYTES_PER_S = 500.0  # of a file whose tests have not been run


@dataclass
class TestMap:
    """Tests by the functions that they execute.

    functions: of each test (or file of tests), ``path:name`` of functions of the program, where what is defined within
    one counts as that one; ``path:`` where it is not known which functions of a module.
    seconds: of processor, of each test. failed: those that fail unchanged.
    """

    __test__ = False  # no test itself

    functions: dict[str, list[str]] = field(default_factory=dict[str, list[str]])
    seconds: dict[str, float] = field(default_factory=dict[str, float])
    failed: list[str] = field(default_factory=list[str])

    def tests_of(self, path: Path, function: str, first: Iterable[Path] = ()) -> list[str]:
        """The tests that execute a function, or, where there is none, anything of its module.

        File by file, since tests of a file share what one has made: first those of the module's name, then the files
        named, then those that take little.
        """
        place, module = f"{path}:{function}", f"{path}:"
        sound = {test: places for test, places in self.functions.items() if test not in self.failed}
        hits = {test for test, places in sound.items() if place in places or module in places}
        hits = hits or {test for test, places in sound.items() if any(one.startswith(module) for one in places)}
        cost, early, own = defaultdict[str, float](float), {str(name) for name in first}, f"/test_{path.stem}.py"
        for test in hits:
            cost[_file(test)] += self.seconds[test]

        def place_in_order(test: str) -> tuple[bool, bool, float, str, float]:
            file = _file(test)
            return not file.endswith(own), file not in early, cost[file], file, self.seconds[test]

        return sorted(hits, key=place_in_order)

    def files_of(self, modules: Iterable[Path]) -> list[str]:
        """The files whose tests call anything of modules."""
        return sorted({_file(test) for path in modules for test in self.tests_of(path, "")})

    @classmethod
    def read(cls, path: Path) -> TestMap:
        """A map that was written."""
        read = json.loads(path.read_text())
        names: list[str] = read.pop("names")
        return cls({test: [names[k] for k in called] for test, called in read["called"].items()}, read["seconds"],
                   read["failed"])  # fmt: skip

    def write(self, path: Path) -> None:
        """Each name once."""
        names = sorted({name for called in self.functions.values() for name in called})
        numbers = {name: k for k, name in enumerate(names)}
        called = {test: [numbers[name] for name in own] for test, own in self.functions.items()}
        path.write_text(json.dumps(dict(names=names, called=called, seconds=self.seconds, failed=self.failed)))


def static_map(root: Path) -> TestMap:
    """Without a run: a file of tests stands for its tests, and calls what it imports and what its folder mirrors."""
    made = TestMap()
    for path in sorted((root / "tests").rglob("test_*.py")):
        name = path.relative_to(root)
        imported = {f"{one.replace('.', '/')}.py:" for one in _imported(path) if one.startswith("kf_calib")}
        package = Path("kf_calib", *name.parts[1:-1])
        mirrored = (
            {f"{module.relative_to(root)}:" for module in (root / package).rglob("*.py")} if name.parts[2:] else set()
        )
        made.functions[str(name)] = sorted(imported | mirrored)
        made.seconds[str(name)] = path.stat().st_size / _BYTES_PER_S
    return made


class Mapper:
    """A plugin of pytest that notes which functions of a folder each test calls, in this process.

    What a fixture of a module or a class calls counts for all tests of its file.
    """

    def __init__(self, root: Path, folder: Path) -> None:
        self._root, self._prefix = f"{root}/", f"{root / folder}/"
        self.map = TestMap()
        self._shared: dict[str, set[str]] = defaultdict(set)
        self._now: dict[int, CodeType] = {}

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[Any]:
        self._now, begun_s = {}, _processor_s()
        threading.setprofile(self._note)
        sys.setprofile(self._note)
        try:
            return (yield)
        finally:
            sys.setprofile(None)
            threading.setprofile(None)
            self.map.functions[item.nodeid] = sorted(self._called())
            self.map.seconds[item.nodeid] = round(_processor_s() - begun_s, 3)

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any, request: pytest.FixtureRequest) -> Iterator[Any]:
        if fixturedef.scope == "function":
            return (yield)
        outer, self._now = self._now, {}
        try:
            return (yield)
        finally:
            self._shared[_file(request.node.nodeid)] |= self._called()
            self._now = outer

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.map.failed.append(report.nodeid)

    def write(self, path: Path) -> None:
        """The map, with what fixtures call."""
        for test, names in self.map.functions.items():
            self.map.functions[test] = sorted({*names, *self._shared[_file(test)]})
        self.map.write(path)

    def _note(self, frame: FrameType, event: str, _: Any) -> None:
        """Called at calls and returns; lines, which would take many times as long, are not traced."""
        code = frame.f_code
        if id(code) not in self._now:
            self._now[id(code)] = code

    def _called(self) -> set[str]:
        codes = [code for code in list(self._now.values()) if code.co_filename.startswith(self._prefix)]
        return {f"{code.co_filename.removeprefix(self._root)}:{code.co_qualname.partition(LOCAL)[0]}" for code in codes}


def _file(test: str) -> str:
    return test.partition("::")[0]


def _processor_s() -> float:
    """Of this process and of those that it has started and waited for."""
    taken = os.times()
    return taken.user + taken.system + taken.children_user + taken.children_system


def importing_tests(root: Path, module: Path) -> list[Path]:
    """The files of tests that import a module, the smallest first."""
    name = ".".join(module.with_suffix("").parts)
    files = [path for path in (root / "tests").rglob("test_*.py") if name in _imported(path)]
    return [path.relative_to(root) for path in sorted(files, key=lambda path: path.stat().st_size)]


@functools.cache
def _imported(path: Path) -> set[str]:
    return {name for node in ast.walk(ast.parse(path.read_text())) for name in _names(node)}


def _names(node: ast.AST) -> Iterable[str]:
    if isinstance(node, ast.ImportFrom) and node.module:
        return [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
    return [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
