"""Profiles of positioners: how one is told to move, to stop, and what it answers, as a TOML file says.

    kind = "lines"                                  # or "command"
    address = "TCPIP::192.168.53.1::9878::SOCKET"   # as PyVISA names it
    gimbals = ["1", "2"]                            # the controller's names of the gimbals, outer to inner
    move = ":Demand:Position {axis},{deg:.4f}"      # for each gimbal
    read = ":Read:Position? {axis}"
    stop = ":Mode:Rate {axis};:Demand:Rate {axis},0"
    fault = ":Interlock? {axis}"
    fault_word = "Fault"                            # what the answer holds where something is wrong

In text, ``{axis}`` is the name of a gimbal, ``{deg}`` its angle, and ``{angles}`` all angles, in the unit of the
controller.

Positioners that a profile describes: a controller that takes lines of text, over whatever PyVISA opens (sockets,
serial ports, GPIB), or commands of the user's that are run with the angles as arguments.
"""

from __future__ import annotations

import math
import re
import shlex
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, with_config
from typing_extensions import TypedDict

from kf_calib.errors import InputError
from kf_calib.positioning.link import LineLink, refuse_address
from kf_calib.positioning.positioner import PositionerError, Watchfulness
from kf_calib.support.toml_files import FINITE, TEXT, Misfit, converted, toml_table

SHIPPED = Path(__file__).parent / "profiles"
"""Profiles that come with the package, by the names of their files."""

_POSITIVE = Annotated[FINITE, Field(gt=0.0)]
_Texts = TEXT | list[TEXT]
_ENDINGS = {"lf": "\n", "crlf": "\r\n", "cr": "\r"}


@with_config(extra="forbid")
class _Content(TypedDict, total=False):
    kind: Literal["lines", "command"]
    address: TEXT
    gimbals: Annotated[list[TEXT], Field(min_length=1, max_length=6)]
    signs: list[Literal[1, -1]]
    zeros_deg: list[FINITE]
    unit: Literal["deg", "rad"]
    begin: _Texts
    move: _Texts
    read: _Texts
    stop: _Texts
    fault: _Texts
    no_fault: TEXT
    fault_word: TEXT
    answer: TEXT
    answers: bool
    termination: Literal["lf", "crlf", "cr"]
    baud: Annotated[int, Field(gt=0)]
    timeout_s: _POSITIVE
    tolerance_deg: _POSITIVE
    still_degps: _POSITIVE
    stand_s: _POSITIVE
    begin_s: _POSITIVE
    late_s: _POSITIVE


@dataclass(frozen=True)
class Profile:
    """What a profile says.

    kind: lines to a controller, or commands that are run. address: of the controller, as PyVISA names it. gimbals: its
    names of the gimbals. signs, zeros_deg: controller's angle = sign * gimbal angle + zero. unit: of its angles. begin,
    move, read, stop, fault: what to say, or the words of a command to run. no_fault: what the answer about faults holds
    where there is none; fault_word: what it holds where there is one. answer: what an
    answer about positions looks like, with {deg} in place of the angles. answers: whether it answers commands that ask
    nothing. termination: ends of lines. baud: of a serial port. timeout_s: of an answer. watch: what a motion must be
    like.
    """

    name: str
    kind: Literal["lines", "command"]
    gimbals: tuple[str, ...]
    signs: tuple[int, ...]
    zeros_deg: tuple[float, ...]
    move: tuple[str, ...]
    read: tuple[str, ...]
    stop: tuple[str, ...]
    fault: tuple[str, ...] = ()
    begin: tuple[str, ...] = ()
    address: str = ""
    unit: Literal["deg", "rad"] = "deg"
    no_fault: str = ""
    fault_word: str = ""
    answer: str = ""
    answers: bool = False
    termination: str = "\n"
    baud: int = 9600
    timeout_s: float = 2.0
    watch: Watchfulness = field(default_factory=Watchfulness)

    def is_fault(self, answer: str) -> bool:
        """Whether an answer tells of a fault."""
        if self.fault_word:
            return self.fault_word.lower() in answer.lower()
        return self.no_fault.lower() not in answer.lower()

    def to_controller(self, gimbal_deg: Sequence[float]) -> list[float]:
        """Angles of the controller, in its unit, of gimbal angles."""
        degrees = [s * angle + zero for s, angle, zero in zip(self.signs, gimbal_deg, self.zeros_deg, strict=True)]
        return [math.radians(angle) if self.unit == "rad" else angle for angle in degrees]

    def from_controller(self, angles: Sequence[float]) -> tuple[float, ...]:
        """Gimbal angles, deg, of angles of the controller."""
        degrees = [math.degrees(angle) if self.unit == "rad" else angle for angle in angles]
        return tuple(s * (angle - zero) for s, angle, zero in zip(self.signs, degrees, self.zeros_deg, strict=True))


def is_shipped(path: Path) -> bool:
    """Whether a profile is one of those that come with the package, by its name."""
    return not path.suffix and (SHIPPED / f"{path}.toml").is_file()


def read_profile(path: Path, width: int | None) -> Profile:
    """The profile of a file, or of the shipped one of this name. width: how many gimbals it must name, None for any
    number. Raises InputError."""
    path = SHIPPED / f"{path}.toml" if is_shipped(path) else path
    try:
        content = converted(toml_table(path, 'move = "MOVE {axis} {deg:.3f}"'), _Content)
    except Misfit as error:
        raise InputError(f"{path}: {error}: see docs/run.md for the keys of a profile.") from None
    missing = [key for key in ("kind", "gimbals", "move", "read", "stop") if key not in content]
    if missing:
        raise InputError(f"{path}: lacks {missing[0]}, which every profile has: see docs/run.md.")
    return _checked(path, content, width)


def _checked(path: Path, content: Mapping[str, Any], width: int | None) -> Profile:
    """Return the profile of these values, checked against each other."""
    gimbals = tuple(content["gimbals"])
    width = len(gimbals) if width is None else width
    if len(gimbals) != width:
        raise InputError(f"{path}: names {len(gimbals)} gimbals, and the bench has {width}: name each, outer to inner.")
    values: dict[str, Any] = {key: value for key, value in content.items() if key in Profile.__annotations__}
    for key, default in (("signs", 1), ("zeros_deg", 0.0)):
        values[key] = tuple(content.get(key, [default] * width))
        if len(values[key]) != width:
            raise InputError(f"{path}: {key} has {len(values[key])} numbers for {width} gimbals.")
    for key in ("begin", "move", "read", "stop", "fault"):
        said = content.get(key, [])
        values[key] = (said,) if isinstance(said, str) else tuple(said)
        for text in values[key]:
            _refuse_unknown_fields(path, key, text)
    if content["kind"] == "lines" and not content.get("address"):
        raise InputError(f"{path}: lacks the address of the controller, such as TCPIP::192.168.53.1::9878::SOCKET.")
    if content["kind"] == "lines":
        refuse_address(str(path), content["address"])
    _refuse_blind(path, content)
    values["termination"] = _ENDINGS[content.get("termination", "lf")]
    watched = {key: content[key] for key in Watchfulness.__annotations__ if key in content}
    values |= {"gimbals": gimbals, "name": path.stem, "watch": Watchfulness(**watched)}
    return Profile(**values)


def _refuse_blind(path: Path, content: Mapping[str, Any]) -> None:
    """Raise InputError for a profile by which a fault, or a position, cannot be told."""
    if "fault" in content and not (content.get("no_fault", "").strip() or content.get("fault_word", "").strip()):
        raise InputError(
            f"{path}: asks for faults and does not say how one is told: add no_fault, what the answer holds where "
            "there is none, or fault_word, what it holds where there is one."
        )
    if content.get("answer", "{deg}").count("{deg}") != 1:
        raise InputError(f"{path}: answer = {content['answer']!r} lacks {{deg}}, where the angles stand.")


def _refuse_unknown_fields(path: Path, key: str, text: str) -> None:
    """Raise InputError for what stands in braces and is not known."""
    try:
        text.format(axis="1", deg=0.0, angles="0", **{f"deg{k}": 0.0 for k in range(1, 7)})
    except (ValueError, KeyError, IndexError, AttributeError):
        raise InputError(
            f"{path}: {key} = {text!r} has something in braces that is not known: use {{axis}}, {{deg:.4f}}, {{deg1}} "
            "or {angles}."
        ) from None


def said_for(profile: Profile, text: str, angles: Sequence[float], gimbal: int) -> str:
    """A text with its fields filled in for a gimbal; angles: of the controller."""
    numbered = {f"deg{k}": angle for k, angle in enumerate(angles, start=1)}
    joined = " ".join(f"{angle:.6f}" for angle in angles)
    deg = angles[gimbal] if angles else 0.0
    return text.format(axis=profile.gimbals[gimbal], deg=deg, angles=joined, **numbered)


def is_for_each(text: str) -> bool:
    """Whether a text is to be said for each gimbal, not once for all."""
    return "{axis}" in text or "{deg}" in text or "{deg:" in text


_FARTHEST_DEG = 1e5  # no gimbal has turned farther
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d{1,3})?")


def angles_in(answer: str, pattern: str, names: Sequence[str]) -> tuple[float, ...]:
    """The angles that an answer is, one for each of these gimbals; raises PositionerError where it is none.

    The answer is the angles and nothing else, with blanks, commas or semicolons between; that about one gimbal may
    begin with its name. pattern: how an answer looks, with {deg} in place of the angles; "" for these alone.
    """
    text, sides = answer.strip(), pattern.split("{deg}")
    if pattern:
        if not (text.startswith(sides[0]) and text.endswith(sides[1])):
            raise PositionerError(f"the answer {_shown(answer)} is not {pattern!r}")
        text = text[len(sides[0]) : len(text) - len(sides[1])]
    words = [word for word in re.split(r"[\s,;]+", text.strip("[]() ")) if word]
    if len(names) == 1 and len(words) == 2 and words[0].rstrip(":=").lower() == names[0].lower():
        words = words[1:]
    angles = tuple(float(word) if _NUMBER.fullmatch(word) else math.nan for word in words)
    if len(angles) != len(names) or not all(abs(angle) < _FARTHEST_DEG for angle in angles):
        wanted = "an angle" if len(names) == 1 else f"{len(names)} angles"
        raise PositionerError(
            f"the answer {_shown(answer)} is not {wanted} (key answer of a profile: what stands around)"
        )
    return angles


def _shown(answer: str) -> str:
    """Return an answer as it may be shown: no commands to the terminal, and not too much."""
    return ascii(answer[:60])


class LinePositioner:
    """A controller that is spoken to as its profile says. Raises PositionerError where it does not answer."""

    def __init__(self, profile: Profile) -> None:
        self.profile = profile
        self.link = LineLink(profile.name, profile.address, profile.termination, profile.baud, profile.timeout_s)
        self._is_moved = False

    def when_broken_off(self, broken_off: Callable[[], bool]) -> None:
        """Have no answer waited for once this is so."""
        self.link.broken_off = broken_off

    def move_to(self, gimbal_deg: Sequence[float]) -> None:
        angles = self.profile.to_controller(gimbal_deg)
        begin = () if self._is_moved else self.profile.begin
        self._is_moved = True
        for text in (*begin, *self.profile.move):
            self._say(text, angles)

    def read(self) -> tuple[float, ...]:
        angles, names = list[float](), self.profile.gimbals
        for text in self.profile.read:
            of_answers = [[name] for name in names] if is_for_each(text) else [names]
            for answer, of_answer in zip(self._ask(text), of_answers, strict=True):
                angles += angles_in(answer, self.profile.answer, of_answer)
        if len(angles) != len(names):
            said = f"the answers about the position have {len(angles)} numbers, and there are {len(names)} gimbals"
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
                    return _shown(answer).strip("'\"")
        return ""

    def close(self) -> None:
        """Let go of the link."""
        self.link.close()

    def _say(self, text: str, angles: Sequence[float]) -> None:
        say = self.link.ask if self.profile.answers else self.link.say
        for line in self._lines(text, angles):
            say(line)

    def _ask(self, text: str) -> list[str]:
        return [self.link.ask(line) for line in self._lines(text, [])]

    def _lines(self, text: str, angles: Sequence[float]) -> list[str]:
        """Return a text for each gimbal, or once where it is for all."""
        count = len(self.profile.gimbals) if is_for_each(text) else 1
        return [said_for(self.profile, text, angles, gimbal) for gimbal in range(count)]


_SLICE_S = 0.05  # of waiting, after which is looked whether the run is broken off


class CommandPositioner:
    """Runs the commands of its profile. The command that moves may last as long as the motion, or begin it and end.

    Reading prints the angles, outer gimbal first. Raises PositionerError where a command fails.
    """

    def __init__(self, profile: Profile) -> None:
        self.profile = profile
        self._moving: subprocess.Popen[str] | None = None
        self._broken_off: Callable[[], bool] = lambda: False

    def when_broken_off(self, broken_off: Callable[[], bool]) -> None:
        """Have no command waited for once this is so."""
        self._broken_off = broken_off

    def move_to(self, gimbal_deg: Sequence[float]) -> None:
        words = self._words(self.profile.move[0], self.profile.to_controller(gimbal_deg))
        self._end_move()
        try:
            self._moving = subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                                            stderr=subprocess.PIPE, text=True)  # fmt: skip
        except OSError as error:
            raise PositionerError(f"{words[0]} cannot be run ({error.strerror})") from error

    def read(self) -> tuple[float, ...]:
        angles = angles_in(self._run(self.profile.read[0]), self.profile.answer, self.profile.gimbals)
        return self.profile.from_controller(angles)

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
            ran = subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        except OSError as error:
            raise PositionerError(f"{words[0]} cannot be run ({error.strerror})") from error
        with ran:
            printed, complained = self._waited_for(ran, words[0])
        if ran.returncode:
            said = complained.decode(errors="replace").strip()[:200]
            raise PositionerError(f"{text} ended with exit code {ran.returncode}: {said}")
        return printed.decode(errors="backslashreplace")

    def _waited_for(self, ran: subprocess.Popen[bytes], name: str) -> tuple[bytes, bytes]:
        """Return what a command prints; it is killed where it takes too long, or where the run is broken off."""
        until_s = time.monotonic() + self.profile.timeout_s
        while True:
            try:
                return ran.communicate(timeout=_SLICE_S)
            except subprocess.TimeoutExpired:
                if self._broken_off() or time.monotonic() > until_s:
                    ran.kill()
                    ran.communicate()
                    why = f"did not end within {self.profile.timeout_s:g} s"
                    raise PositionerError(
                        f"{name} {why if time.monotonic() > until_s else 'is not waited for'}"
                    ) from None
