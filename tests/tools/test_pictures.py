"""The pictures of README and docs are those that tools/pictures draws today."""

import re

import numpy as np
import pictures
import pytest
from helpers.paths import ROOT
from PIL import Image


@pytest.mark.parametrize("name", pictures.PICTURES)
def test_a_picture_was_drawn_from_what_there_is_today(name: str) -> None:
    picture = Image.open(pictures.DOCS / f"{name}.png")
    assert picture.text[pictures.KEY] == pictures.drawn_from(), "stale: run tools/pictures"
    assert picture.width >= 1200 and np.ptp(np.asarray(picture.convert("L"))) > 150


def test_every_picture_of_the_pages_is_drawn_by_a_tool_and_every_drawn_one_is_shown() -> None:
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    shown = {name for page in pages for name in re.findall(r"!\[[^\]]*\]\((?:docs/)?([\w]+)\.png\)", page.read_text())}
    drawn = {*pictures.PICTURES, *pictures.OF_SCRIPTS}
    of_a_trial = {"blind_trial", "blind_trial_reliability"}  # which draws them at its end, after hours
    assert shown == drawn | of_a_trial
    assert {path.stem for path in (ROOT / "docs").glob("*.png")} == drawn | of_a_trial
