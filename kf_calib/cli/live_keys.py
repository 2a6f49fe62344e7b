"""Single keys pressed on the terminal of a live run."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import sys
import time
from collections.abc import Callable, Iterator

_LOOK_S = 0.02  # Windows can only be asked whether a key was pressed


@contextlib.contextmanager
def pressed_keys(use: bool) -> Iterator[Callable[[float], str]]:
    """A function that waits for a key so long, and gives it or nothing."""
    if not (use and sys.stdin.isatty()):
        yield _no_key
    elif sys.platform == "win32":
        yield _windows_key
    else:
        import termios
        import tty

        before = termios.tcgetattr(sys.stdin)
        tty.setcbreak(sys.stdin)
        try:
            yield _key
        finally:
            with contextlib.suppress(termios.error):  # the terminal is gone
                termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)


def _key(seconds: float) -> str:
    if not select.select([0], [], [], seconds)[0]:
        return ""
    key = os.read(0, 1)
    if not key:
        raise OSError(errno.EIO, os.strerror(errno.EIO))  # as a terminal says that is gone
    return key.decode(errors="replace")


def _windows_key(seconds: float) -> str:
    assert sys.platform == "win32"
    import msvcrt

    end_s = time.monotonic() + seconds
    while not msvcrt.kbhit():
        if time.monotonic() >= end_s:
            return ""
        time.sleep(_LOOK_S)
    key = msvcrt.getwch()
    if key == "\x03":  # where the console hands Ctrl-C on as a key
        raise KeyboardInterrupt
    return key


def _no_key(seconds: float) -> str:
    time.sleep(seconds)
    return ""
