"""A positioner that programs of the user's move: a command that is run with the angles as arguments."""

from __future__ import annotations

import re
import shlex
import subprocess
from collections.abc import Sequence

from kf_calib.positioning.positioner import PositionerError
from kf_calib.positioning.profile import Profile, said_for

_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")


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
        numbers = [float(number) for number in _NUMBER.findall(self._run(self.profile.read[0]))]
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
