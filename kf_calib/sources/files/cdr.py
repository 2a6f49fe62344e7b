"""CDR layout of the four ROS 2 messages in a recording: packed and unpacked many at a time.

Messages of one topic have their numbers at the same byte offsets while the strings in them keep their lengths,
so a whole run of messages is one numpy structured array. Offsets count from the start of the message, whose
first four bytes name the encapsulation (00 01 00 00: little-endian CDR); alignment counts from byte 4.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench.arrays import Floats
from kf_calib.bench.streams import SECOND_NS, Stream
from kf_calib.sources.files.fields import Joints, MessageError
from kf_calib.sources.files.mcap_records import at_every_byte

Offsets = NDArray[np.int64]

_LITTLE_ENDIAN = b"\x00\x01\x00\x00"
_FRAME = 12  # byte offset of frame_id in every message that starts with a std_msgs/Header
_HEAD = np.dtype([("kind", "<u4"), ("sec", "<i4"), ("nanosec", "<u4"), ("frame", "<u4")])
_MAX_PADDING = 7
_ANEW = "the messages are not of the type that the topic has, so record it anew, or choose another topic"


@dataclass(frozen=True)
class Layout:
    """Where the numbers lie in messages of one shape.

    size: bytes of a message. values: offset of the first of ``width`` consecutive float64.
    flagged: the float64 after them is -1 where they were not measured.
    names: what each value is called (joints only), spelled out in the bytes ``names_at``, which are alike in all
    messages of this layout.
    """

    size: int
    values: int
    width: int
    flagged: bool = False
    names: tuple[str, ...] = ()
    names_at: tuple[int, int] = (0, 0)


@lru_cache(maxsize=64)
def dtype_of(layout: Layout) -> np.dtype[np.void]:
    """Structured dtype over one message: fields sec, nanosec, values, and head, names, numbers as bytes.

    head: encapsulation, stamp and length of frame_id. numbers: the values and, where flagged, one more.
    """
    start, stop = layout.names_at
    count = layout.width + layout.flagged
    fields: dict[str, tuple[Any, int]] = {
        "head": (f"V{_HEAD.itemsize}", 0),
        "sec": ("<i4", 4),
        "nanosec": ("<u4", 8),
        "names": ((np.uint8, (stop - start,)), start),
        "values": (("<f8", (layout.width,)), layout.values),
        "numbers": (f"V{8 * count}", layout.values),
    }
    formats, offsets = zip(*fields.values(), strict=True)
    return np.dtype(
        {"names": list(fields), "formats": list(formats), "offsets": list(offsets), "itemsize": layout.size}
    )


@dataclass(frozen=True)
class MessageType:
    """One ROS 2 message: ``name``, full ``schema`` text, and the layout of a given message's bytes."""

    name: str
    schema: str
    layout: Callable[[bytes], Layout]

    @property
    def names(self) -> tuple[str, str]:
        """The name, and as it was in older bags."""
        return self.name, self.name.replace("/msg/", "/")


def _align(offset: int, to: int) -> int:
    return offset + (4 - offset) % to


def _uint32(message: bytes, offset: int) -> int:
    return struct.unpack_from("<I", message, offset)[0]


def _after_string(message: bytes, offset: int) -> int:
    end = offset + 4 + _uint32(message, offset)
    if end > len(message):
        raise MessageError(f"a string of the message ends at byte {end} of {len(message)}: {_ANEW}")
    return end


def _numbers(width: int, *, before: int = 0, after: int = 0, flagged: bool = False) -> Callable[[bytes], Layout]:
    """What tells the layout of messages that are a header and numbers: so many before the values and after them."""

    def layout(message: bytes) -> Layout:
        values = _align(_after_string(message, _FRAME), 8) + 8 * before
        return Layout(size=values + 8 * (width + after), values=values, width=width, flagged=flagged)

    return layout


def _joint_state_layout(message: bytes) -> Layout:
    start = _align(_after_string(message, _FRAME), 4)
    count, offset = _uint32(message, start), start + 4
    names: list[str] = []
    for _ in range(count):
        begin = _align(offset, 4)
        offset = _after_string(message, begin)
        names.append(message[begin + 4 : offset - 1].decode(errors="replace"))
    offset = _align(offset, 4)
    width, offset = _uint32(message, offset), offset + 4
    values = _align(offset, 8) if width else offset
    if count not in (0, width):
        raise MessageError(f"it names {count} joints but gives {width} positions")
    end = values + 8 * width
    for _ in ("velocity", "effort"):
        offset = _align(end, 4)
        more = _uint32(message, offset)
        end = _align(offset + 4, 8) + 8 * more if more else offset + 4
    return Layout(size=end, values=values, width=width, names=tuple(names), names_at=(start, values))


_RULER = "=" * 80
_HEADER_SCHEMA = f"""{_RULER}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_RULER}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
_QUATERNION_SCHEMA = f"""{_RULER}
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
"""
_VECTOR_SCHEMA = f"""{_RULER}
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
"""

IMU = MessageType(
    "sensor_msgs/msg/Imu",
    f"""std_msgs/Header header
geometry_msgs/Quaternion orientation
float64[9] orientation_covariance
geometry_msgs/Vector3 angular_velocity
float64[9] angular_velocity_covariance
geometry_msgs/Vector3 linear_acceleration
float64[9] linear_acceleration_covariance
{_HEADER_SCHEMA}{_QUATERNION_SCHEMA}{_VECTOR_SCHEMA}""",
    _numbers(3, before=4 + 9 + 3 + 9, after=9, flagged=True),  # orientation and rates come first, with covariances
)
JOINT_STATE = MessageType(
    "sensor_msgs/msg/JointState",
    f"""std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
{_HEADER_SCHEMA}""",
    _joint_state_layout,
)
QUATERNION = MessageType(
    "geometry_msgs/msg/QuaternionStamped",
    f"""std_msgs/Header header
geometry_msgs/Quaternion quaternion
{_HEADER_SCHEMA}{_QUATERNION_SCHEMA}""",
    _numbers(4),
)
TEMPERATURE = MessageType(
    "sensor_msgs/msg/Temperature",
    f"""std_msgs/Header header
float64 temperature
float64 variance
{_HEADER_SCHEMA}""",
    _numbers(1, after=1),
)


def _string(text: str) -> bytes:
    raw = text.encode() + b"\x00"
    return struct.pack("<I", len(raw)) + raw


def _append(message: bytes, alignment: int, content: bytes) -> bytes:
    return message.ljust(_align(len(message), alignment), b"\x00") + content


def _header(frame_id: str) -> bytes:
    return _LITTLE_ENDIAN + bytes(8) + _string(frame_id)


def imu_message(frame_id: str) -> bytes:
    """An Imu at stamp 0 that reads zero; orientation and rates carry the -1 of fields not measured."""
    unmeasured = (-1.0, *[0.0] * 8)
    numbers = (0.0, 0.0, 0.0, 1.0, *unmeasured, 0.0, 0.0, 0.0, *unmeasured, *[0.0] * (3 + 9))
    return _append(_header(frame_id), 8, struct.pack("<37d", *numbers))


def joint_state_message(frame_id: str, names: Sequence[str]) -> bytes:
    """A JointState at stamp 0 with ``names`` at position zero, without velocities and efforts."""
    message = _append(_header(frame_id), 4, struct.pack("<I", len(names)))
    for name in names:
        message = _append(message, 4, _string(name))
    message = _append(message, 4, struct.pack("<I", len(names)))
    return _append(message, 8 if names else 4, bytes(8 * len(names))) + bytes(8)


def quaternion_message(frame_id: str) -> bytes:
    """A QuaternionStamped at stamp 0, all zero."""
    return _append(_header(frame_id), 8, bytes(4 * 8))


def temperature_message(frame_id: str) -> bytes:
    """A Temperature at stamp 0 of 0 degC; variance 0, which the message's definition reads as unknown."""
    return _append(_header(frame_id), 8, bytes(2 * 8))


def fill(messages: NDArray[np.void], stream: Stream) -> None:
    """Put stamps and values, of their number, into messages (n,); raises MessageError where a stamp does not fit."""
    seconds, nanoseconds = np.divmod(stream.time_ns, SECOND_NS)
    if len(seconds) and not (0 <= seconds.min() and seconds.max() < 2**31):
        raise MessageError("stamps must be nanoseconds between the years 1970 and 2038")
    messages["sec"], messages["nanosec"], messages["values"] = seconds, nanoseconds, stream.values


def pack(kind: MessageType, template: bytes, stream: Stream) -> list[bytes]:
    """One message for each sample of ``stream``: ``template`` with its stamp and values put in.

    Raises MessageError where the number of values is not the template's or a stamp does not fit the message.
    """
    layout = kind.layout(template)
    if stream.values.shape != (len(stream), layout.width):
        raise MessageError(f"{kind.name} holds {layout.width} values a sample here, not {stream.values.shape[1:]}")
    messages = np.frombuffer(bytearray(template * len(stream)), dtype_of(layout))
    fill(messages, stream)
    packed, size = messages.tobytes(), messages.itemsize
    return [packed[start : start + size] for start in range(0, len(packed), size)]


class Decoder:
    """Samples from messages of one topic: stamps from header.stamp, ``width`` values each.

    joints: finds the gimbals among the positions of a joint state; messages without them are passed over.
    """

    def __init__(self, kind: MessageType, width: int, joints: Joints | None = None) -> None:
        self.kind = kind
        self.width = width
        self._joints = joints or Joints(width)

    def __call__(self, buffer: bytes, at: Offsets, size: int) -> Stream:
        """The messages of ``size`` bytes each that start at offsets ``at`` (n,) of ``buffer``, all within it.

        Raises MessageError for a message of another layout.
        """
        return self.stream_with_offsets(buffer, at, size)[1]

    def stream_with_offsets(self, buffer: bytes, at: Offsets, size: int) -> tuple[Offsets, Stream]:
        """The same, after the offsets (m,) of the messages that the m samples are from."""
        time_ns, values = np.empty(len(at), np.int64), np.empty((len(at), self.width))
        rest, kept = np.arange(len(at)), np.ones(len(at), bool)
        while len(rest):  # once, but for topics whose strings change
            start = int(at[rest[0]])
            layout = self._layout(buffer[start : start + size])
            columns = self._columns(layout)
            every = at_every_byte(buffer, dtype_of(layout))
            head = every["head"][at[rest]].view(_HEAD)
            alike = (head["kind"] == head["kind"][0]) & (head["frame"] == head["frame"][0])
            if every["names"].shape[1]:
                names = every["names"][at[rest]]
                alike &= (names == names[0]).all(axis=1)
            stamps = head["sec"].astype(np.int64) * SECOND_NS + head["nanosec"]
            if len(rest) == len(at) and alike.all() and columns is not None:
                return at, Stream(stamps, self._values(every["numbers"][at], layout, columns))
            part, rest = rest[alike], rest[~alike]
            if columns is None:
                kept[part] = False
            else:
                numbers = every["numbers"][at[part]]
                time_ns[part], values[part] = stamps[alike], self._values(numbers, layout, columns)
        return at[kept], Stream(time_ns[kept], values[kept])

    def _layout(self, message: bytes) -> Layout:
        if len(message) < len(_LITTLE_ENDIAN):
            raise MessageError(f"a {self.kind.name} does not fit in its {len(message)} bytes: {_ANEW}")
        if message[:2] != _LITTLE_ENDIAN[:2]:
            raise MessageError(
                f"its encapsulation is {message[:2].hex(' ')}, only 00 01 (little-endian CDR) can be read: convert it"
            )
        try:
            layout = self.kind.layout(message)
        except struct.error:
            raise MessageError(f"a {self.kind.name} does not fit in its {len(message)} bytes: {_ANEW}") from None
        if not layout.size <= len(message) <= layout.size + _MAX_PADDING:
            raise MessageError(f"a {self.kind.name} takes {layout.size} bytes, the message has {len(message)}: {_ANEW}")
        return layout

    def _columns(self, layout: Layout) -> tuple[int, ...] | None:
        """Which values of a message are wanted; None: none of them."""
        if self.kind is not JOINT_STATE:
            return tuple(range(layout.width))
        return self._joints(layout.names, layout.width)

    def _values(self, numbers: NDArray[np.void], layout: Layout, columns: tuple[int, ...]) -> Floats:
        table = numbers.view("<f8").reshape(len(numbers), -1)
        if layout.flagged and np.any(table[:, layout.width] == -1.0):
            raise MessageError(
                "linear_acceleration is marked as not measured (-1 in its covariance): choose another topic by "
                "--accel-topic"
            )
        if columns == tuple(range(self.width)):
            return table[:, : self.width]
        return table[:, columns]
