"""The documentation as a reader has it: it builds, its links lead somewhere, a browser shows it without the network."""

import json
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import pytest
import reference_pages
from helpers.long_runs import slow

import kf_calib

pytest.importorskip("sphinx", reason="Sphinx is not there: the documentation is not built")

DOCS = Path(__file__).resolve().parents[1] / "docs"


class Page(HTMLParser):
    """What an HTML page links to, what it loads, and its anchors."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links, self.loads, self.anchors = list[str](), list[str](), set[str]()
        self.feed(path.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.anchors |= {name for name in (given.get("id"), given.get("name")) if name}
        self.loads += [given["src"]] if given.get("src") else []
        if href := given.get("href"):
            (self.links if tag == "a" else self.loads).append(href)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built as tools/docs does, with warnings as errors."""
    out = tmp_path_factory.mktemp("site")
    words = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-d", out / "doctrees", DOCS, out / "html"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return out / "html"


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, Page]:
    return {path: Page(path) for path in site.rglob("*.html")}


def test_every_source_is_a_page(site: Path) -> None:
    assert {path.stem for path in DOCS.glob("*.md")} <= {path.stem for path in site.glob("*.html")}


def test_every_link_within_the_site_leads_to_a_page_and_a_place_in_it(pages: dict[Path, Page]) -> None:
    dead = [
        (path.name, link)
        for path, page in pages.items()
        for link in [*page.links, *page.loads]
        if not urlsplit(link).scheme and not _leads_somewhere(path, link, pages)
    ]
    assert dead == []


def test_a_page_loads_nothing_from_elsewhere(pages: dict[Path, Page]) -> None:
    loads = [(path.name, each) for path, page in pages.items() for each in page.loads]
    assert loads and [each for each in loads if urlsplit(each[1]).scheme not in ("", "data")] == []


def test_commands_effects_and_public_names_are_all_there(pages: dict[Path, Page]) -> None:
    anchors = {path.name: page.anchors for path, page in pages.items()}
    assert {name.lower().replace("_", "-") for name in kf_calib.__all__} <= {
        each.replace("_", "-") for each in anchors["api.html"]
    }
    listed = json.loads(_printed("effects", "--json"))["effects"]
    assert {each["effect"].partition(":")[0] for each in listed} <= anchors["effects.html"]
    commands = {"demo", "simulate", "record", "live", "replay", "compare", "diagnose", "improve", "report", "plan",
                "paper", "info"}  # fmt: skip
    assert commands <= anchors["command_line.html"]


def test_pages_of_reference_are_as_the_program_says() -> None:
    """tools/reference_pages.py writes them anew after a change of help, docstrings or effects."""
    for path, text in reference_pages.pages().items():
        assert path.read_text() == text, f"{path.name}: python tools/reference_pages.py"


def test_equations_are_mathml_without_a_command_of_tex_left_over(site: Path) -> None:
    for path in site.glob("*.html"):
        equations = re.findall(r"<math\b.*?</math>", path.read_text(), re.DOTALL)
        assert len(equations) > 50 or path.stem != "filter"
        assert [each for each in equations if "\\" in each] == [], path.name


@pytest.mark.parametrize("pages", ["filter index search", *slow("*")])
def test_a_browser_shows_every_page_without_an_error_and_asks_nobody(browser: Any, site: Path, pages: str) -> None:
    told, asked, shown = list[str](), list[str](), browser.new_page()
    shown.on("console", lambda message: told.append(f"{shown.url}: {message.text}"))
    shown.on("pageerror", lambda error: told.append(f"{shown.url}: {error}"))
    shown.on("requestfailed", lambda request: told.append(f"{shown.url}: {request.url} cannot be loaded"))
    shown.on("request", lambda request: asked.append(request.url))
    for path in sorted(path for name in pages.split() for path in site.glob(f"{name}.html")):
        shown.goto(path.as_uri())
        assert shown.locator("h1").first.is_visible() or path.stem in ("search", "genindex"), path.name
    assert told == []
    assert asked and [url for url in asked if urlsplit(url).scheme not in ("file", "data")] == []


def test_the_search_of_the_site_finds_a_page(browser: Any, site: Path) -> None:
    shown = browser.new_page()
    shown.goto(f"{(site / 'search.html').as_uri()}?q=innovation")
    found = shown.locator("#search-results li a", has_text="From a reading to the posterior")
    found.first.wait_for()  # results come one after the other
    assert found.first.is_visible()


def _leads_somewhere(page: Path, link: str, pages: dict[Path, Page]) -> bool:
    parts = urlsplit(link)
    target = (page.parent / unquote(parts.path)).resolve() if parts.path else page
    place = unquote(parts.fragment)
    return target.is_file() and (not place or target not in pages or place in pages[target].anchors)


def _printed(*words: str) -> str:
    command = [sys.executable, "-m", "kf_calib.cli", *words]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=120).stdout
