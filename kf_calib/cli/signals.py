"""Signals that ask a run to end: Ctrl-C, SIGTERM, and SIGHUP, which comes when the terminal is closed.

On Windows SIGBREAK stands for the last two: Ctrl-Break, and a console that is closed.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def answered(answer: Callable[[signal.Signals], None]) -> Iterator[None]:
    """Have ``answer`` called for each of them; SIGHUP stays ignored where it was (nohup).

    After a SIGHUP further ones are ignored for good: terminal and shell both send one, and the second must not kill
    the process while it writes its results and ends.
    """
    came: set[int] = set()

    def called(number: int, _: FrameType | None) -> None:
        came.add(number)
        answer(signal.Signals(number))

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [signal.SIGINT, signal.SIGTERM]
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    if (broken := getattr(signal, "SIGBREAK", None)) is not None:
        numbers.append(broken)
    before = {number: signal.signal(number, called) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            hung_up = number in came and number not in (signal.SIGINT, signal.SIGTERM)
            signal.signal(number, signal.SIG_IGN if hung_up else handler)


class Interrupter:
    """An answer by which any of them is Ctrl-C: what is at work lets go of what it has open.

    Within ``finished_first`` it takes effect only at the end of the block: a file that is being written stays whole.
    """

    def __init__(self) -> None:
        self._busy = self._asked = False

    def __call__(self, _: signal.Signals) -> None:
        self._asked = True
        if not self._busy:
            raise KeyboardInterrupt

    @contextmanager
    def finished_first(self) -> Iterator[None]:
        """Let the block be done before an interrupt takes effect."""
        self._busy = True
        try:
            yield
        finally:
            self._busy = False
        if self._asked:
            raise KeyboardInterrupt
