"""The mutation tester makes the change that it names, has its tests run, and tells whether one fails."""

import importlib.util
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

import pytest
from mutation_trials.changes import changes_in, function_at
from mutation_trials.command import Trial, counts
from mutation_trials.runner import Runner
from mutation_trials.server import Outcome, in_child, replace_code, report
from mutation_trials.test_map import TestMap

SOURCE = """
LIMIT = 3.0

class Circle:
    def __init__(self, radius=1.0):
        self.radius = radius

    def area(self):
        return 3.0 * self.radius**2

@functools.cache
def wide(radius):
    return [limit for limit in (1.0, LIMIT) if radius > limit]
"""


def loaded(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec and spec.loader
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


@pytest.fixture
def module(tmp_path: Path) -> ModuleType:
    path = tmp_path / "to_be_changed.py"
    path.write_text(f"import functools\n{SOURCE}")
    return loaded(path)


def test_each_change_is_one_and_knows_its_function() -> None:
    found = {f"{change} in {function_at(SOURCE, change)}" for change in changes_in(SOURCE)}
    assert found == {
        "3.0 -> 6.0 in ", "3.0 -> 1.5 in ", "1.0 -> 2.0 in ", "1.0 -> 0.5 in ",
        "3.0 -> 6.0 in Circle.area", "3.0 -> 1.5 in Circle.area", "* -> / in Circle.area", "** -> * in Circle.area",
        "2 -> 3 in Circle.area", "2 -> 1 in Circle.area", "> -> >= in wide", "> -> < in wide", "1.0 -> 2.0 in wide",
        "1.0 -> 0.5 in wide",
    }  # fmt: skip


def test_functions_of_a_loaded_module_take_the_code_of_its_file(module: ModuleType) -> None:
    """Those that others have taken from it, too, and without what they have in a cache."""
    path, area, wide = Path(str(module.__file__)), module.Circle.area, module.wide
    assert area(module.Circle(2.0)) == 12.0 and wide(2.0) == [1.0]
    path.write_text(path.read_text().replace("**2", "**3").replace("radius >", "radius <"))
    assert replace_code(path)
    assert area(module.Circle(2.0)) == 24.0 and wide(2.0) == [3.0]


def test_two_functions_of_one_name_and_line_cannot_be_told_apart_but_within_another(tmp_path: Path) -> None:
    source = "def total(values):\n    return sum(v for v in values) + sum(v for v in values)\n"
    path = tmp_path / "within.py"
    path.write_text(source)
    total = loaded(path).total
    path.write_text(source.replace(") +", ") -"))
    assert replace_code(path) and total([1, 2]) == 0
    path = tmp_path / "twins.py"
    path.write_text("one, other = lambda: 1, lambda: 2\n")
    twins = loaded(path)
    assert not replace_code(path) and twins.one() == 1


def test_a_child_answers_or_takes_too_long() -> None:
    def hang(answer: int) -> None:
        report(answer, at="a test")
        time.sleep(60.0)

    assert in_child(lambda answer: report(answer, at="a test") or report(answer, failed="a test")) == Outcome("a test")
    assert in_child(lambda answer: report(answer, at="a test") or report(answer, failed="")) == Outcome()
    assert in_child(lambda _: None) == Outcome()
    assert in_child(lambda _: os.kill(os.getpid(), signal.SIGXCPU)) == Outcome(late="a test")
    assert in_child(hang, longest_s=0.3) == Outcome(late="a test")
    assert "the tests were not run" in in_child(lambda _: 1 // 0).failed


def test_what_a_child_has_started_ends_with_it() -> None:
    def start(_: int) -> None:
        if os.fork() == 0:
            time.sleep(60.0)
        time.sleep(60.0)

    begun_s = time.monotonic()
    assert in_child(start, longest_s=0.3) == Outcome(late="a test")
    assert time.monotonic() - begun_s < 30.0


PASSED, FAILED, LATE = Outcome(), Outcome("t.py::one"), Outcome(late="t.py::one")


@pytest.mark.parametrize(
    ("outcomes", "answer", "count"),
    [
        ([PASSED], "SURVIVED 1 of 1 tests", "kf_calib: 0 of 1 changes noticed"),
        ([FAILED, FAILED, PASSED], "t.py::one", "kf_calib: 1 of 1 changes noticed"),
        ([LATE, FAILED, PASSED], "t.py::one", "kf_calib: 1 of 1 changes noticed"),
        ([LATE, LATE, PASSED], "t.py::one (takes too long)", "kf_calib: 1 of 1 changes noticed"),
        ([LATE, PASSED], "UNSURE t.py::one (takes too long), once in two runs", "1 unsure"),
        ([LATE, LATE, LATE], "UNSURE t.py::one (takes too long), without the change, too", "1 unsure"),
        ([FAILED, FAILED, FAILED], "UNSURE t.py::one, without the change, too", "1 unsure"),
    ],
)
def test_a_test_notices_a_change_if_it_fails_again_and_not_without_it(
    outcomes: list[Outcome], answer: str, count: str, tmp_path: Path
) -> None:
    """All tests run with the change; what fails, once more with it and once without it."""
    runs = [("0.5", ["t.py"]), ("0.5", ["t.py::one"]), ("1.0", ["t.py::one"])]
    (tmp_path / "m.py").write_text("SIZE = 1.0")
    change, remaining = changes_in("SIZE = 1.0")[0], list(outcomes)

    class Scripted(Runner):
        def __init__(self) -> None:
            self._copy, self._budget_s, self._map = tmp_path, 1.0, TestMap({"t.py": ["m.py:"]}, {"t.py": 0.1})

        def _ask(self, path: Path, function: str, tests: Sequence[str]) -> Outcome:
            if not tests:
                return PASSED
            size, expected = runs.pop(0)
            assert (tmp_path / path).read_text() == f"SIZE = {size}" and tests == expected
            return remaining.pop(0)

    tried = Trial(Path("kf_calib/m.py"), change, 1.0, Scripted().noticed_by(Path("m.py"), change))
    assert str(tried.answer) == answer and counts([tried]) == count and not remaining


def test_changes_that_are_made_together_are_told_by_all_tests_that_fail(tmp_path: Path) -> None:
    """Of three changes two are noticed; the module is as it was afterwards."""
    source = "SIZE = 1.0\ndef one():\n    return SIZE + 2\ndef other():\n    return 3, 0.5\n"
    tests = "import m\ndef test_size():\n    assert m.one() > 2.5\ndef test_other():\n    assert m.other()[0] == 3\n"
    (tmp_path / "m.py").write_text(source)
    (tmp_path / "test_m.py").write_text(f"{tests}def test_nothing():\n    pass\n")
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = slow")
    wanted = {"1.0 -> 0.5", "3 -> 4", "0.5 -> 1.0"}

    class Still(Runner):
        def __init__(self) -> None:
            self._copy, self._environment = tmp_path, os.environ | {"PYTHONPATH": str(tmp_path)}
            self._map = TestMap({"test_m.py": ["m.py:"]}, {"test_m.py": 0.1})

    changes = [(Path("m.py"), change) for change in changes_in(source) if str(change) in wanted]
    assert len(changes) == 3
    assert Still().failing_together(changes) == ["test_m.py::test_size", "test_m.py::test_other"]
    assert (tmp_path / "m.py").read_text() == source


def test_the_tests_that_call_a_function_come_with_the_quick_file_first_after_those_named(tmp_path: Path) -> None:
    called = {"a.py::slow": ["m.py:f"], "b.py::one": ["m.py:f"], "b.py::two": ["m.py:g"], "c.py::bad": ["m.py:f"],
              "d.py::long": ["m.py:f"]}  # fmt: skip
    seconds = {"a.py::slow": 3.0, "b.py::one": 1.0, "b.py::two": 9.0, "c.py::bad": 0.1, "d.py::long": 5.0}
    TestMap(called, seconds, ["c.py::bad"]).write(tmp_path / "map.json")
    tests = TestMap.read(tmp_path / "map.json")
    assert tests == TestMap(called, seconds, ["c.py::bad"])
    assert tests.tests_of(Path("m.py"), "f") == ["b.py::one", "a.py::slow", "d.py::long"]
    assert tests.tests_of(Path("m.py"), "f", [Path("d.py")]) == ["d.py::long", "b.py::one", "a.py::slow"]
    own = TestMap({"a/test_m.py::slow": ["m.py:f"]} | called, {"a/test_m.py::slow": 99.0} | seconds, ["c.py::bad"])
    assert own.tests_of(Path("m.py"), "f", [Path("d.py")])[:2] == ["a/test_m.py::slow", "d.py::long"]
    assert tests.tests_of(Path("m.py"), "no function's") == ["a.py::slow", "d.py::long", "b.py::one", "b.py::two"]


MAPPED = """
import sys
from pathlib import Path
import pytest
from mutation_trials.test_map import Mapper

mapper = Mapper(Path.cwd(), Path("shapes"))
code = pytest.main(["-q", "-p", "no:cacheprovider", "test_shapes.py"], plugins=[mapper])
mapper.write(Path("map.json"))
sys.exit(code)
"""
TESTS = """
import pytest
from shapes.circle import Circle, wide

@pytest.fixture(scope="module")
def circle():
    return Circle()

def test_area(circle):
    assert circle.area() == 3.0

def test_wide(circle):
    assert wide(2.0) == [1.0]
"""


def test_a_map_knows_what_tests_and_their_fixtures_call(tmp_path: Path) -> None:
    (tmp_path / "shapes").mkdir()
    (tmp_path / "shapes/circle.py").write_text(f"import functools\n{SOURCE}")
    (tmp_path / "test_shapes.py").write_text(TESTS)
    tools = Path(__file__).resolve().parents[2] / "tools"
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{tools}"}
    run = [sys.executable, "-c", MAPPED]
    subprocess.run(run, cwd=tmp_path, env=environment, check=True, timeout=60, capture_output=True)
    known = TestMap.read(tmp_path / "map.json")
    called = {test: {place.partition(":")[2] for place in places} for test, places in known.functions.items()}
    assert called == {"test_shapes.py::test_area": {"Circle.__init__", "Circle.area"},
                      "test_shapes.py::test_wide": {"Circle.__init__", "wide"}}  # fmt: skip
    assert known.failed == [] and all(0.0 <= seconds < 5.0 for seconds in known.seconds.values())
