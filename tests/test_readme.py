"""What the README and the pages of docs print is what their commands give."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner
from long_runs import slow

import kf_calib
from kf_calib.cli import cli

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
PAGES = [README, *sorted((ROOT / "docs").glob("*.md"))]
GAP = "\n...\n"
WIDTH = 100  # columns of a page's blocks, and of the terminal that its commands print on


def test_the_demo_does_the_main_job_and_prints_what_is_shown(tmp_path: Path) -> None:
    """In a process of its own."""
    out = tmp_path / "out"
    words = [sys.executable, "-m", "kf_calib.cli", "demo", str(out)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    text = README.read_text()
    shown = re.search(r"```text\n(.*?)^```", text[text.index("tools/demo") :], re.DOTALL | re.MULTILINE)
    assert shown
    _assert_shown(shown[1], done.stdout.replace(str(out), "out"), "tools/demo")
    assert "Model and measurements agree" in done.stdout
    apart = dict(re.findall(r"│ (\w+) +│ +[\d.]+ │ +[\d.]+ │ +([-+.\de]+) │", done.stdout))
    assert apart.keys() == {"block", "filterpy", "batch"} and max(map(float, apart.values())) <= 1e-6
    assert all((out / f"demo.{kind}").exists() for kind in ("mcap", "truth.json", "rrd"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
@pytest.mark.parametrize("left_out", ["--honest", *slow(None)])
def test_the_commands_of_a_page_print_what_is_shown(
    page: Path, left_out: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = page.read_text()
    _make_files(text, tmp_path)
    monkeypatch.chdir(tmp_path)
    for command, shown in consoles(text):
        if left_out and left_out in command:
            continue
        _assert_shown(shown, _said(command), f"{page.name}: {command!r}")


@pytest.mark.parametrize("page", [README, ROOT / "docs" / "python.md"], ids=lambda page: page.name)
def test_the_python_of_a_page_prints_what_is_shown(page: Path, tmp_path: Path) -> None:
    """A block of Python with a block of text below it, in a process of its own."""
    text = page.read_text()
    _make_files(text, tmp_path)
    programs = re.findall(r"^```python\n((?:(?!```).)*?)^```\n\n```text\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    assert programs
    for code, shown in programs:
        done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        _assert_shown(shown, done.stdout, f"{page.name}: {code}")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_page_is_narrow_and_its_pictures_and_links_are_there(page: Path) -> None:
    text = page.read_text()
    blocks = re.findall(r"^```\w*\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    assert all(len(line) <= WIDTH for block in blocks for line in block.splitlines())
    links = [link for link in re.findall(r"\]\(([^)]+)\)", text) if "://" not in link]
    for link in links:
        target, _, place = link.partition("#")
        other = page.parent / target if target else page
        assert other.is_file(), link
        assert not place or place in _anchors(other.read_text()), link
    for picture in (page.parent / link for link in links if link.endswith(".png")):
        assert picture.stat().st_size < 150_000


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_page_has_one_title(page: Path) -> None:
    prose = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    assert len(re.findall(r"^# ", prose, re.MULTILINE)) == 1 and prose.startswith("# ")


def test_the_readme_and_the_changelog_are_short() -> None:
    assert len(README.read_bytes()) <= 9000
    assert len((ROOT / "CHANGELOG.md").read_bytes()) <= 4000


KEYS_OF = {
    "replay": "replay hidden.mcap --json",
    "diagnose": "diagnose hidden.mcap --json",
    "improve": "improve hidden.mcap --unattended --json",
    "compare": "compare navigation_24.mcap --json",
    "plan": "plan --count 4 --beside-paper --json",
    "effects": "effects hysteresis --recording hidden.mcap --json",
    "paper": "paper --repetitions 2 --json",
    "record": "record faces.mcap faces.csv --axes 'y z x' --gravity 9.81 --json",
    "simulate": "simulate made.mcap --dwell-s 2 --slew-degps 180 --json",
    "live": "live navigation_24.mcap --json",
}


@pytest.mark.parametrize("name", KEYS_OF)
def test_the_keys_of_json_are_those_of_the_page(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All keys of an object, and no others, stand in the first column of the tables under the command's heading."""
    shutil.copytree(ROOT / "recordings", tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(cli, shlex.split(KEYS_OF[name]))
    assert done.exit_code == 0, done.output
    printed = json.loads(done.stdout.splitlines()[-1])
    shared = {"live": {"replay", "diagnose", "live"}}.get(name, {name})
    assert printed.keys() == set().union(*(_keys_of(each) for each in shared))


def _keys_of(name: str) -> set[str]:
    sections = re.split(r"^## ", (ROOT / "docs" / "json-keys.md").read_text(), flags=re.MULTILINE)
    (own,) = (section for section in sections if section.startswith(f"`{name}`"))
    firsts = [line.split("|")[1] for line in own.splitlines() if line.startswith("| `")]
    return {key for first in firsts for key in re.findall(r"`(\w+)[^`]*`", first)}


def test_the_effect_that_was_hidden_spoils_the_scale_factors_until_it_is_in_the_model() -> None:
    """What the tutorial says of the side file: 4 to 7 sigma before, within 1 after."""
    recordings = ROOT / "recordings"
    truth = json.loads((recordings / "hidden.truth.json").read_text())
    (effect,) = truth["effects"]
    before = kf_calib.calibrate(kf_calib.open_recording(recordings / "hidden.mcap"))
    after = kf_calib.calibrate(
        kf_calib.open_recording(recordings / "hidden.mcap"), kf_calib.Settings(effects=(effect["name"],))
    )
    for symbol in ("K1", "K2", "K3"):
        wrong, right = (_error_in_sigma(run, symbol, truth["parameters"]) for run in (before, after))
        assert 4 < wrong < 7
        assert right < 1
    for given, size in zip(list(after.parameters.values())[12:], effect["sizes"].values(), strict=True):
        assert given.value is not None and given.sigma is not None
        assert abs(given.value - size) < 1.5 * given.sigma


def consoles(text: str) -> list[tuple[str, str]]:
    """Every command of the console blocks, with what is shown below it; a backslash goes on in the next line."""
    blocks = re.findall(r"^```console\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    parts = [part for block in blocks for part in re.split(r"^\$ ", block.replace("\\\n", " "), flags=re.MULTILINE)[1:]]
    return [(command, shown) for command, _, shown in (part.partition("\n") for part in parts)]


def _make_files(text: str, folder: Path) -> None:
    """What a page needs: the recordings, and each block of a page that begins with a comment that is a file's name."""
    shutil.copytree(ROOT / "recordings", folder / "recordings")
    for name, content in re.findall(r"^```\w+\n# (\S+\.(?:py|toml))\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
        (folder / name).write_text(content)


def _said(command: str) -> str:
    """What a command line of a page prints in this folder; ours in this process, since many starts take long, but for
    those that load effects, which would stay."""
    program, *words = shlex.split(command)
    if program == "kf-calib" and "--effects-from" in words:
        program, words = sys.executable, ["-m", "kf_calib.cli", *words]
    if program == "kf-calib":
        ours = CliRunner(env={"COLUMNS": str(WIDTH)}).invoke(cli, words)
        assert ours.exit_code == 0, f"{command}: {ours.output} {ours.exception}"
        return ours.stdout
    own = os.environ | {"COLUMNS": str(WIDTH)}
    return subprocess.run([program, *words], capture_output=True, text=True, check=True, timeout=120, env=own).stdout


def _assert_shown(shown: str, printed: str, what: str) -> None:
    """Each part of what is shown, between gaps, is printed, in this order; lines are broken anywhere."""
    place, printed = 0, _words(printed)
    for part in map(_words, f"\n{shown}\n".split(GAP)):
        found = printed.find(part, place)
        assert found >= 0, f"{what} does not print, in this place:\n{part}\nbut:\n{printed}"
        place = found + len(part)


def _anchors(text: str) -> set[str]:
    """Of the headings, as GitHub and MyST make them."""
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def _words(text: str) -> str:
    """Pages break long lines where they like."""
    return " ".join(text.split())


def _error_in_sigma(run: kf_calib.Calibration, symbol: str, truth: dict[str, float]) -> float:
    given = run.parameters[symbol]
    assert given.value is not None and given.sigma is not None
    return abs(given.value - truth[symbol]) / given.sigma
