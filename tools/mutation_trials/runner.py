"""Makes one change after another in a private copy of the checkout, and runs the tests that execute its line."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from mutation_trials import server
from mutation_trials.changes import Change
from mutation_trials.test_map import TestMap, importing_tests, own_tests

_SLOWER, _LEAST_S = 10.0, 20.0
_FURTHER_S = 20.0
"""Processor time that the tests of other folders may take."""


def copied(root: Path, folder: Path) -> Path:
    """A copy of what git knows of a checkout; the environment is shared."""
    names = subprocess.run(["git", "ls-files", "-z"], cwd=root, capture_output=True, check=True, text=True).stdout
    for name in filter(None, names.split("\0")):
        if (source := root / name).is_file():
            (target := folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, target, follow_symlinks=False)
        elif source.is_symlink():
            (folder / name).symlink_to(source.readlink())
    return folder


class Runner:
    """The tests of one package of a copy, and the process that runs them; further: those of other folders, too."""

    def __init__(self, root: Path, package: Path, further: bool = True) -> None:
        self._root, self._own, self._further = root, own_tests(root, package), further
        self._folder = tempfile.TemporaryDirectory(prefix="mutation_map")
        place = Path(self._folder.name, "map.json")
        places = os.pathsep.join([str(root), str(Path(server.__file__).parents[1])])
        environment = os.environ | {"PYTHONPATH": places, "OPENBLAS_NUM_THREADS": "1"}
        words = [sys.executable, server.__file__, root, package, place, *self._own]
        self._process = subprocess.Popen(
            [*map(str, words)], cwd=root, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        assert self._process.stdout is not None
        if self._process.stdout.readline().strip() != "ready":
            raise RuntimeError(f"the tests of {package} cannot be run")
        self.map = TestMap.read(place)

    def noticed_by(self, path: Path, change: Change) -> str:
        """The test that notices a change; empty if none does."""
        place = self._root / path
        source = place.read_text()
        place.write_text(change.of(source))
        for stale in (place.parent / "__pycache__").glob(f"{place.stem}.*.pyc"):
            stale.unlink()
        try:
            return self._of_its_folder(path, change.line) or (self._of_others(path) if self._further else "")
        finally:
            place.write_text(source)

    def _of_its_folder(self, path: Path, line: int) -> str:
        tests = self.map.tests_of(path, line)
        files = sorted({test.partition("::")[0] for test in tests})
        usual_s = sum(self.map.seconds[test] for test in tests)
        return self._ask(files, tests, max(_SLOWER * usual_s, _LEAST_S)) if tests else ""

    def _of_others(self, path: Path) -> str:
        files = [str(file) for file in importing_tests(self._root, path) if file not in self._own]
        said = self._ask(files, [], _FURTHER_S) if files else ""
        return "" if said == "time" else said

    def _ask(self, files: Sequence[str], tests: Sequence[str], limit_s: float) -> str:
        assert self._process.stdin is not None and self._process.stdout is not None
        print(json.dumps({"files": files, "tests": tests, "limit_s": limit_s}), file=self._process.stdin, flush=True)
        said = json.loads(self._process.stdout.readline())
        if said.startswith("the tests were not run"):
            raise RuntimeError(said)
        return said

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()
        self._folder.cleanup()
