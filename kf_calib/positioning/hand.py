"""A positioner that is a person: the screen says where to turn the gimbals, and Enter says that it is done."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence


class HandPositioner:
    """Asks for each motion by ``say``; ``done`` is called when the person says that the gimbals stand there.

    Before the first answer they are taken to stand at ``start_deg``.
    """

    def __init__(self, start_deg: Sequence[float], say: Callable[[str], None]) -> None:
        self._say, self._lock = say, threading.Lock()
        self._stands, self._asked = tuple(start_deg), tuple(start_deg)

    def move_to(self, gimbal_deg: Sequence[float]) -> None:
        with self._lock:
            self._asked = tuple(gimbal_deg)
        self._say(f"turn the gimbals to {', '.join(f'{angle:.1f}' for angle in gimbal_deg)} deg, then press Enter")

    def read(self) -> tuple[float, ...]:
        with self._lock:
            return self._stands

    def stop(self) -> None:
        self._say("stop: leave the gimbals where they are")

    def fault(self) -> str:
        return ""

    def done(self) -> None:
        """The gimbals stand where they were asked to be."""
        with self._lock:
            self._stands = self._asked

    @property
    def is_waiting(self) -> bool:
        """Whether a motion was asked for and is not done."""
        with self._lock:
            return self._stands != self._asked
