"""Makes one change after another in a private copy of the checkout, and has the tests run that call what is changed."""

from __future__ import annotations

import functools
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from mutation_trials import server
from mutation_trials.changes import Change, function_at
from mutation_trials.server import Outcome
from mutation_trials.test_map import TestMap, importing_tests


@dataclass(frozen=True)
class Answer:
    """noticed_by: the test that failed; empty: none of ``tried``, of ``calling`` that call what was changed.

    unsure: a test that failed or took too long, but passes with the change when it is run again, or does the same
    without the change, so that it tells nothing.
    """

    noticed_by: str
    tried: int
    calling: int
    unsure: str = ""

    def __str__(self) -> str:
        survived = f"SURVIVED {self.tried} of {self.calling} tests"
        return self.noticed_by or (f"UNSURE {self.unsure}" if self.unsure else survived)


def copied(root: Path, folder: Path) -> Path:
    """A copy of what git knows of a checkout; the environment is shared."""
    for name in _known_to_git(root):
        if (source := root / name).is_file():
            (target := folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, target, follow_symlinks=False)
        elif source.is_symlink():
            (folder / name).symlink_to(source.readlink())
    return folder


def content_hash(root: Path) -> str:
    """Of the program and its tests, as a map of tests depends on them."""
    found = hashlib.sha256()
    for name in _known_to_git(root):
        if name.startswith(("kf_calib/", "tests/")) and name.endswith(".py") and (path := root / name).is_file():
            found.update(name.encode() + path.read_bytes())
    return found.hexdigest()[:16]


def _known_to_git(root: Path) -> list[str]:
    names = subprocess.run(["git", "ls-files", "-z"], cwd=root, capture_output=True, check=True, text=True).stdout
    return [name for name in names.split("\0") if name]


def _write(module: Path, source: str) -> None:
    """Without what was compiled of it: Python tells by the second whether that is old."""
    module.write_text(source)
    for stale in (module.parent / "__pycache__").glob(f"{module.stem}.*.pyc"):
        stale.unlink()


def _repeated(outcome: Outcome, tests: Sequence[str]) -> Sequence[str]:
    """What to run to see whether an outcome was by chance: the test that failed, or all if it is not known which."""
    if outcome.passed:
        return []
    test = outcome.failed or outcome.late
    return [test] if "::" in test and not test.endswith(")") else tests


def failing(root: Path, files: Sequence[str], environment: Mapping[str, str]) -> list[str]:
    """The tests of some files that fail, in a process of their own."""
    words = [sys.executable, "-m", "pytest", *server.QUIET, "-rfE", *files]
    said = subprocess.run(words, cwd=root, env=environment, capture_output=True, text=True).stdout
    found = (re.fullmatch(r"(?:FAILED|ERROR) (.+?)(?: - .*)?", line) for line in said.splitlines())
    return [match[1] for match in found if match]


class Runner:
    """The fast tests of a copy that call what some modules have, and the process that runs them.

    map_file: which tests call which functions; made where it is not there. budget_s: usual processor time of the tests
    that are run of one change, the quickest files first.
    """

    def __init__(self, copy: Path, modules: Iterable[Path], map_file: Path, budget_s: float) -> None:
        self._copy, self._budget_s = copy, budget_s
        files = TestMap.read(map_file).files_of(modules) if map_file.exists() else []
        places = os.pathsep.join([str(copy), str(copy / "tools")])
        self._environment = os.environ | {"PYTHONPATH": places, "OPENBLAS_NUM_THREADS": "1"}
        self._environment.pop("PYTHONDONTWRITEBYTECODE", None)
        words = [sys.executable, server.__file__, copy, map_file, *files]
        self._process = subprocess.Popen(
            [*map(str, words)], cwd=copy, env=self._environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            text=True,
        )  # fmt: skip
        assert self._process.stdout is not None
        if self._process.stdout.readline().strip() != "ready":
            raise RuntimeError("the tests cannot be run: see tools/test")
        self._map = TestMap.read(map_file)

    def noticed_by(self, path: Path, change: Change, among: Sequence[str] | None = None) -> Answer:
        """The test that notices a change; among: the tests that are run, in place of those that the budget allows."""
        place, source = self._copy / path, self._source(path)
        function = function_at(source, change)
        calling = self._map.tests_of(path, function, importing_tests(self._copy, path))
        tests = self._affordable(calling) if among is None else among
        _write(place, change.of(source))
        try:
            first = self._ask(path, function, tests)
            again = self._ask(path, function, _repeated(first, tests))
        finally:
            _write(place, source)
        unchanged = self._ask(path, function, _repeated(again, tests))
        said = str(again)
        if first.passed or (not again.passed and unchanged.passed):
            return Answer(said, len(tests), len(calling))
        return Answer("", len(tests), len(calling), unsure=f"{first}, once in two runs" if again.passed else
                      f"{said}, without the change, too")  # fmt: skip

    def failing_together(self, changes: Iterable[tuple[Path, Change]]) -> list[str]:
        """The tests that fail where changes are made at once, of all that call any of what they change; of several at
        one place the first is made."""
        made, files = defaultdict[Path, dict[int, Change]](dict), set[str]()
        for path, change in changes:
            made[path].setdefault(change.start, change)
            calling = self._map.tests_of(path, function_at(self._source(path), change))
            files |= {test.partition("::")[0] for test in calling}
        sources = {path: self._source(path) for path in made}
        try:
            for path, by_start in made.items():
                last_first = sorted(by_start.values(), reverse=True)
                _write(self._copy / path, functools.reduce(lambda text, one: one.of(text), last_first, sources[path]))
            return failing(self._copy, sorted(files), self._environment)
        finally:
            for path, source in sources.items():
                _write(self._copy / path, source)

    def _source(self, path: Path) -> str:
        return (self._copy / path).read_text()

    def _affordable(self, tests: Sequence[str]) -> list[str]:
        """As many as the budget allows, and one."""
        taken, spent_s = list[str](), 0.0
        for test in tests:
            if spent_s > self._budget_s:
                break
            taken.append(test)
            spent_s += self._map.seconds[test]
        return taken

    def _ask(self, path: Path, function: str, tests: Sequence[str]) -> Outcome:
        if not tests:
            return Outcome()
        usual_s = defaultdict[str, float](float)
        for test in tests:
            file = test.partition("::")[0]
            usual_s[file] += self._map.seconds.get(test, self._map.seconds.get(file, 0.0))
        asked = {
            "path": str(path),
            "function": function,
            "tests": tests,
            "usual_s": usual_s,
            "budget_s": self._budget_s,
        }
        assert self._process.stdin is not None and self._process.stdout is not None
        print(json.dumps(asked), file=self._process.stdin, flush=True)
        outcome = Outcome(**json.loads(self._process.stdout.readline()))
        if outcome.failed.startswith("the tests were not run"):
            raise RuntimeError(outcome.failed)
        return outcome

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()
