"""Set-up of a checkout where there is no shell."""

import os
import sys
from collections.abc import Sequence
from pathlib import Path

import checkout
import pytest


class Commands(list[list[str]]):
    """Commands as they would have been run; the one that holds ``failing`` ends with 7."""

    def __init__(self, environment: Path, failing: str = "-- none --") -> None:
        super().__init__()
        self._environment, self._failing = environment, failing

    def __call__(self, command: Sequence[str]) -> int:
        self.append([*command])
        self._environment.mkdir(exist_ok=True)
        return 7 if self._failing in command else 0


@pytest.mark.parametrize("system, python", [("nt", "Scripts/python.exe"), ("posix", "bin/python")])
def test_packages_are_set_up_once_and_by_their_hashes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, system: str, python: str
) -> None:
    inside = str(tmp_path / "venv" / python)
    commands = Commands(tmp_path / "venv")
    monkeypatch.setattr(checkout, "python_of", lambda environment: environment / python)
    for _ in range(2):
        assert checkout.main(["demo", "out", "--json"], commands, tmp_path / "venv") == 0
    made, locked, project, *demos = commands
    assert made[:4] == [sys.executable, "-m", "venv", "--clear"]
    assert locked[0] == inside and "--require-hashes" in locked and locked[-1].endswith("requirements.lock")
    assert project[0] == inside and "--no-deps" in project
    assert demos == [[inside, "-m", "kf_calib", "demo", "out", "--json"]] * 2


def test_a_changed_lock_is_set_up_anew(tmp_path: Path) -> None:
    commands = Commands(tmp_path / "venv")
    assert checkout.main(["test", "-n", "2"], commands, tmp_path / "venv") == 0
    (tmp_path / "venv" / "kf_calib-checkout").write_text("test of another lock\n")
    assert checkout.main(["test"], commands, tmp_path / "venv") == 0
    assert len(commands) == 2 * 4 and commands[3][1:] == ["-m", "pytest", "-n", "2"]


def test_what_fails_is_said_and_not_taken_for_done(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    failing = Commands(tmp_path / "venv", failing="--require-hashes")
    assert checkout.main(["demo"], failing, tmp_path / "venv") == 7
    assert "ended with 7: mend that, and run it again." in capsys.readouterr().err
    assert len(failing) == 2 and not (tmp_path / "venv" / "kf_calib-checkout").exists()


@pytest.mark.parametrize("words", [[], ["install"]])
def test_another_word_is_answered_with_the_usage(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert checkout.main(words, lambda _: 0) == 2 and "usage: py tools/checkout.py demo" in capsys.readouterr().err


def test_the_python_inside_is_where_venv_puts_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert checkout.python_of(tmp_path) == Path(sys.executable.replace(sys.prefix, str(tmp_path))).with_name("python")
    monkeypatch.setattr(os, "name", "nt")
    assert str(checkout.python_of(tmp_path)).endswith("Scripts/python.exe")
