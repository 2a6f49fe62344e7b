"""A picture of a Rerun recording, rendered without a window: for the pages of the docs, and for tests.

The viewer of Rerun runs headless on a free port of this machine, loads the file, gives its picture, and is ended. It
draws with Vulkan, by the software driver of Mesa where there is no graphics card.
"""

from __future__ import annotations

import io
import os
import socket
import subprocess
import tempfile
import time as clock
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from PIL import Image

from kf_calib.views.rerun.growing import binary, obituary

if TYPE_CHECKING:
    from rerun.experimental import ViewerClient

_PATIENCE_S = 60.0  # enough for software rendering on a busy machine; the usual time is 2 s
_MENU_PX = 36  # height of the window's top bar, which stays as an empty strip when its menu is hidden, and is cut off
_IDLE_S = 3.0  # a viewer that is idle for this long without showing anything has refused the file
_POLL_S = 0.05
_SETTLED = 2  # equal pictures in a row that are needed, as views still size their axes in the first frames


class ScreenshotError(RuntimeError):
    """The viewer could not draw the recording."""


def screenshot(
    rrd_path: str | Path,
    png_path: str | Path,
    size: tuple[int, int] = (1600, 1000),
    timeline: str | None = None,
    time: float | None = None,
) -> Path:
    """Draw a recording into a PNG file of ``size`` (width, height) pixels, and return its path.

    ``timeline`` and ``time`` move the cursor first (s on a timeline of durations, a count on a sequence); without them
    the picture shows the recording as it opens. Raises ScreenshotError where the viewer cannot draw it.
    """
    rrd, png = Path(rrd_path).resolve(), Path(png_path).resolve()
    if not rrd.is_file():
        raise ScreenshotError(f"there is no recording {rrd_path}: write one with --rrd first.")
    screenshots(rrd, size, timeline, [time])[0].save(png)
    return png


def screenshots(
    rrd: Path, size: tuple[int, int], timeline: str | None, moments: Sequence[float | None]
) -> list[Image.Image]:
    """Pictures of a recording with the time cursor at each of the ``moments``, drawn by one viewer (``screenshot``)."""
    pictures = list[Image.Image]()
    with viewer(rrd, size) as client:
        client.run_command("ui.toggle_top_panel")
        for moment in moments:
            if timeline is not None:
                _seek(client, timeline, moment)
            window = Image.open(io.BytesIO(_steady_picture(client)))
            pictures.append(window.crop((0, _MENU_PX, window.width, window.height)).convert("RGB"))
    return pictures


@contextmanager
def viewer(rrd: Path, size: tuple[int, int]) -> Iterator[ViewerClient]:
    """A headless viewer that has loaded the file; its process is ended in any case."""
    with tempfile.TemporaryDirectory(prefix="kf_calib_") as folder:
        port, log = free_port(), Path(folder, "viewer.log")
        command = [
            binary(), "--headless", "--port", str(port), "--bind", "127.0.0.1", "--hide-welcome-screen",
            "--window-size", f"{size[0]}x{size[1] + _MENU_PX}", str(rrd),
        ]  # fmt: skip
        quiet = {**os.environ, "CI": "true", "RUST_LOG": "error"}  # CI: the viewer then sends no usage data
        with log.open("wb") as sink:
            process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=sink, stderr=sink, env=quiet)
        try:
            yield _viewer_with_file(process, port, log)
        finally:
            process.kill()
            process.wait()


def free_port() -> int:
    """Number of a port of this machine that is free."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _viewer_with_file(process: subprocess.Popen[bytes], port: int, log: Path) -> ViewerClient:
    """Return the viewer once it has loaded the file; raise ScreenshotError if it ends or takes too long."""
    from rerun.experimental import ViewerClient

    began = idle_since = clock.monotonic()
    while clock.monotonic() < began + _PATIENCE_S:
        if process.poll() is not None:
            raise ScreenshotError(obituary(log.read_text(encoding="utf-8", errors="replace")))
        clock.sleep(_POLL_S)
        try:
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            state = client.get_state()
        except Exception:  # not listening yet; the client raises whatever its transport raises
            idle_since = clock.monotonic()
            continue
        if state.loading:
            idle_since = clock.monotonic()
        elif state.recordings:
            return client
        elif clock.monotonic() > idle_since + _IDLE_S:
            try:
                client.take_screenshot()
            except Exception:  # the viewer listens before it has found a graphics driver, and ends if it finds none
                idle_since = clock.monotonic()
                continue
            raise ScreenshotError("the file holds nothing that Rerun can show: write it again with --rrd.")
    raise ScreenshotError(f"the Rerun viewer did not load the recording within {_PATIENCE_S:g} s: try again.")


def _seek(client: ViewerClient, timeline: str, time: float | None) -> None:
    """Show a timeline with its cursor at ``time`` (None: the cursor is not moved)."""
    known = {line.name: line.time_type for line in client.get_state().recordings[0].timelines}
    if timeline not in known:
        raise ScreenshotError(f"the recording has no timeline {timeline!r}: use one of {', '.join(sorted(known))}.")
    if time is None:
        client.set_time(timeline)
    elif known[timeline] == "sequence":
        client.set_time(timeline, sequence=round(time), play_state="paused")
    else:
        client.set_time(timeline, duration=float(time), play_state="paused")


def _steady_picture(client: ViewerClient) -> bytes:
    """Return the picture (PNG) once it no longer changes, as layouts and axes take a few frames."""
    picture, equal, deadline = b"", 0, clock.monotonic() + _PATIENCE_S
    while equal < _SETTLED and clock.monotonic() < deadline:
        try:
            following = client.take_screenshot()
        except RuntimeError as error:
            raise ScreenshotError(f"the Rerun viewer drew no picture ({error}): try again.") from None
        equal = equal + 1 if following == picture else 0
        picture = following
    return picture
