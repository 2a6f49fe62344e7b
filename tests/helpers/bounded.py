"""A limit of time and memory for one case: a hostile file fails its test, and not the machine."""

import re
import resource
import signal
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace


class TooLongError(BaseException):
    """No error that a program may take for one of its own."""


@contextmanager
def bounded(seconds: float = 20.0, megabytes: float = 600.0) -> Iterator[None]:
    """What runs inside takes no more ``seconds`` of the processor, and at its peak no more memory than there was before
    and ``megabytes``."""
    Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
    before, taken = _status("VmRSS"), _status("VmSize")
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (int((taken + 2.0 * megabytes) * 2**20), hard))
    handler = signal.signal(signal.SIGPROF, _too_long)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, handler)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
    grown = _status("VmHWM") - before
    assert grown < megabytes, f"it took {grown:.0f} MB"


def _too_long(*_: object) -> None:
    raise TooLongError


def _status(key: str) -> float:
    """A size of this process, MB."""
    found = re.search(rf"{key}:\s*(\d+) kB", Path("/proc/self/status").read_text())
    assert found
    return int(found[1]) / 1024.0


@contextmanager
def traced() -> Iterator[SimpleNamespace]:
    """The most ``bytes`` that Python's objects take inside."""
    peak = SimpleNamespace(bytes=0)
    tracemalloc.start()
    try:
        yield peak
    finally:
        peak.bytes = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
