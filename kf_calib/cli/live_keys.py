"""Single keys pressed on the terminal of a live run."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import sys
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    pass


@contextlib.contextmanager
def pressed_keys(use: bool) -> Iterator[Callable[[float], str]]:
    """A function that waits for a key so long, and gives it or nothing."""
    if not (use and sys.stdin.isatty()):
        yield _no_key
        return
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


def _no_key(seconds: float) -> str:
    time.sleep(seconds)
    return ""
