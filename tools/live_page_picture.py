"""The page of a live run as a picture, on a screen and on a phone: recordings/hidden.mcap, amid its last dwell."""

from __future__ import annotations

import io
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from PIL import Image
from playwright.sync_api import Browser, sync_playwright

import kf_calib
from kf_calib.views.live.content import content_of
from kf_calib.views.live.page import directions_of, gimbals_of, page_object
from kf_calib.views.live.server import PageServer

RECORDING = Path(__file__).resolve().parents[1] / "recordings" / "hidden.mcap"
_SCREENS = ((1240, 880, "light"), (400, 880, "dark"))
_GAP_PX = 24


def drawn() -> Image.Image:
    """The page twice, side by side."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    server = PageServer(0)
    server.state = _state(_amid_the_run())
    try:
        with sync_playwright() as running:
            browser = running.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
            shots = [_shot(browser, server.url, *screen) for screen in _SCREENS]
            browser.close()
    finally:
        server.close()
    picture = Image.new("RGB", (sum(shot.width for shot in shots) + _GAP_PX, shots[0].height), "#888888")
    picture.paste(shots[0], (0, 0))
    picture.paste(shots[1], (shots[0].width + _GAP_PX, 0))
    return picture


def _amid_the_run() -> kf_calib.Session:
    source = kf_calib.open_recording(RECORDING)
    session = kf_calib.Session.fed(source.bench, wanted={name: 1e-7 for name in ("K1", "K2", "K3")})
    for batch in source:
        session.ingest(batch)
    return session


def _state(session: kf_calib.Session) -> Callable[[], dict[str, Any]]:
    standing, bench = session.standing, session.source.bench
    content = content_of(standing, None, "hidden.mcap")
    made = page_object(content, directions_of(standing, bench), gimbals_of(standing, bench))
    return lambda: made


def _shot(browser: Browser, url: str, width: int, height: int, colours: str) -> Image.Image:
    page = browser.new_page(viewport={"width": width, "height": height}, color_scheme=colours)  # type: ignore[arg-type]
    page.goto(url)
    page.locator("#sphere svg").wait_for()
    return Image.open(io.BytesIO(page.screenshot())).convert("RGB")
