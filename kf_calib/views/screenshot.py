"""A picture of a Rerun recording as it opens, rendered without a window: for reports, and for machines with no display.

Rerun's viewer runs headless on a free port of this machine, loads the file, is asked for its picture, and is ended.
It draws with Vulkan; where there is no graphics card, Mesa's software driver does.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import tempfile
import time as clock
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from kf_calib.errors import KfCalibError

if TYPE_CHECKING:
    from rerun.experimental import ViewerClient

_PATIENCE_S = 60.0  # software rendering on a busy machine; the usual time is 2 s
_POLL_S = 0.05
_SETTLED = 2  # equal pictures in a row: views size their axes over the first frames

_Answer = TypeVar("_Answer")


class ScreenshotError(KfCalibError):
    """The viewer could not draw the recording."""


def screenshot(
    rrd_path: str | Path,
    png_path: str | Path,
    size: tuple[int, int] = (1600, 1000),
    timeline: str | None = None,
    time: float | None = None,
) -> Path:
    """Draw a recording into a PNG of ``size`` (width, height) pixels, and return its path.

    ``timeline`` and ``time`` move the cursor first (s on a timeline of durations, a count on a sequence);
    without them the picture is what the file opens with. Raises ScreenshotError, InputError for no such file.
    """
    rrd, png = Path(rrd_path).resolve(), Path(png_path).resolve()
    if not rrd.is_file():
        raise ScreenshotError(f"there is no recording {rrd_path}: write one with --rrd first.")
    with _viewer(rrd, size) as (process, port, log):
        from rerun.experimental import ViewerClient

        def connect() -> ViewerClient | None:
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            state = client.get_state()
            return client if state.recordings and not state.loading else None

        client = _patiently(connect, process, log)
        client.run_command("ui.toggle_top_panel")  # the window's menu is no part of the picture
        if timeline is not None:
            _seek(client, timeline, time)
        picture = _settled(client)
    try:
        png.write_bytes(picture)
    except OSError as error:
        raise ScreenshotError(f"the picture {png_path} cannot be written: {error.strerror}.") from None
    return png


@contextmanager
def _viewer(rrd: Path, size: tuple[int, int]) -> Iterator[tuple[subprocess.Popen[bytes], int, Path]]:
    """A headless viewer of the file: its process, port and log; ended whatever happens."""
    with tempfile.TemporaryDirectory(prefix="kf_calib_") as folder, socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
        probe.close()
        log = Path(folder, "viewer.log")
        command = [
            _binary(), "--headless", "--port", str(port), "--bind", "127.0.0.1", "--window-size", "{}x{}".format(*size),
            "--hide-welcome-screen", str(rrd),
        ]  # fmt: skip
        quiet = {**os.environ, "CI": "true", "RUST_LOG": "error"}  # CI: the viewer then sends no usage data
        with log.open("wb") as sink:
            process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=sink, stderr=sink, env=quiet)
        try:
            yield process, port, log
        finally:
            process.kill()
            process.wait()


def _binary() -> str:
    """The viewer itself: the script of the same name would be a second process, which outlives a kill."""
    import rerun_cli

    return str(Path(rerun_cli.__file__).with_name("rerun.exe" if sys.platform == "win32" else "rerun"))


def _patiently(ask: Callable[[], _Answer | None], process: subprocess.Popen[bytes], log: Path) -> _Answer:
    """Ask until there is an answer; raises where the viewer ended or time ran out."""
    deadline = clock.monotonic() + _PATIENCE_S
    while clock.monotonic() < deadline:
        if process.poll() is not None:
            raise ScreenshotError(_obituary(log.read_text(errors="replace")))
        try:
            answer = ask()
        except Exception:  # not listening yet: the client raises what its transport raises
            answer = None
        if answer is not None:
            return answer
        clock.sleep(_POLL_S)
    raise ScreenshotError(f"the Rerun viewer did not load the recording within {_PATIENCE_S:g} s: try again.")


def _obituary(log: str) -> str:
    if "adapter" in log or "vulkan" in log.lower():
        return (
            "the Rerun viewer found no graphics driver: install Vulkan's software driver "
            "(Debian and Ubuntu: apt-get install mesa-vulkan-drivers)."
        )
    said = next((line.strip() for line in reversed(log.splitlines()) if line.strip()), "nothing said")
    return f"the Rerun viewer ended before it drew anything ({said[:200]}): open the .rrd file with `rerun` to see why."


def _seek(client: ViewerClient, timeline: str, time: float | None) -> None:
    """Show a timeline, its cursor at ``time`` (None: where it is)."""
    known = {line.name: line.time_type for line in client.get_state().recordings[0].timelines}
    if timeline not in known:
        raise ScreenshotError(f"the recording has no timeline {timeline!r}: use one of {', '.join(sorted(known))}.")
    if time is None:
        client.set_time(timeline)
    elif known[timeline] == "sequence":
        client.set_time(timeline, sequence=round(time), play_state="paused")
    else:
        client.set_time(timeline, duration=float(time), play_state="paused")


def _settled(client: ViewerClient) -> bytes:
    """The picture (PNG), once it stays the same: layouts and axes take a few frames."""
    picture, equal, deadline = b"", 0, clock.monotonic() + _PATIENCE_S
    while equal < _SETTLED and clock.monotonic() < deadline:
        try:
            following = client.take_screenshot()
        except RuntimeError as error:
            raise ScreenshotError(f"the Rerun viewer drew no picture ({error}): try again.") from None
        equal = equal + 1 if following == picture else 0
        picture = following
    return picture
