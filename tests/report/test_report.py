"""The report as its reader has it: in a browser, light, dark and printed, without the network, whatever is in it."""

import io
import re
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.known_runs import hidden_diagnosed, hidden_improved
from matplotlib.figure import Figure
from PIL import Image

import kf_calib
from kf_calib.report import drawing
from kf_calib.report.contents import Measured, page_of
from kf_calib.report.drawing import Drawing, draw_all
from kf_calib.report.page import save
from kf_calib.views import console
from kf_calib.views.figures import style
from kf_calib.views.html import PageTable, parts_of
from kf_calib.views.terminal import ConsoleTable

EVIL = "<script>document.title='evil'</script>"
MORE_EVIL = "</script><img src=x onerror=\"document.title='evil'\">"


@pytest.fixture(scope="module")
def found() -> kf_calib.Diagnosis:
    return hidden_diagnosed()


@pytest.fixture(scope="module")
def path(found: kf_calib.Diagnosis, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of a run with a hidden effect, and with all that a recording could say made into markup."""
    bench = replace(found.before.bench, notes={"block_serial": EVIL, "note": MORE_EVIL})
    before = replace(found.before, bench=bench, warnings=(EVIL, MORE_EVIL))
    place = tmp_path_factory.mktemp("report") / "report.html"
    measured = Measured(MORE_EVIL, "6e21", datetime(2025, 6, 15, tzinfo=UTC))
    page = page_of(replace(found, before=before), [measured], [EVIL], [EVIL])
    save(page, place)
    return place


@pytest.fixture
def told() -> list[str]:
    return []


LIGHT = pytest.mark.parametrize("shown", ["light"], indirect=True)
"""Where colours do not matter."""
DARK = pytest.mark.parametrize("shown", ["dark"], indirect=True)


@pytest.fixture(params=["light", "dark"])
def shown(browser: Any, path: Path, told: list[str], request: pytest.FixtureRequest) -> Iterator[Any]:
    """The page, open; what the browser complains of, and asks for beside the page, is told."""
    page = browser.new_page(viewport={"width": 1200, "height": 700}, color_scheme=request.param)
    page.on("console", lambda message: told.append(message.text))
    page.on("pageerror", lambda error: told.append(str(error)))
    page.on("dialog", lambda dialog: told.append(dialog.message))
    page.on("request", lambda each: None if each.url in (path.as_uri(),) or each.url.startswith("data:")
            else told.append(each.url))  # fmt: skip
    page.goto(path.as_uri())
    yield page
    page.close()


@pytest.mark.slow
@LIGHT
def test_every_figure_has_ink_and_nothing_is_asked_or_complained_of(shown: Any, told: list[str]) -> None:
    drawn = shown.locator(".drawing svg, .drawing img, .plot canvas")
    assert drawn.count() >= 3
    page = Image.open(io.BytesIO(shown.screenshot(full_page=True))).convert("L")
    for box in (drawn.nth(k).bounding_box() for k in range(drawn.count())):
        assert _ink(page.crop((box["x"], box["y"], box["x"] + box["width"], box["y"] + box["height"]))) > 0.003
    assert shown.title().endswith(MORE_EVIL) and "evil" != shown.title()
    assert shown.locator("img:not([src^='data:image/png'])").count() == 0
    assert told == []


def test_figures_are_light_on_dark_and_dark_on_light(shown: Any, told: list[str]) -> None:
    """All but those on a white card, which is white in the dark, too."""
    ground = _brightness(shown.evaluate("getComputedStyle(document.documentElement).backgroundColor"))
    for kind, expected in ((":not(.card)", ground), (".card", 255)):
        figures = shown.locator(f".drawing{kind} svg")
        assert figures.count()
        for k in range(figures.count()):
            grey = np.asarray(Image.open(io.BytesIO(figures.nth(k).screenshot())).convert("L")).astype(float)
            assert abs(np.median(grey) - expected) < 12
            assert np.abs(grey - expected).max() > 160  # ink, and not only lines that are hardly seen
    assert told == []


@LIGHT
def test_nothing_is_wider_than_the_page(shown: Any) -> None:
    assert shown.evaluate("document.documentElement.scrollWidth") <= 1200


@LIGHT
def test_the_explorer_shows_what_is_chosen(shown: Any, found: kf_calib.Diagnosis, told: list[str]) -> None:
    place, canvas = shown.locator(".plot").first, shown.locator(".plot canvas").first
    pictures = [canvas.screenshot()]
    for name, choice in (
        ("driver", {"index": shown.locator("select[name=driver] option").count() - 1}),
        ("model", {"label": "with hysteresis"}),
        ("unit", {"value": "sigma"}),
    ):
        shown.locator(f"select[name={name}]").select_option(**choice)
        pictures.append(place.locator("canvas").screenshot())
    shown.locator("input[name=a2]").uncheck()
    pictures.append(place.locator("canvas").screenshot())
    assert len(set(pictures)) == len(pictures)
    assert told == []


@LIGHT
def test_the_explorer_reads_out_the_residual_of_a_dwell(shown: Any, found: kf_calib.Diagnosis) -> None:
    options = shown.locator("select[name=driver] option").all_inner_texts()
    first = next(k for k, text in enumerate(options) if "must explain" not in text)  # shapes of effects come before
    shown.locator("select[name=driver]").select_option(index=first)
    shown.locator(".plot").scroll_into_view_if_needed()
    box, readout = shown.locator(".plot .u-over").bounding_box(), shown.locator(".readout")
    for x, y in product(np.linspace(0.1, 0.9, 9), np.linspace(0.2, 0.8, 7)):
        shown.mouse.move(box["x"] + x * box["width"], box["y"] + y * box["height"])
        if "Dwell" in readout.inner_text():
            break
    text = readout.inner_text().replace("−", "-")
    dwell, channel = map(int, re.search(r"Dwell (\d+), accelerometer (\d)", text).groups())
    residual, sigma = map(float, re.search(r"residual (\S+) ± (\S+) µg", text).groups())
    table = found.before.residuals()
    (row,) = table[(table["dwell"] == dwell) & (table["accelerometer"] == channel)]
    micro_g = 9.80665e-6
    assert residual == pytest.approx(row["residual_mps2"] / micro_g, rel=1e-3)
    assert sigma == pytest.approx(row["sigma_mps2"] / micro_g, rel=1e-3)
    angles = [float(each) for each in re.search(r"gimbals at (.*?) deg", text)[1].split(", ")]
    assert angles == pytest.approx([row[f"gimbal{k}_deg"] for k in (1, 2, 3)], rel=1e-3, abs=1e-3)


@DARK
def test_print_has_the_figures_and_leaves_out_what_needs_a_hand(shown: Any) -> None:
    shown.emulate_media(media="print")
    assert not shown.locator(".explorer").first.is_visible() and not shown.locator("nav").is_visible()
    assert shown.locator(".drawing svg").first.is_visible()
    assert _brightness(shown.evaluate("getComputedStyle(document.documentElement).backgroundColor")) == 255
    pages = re.findall(rb"/Type\s*/Page\b", shown.pdf(prefer_css_page_size=True))
    assert 3 <= len(pages) <= 16


def test_what_a_recording_says_is_text(path: Path) -> None:
    html = path.read_text()
    assert EVIL not in html and MORE_EVIL not in html and html.count("&lt;script&gt;") >= 3
    assert len(re.findall(r"<script\b", html)) == 3  # what the explorer reads, uPlot, the explorer
    assert re.findall(r'(?:src|href)="(?!#|data:)', html) == []
    assert "2025-06-15" in html


@pytest.mark.slow
def test_the_same_result_is_the_same_file_and_a_small_one(found: kf_calib.Diagnosis, path: Path) -> None:
    pages = [page_of(found, [Measured("a", "b")], []).html for _ in range(2)]
    assert pages[0] == pages[1]
    assert path.stat().st_size < 1.5e6


def test_numbers_are_those_of_the_console_with_their_points_in_line(found: kf_calib.Diagnosis) -> None:
    drawn = console.parameter_table(found.before)
    (table,) = parts_of(drawn)
    assert isinstance(table, PageTable)
    printed = [[str(cell) for cell in column.cells] for column in drawn.columns]
    assert [[str(cell).replace("−", "-") for cell in column] for column in zip(*table.rows, strict=True)] == printed
    for heading, column in zip(table.headings, zip(*table.rows, strict=True), strict=True):
        widths = {(len(cell.fraction + cell.fraction_room), cell.rest_room) for cell in column}
        assert len(widths) == 1 or not heading.is_number
    assert "<i" not in str(table.rows[0][1])


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("-0.52", ("−0", ".52", "")), ("7.3e-30", ("7", ".3e-30", "")), ("< 1e-300", ("< 1", "e-300", "")),
        ("0.5089 deg", ("0", ".5089", " deg")), ("not seen", ("not seen", "", "")), ("", ("", "", "")),
        ("145.5 / 3", ("145", ".5", " / 3")), ("-80.7, 178.0", ("−80", ".7", ", 178.0")),
    ],
)  # fmt: skip
def test_a_number_is_split_at_its_decimal_point(text: str, parts: tuple[str, str, str]) -> None:
    table = ConsoleTable()
    table.add_column("x", justify="right")
    table.add_row(text)
    (shown,) = parts_of(table)
    assert isinstance(shown, PageTable)
    cell = shown.rows[0][0]
    assert (cell.whole, cell.fraction, cell.rest) == parts


def many_points(seed: int, count: int = 20_000) -> Figure:
    with style.styled():
        figure = style.blank()
        values = np.random.default_rng(seed).normal(size=(2, count))
        for axes in figure.subplots(1, 2).flat:
            axes.plot(*values, "o", color=style.ACCELEROMETERS[0], markersize=1.5)
            axes.axhline(0.0, color="#6b6b6b")
    return figure


def test_figures_of_many_points_stay_small() -> None:
    few = Figure()
    few.subplots().plot([1, 2, 3], "o", color=style.ACCELEROMETERS[1])
    drawings = [Drawing("many", lambda: many_points(1), "many"), Drawing("few", lambda: few, "few")]
    draw_all(drawings)
    many, small = (drawing.markup for drawing in drawings)
    assert len(many) < 400_000 and "data:image/png" in many and many.startswith("<svg") and not drawings[0].on_white
    assert "data:image" not in small and small.count("<use") >= 3 and "#009e73" in small


def test_figures_of_a_page_share_no_name_that_something_refers_to() -> None:
    drawings = [Drawing(f"{k}", partial(many_points, 1, 100 + k), f"d{k}") for k in range(2)]
    draw_all(drawings)
    first, second = (set(re.findall(r'(?:href="#|url\(#)([^")]+)', drawing.markup)) for drawing in drawings)
    assert first and second and not first & second


def test_what_is_still_too_large_is_a_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drawing, "_MOST", 1_000)
    drawings = [Drawing(f"{k}", partial(many_points, k, 2_000), f"d{k}") for k in range(2)]
    draw_all(drawings)
    for each in drawings:
        assert each.on_white and each.markup.startswith("<img") and len(each.markup) < 250_000


def test_copies_of_the_process_draw_what_it_would_draw_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    pages = []
    for cores in (1, 3):
        monkeypatch.setattr(drawing, "_cores", lambda cores=cores: cores)
        drawings = [Drawing(f"{k}", partial(many_points, k, 40), f"d{k}") for k in range(4)]
        draw_all(drawings)
        pages.append([each.markup for each in drawings])
    assert pages[0] == pages[1] and len(set(pages[0])) == 4


def test_letters_of_a_figure_are_text_that_can_be_searched() -> None:
    figure = Figure()
    figure.suptitle("a < b & c")
    (shown,) = drawings = [Drawing("letters", lambda: figure, "l")]
    draw_all(drawings)
    assert "a &lt; b &amp; c</text>" in shown.markup


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_on_a_phone_the_sigmas_are_seen_and_what_is_wider_says_so(browser: Any, path: Path, scheme: Any) -> None:
    page = browser.new_page(viewport={"width": 400, "height": 800}, color_scheme=scheme)
    page.goto(path.as_uri())
    assert page.evaluate("document.documentElement.scrollWidth") <= 400
    table = page.locator("table", has=page.locator("caption", has_text="Parameters (1σ)")).first
    sigma = table.locator("th", has_text="sigma").first.bounding_box()
    assert sigma["x"] + sigma["width"] <= 400
    hints = page.evaluate(
        "[...document.querySelectorAll('.table, .drawing')].filter(each => each.scrollWidth > each.clientWidth)"
        ".map(each => [getComputedStyle(each).backgroundAttachment,"
        " each.matches('.table') || getComputedStyle(each, '::before').content.includes('swipe')])"
    )
    assert len(hints) >= 5 and all("local" in shadow and "scroll" in shadow and told for shadow, told in hints)
    page.close()


def test_a_page_gives_one_verdict_and_not_that_of_the_misfit_as_a_whole_beside_it(path: Path) -> None:
    html = path.read_text()
    assert html.count("Residuals fail") == 1 and "noise alone gives a misfit this large" not in html


def test_the_contents_name_every_section_of_the_page(path: Path) -> None:
    html = path.read_text()
    listed = re.findall(r'<li><a href="#(\w+)">([^<]*)</a>', html)
    assert [name for name, _ in listed] == re.findall(r'<section id="(\w+)"', html)
    assert all(text.strip() for _, text in listed)


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_the_page_of_an_improvement_leads_with_the_story_and_the_picture_of_the_steps() -> None:
    state = hidden_improved()
    page = page_of(state, [Measured("hidden.mcap", "6e21")], [])
    wrong, added, brought, left = page.verdict
    assert wrong.startswith("What was wrong: ") and "off by" in wrong
    assert added.startswith("What was added: hysteresis, ") and "±" in added and "probability" in added
    before, after = (state.start.before.held_out_rms_mps2, state.result.held_out_rms_mps2)
    floor = state.result.held_out_floor_mps2
    assert before and after and floor and f"from {before / floor:.2f} to {after / floor:.2f} times" in brought
    assert left == f"What is left: {state.reason}"
    first = page.sections[0].parts[0]
    assert isinstance(first, Drawing) and first.title == "The error falls"


def _ink(picture: Image.Image) -> float:
    """The share of pixels that are not like the paper, which most are."""
    pixels = np.asarray(picture, float)
    return float(np.mean(np.abs(pixels - np.median(pixels)) > 40))


def _brightness(colour: str) -> float:
    """Mean of red, green and blue, 0 to 255, of what a browser says of a colour."""
    numbers = [float(each) for each in re.findall(r"[\d.]+", colour.removeprefix("color(srgb"))[:3]]
    return float(np.mean(numbers)) * (255.0 if colour.startswith("color(") else 1.0)
