"""The Rerun view of a run that goes on: nothing that a viewer does, or does not do, reaches whoever offers results.

A thread turns results into the bytes of an .rrd file, and passes them on to a file and through a pipe to a process of
its own: ``rerun -``, which sends them to the viewer that listens on the port, or becomes that viewer. In this process
no call of Rerun's waits for a network: one that does, for a viewer that hangs, holds even the exit of its program.
"""

from __future__ import annotations

import os
import queue
import socket
import struct
import subprocess
import sys
import tempfile
import threading
from contextlib import suppress
from contextvars import copy_context
from pathlib import Path
from typing import IO

from kf_calib.errors import InputError
from kf_calib.estimation.results import Calibration
from kf_calib.online.status import Judgement
from kf_calib.support.output_files import Growing
from kf_calib.views.rerun import grow
from kf_calib.views.rerun.names import new_stream

PORT = 9876
_ADDRESS = "http://127.0.0.1:{web_port}/?url=rerun%2Bhttp%3A%2F%2F127.0.0.1%3A{port}%2Fproxy"
"""Where a browser finds the viewer, and the data."""
_HEADER = 12  # bytes before the first message of what Rerun encoded
_LAST_S = 1.0  # in which a browser gets what was sent last
_WAITING = 4  # results; the next one that comes through shows what those left out would have


class GrowingView:
    """Offer it results; ``close`` it. rrd: a file to write; port: of the viewer, None: no viewer.

    bind: the address a viewer that is opened listens on. web: a browser is the viewer, at ``url``, while this is open.
    Raises InputError where another viewer has the port of a browser's. dropped: results that came while ``waiting``
    others waited, whose dwells are shown by the next. trouble: why the viewer shows nothing any more.
    """

    def __init__(
        self, rrd: Path | None = None, port: int | None = PORT, bind: str = "127.0.0.1", waiting: int = _WAITING,
        web: bool = False,
    ) -> None:  # fmt: skip
        self.dropped, self.trouble, self._relays = 0, "", port is not None and _listens(port)
        if web and self._relays:
            raise InputError(f"port {port} is taken by another Rerun viewer: close it, or add --rerun-port.")
        self._results = queue.Queue[tuple[Calibration, Judgement | None] | None](waiting)
        self._file = _GrowingFile(rrd) if rrd else None
        self._viewer = None
        self._stream = new_stream()
        self._encoded = self._stream.binary_stream()
        self._is_gone = False  # the viewer
        self._log = tempfile.TemporaryFile()  # noqa: SIM115  # closed with the viewer's pipe
        if port is not None:
            self._viewer = _viewer(port, bind, self._log, web)
        self.url = "" if port is None or not web else _ADDRESS.format(web_port=port + 1, port=port)
        self._thread = threading.Thread(target=copy_context().run, args=(self._show,), name="rerun", daemon=True)
        self._thread.start()

    @property
    def began(self) -> bool:
        """Whether there is a file by now."""
        return self._file is not None and self._file.began

    def offer(self, result: Calibration, judgement: Judgement | None = None) -> None:
        """Show a result when there is time, with what was judged of it; never waits."""
        try:
            self._results.put_nowait((result, judgement))
        except queue.Full:
            self.dropped += 1

    def close(self, patience_s: float = 5.0) -> None:
        """Show what waits, for no longer than that; a viewer that is open stays so."""
        with suppress(queue.Full):
            self._results.put(None, timeout=patience_s)
        self._thread.join(patience_s)
        viewer = self._viewer
        if viewer is None:
            return
        if self.url:
            with suppress(subprocess.TimeoutExpired):
                viewer.wait(_LAST_S)  # it never ends by itself
            viewer.terminate()
            viewer.wait()
            return
        if self._relays and not self._thread.is_alive():  # what sends to a viewer that was there ends by itself
            with suppress(subprocess.TimeoutExpired):
                viewer.wait(patience_s)
        if self._thread.is_alive() or (self._relays and viewer.poll() is None):
            self.trouble = self.trouble or "the Rerun viewer does not answer: look at the recording with replay --rrd."
            viewer.kill()  # ends the wait for it
            viewer.wait()
            self._thread.join(patience_s)
        elif viewer.poll() is None:
            viewer.returncode = 0  # it is the user's window now, and not to be waited for

    def _show(self) -> None:
        shown, laid_out = 0, 0
        try:
            while (offered := self._results.get()) is not None:
                result, judgement = offered
                count = len(result.visits)
                lay_out = count >= 2 * laid_out or count < shown  # not each time: who looks on may have changed it
                grow(result, self._stream, shown, lay_out, judgement)
                shown, laid_out = count, count if lay_out else laid_out
                self._pass_on(self._encoded.read() or b"")
        except Exception as error:  # a view that fails is no reason for a run to
            self.trouble = f"the Rerun view stopped: {error}"
        self._stream.disconnect()
        if self._file is not None:
            self._file.close()
        if self._viewer is not None and self._viewer.stdin is not None:
            with suppress(OSError):
                self._viewer.stdin.close()
        self._log.close()

    def _pass_on(self, data: bytes) -> None:
        """To the file and to the viewer: what is the matter with one is no reason to leave out the other."""
        if self._file is not None:
            self.trouble = self._file.write(data) or self.trouble
        viewer = self._viewer
        if viewer is None or self._is_gone:
            return
        assert viewer.stdin is not None
        try:
            viewer.stdin.write(data)
            viewer.stdin.flush()
        except OSError:
            self._is_gone = True
            viewer.wait()
            self._log.seek(0)
            self.trouble = self.trouble or obituary(self._log.read().decode(errors="replace"))


class _GrowingFile:
    """The view so far; an earlier file of that name stays until there is something to see."""

    def __init__(self, path: Path) -> None:
        self._path, self._place = path, Growing(path)
        self._file: IO[bytes] | None = None
        self.began = self._is_lost = False

    def write(self, data: bytes) -> str:
        """Why the file ends here, the first time that it does."""
        if self._is_lost:
            return ""
        try:
            if self._file is None:
                self._file = self._place.open()
                self._file.write(data[:_HEADER])
            self._file.write(messages(data))
            self._file.flush()
            self._place.settle()
            self.began = True
        except OSError as error:
            self._is_lost = True
            return f"{self._path} is not written on ({error.strerror})."
        except InputError as error:
            self._is_lost = True
            return str(error)
        return ""

    def close(self) -> None:
        if self._file is not None:
            with suppress(OSError):
                self._file.close()
            if not self._place.settled:
                self._place.discard()


def messages(data: bytes) -> bytes:
    """What Rerun encoded, without header and footer: the parts of a file can then follow one another.

    A footer tells where the messages before it lie, counted from the beginning of the file; the viewer refuses a file
    whose last footer does not agree. Of a message: kind and size, 8 bytes each, and as many bytes; kind 0 is the end.
    """
    at = _HEADER
    while at < len(data):
        kind, size = struct.unpack_from("<QQ", data, at)
        if kind == 0:
            break
        at += 16 + size
    return data[_HEADER:at]


def binary() -> str:
    """Path of the viewer itself; the script of the same name would start it as a process that outlives a kill."""
    import rerun_cli

    return str(Path(rerun_cli.__file__).with_name("rerun.exe" if sys.platform == "win32" else "rerun"))


def obituary(log: str) -> str:
    """Why the viewer ended, from its log, in one sentence."""
    if any(word in log for word in ("render context", "graphics adapter", "Vulkan")):
        return (
            "the Rerun viewer found no graphics driver: install Vulkan's software driver "
            "(Debian and Ubuntu: apt-get install mesa-vulkan-drivers)."
        )
    lines = [line.strip() for line in log.splitlines() if line.strip() and "XDG_RUNTIME_DIR" not in line]
    said = next((line for line in lines if "panicked" in line), lines[0] if lines else "it said nothing")
    return f"the Rerun viewer ended before it drew anything ({said[:200]}): open the .rrd file with `rerun` to see why."


def _listens(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), timeout=1.0).close()
    except OSError:
        return False
    return True


def _viewer(port: int, bind: str, log: IO[bytes], web: bool) -> subprocess.Popen[bytes]:
    served = ["--serve-web", "--web-viewer-port", str(port + 1)] if web else []
    command = [binary(), "--port", str(port), "--bind", bind, "--hide-welcome-screen", *served, "-"]
    quiet = {**os.environ, "RUST_LOG": "error"}
    return subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=log, stderr=log, env=quiet, start_new_session=True
    )  # its own session: Ctrl-C is for the run
