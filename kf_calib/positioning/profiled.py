"""Positioners that a profile describes: a controller that takes lines of text, over whatever PyVISA opens (sockets,
serial ports, GPIB), or commands of the user's that are run with the angles as arguments."""

from __future__ import annotations

import re
import shlex
import subprocess
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


class CommandPositioner:
    """Runs the commands of its profile. The command that moves may last as long as the motion, or begin it and end.

    Reading prints the angles, outer gimbal first. Raises PositionerError where a command fails.
    """

    def __init__(self, profile: Profile) -> None:
        self.profile = profile
        self._moving: subprocess.Popen[str] | None = None

    def move_to(self, gimbal_deg: Sequence[float]) -> None:
        words = self._words(self.profile.move[0], self.profile.to_controller(gimbal_deg))
        self._end_move()
        try:
            self._moving = subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                                            stderr=subprocess.PIPE, text=True)  # fmt: skip
        except OSError as error:
            raise PositionerError(f"{words[0]} cannot be run ({error.strerror})") from error

    def read(self) -> tuple[float, ...]:
        numbers = _numbers(self._run(self.profile.read[0]))
        if len(numbers) != len(self.profile.gimbals):
            wanted = len(self.profile.gimbals)
            raise PositionerError(f"{self.profile.read[0]} printed {len(numbers)} numbers, not {wanted} angles")
        return self.profile.from_controller(numbers)

    def stop(self) -> None:
        self._end_move()
        self._run(self.profile.stop[0])

    def fault(self) -> str:
        if self._moving is not None and self._moving.poll() not in (None, 0):
            said = (self._moving.stderr.read() if self._moving.stderr else "").strip()
            return f"the command that moves failed: {said or f'exit code {self._moving.returncode}'}"
        if not self.profile.fault:
            return ""
        answer = self._run(self.profile.fault[0]).strip()
        return answer if self.profile.is_fault(answer) else ""

    def close(self) -> None:
        """End the command that moves, if it is still at it."""
        self._end_move()

    def _end_move(self) -> None:
        if self._moving is not None and self._moving.poll() is None:
            self._moving.terminate()
            try:
                self._moving.wait(self.profile.timeout_s)
            except subprocess.TimeoutExpired:
                self._moving.kill()
        if self._moving is not None and self._moving.stderr is not None:
            self._moving.stderr.close()
        self._moving = None

    def _words(self, text: str, angles: Sequence[float]) -> list[str]:
        return shlex.split(said_for(self.profile, text, angles, 0))

    def _run(self, text: str) -> str:
        words = self._words(text, [])
        try:
            done = subprocess.run(words, stdin=subprocess.DEVNULL, capture_output=True, text=True,
                                  timeout=self.profile.timeout_s)  # fmt: skip
        except subprocess.TimeoutExpired:
            raise PositionerError(f"{words[0]} did not end within {self.profile.timeout_s:g} s") from None
        except OSError as error:
            raise PositionerError(f"{words[0]} cannot be run ({error.strerror})") from error
        if done.returncode:
            raise PositionerError(f"{text} ended with exit code {done.returncode}: {done.stderr.strip()[:200]}")
        return done.stdout
