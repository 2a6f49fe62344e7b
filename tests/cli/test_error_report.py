"""The report of an error that was not foreseen: what a maintainer needs, and nothing of the user's data."""

import re
import shutil
import tempfile
from pathlib import Path

import pytest

from kf_calib.cli.failures import without_values

RECORDING = Path(__file__).resolve().parents[2] / "recordings" / "hidden.mcap"
SECRET = "turbine-9"


@pytest.fixture
def failing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A recording whose result cannot be printed, by an error that has its name in its message."""

    def fail(*_: object) -> None:
        try:
            float(SECRET)
        except ValueError:
            raise KeyError(SECRET) from None

    monkeypatch.setattr("kf_calib.views.console.summary", fail)
    shutil.copy(RECORDING, tmp_path / f"{SECRET}.mcap")
    return tmp_path / f"{SECRET}.mcap"


def test_the_sentence_names_a_report_that_holds_none_of_the_data(
    run, tmp_path: Path, failing: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (temporary := tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    err = run.refused("replay", failing, "--with=second-order", "--gravity", "9.81")
    (report,) = temporary.iterdir()
    assert f"{report}, which holds none of your data" in err
    text = report.read_text(encoding="utf-8")
    assert SECRET not in text and str(tmp_path) not in text and str(Path.home()) not in text
    assert "command: replay · --with --gravity ·\n" in text and "\nKeyError\n" in text and "\nValueError\n" in text
    assert re.search(r"kf_calib.cli.replay\.py:\d+ in ", text) and re.search(r"numpy \d+\.\d+", text)


def test_where_no_report_can_be_written_the_traceback_is_asked_for(
    run, tmp_path: Path, failing: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "nowhere"))
    code, _, err = run("replay", failing)
    assert code == 2 and "please report it, with the traceback that KF_CALIB_TRACEBACK=1" in err


@pytest.mark.parametrize(
    "words, kept",
    [
        (["replay", "a.mcap", "--with", "b", "--json"], "replay · --with · --json"),
        (["live", "--axes=y z", "-oout.html", "-1,2,3"], "live --axes -o ·"),
        (["a.mcap"], "·"),
    ],
)
def test_of_what_was_typed_the_names_of_options_are_kept(words: list[str], kept: str) -> None:
    assert " ".join(without_values(words)) == kept
