"""A browser without a window, for pages that the project makes."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

_CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@contextmanager
def chromium() -> Iterator[Any]:
    """Chromium by playwright; the test is skipped where one of them is not there."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not there: no browser is asked")
    if _CHROMIUM is None:
        pytest.skip("no Chromium is there (Debian: apt-get install chromium): no browser is asked")
    with playwright.sync_playwright() as running:
        opened = running.chromium.launch(executable_path=_CHROMIUM, args=["--no-sandbox"])  # root in a container
        yield opened
        opened.close()
