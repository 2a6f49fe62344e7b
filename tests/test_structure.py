"""Imports point one way, and importing the package is cheap."""

from __future__ import annotations

import ast
import json
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
    {"exchange", "reproduction", "design"}, {"diagnosis"}, {"fleet", "online"}, {"positioning"}, {"views"}, {"cli"},
)  # fmt: skip
"""The packages from the ground up: a package imports from those of lower levels only."""


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
    if name not in ("cli", "views", "", "__main__"):
        assert "views" not in seen and "cli" not in seen


@pytest.mark.parametrize("own", [room for room in ROOMS if room != "kf_calib"])
def test_a_package_imports_from_lower_levels_only(own: str) -> None:
    level = {name: number for number, names in enumerate(LEVELS) for name in names}
    name = own.removeprefix("kf_calib.")
    if name != "__main__":
        imported_rooms = {other.removeprefix("kf_calib.") for other in packages()[own]} - {"kf_calib"}
        assert [other for other in sorted(imported_rooms) if level[other] >= level[name]] == []


LEAVES = {
    "fleet": {"cli.fleet", "views.fleet", "views.figures.fleet", "views.report.fleet"},
    "exchange.certificate": {"cli.exchange", "views.exchange"},
    "reproduction": {"cli.paper", "views.paper", "views.figures.experiment"},
}
"""Packages that nothing else builds on, and those who may know each: its command, its views, its page."""


def is_in(module: str, package: str) -> bool:
    return module == package or module.startswith(f"{package}.")


@pytest.mark.parametrize("leaf", LEAVES)
def test_a_leaf_is_known_to_its_command_and_its_views_alone(leaf: str) -> None:
    """And to the package itself, whose public names are imported when they are used."""
    package, known_to = f"kf_calib.{leaf}", {f"kf_calib.{name}" for name in LEAVES[leaf]}
    assert known_to <= set(MODULES)
    importing = {name for name in MODULES if any(is_in(other, package) for other in modules()[name])}
    assert {name for name in importing if not is_in(name, package)} <= known_to | {"kf_calib"}
    for name in known_to:
        among = {other for other in MODULES if name in modules()[other]}
        assert all(other in known_to or other.startswith("kf_calib.cli.") for other in among), name


@pytest.mark.parametrize("collecting", [False, *slow(True)])
def test_everything_else_is_imported_and_the_tests_of_the_core_are_collected_without_leaves(collecting: bool) -> None:
    """Commands, too, which import what they need when they run."""
    leafy = [f"kf_calib.{name}" for leaf, known_to in LEAVES.items() for name in (leaf, *known_to)
             if not name.startswith("cli.")]  # fmt: skip
    others = sorted(name for name in MODULES if not any(is_in(name, leaf) for leaf in leafy) and "__main__" not in name)
    folders = [str(ROOT / "tests" / name) for name in sorted({*CORE, "sources"})]
    code = f"""
import sys, importlib
class Missing:
    def find_spec(self, name, path=None, target=None):
        if any(name == leaf or name.startswith(leaf + ".") for leaf in {leafy}):
            raise ModuleNotFoundError(name)
sys.meta_path.insert(0, Missing())
for name in {others}:
    importlib.import_module(name)
import pytest
{collecting} and sys.exit(pytest.main(["--collect-only", "-qq", "-n", "0", "-p", "no:cacheprovider", *{folders}]))
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]


def test_nothing_lies_beside_the_packages() -> None:
    flat = sorted(path.name for path in PACKAGE.iterdir() if path.is_file() and path.suffix == ".py")
    assert set(flat) <= {"__init__.py", "__main__.py", "errors.py"}
    for package in (path for path in PACKAGE.rglob("*") if path.is_dir() and path.name not in ("__pycache__", *DATA)):
        text = (package / "__init__.py").read_text()
        assert ast.get_docstring(ast.parse(text)), package


CEILINGS = {
    "kf_calib": 190,
    "support": 1000,
    "bench": 1695,
    "effects": 3130,
    "sources": 13200,
    "dwells": 3800,
    "noise": 3420,
    "estimation": 7740,
    "design": 1880,
    "diagnosis": 5060,
    "online": 1660,
    "exchange": 4350,
    "fleet": 3560,
    "positioning": 1440,
    "reproduction": 470,
    "views": 9340,
    "cli": 4560,
}
"""How many lines each room may have. A ceiling is lowered when its room has shrunk, and raised for nothing."""
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
    assert verbs == {"save": {"kf_calib.views.figures.collection", "kf_calib.views.report.page"}}


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
