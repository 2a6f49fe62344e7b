"""Imports point one way, and importing the package is cheap."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "kf_calib"
LEVELS = [
    ["errors", "lock", "stage", "tails", "text"],
    ["toml_file"],
    ["outputs", "samples"],
    ["paper", "schema"],
    ["bench_keys"],
    ["bench"],
    ["effects", "mountings", "slews", "stillness"],
    ["triangle", "banded", "autoregression", "dwells", "gate", "spectrum"],
    ["averaging", "trace", "walk"],
    ["model"],
    ["folding"],
    ["noise", "blunders"],
    ["restricted"],
    ["information", "kalman", "batch", "readings", "likelihood", "odds"],
    ["periodogram"],
    ["aims", "scan", "experiment"],
    ["fitting", "inferred"],
    ["prospect", "reach", "trend"],
    ["designs", "held_out", "outlying", "tour"],
    ["planner"],
    ["advice", "running", "visibility"],
    ["sources"],
    ["calibration"],
    ["comparison", "model_file"],
    ["assessment"],
    ["drivers", "pairs", "scattering", "watch"],
    ["diagnosis"],
    ["improvement"],
    ["journal", "standing"],
    ["live"],
    ["views"],
    ["cli"],
    ["__main__"],
]
LEVEL = {name: k for k, names in enumerate(LEVELS) for name in names}


def imported(path: Path) -> set[str]:
    """Modules of the package a file imports at run time, by their first part."""
    tree = ast.parse(path.read_text())
    typing_only = {
        node
        for branch in ast.walk(tree)
        if isinstance(branch, ast.If) and getattr(branch.test, "id", "") == "TYPE_CHECKING"
        for node in ast.walk(branch)
    }
    found = set()
    for node in ast.walk(tree):
        if node in typing_only:
            continue
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "kf_calib":
            parts = node.module.split(".")
            found |= {parts[1]} if len(parts) > 1 else {alias.name for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {alias.name.split(".")[1] for alias in node.names if alias.name.startswith("kf_calib.")}
    return found


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_one_way(path: Path) -> None:
    own = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    if own == "__init__":
        return
    if own == "sources":
        assert imported(path) <= {"bench", "samples", "errors", "outputs", "sources"} | (
            {"dwells"} if path.stem == "recorder" else set()
        )
        return
    below = {name for name in LEVEL if LEVEL[name] < LEVEL[own]} | {own}
    if own in ("calibration", "diagnosis", "model"):
        below |= {"views"}  # they print themselves
    assert imported(path) <= below, imported(path) - below


def test_import_is_cheap_and_leaves_filterpy_and_rerun_alone() -> None:
    code = "import sys, kf_calib; print(*[m for m in ('filterpy', 'rerun', 'scipy', 'matplotlib') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


HEAVY = (
    "pydantic", "scipy.linalg", "scipy.optimize", "scipy.stats", "scipy.signal", "scipy.interpolate", "filterpy",
    "rerun", "rich.console", "pint", "simpleeval", "serial", "tomli_w", "matplotlib", "kf_calib.diagnosis",
    "kf_calib.cli.live", "kf_calib.cli.plan", "kf_calib.model_file", "kf_calib.comparison",
)  # fmt: skip


def test_a_replay_imports_nothing_that_it_does_not_need() -> None:
    code = (
        "import sys; from kf_calib.cli import cli; sys.argv[0] = 'kf-calib'; cli.main(sys.argv[1:], "
        f"standalone_mode=False); print(*[m for m in {HEAVY} if m in sys.modules], file=sys.stderr)"
    )
    recording = PACKAGE.parent / "recordings" / "navigation_24.mcap"
    command = [sys.executable, "-c", code, "replay", str(recording), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert json.loads(done.stdout)["dwells"] == 24
    assert done.stderr.strip() == ""
