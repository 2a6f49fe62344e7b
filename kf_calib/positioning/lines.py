"""A positioner whose controller takes lines of text, over whatever PyVISA opens: sockets, serial ports, GPIB."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from kf_calib.positioning.positioner import PositionerError
from kf_calib.positioning.profile import Profile, is_for_each, said_for
from kf_calib.support.extras import need

_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")


class LinePositioner:
    """A controller that is spoken to as its profile says. Raises PositionerError where it does not answer."""

    def __init__(self, profile: Profile) -> None:
        need("pyvisa", "positioner", f"the positioner {profile.name}")
        need("pyvisa_py", "positioner", f"the positioner {profile.name}")
        self.profile = profile
        self._is_moved = False
        with _told(profile, "opened"):
            import pyvisa

            self._link: Any = pyvisa.ResourceManager("@py").open_resource(profile.address)
            self._link.read_termination = self._link.write_termination = profile.termination
            self._link.timeout = 1000.0 * profile.timeout_s
            if profile.address.upper().startswith("ASRL"):
                self._link.baud_rate = profile.baud

    def move_to(self, gimbal_deg: Sequence[float]) -> None:
        angles = self.profile.to_controller(gimbal_deg)
        begin = () if self._is_moved else self.profile.begin
        self._is_moved = True
        for text in (*begin, *self.profile.move):
            self._say(text, angles)

    def read(self) -> tuple[float, ...]:
        angles, wanted = list[float](), len(self.profile.gimbals)
        for text in self.profile.read:
            for answer in self._ask(text):
                numbers = _numbers(answer)
                angles += numbers[-1:] if is_for_each(text) else numbers  # some name the gimbal before its angle
        if len(angles) != wanted:
            said = f"the answers about the position have {len(angles)} numbers, and there are {wanted} gimbals"
            raise PositionerError(f"the positioner {self.profile.name}: {said}")
        return self.profile.from_controller(angles)

    def stop(self) -> None:
        for text in self.profile.stop:
            self._say(text, [0.0] * len(self.profile.gimbals))
        self._is_moved = False

    def fault(self) -> str:
        for text in self.profile.fault:
            for answer in self._ask(text):
                if self.profile.is_fault(answer):
                    return answer
        return ""

    def close(self) -> None:
        """Let go of the link."""
        self._link.close()

    def _say(self, text: str, angles: Sequence[float]) -> None:
        count = len(self.profile.gimbals) if is_for_each(text) else 1
        for gimbal in range(count):
            line = said_for(self.profile, text, angles, gimbal)
            with _told(self.profile, f"told {line!r}"):
                if self.profile.answers:
                    self._link.query(line)
                else:
                    self._link.write(line)

    def _ask(self, text: str) -> list[str]:
        answers = list[str]()
        for gimbal in range(len(self.profile.gimbals) if is_for_each(text) else 1):
            line = said_for(self.profile, text, [], gimbal)
            with _told(self.profile, f"asked {line!r}"):
                answers.append(str(self._link.query(line)).strip())
        return answers


def _numbers(answer: str) -> list[float]:
    """Return the numbers of an answer."""
    return [float(number) for number in _NUMBER.findall(answer)]


@contextmanager
def _told(profile: Profile, what: str) -> Iterator[None]:
    """Turn whatever a link raises into an error of the positioner."""
    try:
        yield
    except PositionerError:
        raise
    except Exception as error:  # of PyVISA, of the system, of a library below
        said = " ".join(str(error).split()) or type(error).__name__
        raise PositionerError(f"the positioner {profile.name} at {profile.address}, {what}: {said}") from error
