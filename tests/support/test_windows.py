"""What Windows does otherwise, pretended: nothing here can run it.

Its locks are those of a file's bytes, no open file can be renamed or removed, keys are asked for one by one, and its
consoles have code pages without the signs of this field.
"""

import ctypes
import importlib
import io
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from kf_calib.bench.bench import Bench, parse_axes
from kf_calib.bench.streams import Batch, Stream
from kf_calib.cli import echo, failures, live_run
from kf_calib.errors import InputError
from kf_calib.sources.files.recorder import Recorder
from kf_calib.sources.files.recording import Recording
from kf_calib.support import file_lock, output_files

BENCH = Bench(parse_axes("y z x"), 9.81)
EARLIER = b"the user's own"
FAR = 2**40  # bytes: no content of a file reaches so far


class Kernel32:
    """Locks of a byte of a file, for as long as the handle is open; a handle is a descriptor here."""

    def __init__(self) -> None:
        self._held = dict[tuple[int, int], os.stat_result]()

    def LockFileEx(self, handle: Any, flags: int, zero: int, low: int, high: int, place: Any) -> int:
        assert (flags, zero, low, high) == (3, 0, 1, 0)
        descriptor, at, file = handle.value, _place(place), os.fstat(handle.value)
        assert at > FAR, "content that is locked cannot be read by others"
        for (holder, held_at), held in self._held.items():
            if held_at == at and holder != descriptor and os.path.samestat(held, file) and _is_open(holder, held):
                return 0
        self._held[descriptor, at] = file
        return 1

    def UnlockFileEx(self, handle: Any, zero: int, low: int, high: int, place: Any) -> int:
        assert (zero, low, high) == (0, 1, 0)
        del self._held[handle.value, _place(place)]
        return 1


def _place(reference: Any) -> int:
    return reference._obj.offset + reference._obj.offset_high * 2**32


def _is_open(descriptor: int, file: os.stat_result) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), file)
    except OSError:
        return False


def _is_open_here(path: Path) -> bool:
    status = path.stat()
    return any(_is_open(int(link.name), status) for link in Path("/proc/self/fd").iterdir())


@pytest.fixture
def locks(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """``file_lock`` as it is imported on Windows, and used by the files that grow."""
    kernel = Kernel32()
    monkeypatch.setattr(ctypes, "WinDLL", lambda _: kernel, raising=False)
    monkeypatch.setitem(sys.modules, "msvcrt", SimpleNamespace(get_osfhandle=lambda descriptor: descriptor))
    monkeypatch.setattr(sys, "platform", "win32")
    imported = importlib.reload(file_lock)
    monkeypatch.undo()
    monkeypatch.setattr(output_files, "lock", imported.lock)
    monkeypatch.setattr(output_files, "writer", imported.writer)
    yield imported
    importlib.reload(file_lock)


@pytest.fixture
def windows(locks: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    """No file that is open can be renamed, replaced or removed."""
    monkeypatch.setattr(output_files, "_RENAMES_OPEN_FILES", False)

    def refused_if_open(change: Any) -> Any:
        def called(path: Path, *others: Any, **options: Any) -> Any:
            for name in (path, *(Path(other) for other in others)):
                if name.exists() and _is_open_here(name):
                    raise PermissionError(13, "The process cannot access the file because it is being used", str(name))
            return change(path, *others, **options)

        return called

    for name in ("rename", "replace", "unlink"):
        monkeypatch.setattr(Path, name, refused_if_open(getattr(Path, name)))


def batch(count: int = 100) -> Batch:
    stamps = 10**9 + np.arange(count) * 10**7
    return Batch(Stream(stamps, np.full((count, 3), 9.81)), Stream(stamps[:1], np.zeros((1, 3))))


def test_a_locked_file_can_be_read_and_its_writer_is_told(locks: ModuleType, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with path.open("xb") as file:
        assert locks.lock(file)
        file.write(b"content")
        file.flush()
        with path.open("r+b") as second:
            assert not locks.lock(second) and second.tell() == 0
        assert locks.writer(path) == "another run" and path.read_bytes() == b"content"
    assert locks.writer(path) == "" and locks.writer(tmp_path / "nothing") == ""


@pytest.mark.usefixtures("windows")
@pytest.mark.parametrize("is_there", [False, True])
def test_a_recording_takes_the_place_of_an_earlier_one(tmp_path: Path, is_there: bool) -> None:
    path = tmp_path / "run.mcap"
    if is_there:
        path.write_bytes(EARLIER)
    with Recorder(path, BENCH, overwrite=True) as recorder:
        with pytest.raises(InputError, match="is being written by another run"):
            Recorder(path, BENCH, overwrite=True)
        recorder.write(batch())
        recorder.flush()
        assert sum(len(part.accel) for part in Recording(path)) == 100, "it has its name while it is written"
    assert [name.name for name in tmp_path.iterdir()] == ["run.mcap"]


@pytest.mark.usefixtures("windows")
def test_an_earlier_recording_comes_back_where_no_reading_came(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(EARLIER)
    recorder = Recorder(path, BENCH, overwrite=True)
    recorder.finish()
    assert path.read_bytes() == EARLIER and len(list(tmp_path.iterdir())) == 1


def test_keys_are_asked_for_until_the_time_is_over(monkeypatch: pytest.MonkeyPatch) -> None:
    keys = list("q")
    monkeypatch.setitem(sys.modules, "msvcrt", SimpleNamespace(kbhit=lambda: bool(keys), getwch=lambda: keys.pop(0)))
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(isatty=lambda: True))
    with live_run.pressed_keys(True) as key:
        assert (key(0.0), key(0.05)) == ("q", "")
        keys.append("\x03")
        with pytest.raises(KeyboardInterrupt):
            key(0.0)


def test_a_console_that_is_closed_ends_the_run_in_good_order(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(signal, "SIGBREAK", signal.SIGUSR1, raising=False)
    seen = list[signal.Signals]()
    with failures.answered(seen.append):
        signal.raise_signal(signal.SIGUSR1)
    assert seen == [signal.SIGUSR1]


@pytest.mark.parametrize("code_page", ["cp1252", "cp437", "cp850", "latin-1", "ascii"])
def test_a_pipe_gets_utf_8_where_a_code_page_lacks_signs(code_page: str) -> None:
    environment = {**os.environ, "PYTHONIOENCODING": code_page, "PYTHONUTF8": "0"}
    code = "from kf_calib.cli.echo import open_streams, echo; open_streams(); echo('σ ┃ µg χ²')"
    words = [sys.executable, "-c", code]
    done = subprocess.run(words, env=environment, capture_output=True, check=True, timeout=120)
    assert done.stdout.decode("utf-8").strip() == "σ ┃ µg χ²"


def test_a_terminal_keeps_its_code_page(monkeypatch: pytest.MonkeyPatch) -> None:
    class Terminal(io.TextIOWrapper):
        def isatty(self) -> bool:
            return True

    raw = io.BytesIO()
    terminal = Terminal(raw, encoding="cp437")
    monkeypatch.setattr(sys, "stdout", terminal)
    echo.open_streams()
    terminal.write("σ ┃ χ²")
    terminal.flush()
    assert raw.getvalue().decode("cp437") == "σ ? ?²"


def test_text_files_name_their_encoding() -> None:
    """The default is UTF-8 on Linux and macOS, and the code page of the country on Windows."""
    root = Path(__file__).resolve().parents[2]
    words = [sys.executable, "-m", "ruff", "check", "--preview", "--select", "PLW1514", "--isolated", "kf_calib"]
    done = subprocess.run(words, cwd=root, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout
