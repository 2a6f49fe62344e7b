"""What a long computation is doing, in a few words, for whoever shows it to a person who waits.

    with stage.listener(print):
        kf_calib.diagnose(run)  # "scanning 36 effects", "refitting with hysteresis" ...

How many refits a diagnosis needs is known at its end only: there is no honest fraction of it, but these words.
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
def listener(heard: Callable[[str], None]) -> Iterator[None]:
    """``heard`` is called with each stage that begins in this context and in this thread."""
    token = _listener.set(heard)
    try:
        yield
    finally:
        _listener.reset(token)
