"""Where the numbers of a quantity are in messages of any type, by the names that lead to them.

Written ``QUANTITY=TOPIC:PATH,PATH,...@TIME``: ``accel=/imu:acc.x,acc.y,acc.z@header.stamp``. A path is of names and, in
lists, of places from 0 on, with dots between: ``acc.0``. It may lead to a list of numbers, ``acc``, or go through a
list of objects, ``joints.position``, and then may be followed by where the names of these numbers are, in brackets:
``joints.position[joints.name]``.

Which positions of a joint state are the gimbals: a message may give them in any order, and among other joints.

They are told by their names. Stated names (bench key ``joints``, outer to inner) win; else names in which a word is
outer, middle or inner, as recordings made here have, or, where a message gives as many joints as there are gimbals, the
letter of the gimbal's axis. As many joints of other names, or of none, are the gimbals in the order in which they come.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from functools import cached_property
from itertools import islice
from typing import Any

import numpy as np

from kf_calib.errors import InputError

QUANTITIES = ("accel", "angles", "attitude", "temperature")
LOG_TIME = "log_time"
"""In place of a path to the time: when the file says that it got the message."""
_USUAL_TIMES = ("header.stamp", "timestamp", "stamp")
_QUANTITY_UNITS = {"ns": 1, "us": 1_000, "ms": 1_000_000}  # the end of a name of a time; any other is in seconds
_SECONDS, _NANOSECONDS = ("sec", "secs", "seconds", "s"), ("nsec", "nanosec", "nsecs", "nanos", "nanoseconds", "ns")
_GRAMMAR = re.compile(r"(?P<quantity>\w+)=(?P<topic>[^:@]+):(?P<paths>[^@]+?)(?:@(?P<time>[\w.]+))?")
_PATH = re.compile(r"[\w.-]+")
_SHOWN = 12  # names in a message
_INT64 = 1 << 63
_MOST_PATHS, _DEEPEST = 1000, 12
_LONGEST_TIME = 64  # characters of one in ISO 8601


class MessageError(ValueError):
    """A message is not of the type, or does not have what is sought in it, that its topic promises."""


@dataclass(frozen=True)
class Fields:
    """Where ``quantity`` is in the messages of ``topic``.

    names: path to the names of the numbers, where it was stated. time: path to the time; None: where it usually is.
    """

    quantity: str
    topic: str
    paths: tuple[str, ...]
    names: str | None = None
    time: str | None = None

    @classmethod
    def of(cls, text: str) -> Fields:
        """As written (see above). Raises InputError."""
        match = _GRAMMAR.fullmatch(text.strip())
        if not match or match["quantity"] not in QUANTITIES:
            raise InputError(
                f"--field {text!r} cannot be read: write QUANTITY=TOPIC:PATH,PATH,... with "
                f"{', '.join(QUANTITIES[:-1])} or {QUANTITIES[-1]} for the quantity, for example "
                "accel=/imu:acc.x,acc.y,acc.z."
            )
        body, names = match["paths"].strip(), None
        if body.endswith("]") and "[" in body:
            body, _, names = body[:-1].partition("[")
        paths = tuple(path.strip() for path in body.split(","))
        wrong = [path for path in (*paths, *([names] if names is not None else [])) if not _PATH.fullmatch(path)]
        if wrong or (names is not None and len(paths) > 1):
            raise InputError(
                f"--field {text!r}: {(wrong or [body])[0]!r} is no path: join names by dots, and paths by commas, for "
                "example acc.x,acc.y,acc.z, or one path to a list, position, with its names, position[name]."
            )
        return cls(match["quantity"], match["topic"].strip(), paths, names, match["time"])

    @cached_property
    def _segments(self) -> list[list[str]]:
        """Return the names of the nested fields in each path."""
        return [path.split(".") for path in self.paths]

    def numbers(self, message: Any) -> list[float]:
        """The numbers in a message. Raises MessageError."""
        numbers = list[float]()
        for path, segments in zip(self.paths, self._segments, strict=True):
            value = _at(message, segments, path)
            if type(value) is float:
                numbers.append(value)
            else:
                numbers += [_number(each, path) for each in _flat(value)]
        return numbers

    def labels(self, message: Any) -> tuple[str, ...]:
        """The names of the numbers; none where no path to them is known."""
        if self.names is None:
            return ()
        return tuple(str(each) for each in _flat(_at(message, self.names.split("."), self.names)))

    def timed_by(self, message: Any) -> str:
        """Path to the time in messages like this one; ``LOG_TIME`` where they have none."""
        return self.time or next((path for path in _USUAL_TIMES if _has(message, path)), LOG_TIME)


_XYZ = ("x", "y", "z")
_KNOWN = {
    "sensor_msgs/Imu": Fields("accel", "", tuple(f"linear_acceleration.{axis}" for axis in _XYZ)),
    "sensor_msgs/JointState": Fields("angles", "", ("position",), "name"),
    "foxglove.JointStates": Fields("angles", "", ("joints.position",), "joints.name"),
    "geometry_msgs/QuaternionStamped": Fields("attitude", "", tuple(f"quaternion.{axis}" for axis in (*_XYZ, "w"))),
    "foxglove.PoseInFrame": Fields("attitude", "", tuple(f"pose.orientation.{axis}" for axis in (*_XYZ, "w"))),
    "sensor_msgs/Temperature": Fields("temperature", "", ("temperature",)),
}


def attitude_in(paths: Collection[str]) -> str | None:
    """The path to the first quaternion x, y, z, w among these paths to numbers; None where there is none."""
    ends = (path.removesuffix(".w") for path in paths if path.endswith(".w"))
    return next((end for end in ends if all(f"{end}.{axis}" in paths for axis in _XYZ)), None)


def has_time(paths: Collection[str]) -> bool:
    """Tell whether messages with these paths to numbers have their time where it usually is."""
    return any(path == time or path.startswith(f"{time}.") for time in _USUAL_TIMES for path in paths)


def known_fields(schema: str) -> Fields | None:
    """Those of a message of ROS or Foxglove, by the name of its schema; None where it is none of these."""
    return _KNOWN.get(schema.replace("/msg/", "/"))


def time_ns(message: Any, path: str) -> int:
    """The time in a message: an object with seconds and nanoseconds, a number, or text. Raises MessageError."""
    value = _at(message, path.split("."), path)
    if isinstance(value, str):
        return _time_of_text(value, path)
    if isinstance(value, int | float) and not isinstance(value, bool):
        unit = _QUANTITY_UNITS.get(re.split(r"[_.]", path)[-1], 1_000_000_000)
        return _within(value * unit if isinstance(value, int) else _exactly(value, unit, path), path)
    seconds, nanoseconds = (next((name for name in names if _has(value, name)), None) for names in
                            (_SECONDS, _NANOSECONDS))  # fmt: skip
    if seconds is None:
        raise MessageError(f"{path} in a message is no time: name another by @, or the time of receipt, @{LOG_TIME}")
    parts = _at(value, [seconds], path), _at(value, [nanoseconds], path) if nanoseconds else 0
    if not all(isinstance(part, int) for part in parts):
        raise MessageError(f"{path} in a message has seconds and nanoseconds that are no whole numbers")
    return _within(parts[0] * 1_000_000_000 + parts[1], path)


def paths_of(message: Any) -> Iterator[str]:
    """Paths to all that is in a message, as far as one is told of; of a list of objects those in its first."""
    return islice(_paths_of(message), _MOST_PATHS)


def _paths_of(message: Any, before: str = "", depth: int = 0) -> Iterator[str]:
    """As ``paths_of``; a type of protobuf that holds itself has no end."""
    if _is_list(message):
        message = message[0] if len(message) and _is_object(message[0]) else None
    if depth == _DEEPEST or not _is_object(message):
        yield from [before] if before else []
        return
    for name in _names_in(message):
        value = message[name] if isinstance(message, Mapping) else getattr(message, name)
        yield from _paths_of(value, f"{before}.{name}" if before else str(name), depth + 1)


def _exactly(value: float, unit: int, path: str) -> int:
    """As it is written in decimals, to the nanosecond."""
    try:
        return int((Decimal(repr(value)) * unit).to_integral_value())
    except (ArithmeticError, ValueError):
        raise MessageError(f"{path} in a message is {value}, which is no time") from None


def _within(value: int, path: str) -> int:
    if not -_INT64 <= value < _INT64:
        raise MessageError(f"{path} in a message is too large for a time: name its unit by its end, _ns, _us or _ms")
    return value


def _time_of_text(text: str, path: str) -> int:
    """As in ISO 8601, in UTC."""
    try:
        stamp = np.datetime64(re.sub(r"(Z|[+-]00:?00)$", "", text[:_LONGEST_TIME]), "ns")
    except ValueError:
        stamp = np.datetime64("NaT")
    if np.isnat(stamp):
        raise MessageError(
            f"{path} in a message is {text[:40]!r}, not a time such as 2026-05-04T12:00:00.25Z (in UTC): name another "
            f"by @, or the time of receipt, @{LOG_TIME}"
        )
    return int(stamp.astype(np.int64))


def _number(value: Any, path: str) -> float:
    if value is None:  # JSON has no other way to write what is not a number
        return float("nan")
    if isinstance(value, bool) or not isinstance(value, int | float):
        kind = f"an object with {_names(value)}" if _is_object(value) else repr(value)[:40]
        raise MessageError(f"{path} in a message is {kind} in place of a number: name the right one by --field")
    try:
        return float(value)
    except OverflowError:
        return float("inf")


def _flat(value: Any) -> Iterator[Any]:
    """All that is in lists of lists, which may be nested deeply, and in vectors and quaternions: x, y, z and w."""
    waiting = [value]
    while waiting:
        first = waiting.pop()
        if _is_list(first):
            waiting += reversed(first)
        elif not isinstance(first, int | float) and {*_XYZ} <= (names := {*_names_in(first)}) <= {*_XYZ, "w"}:
            waiting += [_at(first, [name], name) for name in ("w", *reversed(_XYZ)) if name in names]
        else:
            yield first


def _at(value: Any, steps: Sequence[str], path: str) -> Any:
    """What the steps lead to; through each object of a list, where a step is no place in it."""
    for k, step in enumerate(steps):
        if _is_list(value) and not step.isdigit():
            return [_at(each, steps[k:], path) for each in value]
        try:
            value = value[step] if isinstance(value, Mapping) else _part(value, step)
        except (KeyError, IndexError, AttributeError, TypeError):
            raise MessageError(
                f"a message has no {path}: it has {_names(value)}, so name what is to be used by --field"
            ) from None
    return value


def _part(value: Any, step: str) -> Any:
    if _is_list(value):
        return value[int(step)]
    if step not in _names_in(value):
        raise KeyError(step)
    return getattr(value, step)


def _has(value: Any, path: str) -> bool:
    try:
        _at(value, path.split("."), path)
    except MessageError:
        return False
    return True


def _is_list(value: Any) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str | bytes)


def _is_object(value: Any) -> bool:
    return isinstance(value, Mapping) or hasattr(value, "DESCRIPTOR") or hasattr(value, "_full_text")


def _names_in(value: Any) -> list[str]:
    """The names of what an object has: of JSON, of protobuf, or of ROS; none of anything else."""
    if isinstance(value, Mapping):
        return [str(name) for name in value]
    if hasattr(value, "DESCRIPTOR"):
        return list(value.DESCRIPTOR.fields_by_name)
    return list(value.__slots__) if _is_object(value) else []


def _names(value: Any) -> str:
    """What an object has, or what it is."""
    if not _is_object(value):
        return f"a list of {len(value)} there" if _is_list(value) else f"{value!r:.40} there"
    names = _names_in(value)
    return ", ".join(names[:_SHOWN]) + " ..." * (len(names) > _SHOWN) or "nothing"


_USUAL = {2: ("outer", "inner"), 3: ("outer", "middle", "inner")}
_OURS = re.compile(r"outer|middle|inner|axis\d+")
_UNITS = ("deg", "rad")


def gimbal_names(count: int) -> tuple[str, ...]:
    """What gimbals are called in a recording, outer to inner."""
    return _USUAL.get(count) or tuple(f"axis{i}" for i in range(count))


def as_columns(text: str) -> Mapping[str, str]:
    """Our names of a table's columns where it names the gimbals as the stated joints are named."""
    joints = text.replace(",", " ").split()
    pairs = list(zip(joints, gimbal_names(len(joints)), strict=True))
    return {f"{joint}_{unit}": f"{usual}_{unit}" for joint, usual in pairs for unit in _UNITS}


class Joints:
    """Finds ``count`` gimbals, outer to inner, in message after message.

    stated: names of theirs. letters: of their axes, where all are different. warn: is told once where gimbals are taken
    by names that nobody stated, and not as they come.
    """

    def __init__(
        self,
        count: int,
        stated: Sequence[str] = (),
        letters: Sequence[str] = (),
        warn: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._count, self._stated, self._letters, self._warn = count, tuple(stated), tuple(letters), warn
        self._first: tuple[str, ...] | None = None
        self._is_told = False
        self.found = False
        """Whether any message had the stated joints."""
        self.others: tuple[str, ...] = ()
        """Names in a message that has none of them."""

    def __call__(self, names: tuple[str, ...], width: int) -> tuple[int, ...] | None:
        """Where the gimbals are among ``width`` positions; None: the message is of other joints only.

        Raises MessageError where the names do not tell.
        """
        if self._stated:
            return self._by_statement(names)
        known = self._by_meaning(names)
        if self._first is None:
            self._first = tuple(names[i] for i in known) if known else names
        if known:
            self._refuse_change(tuple(names[i] for i in known))
            self._tell(names, known)
            return known
        if width != self._count:
            raise MessageError(self._unclear(names, width))
        self._refuse_change(names)
        return tuple(names.index(name) for name in self._first) if names else tuple(range(width))

    def _by_statement(self, names: tuple[str, ...]) -> tuple[int, ...] | None:
        missing = [name for name in self._stated if names.count(name) != 1]
        if not missing:
            self.found = True
            return tuple(names.index(name) for name in self._stated)
        if names and len(missing) == len(self._stated):
            self.others = self.others or names
            return None
        given, lost = f"names {', '.join(names)}" if names else "gives joints without names", ", ".join(missing)
        raise MessageError(f"a message {given}, so that {lost} of the stated joints cannot be found in it")

    def _by_meaning(self, names: tuple[str, ...]) -> tuple[int, ...] | None:
        usual = gimbal_names(self._count)
        if any(_OURS.fullmatch(word) and word not in usual for name in names for word in _words(name)):
            return None  # of more gimbals, or fewer, than axes are stated
        for words in (usual, self._letters if len(names) == self._count else ()):
            places = [[i for i, name in enumerate(names) if word in _words(name)] for word in words]
            if places and all(len(own) == 1 for own in places):
                return tuple(own[0] for own in places)
        return None

    def _refuse_change(self, names: tuple[str, ...]) -> None:
        assert self._first is not None
        if sorted(names) != sorted(self._first):
            raise MessageError(
                f"joint names change from {' '.join(self._first)} to {' '.join(names)}: name the gimbals, outer to "
                "inner, by --joints"
            )

    def _tell(self, names: tuple[str, ...], known: tuple[int, ...]) -> None:
        if known != tuple(range(len(names))) and not self._is_told:
            self._is_told = True
            self._warn(
                f"of the joints {', '.join(names)} the gimbals are, by their names and outer to inner, "
                f"{', '.join(names[i] for i in known)}; --joints states others"
            )

    def _unclear(self, names: tuple[str, ...], width: int) -> str:
        if width < self._count or not names:
            return f"it gives {width} positions for {self._count} gimbal axes: state the axes it has"
        return (
            f"it gives {width} joints ({', '.join(names)}) where {self._count} gimbal axes are stated, and their names "
            "do not tell which are the gimbals: name these, outer to inner, for example "
            f'--joints "{" ".join(names[: self._count])}", or state all axes'
        )


def _words(name: str) -> set[str]:
    """``gimbal_outer_joint``, ``GimbalOuter``: their words in small letters, and the whole name."""
    return {name.lower(), *(word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+", name))}
