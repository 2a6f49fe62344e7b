"""Samples from messages in JSON, protobuf, or CDR of any type that the file defines, one after the other."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from contextlib import redirect_stderr
from typing import Any

import numpy as np
from mcap.records import Schema

from kf_calib.bench.streams import Stream
from kf_calib.errors import MissingExtraError
from kf_calib.sources.files.cdr import IMU, JOINT_STATE, QUATERNION, TEMPERATURE, Offsets
from kf_calib.sources.files.fields import LOG_TIME, Fields, Joints, MessageError, time_ns
from kf_calib.sources.files.mcap_records import log_times

ENCODINGS = ("json", "protobuf")
"""Those in which messages are told by their fields, whatever their type; in CDR only where fields are stated."""
CDR = "cdr"
_ANEW = "record it anew, or name another topic"
_Parse = Callable[[bytes], Any]
_DEFINED = {name: kind.schema.encode() for kind in (IMU, JOINT_STATE, QUATERNION, TEMPERATURE) for name in kind.names}
"""Definitions of types that bags may leave out."""


class _UnreadError(MessageError):
    """A message is not in the encoding that its topic is said to have."""


class FieldDecoder:
    """Samples from messages of one topic, ``width`` numbers each, taken from where ``fields`` says.

    encoding: of ``ENCODINGS``, or ``CDR``. joints: finds the gimbals among numbers that have names. warn: is told once
    where the messages have no time of their own. Raises MessageError where the schema does not say what they are.
    """

    def __init__(
        self, encoding: str, schema: Schema | None, fields: Fields, width: int, joints: Joints | None,
        warn: Callable[[str], None],
    ) -> None:  # fmt: skip
        self.width = width
        self._parse = parser_of(encoding, schema)
        self._fields, self._joints, self._warn = fields, joints, warn
        self._time = ""
        self._unread = list[str]()

    def take_unread(self) -> list[str]:
        """Why messages were left out since this was asked last."""
        unread, self._unread = self._unread, []
        return unread

    def stream_with_offsets(self, buffer: bytes, at: Offsets, size: int) -> tuple[Offsets, Stream]:
        """Those of the messages of ``size`` bytes each at offsets ``at`` of ``buffer``, after the offsets that they are
        from. Raises MessageError; a message that cannot be read is left out, if any before it could be."""
        kept, stamps, values = list[int](), list[int](), list[list[float]]()
        for start in at.tolist():
            try:
                message, numbers = self._read(buffer[start : start + size])
            except _UnreadError as error:
                if not self._time:
                    raise
                self._unread.append(str(error))
                continue
            if numbers is not None:
                kept.append(start)
                stamps.append(self._stamp(message))
                values.append(numbers)
        table, messages = np.array(values, float).reshape(len(values), self.width), np.array(kept, np.int64)
        times = log_times(buffer, messages) if self._time == LOG_TIME else np.array(stamps, np.int64)
        return messages, Stream(times, table)

    def _read(self, data: bytes) -> tuple[Any, list[float] | None]:
        """A message, and the numbers in it that are sought."""
        message = self._parse(data)
        try:
            return message, self._chosen(self._fields.numbers(message), self._fields.labels(message))
        except RecursionError:
            raise _UnreadError(f"a message is nested too deeply: {_ANEW}") from None

    def _chosen(self, numbers: list[float], names: tuple[str, ...]) -> list[float] | None:
        if self._joints and names:
            if len(names) != len(numbers):
                raise MessageError(f"a message names {len(names)} joints but gives {len(numbers)} positions")
            columns = self._joints(names, len(numbers))
            return None if columns is None else [numbers[k] for k in columns]
        if len(numbers) != self.width:
            raise MessageError(
                f"{', '.join(self._fields.paths)} gives {len(numbers)} numbers a message in place of {self.width}: "
                "name as many by --field"
            )
        return numbers

    def _stamp(self, message: Any) -> int:
        """The time in a message; 0 where that of receipt is taken."""
        if not self._time:
            self._time = self._fields.timed_by(message)
            if self._time == LOG_TIME and self._fields.time is None:
                self._warn(
                    "its messages have no time of their own that is known, so the time of receipt is taken; --field "
                    "names another behind @"
                )
        return 0 if self._time == LOG_TIME else time_ns(message, self._time)


def parser_of(encoding: str, schema: Schema | None) -> Callable[[bytes], Any]:
    """What makes an object of a message in one of ``ENCODINGS`` or ``CDR``; raises MessageError, as this does."""
    if encoding == CDR:
        return _of_cdr(schema)
    return _of_protobuf(schema) if encoding == "protobuf" else _of_json


def _of_json(data: bytes) -> Any:
    try:
        return json.loads(data)
    except (ValueError, RecursionError):
        raise _UnreadError(f"a message is not JSON, it begins with {data[:20]!r}: {_ANEW}") from None


def _of_protobuf(schema: Schema | None) -> _Parse:
    """What reads messages of a schema, which is a set of file descriptors."""
    try:
        from google.protobuf.descriptor_pb2 import FileDescriptorSet
        from google.protobuf.descriptor_pool import DescriptorPool
        from google.protobuf.message import DecodeError
        from google.protobuf.message_factory import GetMessageClass
    except ImportError:
        raise MissingExtraError(
            "reading protobuf messages needs protobuf, which is not installed: pip install 'kf_calib[bags]'."
        ) from None
    name = schema.name if schema else ""
    try:
        files = {file.name: file for file in FileDescriptorSet.FromString(schema.data if schema else b"").file}
        pool, added = DescriptorPool(), set[str]()

        def add(file: str) -> None:
            if file not in added and file in files:
                added.add(file)
                for needed in files[file].dependency:
                    add(needed)
                pool.Add(files[file])

        for file in files:
            add(file)
        kind = GetMessageClass(pool.FindMessageTypeByName(name))
    except Exception:  # of many kinds, for the schema may say anything
        raise MessageError(f"its schema {name!r} does not say what its protobuf messages are: record it anew") from None

    def parse(data: bytes) -> Any:
        try:
            return kind.FromString(data)
        except DecodeError:
            raise _UnreadError(f"a message is no {name} in protobuf: {_ANEW}") from None

    return parse


def _of_cdr(schema: Schema | None) -> _Parse:
    """What reads messages of ROS 2 whose definition is in the file, or is one of those known here."""
    try:
        from mcap_ros2.decoder import DecoderFactory
    except ImportError:
        raise MissingExtraError(
            "reading messages of this type needs mcap-ros2-support, which is not installed: pip install "
            "'kf_calib[bags]'."
        ) from None
    name, text = (schema.name, schema.data) if schema else ("without a name", b"")
    encoding = schema.encoding if schema else "ros2msg"
    text = text or _DEFINED.get(name, b"")
    if not text:
        raise MessageError(
            f"the file does not define its messages, {name}: convert it to MCAP, which does, by `ros2 bag convert` on "
            "a computer that knows them"
        )
    try:
        with redirect_stderr(io.StringIO()):  # it prints what it cannot read
            decode = DecoderFactory().decoder_for(CDR, Schema(id=1, name=name, encoding=encoding, data=text))
    except Exception:  # of many kinds, for the definition may say anything
        raise MessageError(f"the definition of its messages, {name}, cannot be read: record it anew") from None
    if decode is None:
        raise MessageError(
            f"its messages, {name}, are defined in {encoding!r} and can be read if defined in 'ros2msg': convert the "
            "file by `ros2 bag convert`"
        )

    def parse(data: bytes) -> Any:
        try:
            return decode(data)
        except Exception:  # likewise, for the bytes may be any
            raise _UnreadError(f"a message is no {name} in CDR: {_ANEW}") from None

    return parse
