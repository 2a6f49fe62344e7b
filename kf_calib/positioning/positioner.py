"""What moves a platform: the protocol that every positioner has, and the sizes by which it is watched; a person as a
positioner.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from kf_calib.errors import KfCalibError


class PositionerError(KfCalibError):
    """A positioner does not answer, or not as it should; the message says what was asked and what came."""


@runtime_checkable
class Positioner(Protocol):
    """Anything that turns gimbals to angles in deg, outer gimbal first, in the sense of the recorded angles.

    No method waits for a motion to end. Each raises PositionerError (or OSError) where the positioner does not answer.
    """

    def move_to(self, gimbal_deg: Sequence[float]) -> None:
        """Begin to move all gimbals to these angles."""
        ...

    def read(self) -> tuple[float, ...]:
        """Return the present angles, deg."""
        ...

    def stop(self) -> None:
        """Bring all gimbals to rest at once."""
        ...

    def fault(self) -> str:
        """Return what the controller reports to be wrong; empty where nothing is."""
        ...


@runtime_checkable
class Interruptible(Protocol):
    """A positioner that may wait for answers."""

    def when_broken_off(self, broken_off: Callable[[], bool]) -> None:
        """Have nothing waited for once this is so: PositionerError is raised at once."""
        ...


@dataclass(frozen=True)
class Watchfulness:
    """What a motion must be like; anything else stops the table.

    tolerance_deg: between target and read-back where it stands. still_degps: rate below which it stands, over
    stand_s. begin_s: in which a move must begin. late_s, late_factor: by which it may last longer than its way and rate
    say. off_path_deg: how far the read-back may lie off the way. latency_s: by which the time of a read-back may be
    wrong. silent_s: how long no reading may come while it stands. stream_deg: between read-back and the angles that are
    recorded.
    """

    tolerance_deg: float = 0.05
    still_degps: float = 0.05
    stand_s: float = 1.0
    begin_s: float = 3.0
    late_s: float = 5.0
    late_factor: float = 1.5
    off_path_deg: float = 2.0
    latency_s: float = 0.25
    silent_s: float = 10.0
    stream_deg: float = 0.5

    def by_hand(self) -> Watchfulness:
        """The same for a person, who takes any time and sets angles less exactly."""
        return Watchfulness(
            tolerance_deg=max(self.tolerance_deg, 1.0), still_degps=math.inf, stand_s=self.stand_s, begin_s=math.inf,
            late_s=math.inf, off_path_deg=math.inf, silent_s=math.inf, stream_deg=3.0,
        )  # fmt: skip


class HandPositioner:
    """Asks for each motion by ``say``; ``done`` is called when the person says that the gimbals stand there.

    Before the first answer they are taken to stand at ``start_deg``.
    """

    def __init__(self, start_deg: Sequence[float], say: Callable[[str], None]) -> None:
        self._say = say
        self._stands = self._asked = tuple(start_deg)

    def move_to(self, gimbal_deg: Sequence[float]) -> None:
        self._asked = tuple(gimbal_deg)
        self._say(f"turn the gimbals to {', '.join(f'{angle:.1f}' for angle in gimbal_deg)} deg, then press Enter")

    def read(self) -> tuple[float, ...]:
        return self._stands

    def stop(self) -> None:
        self._say("stop: leave the gimbals where they are")

    def fault(self) -> str:
        return ""

    def done(self) -> None:
        """The gimbals stand where they were asked to be."""
        self._stands = self._asked
