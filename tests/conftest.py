"""Paths and fixtures shared by the tests."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy: a process a core is enough
os.environ["COLUMNS"] = ""
del os.environ["COLUMNS"]  # readline sets it behind Python's back, and a child would print tables that narrow

from kf_calib.cli import main

SHARED = Path(__file__).resolve().parents[2] / "shared" / "recordings"


@pytest.fixture
def ferraris() -> Path:
    """A real recording made by others; kept beside the project, not in it."""
    path = SHARED / "ferraris_hand.mcap"
    if not path.exists():
        pytest.skip(f"{path} is not there: the recordings of others are kept outside the project")
    return path


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """The command line: exit code, what it prints, what it prints to the error stream."""

    def call(*words: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["kf-calib", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            main()
        out, err = capsys.readouterr()
        return int(ended.value.code or 0), out, err

    return call
