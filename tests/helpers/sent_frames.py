"""Binary frames as a bench sends them (docs/live.md): the other side of ``sources.live.frames``."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

from kf_calib.sources.live.frames import BENCH, FRAME_VERSION

_HEAD = struct.Struct("<BBHIq")  # kind, version, reserved, number, time_ns


def encode(kind: int, number: int, time_ns: int, content: bytes) -> bytes:
    """One frame, with the zero byte that ends it."""
    body = _HEAD.pack(kind, FRAME_VERSION, 0, number & 0xFFFFFFFF, time_ns) + content
    return cobs(body + struct.pack("<I", zlib.crc32(body))) + b"\0"


def sample(kind: int, number: int, time_ns: int, values: Sequence[float]) -> bytes:
    """A frame of one reading (m/s^2), pose (rad, or a quaternion) or temperature (degC)."""
    return encode(kind, number, time_ns, struct.pack(f"<{len(values)}d", *values))


def bench(metadata: Mapping[str, Any]) -> bytes:
    """The frame that describes the bench; to be sent first, and again whenever a link begins."""
    return encode(BENCH, 0, 0, json.dumps(metadata).encode())


def cobs(data: bytes) -> bytes:
    """Consistent Overhead Byte Stuffing (Cheshire and Baker, 1999): no zero byte is left."""
    encoded = bytearray()
    for part in data.split(b"\0"):
        while len(part) >= 254:
            encoded += b"\xff" + part[:254]
            part = part[254:]
        encoded.append(len(part) + 1)
        encoded += part
    return bytes(encoded)
