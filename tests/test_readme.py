"""What the README and the pages of docs print is what their commands give."""

import hashlib
import json
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from itertools import pairwise
from pathlib import Path

import pytest
from click.testing import CliRunner
from consoles import consoles, not_printed
from helpers.long_runs import slow
from helpers.paths import ROOT

import kf_calib
from kf_calib import effects
from kf_calib.cli import cli

README = ROOT / "README.md"
PAGES = [README, *sorted((ROOT / "docs").glob("*.md"))]
WITH_COMMANDS = [page for page in PAGES if "```console" in page.read_text()]
OF_LONG_COMMANDS = {
    "filter_and_batch.md", "fleet.md", "missing_effect.md", "no_angles.md", "own_effect.md", "plan.md", "report.md",
    "tutorial.md",
}  # fmt: skip
"""They take most of the time of all pages. The commands of the tutorial are tested from the wheel, by tools/package, in
each run of .ci/run."""
IN_SHORT = [page for page in WITH_COMMANDS if page.name not in OF_LONG_COMMANDS]
BLOCK = re.compile(r"^```(\S*)(?: \S+)?\n(.*?)^```", re.DOTALL | re.MULTILINE)
OF_OTHER_TESTS = ("--honest",)
"""Options of commands that take long, and do what tests/diagnosis/test_stepwise_selection.py proves."""
FILE = re.compile(r"^:caption: (\S+)\n\n(.*)", re.DOTALL)


@pytest.mark.parametrize("page", [README, *slow(ROOT / "docs" / "python.md")], ids=lambda page: page.name)
def test_the_python_of_a_page_prints_what_is_shown(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Blocks of Python with a block of text below each, without the effects of a user's that others have loaded."""
    shutil.copytree(ROOT / "recordings", tmp_path / "recordings")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(effects, "_registered", {})
    programs = with_text_below(page, "python")
    assert programs
    for code, shown in programs:
        exec(code, {"__name__": "__main__"})
        _assert_shown(shown, _words(capsys.readouterr().out), f"{page.name}: {code}")


@pytest.mark.slow  # .ci/run has it done from the wheel, by tools/package
@pytest.mark.usefixtures("unmeasured")
def test_the_demo_does_the_main_job_and_prints_what_is_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    out = tmp_path / "out"
    done = CliRunner().invoke(cli, ["demo", str(out)])
    assert done.exit_code == 0, f"{done.output} {done.exception}"
    ((_, shown),) = with_text_below(README, "sh")
    _assert_shown(shown, _words(done.stdout.replace(str(out), "out")), "tools/demo")
    assert "Model and measurements agree" in done.stdout
    apart = dict(re.findall(r"│ (\w+) +│ +[\d.]+ │ +[\d.]+ │ +([-+.\de]+) │", done.stdout))
    assert apart.keys() == {"block", "filterpy", "batch"} and max(map(float, apart.values())) <= 1e-6
    assert all((out / f"demo.{kind}").exists() for kind in ("mcap", "truth.json", "rrd"))


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    "page, in_short",
    [*((page, True) for page in IN_SHORT), *slow(*((page, False) for page in WITH_COMMANDS))],
    ids=lambda value: value.name if isinstance(value, Path) else None,
)
def test_the_commands_of_a_page_print_what_is_shown(
    page: Path, in_short: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = page.read_text()
    if "kf-calib certificate" in text:
        pytest.importorskip("typst", reason="typst is not there: no certificate is made")
    shutil.copytree(ROOT / "recordings", tmp_path / "recordings")
    monkeypatch.chdir(tmp_path)
    for name, content in files(text):
        Path(name).write_text(content)
    with _workers_at_once() if "kf-calib fleet" in text else nullcontext():
        for command, shown in consoles(text):
            if not (in_short and any(option in command for option in OF_OTHER_TESTS)):
                _assert_shown(shown, _said_once(command), f"{page.name}: {command!r}")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_page_is_narrow_and_its_pictures_and_links_are_there(page: Path) -> None:
    text = page.read_text()
    assert all(len(line) <= 102 for _, block in BLOCK.findall(text) for line in block.splitlines())
    assert len(re.findall(r"^# ", BLOCK.sub("", text), re.MULTILINE)) == 1
    links = [link.partition("#")[0] for link in re.findall(r"\]\(([^)]+)\)", text) if "://" not in link]
    for link in filter(None, links):
        assert (page.parent / link).is_file(), link
    for picture in (page.parent / link for link in links if link.endswith(".png")):
        assert picture.stat().st_size < 150_000


@pytest.mark.parametrize("page", [page for page in WITH_COMMANDS if page != README], ids=lambda page: page.name)
def test_a_decimal_number_in_the_prose_of_a_page_is_quoted_from_what_is_printed(page: Path) -> None:
    """Quoted in code font, word for word. Options that a reader is told of are no quotation."""
    text = page.read_text()
    shown = _words(" ".join(block for _, block in BLOCK.findall(text)))
    prose = re.sub(r"\$\$.*?\$\$|\$[^$\n]+\$", "", BLOCK.sub("", text), flags=re.DOTALL)
    quoted = [words for words in re.findall(r"`([^`]+)`", prose) if not words.startswith("-")]
    assert [words for words in quoted if re.search(r"\d[.e]-?\d", words) and _words(words) not in shown] == []
    assert re.findall(r"\d+\.\d+", re.sub(r"`[^`]+`", "", prose)) == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_of_the_project_that_a_page_names_are_there(page: Path) -> None:
    named = re.findall(r"`((?:kf_calib|docs|recordings|tests|tools)/[\w./-]*)", page.read_text())
    assert [name for name in named if not (ROOT / name).exists()] == []


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


def with_text_below(page: Path, kind: str) -> list[tuple[str, str]]:
    """Blocks of that kind that are followed by a block of text, with that."""
    blocks = BLOCK.findall(page.read_text())
    return [(own, text) for (each, own), (below, text) in pairwise(blocks) if (each, below) == (kind, "text")]


def files(text: str) -> list[tuple[str, str]]:
    """Every file that a page shows, by its caption, which commands may read."""
    found = [FILE.match(block) for _, block in BLOCK.findall(text)]
    return [(each[1], each[2]) for each in found if each]


def _said_once(command: str) -> str:
    """The same as ``_said``; what another page has had of the same command and the same files is not run again."""
    named = [Path(word).read_bytes() for word in shlex.split(command) if Path(word).is_file()]
    key = command, hashlib.sha256(b"".join(named)).hexdigest()
    if key not in _RUN:
        before = _written()
        printed = _said(command)
        changed = [path for path, state in _written().items() if before.get(path) != state]
        _RUN[key] = printed, {path: path.read_bytes() for path in changed}
    printed, files_made = _RUN[key]
    for path, content in files_made.items():
        path.write_bytes(content)
    return printed


_RUN = dict[tuple[str, str], tuple[str, dict[Path, bytes]]]()
"""What commands have printed, and the files that they have made, by the command and the files that it names."""


def _written() -> dict[Path, tuple[int, int]]:
    """The files in this folder, each with its size and the time of its last change."""
    stats = {path: path.stat() for path in Path().iterdir() if path.is_file()}
    return {path: (stat.st_size, stat.st_mtime_ns) for path, stat in stats.items()}


def _said(command: str) -> str:
    """What a command line of a page prints in this folder; ours in this process, since many starts take long, and
    without the effects of a user's that others have loaded."""
    command, _, given = command.partition(" < ")
    program, *words = shlex.split(command)
    if program == "kf-calib":
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(effects, "_registered", {})
            ours = CliRunner().invoke(cli, words, input=Path(given.strip()).read_bytes() if given else None)
        assert ours.exit_code == 0, f"{command}: {ours.output} {ours.exception}"
        return _words(ours.stdout)
    start = [sys.executable] if program == "python" else [program]
    return _words(subprocess.run([*start, *words], capture_output=True, text=True, check=True, timeout=120).stdout)


@contextmanager
def _workers_at_once() -> Iterator[None]:
    from helpers.fleet_workers import threads, used

    with threads() as client, used(client):
        yield


def _assert_shown(shown: str, printed: str, what: str) -> None:
    """Each part of what is shown, between gaps, is printed, in this order."""
    part = not_printed(shown, printed)
    assert not part, f"{what} does not print, in this place:\n{part}\nbut:\n{printed}"


def _words(text: str) -> str:
    """Pages break long lines where they like."""
    return " ".join(text.split())


def _error_in_sigma(run: kf_calib.Calibration, symbol: str, truth: dict[str, float]) -> float:
    given = run.parameters[symbol]
    assert given.value is not None and given.sigma is not None
    return abs(given.value - truth[symbol]) / given.sigma
