"""The command report and the option --report: the files they write, what they print, and what they refuse."""

import re
import sys
from pathlib import Path

import pytest
from helpers.paths import ROOT

from kf_calib import errors

HIDDEN, CLEAN = (ROOT / "recordings" / name for name in ("hidden.mcap", "navigation_24.mcap"))


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.usefixtures("undrawn")
def test_a_report_says_its_verdict_and_how_it_was_made_and_strict_ends_with_1(run) -> None:
    code, out, err = run("report", HIDDEN, "--settle-s", 1.5, "--no-gate", "--strict")
    assert (code, err) == (1, "") and out.endswith("saved report.html\n")
    page = Path("report.html").read_text()
    assert "Missing: hysteresis" in out and "Missing: hysteresis" in page
    commands = re.search(r"<pre>(.*?)</pre>", page, re.DOTALL)[1].splitlines()
    assert commands == [
        f"kf-calib report {HIDDEN} --settle-s 1.5 --no-gate", f"kf-calib replay {HIDDEN} --settle-s 1.5 --no-gate",
        f"kf-calib diagnose {HIDDEN} --settle-s 1.5 --no-gate", f"sha256sum {HIDDEN}",
    ]  # fmt: skip


@pytest.mark.usefixtures("undrawn")
def test_the_name_of_a_file_is_text(run) -> None:
    name = Path("<img src=x onerror=alert(1)>.mcap")
    name.write_bytes(CLEAN.read_bytes())
    assert run.json("report", name)["consistent"] is True
    page = Path("report.html").read_text()
    assert "<img src=x" not in page and "&lt;img src=x" in page
    assert "Where the model fails" not in page


def test_what_is_there_stays_without_overwrite(run) -> None:
    Path("report.html").write_text("mine")
    assert "--overwrite" in run.refused("report", CLEAN)
    assert Path("report.html").read_text() == "mine"


@pytest.mark.slow
def test_two_models_side_by_side(run) -> None:
    assert run("replay", HIDDEN, "--with", "hysteresis", "--save-model", "after.toml")[0] == 0
    printed = run.json("report", HIDDEN, "--against", "after.toml")
    assert printed["consistent"] is False and printed["against"]["consistent"] is True
    by_symbol = {each["symbol"]: each for each in printed["differences"]}
    assert 4 < abs(by_symbol["K1"]["sigmas"]) < 5 and printed["differences_p_value"] is None
    assert "twelve parameters + hysteresis" in Path("report.html").read_text()


def test_a_model_to_compare_with_is_not_written_over(run) -> None:
    Path("other.toml").write_text('effects = ["hysteresis"]\n')
    err = run.refused("report", HIDDEN, "--against", "other.toml", "--out", "other.toml", "--overwrite")
    assert "is read by this very command" in err
    assert Path("other.toml").read_text().startswith("effects")


@pytest.mark.parametrize("against", ["absent.mcap", "absent.toml"])
def test_what_cannot_be_read_is_a_sentence(run, against: str) -> None:
    assert against in run.refused("report", CLEAN, "--against", against)


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("improve", HIDDEN, "--unattended"), "What is left: Nothing is left that noise would not leave (p ="),
        pytest.param(("compare", CLEAN), "differ by at most", marks=pytest.mark.slow),
    ],
)
def test_improve_and_compare_save_a_page_too(run, words: tuple[object, ...], says: str) -> None:
    code, out, err = run(*words, "--report", "page.html")
    assert (code, err) == (0, "") and "saved page.html" in out
    page = Path("page.html").read_text()
    assert says in page and 'class="explorer"' in page and "undefined" not in page.partition("<script")[0]


def test_without_jinja_the_sentence_says_what_to_install(run, monkeypatch: pytest.MonkeyPatch) -> None:
    found = errors.find_spec
    monkeypatch.setattr(errors, "find_spec", lambda name: None if name == "jinja2" else found(name))
    for name in [name for name in sys.modules if name.startswith("kf_calib.report")]:
        monkeypatch.delitem(sys.modules, name)
    assert "pip install 'kf_calib[report]'" in run.refused("report", CLEAN)
    assert not Path("report.html").exists()
