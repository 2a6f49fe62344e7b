"""Messages about what a long computation is doing, for a display that a waiting person watches.

    with stage.listener(print):
        kf_calib.diagnose(run)  # "scanning 36 effects", "refitting with hysteresis" ...

There are words instead of a fraction because the number of refits of a diagnosis is known at its end only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_listener: ContextVar[Callable[[str], None]] = ContextVar("listener", default=lambda text: None)


def say(text: str) -> None:
    """This is what is being done from now on."""
    _listener.get()(text)


@contextmanager
def listener(on_stage: Callable[[str], None]) -> Iterator[None]:
    """``on_stage`` is called with each stage that begins in this context and in this thread."""
    token = _listener.set(on_stage)
    try:
        yield
    finally:
        _listener.reset(token)
