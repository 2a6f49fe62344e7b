"""Imports point one way, and importing the package is cheap."""

import ast
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from helpers.long_runs import slow
from helpers.paths import ROOT

PACKAGE = ROOT / "kf_calib"
MODULES = {
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__"): path
    for path in PACKAGE.rglob("*.py")
}
DATA = "recordings", "profiles"  # a link: the tutorial's recordings come with the package; profiles of positioners
CORE = {"bench", "dwells", "effects", "noise", "estimation", "design", "diagnosis", "online"}
LEVELS = (
    {"errors"}, {"support"}, {"bench"}, {"effects", "sources"}, {"dwells"}, {"noise"}, {"estimation"},
    {"exchange", "design"}, {"diagnosis"}, {"online"}, {"views"}, {"cli"}, {"report"},
    {"bags", "certificate", "exports", "fleet", "logs", "positioning", "reproduction"},
)  # fmt: skip
"""The packages from the ground up: a package imports from those of lower levels only. The highest are the leaves."""


def imported(path: Path) -> set[str]:
    """Modules of the package that a file imports, wherever in it: at its top, in a function, for types only."""
    found = set[str]()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "kf_calib":
            assert node.module is not None
            found |= {
                name if (name := f"{node.module}.{alias.name}") in MODULES else node.module for alias in node.names
            }
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names if alias.name.split(".")[0] == "kf_calib"}
    return found


def room(module: str) -> str:
    """The package that a module is in, or the module itself where it lies beside the packages."""
    return ".".join(module.split(".")[:2])


@cache
def modules() -> dict[str, set[str]]:
    """What each module imports; read when a test asks, not by every process that only collects the tests."""
    return {name: imported(path) - {name} for name, path in MODULES.items()}


@cache
def packages() -> dict[str, set[str]]:
    """What each package imports."""
    return {
        own: {room(other) for name in MODULES if room(name) == own for other in modules()[name]} - {own}
        for own in ROOMS
    }


ROOMS = sorted(set(map(room, MODULES)))


@pytest.mark.parametrize("graph", [modules, packages])
def test_imports_go_in_no_circle(graph: Callable[[], dict[str, set[str]]]) -> None:
    try:
        order = list(TopologicalSorter(graph()).static_order())
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))
    assert set(graph()) <= set(order)


@pytest.mark.parametrize("own", ROOMS)
def test_imports_point_the_way_that_data_flow(own: str) -> None:
    """Sources know the bench alone; what is simulated and its truth are known to no estimator; views to the commands
    and to the names of the package itself."""
    name = own.removeprefix("kf_calib").removeprefix(".")
    seen = {other.removeprefix("kf_calib.") for other in packages()[own]}
    if name in ("errors", "support", "bench", "effects", "sources"):
        assert seen <= {"errors": set(), "support": {"errors"}, "bench": {"errors", "support"},
                        "effects": {"errors", "support", "bench"},
                        "sources": {"errors", "support", "bench"}}[name]  # fmt: skip
    if name in CORE:
        assert not seen & {"views", "cli", "reproduction"}
        for module in MODULES:
            if room(module) == own:
                assert not any(other.startswith("kf_calib.sources.simulation") for other in modules()[module]), module
    if name not in ("cli", "views", "", "__main__", *LEAVES):
        assert "views" not in seen and "cli" not in seen


@pytest.mark.parametrize("own", [room for room in ROOMS if room != "kf_calib"])
def test_a_package_imports_from_lower_levels_only(own: str) -> None:
    level = {name: number for number, names in enumerate(LEVELS) for name in names}
    name = own.removeprefix("kf_calib.")
    if name != "__main__":
        imported_rooms = {other.removeprefix("kf_calib.") for other in packages()[own]} - {"kf_calib"}
        assert [other for other in sorted(imported_rooms) if level[other] >= level[name]] == []


WITH_A_COMMAND = "certificate", "exports", "fleet", "positioning", "report", "reproduction"
READERS = "bags", "logs"
"""Of files in containers of others."""
LEAVES = (*WITH_A_COMMAND, *READERS)
"""Folders with all of a command, its text and figures too, or of a kind of file, on which nothing else builds."""
PAGES = {"kf_calib.fleet.page", "kf_calib.positioning.section"}
"""What other leaves have to say in a report; each is imported where there is a page to be made."""
HIDDEN = ROOT / "recordings" / "hidden.mcap"
REFUSED = {
    "certificate": ("report", HIDDEN, "--certificate", "c.pdf"),
    "report": ("compare", HIDDEN, "--report", "page.html"),
    "bags": ("replay", "run.bag"),
    "logs": ("replay", "run.mat"),
}
"""What is refused, in a sentence, where a leaf is not there of which a command makes use."""


def is_in(module: str, package: str) -> bool:
    return module == package or module.startswith(f"{package}.")


@pytest.mark.parametrize("leaf", LEAVES)
def test_a_leaf_is_known_to_the_table_of_commands_alone(leaf: str) -> None:
    """And to the package itself, whose public names are imported when they are used."""
    package = f"kf_calib.{leaf}"
    assert (f"{package}.command" in MODULES) is (leaf in WITH_A_COMMAND)
    importing = {name for name in MODULES if any(is_in(other, package) for other in modules()[name])}
    known_to = {"kf_calib", *(PAGES if leaf == "report" else ())}
    assert {name for name in importing if not is_in(name, package)} <= known_to


def without_leaf(leaf: str, folder: Path) -> Path:
    """A copy of the package without a leaf and its line in the table of commands."""
    shutil.copytree(PACKAGE, folder / "kf_calib", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.rmtree(folder / "kf_calib" / leaf)
    table = folder / "kf_calib" / "cli" / "__init__.py"
    text, count = re.subn(rf'"[a-z]+": "{leaf}\.command\.[a-z]+"(,\s*)?', "", table.read_text())
    assert count == (leaf in WITH_A_COMMAND)
    table.write_text(text)
    return folder


@pytest.mark.parametrize("leaf", ["fleet", *slow(*(leaf for leaf in LEAVES if leaf != "fleet"))])
def test_the_program_works_without_a_leaf(leaf: str, tmp_path: Path) -> None:
    """Its folder deleted, with its line in the table of commands: all else is imported, helped with and evaluates."""
    folder = without_leaf(leaf, tmp_path)
    left = [name for name in MODULES if not is_in(name, f"kf_calib.{leaf}") and "__main__" not in name]
    (folder / "run.bag").write_bytes(b"#ROSBAG V2.0\n")
    (folder / "run.mat").write_bytes(b"MATLAB 5.0 MAT-file".ljust(600))
    recording, refused = str(HIDDEN), [str(word) for word in REFUSED.get(leaf, ())]
    code = f"""
import importlib, kf_calib
assert kf_calib.__file__.startswith({str(folder)!r})
for name in {[name for name in left if leaf != "report" or name not in PAGES]}:
    importlib.import_module(name)
from kf_calib.cli import cli
for words in (["--help"], ["replay", "--help"], ["replay", {recording!r}], ["diagnose", {recording!r}]):
    cli.main(words, standalone_mode=False)
if {refused}:
    try:
        cli.main({refused}, standalone_mode=False)
    except kf_calib.InputError as error:
        assert "this program was installed" in str(error) and "{leaf}" in str(error), error
    else:
        raise AssertionError("it was not refused")
"""
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    assert "second-order" in done.stdout.replace("kf-calib effects", "")


def test_nothing_lies_beside_the_packages() -> None:
    flat = sorted(path.name for path in PACKAGE.iterdir() if path.is_file() and path.suffix == ".py")
    assert set(flat) <= {"__init__.py", "__main__.py", "errors.py"}
    for package in (path for path in PACKAGE.rglob("*") if path.is_dir() and path.name not in ("__pycache__", *DATA)):
        text = (package / "__init__.py").read_text()
        assert ast.get_docstring(ast.parse(text)), package


CEILINGS = {
    "kf_calib": 188,
    "support": 1105,
    "bench": 1714,
    "effects": 3161,
    "sources": 11956,
    "dwells": 3898,
    "noise": 3554,
    "estimation": 8044,
    "design": 1879,
    "diagnosis": 6402,
    "online": 1631,
    "exchange": 1964,
    "views": 6907,
    "cli": 3531,
    "report": 780,
    "bags": 403,
    "certificate": 1500,
    "exports": 1146,
    "fleet": 4246,
    "logs": 443,
    "positioning": 1959,
    "reproduction": 855,
}
"""How many lines each room may have. A ceiling is lowered when its room has shrunk. Those of estimation, diagnosis and
(by four lines) views were raised once, for intervals that average over two sizes of noise, and for dwells that are off
beside other terms; that of diagnosis six times more, for causes that nobody knows beside stated noise, for what one
accelerometer alone has, for the readings within dwells beside what is fitted, for what goes with time wherever a bench
may err, for having no rows within dwells of what is not seen there, and for biases that change smoothly, or each by its
own size; and with effects for what lags behind anything and the way that gimbals turn. That of sources was raised for
logs in layouts that their loggers chose, and for objects of many lines. Those of noise, estimation, exchange and views
were raised for biases that walk by another amount each, and intervals that allow for it. Those of bench, support and
dwells were raised for numbers that several rooms had each for itself: of rounding, memory, searches and levels, and for
the names of the state. Several rose by some lines for names of the field, which are longer; that of diagnosis for noise
of one gimbal, for pairs that share decompositions and keep less in memory, and for a jackknife over slews; that of
sources for units in cells and a rate above the names, and that of logs for files of LabVIEW, Parquet and Arrow."""
UNDER_A_CEILING = 400  # lines: where a room has more room than this, its ceiling is out of date


@pytest.mark.parametrize("name", CEILINGS)
def test_a_room_keeps_below_its_ceiling(name: str) -> None:
    lines = dict.fromkeys(CEILINGS, 0)
    for path in PACKAGE.rglob("*.py"):
        first = path.relative_to(PACKAGE).parts[0]
        lines["kf_calib" if first.endswith(".py") else first] += len(path.read_text().splitlines())
    assert CEILINGS[name] - UNDER_A_CEILING < lines[name] <= CEILINGS[name], "more lines, or a ceiling to be lowered"


VERBS = {"read", "write", "save", "save_view", "load", "open", "check", "parse"}


def named(node: ast.stmt) -> set[str]:
    """The public names that a statement at the top of a module gives: classes, functions, aliases of types."""
    if isinstance(node, ast.ClassDef | ast.FunctionDef):
        return set() if node.name.startswith("_") else {node.name}
    targets = node.targets if isinstance(node, ast.Assign) else []
    names = {target.id for target in targets if isinstance(target, ast.Name)}
    return {name for name in names if name[0].isupper() and name != name.upper()}


def test_one_name_stands_for_one_thing() -> None:
    """Every class in the whole package, and every verb that says nothing of its object; ``plot.save`` is public."""
    homes: dict[str, set[str]] = {}
    for module, path in MODULES.items():
        for node in ast.parse(path.read_text()).body:
            for name in named(node):
                homes.setdefault(name, set()).add(module)
    classes = {name for name, where in homes.items() if name[0].isupper() and len(where) > 1}
    assert not classes, {name: homes[name] for name in classes}
    verbs = {name: where for name, where in homes.items() if name in VERBS and len(where) > 1}
    assert verbs == {"save": {"kf_calib.views.figures", "kf_calib.report.page"}}


FILLERS = {"found", "own", "each", "out"}
COMPREHENSIONS = ast.ListComp | ast.SetComp | ast.DictComp | ast.GeneratorExp | ast.Lambda
NEAR = 4  # lines


def far_fillers(function: ast.FunctionDef) -> set[str]:
    """The names without a meaning of their own whose uses in a function, but for comprehensions, are far apart."""
    inside = {id(name) for node in ast.walk(function) if isinstance(node, COMPREHENSIONS) for name in ast.walk(node)}
    names = [node for node in ast.walk(function) if isinstance(node, ast.Name) and node.id in FILLERS]
    stored = {node.id for node in names if isinstance(node.ctx, ast.Store) and id(node) not in inside}
    arguments = {argument.arg for argument in (*function.args.args, *function.args.kwonlyargs)} & FILLERS
    lines = {name: [node.lineno for node in names if node.id == name and id(node) not in inside] for name in FILLERS}
    lines = {name: [*numbers, *([function.lineno] if name in arguments else [])] for name, numbers in lines.items()}
    return {name for name in stored | arguments if max(lines[name]) - min(lines[name]) > NEAR}


def test_a_name_that_is_used_far_from_where_it_is_given_says_what_it_holds() -> None:
    """Not ``found`` or ``own``, which a reader would have to look up."""
    far = {
        f"{module}.{node.name}": names
        for module, path in MODULES.items()
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef) and (names := far_fillers(node))
    }
    assert far == {}


def test_import_is_cheap_and_leaves_filterpy_and_rerun_alone() -> None:
    code = "import sys, kf_calib; print(*[m for m in ('filterpy', 'rerun', 'scipy', 'matplotlib') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=300)
    assert done.stdout.strip() == ""


def test_results_are_printed_where_nothing_of_the_extras_is_installed() -> None:
    code = "import sys, kf_calib.views.html; print(*{'jinja2', 'markupsafe', 'matplotlib'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=300)
    assert done.stdout.strip() == ""


HEAVY = (
    "pydantic", "scipy", "filterpy",
    "rerun", "rich.console", "pint", "simpleeval", "serial", "tomli_w", "matplotlib", "kf_calib.diagnosis",
    "kf_calib.cli.live", "kf_calib.cli.plan", "kf_calib.estimation.model_file", "kf_calib.estimation.engine_comparison",
)  # fmt: skip


def test_a_replay_imports_nothing_that_it_does_not_need() -> None:
    code = (
        "import sys; from kf_calib.cli import cli; sys.argv[0] = 'kf-calib'; cli.main(sys.argv[1:], "
        f"standalone_mode=False); print(*[m for m in {HEAVY} if m in sys.modules], file=sys.stderr)"
    )
    recording = PACKAGE.parent / "recordings" / "navigation_24.mcap"
    command = [sys.executable, "-c", code, "replay", str(recording), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=300)
    assert json.loads(done.stdout)["dwells"] == 24
    assert done.stderr.strip() == ""
