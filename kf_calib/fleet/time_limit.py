"""The time that one run may take: a run that never ends must not keep the others from being evaluated.

Python is told to stop where it is, in the thread that works; that reaches it between two steps of the interpreter. What
does not come to such a step, as a file system that does not answer, is ended with its process, if this is a worker's.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from typing import TypeVar

_AGAIN_S = 5.0  # what is told to stop may be caught on its way
_GRACE_S = 60.0  # at most, before a process is ended


T = TypeVar("T")


class OverTime(BaseException):
    """The time is over; not an ``Exception``, so that nothing that goes on after a failure goes on after this."""


def in_time(limit_s: float, work: Callable[[], T]) -> T:
    """What ``work`` returns; raises OverTime in this thread if it takes longer. A process that does not obey is ended.

    No context manager: what comes while such a one is being left would not find it there any more.
    """
    watch = _Watch(limit_s, threading.get_ident())
    try:
        try:
            threading.Thread(target=watch.run, name="time limit", daemon=True).start()
            return work()
        finally:
            watch.end()
    except OverTime:
        watch.end()  # if it came while that was done
        raise


class _Watch:
    """Waits in a thread of its own until the block ends or its time is over."""

    def __init__(self, limit_s: float, thread: int) -> None:
        self._limit_s, self._thread = limit_s, ctypes.c_ulong(thread)
        self._ended, self._telling = threading.Event(), threading.RLock()

    def run(self) -> None:
        waited_s, patience_s = self._limit_s, min(self._limit_s, _GRACE_S)
        while not self._ended.wait(waited_s):
            if patience_s <= 0.0 and multiprocessing.parent_process() is not None:
                os.kill(os.getpid(), signal.SIGKILL)
            with self._telling:
                if not self._ended.is_set():
                    ctypes.pythonapi.PyThreadState_SetAsyncExc(self._thread, ctypes.py_object(OverTime))
            waited_s = min(_AGAIN_S, patience_s) or _AGAIN_S
            patience_s = max(patience_s - waited_s, 0.0)

    def end(self) -> None:
        """From now on nothing is raised, not even what was on its way."""
        with self._telling:
            self._ended.set()
            ctypes.pythonapi.PyThreadState_SetAsyncExc(self._thread, None)
