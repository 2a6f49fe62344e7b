"""Binary frames for high rates (docs/live.md): CDR structs with a CRC-32, COBS-encoded, each ended by a zero byte.

A frame before encoding, little-endian::

    octet kind; octet version; unsigned short reserved; unsigned long number; long long time_ns;
    double values[n]; unsigned long crc32

``number`` counts the frames of each kind, modulo 2^32: what is missing in it was lost. The bench's own frame holds the
text of a JSON object in place of values.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench.arrays import Floats, Mask, Times
from kf_calib.bench.bench import metadata_of
from kf_calib.bench.streams import Batch, Stream
from kf_calib.sources.text.reader import Described, LineCounts

FRAME_VERSION = 1
BENCH, ACCEL, ANGLES, ATTITUDE, TEMPERATURE = b"BAGQT"
_LONGEST = 1 << 16  # bytes of a frame; one of samples has 254 at most
_SHORT = 254  # up to this many bytes COBS adds one byte and no more
_PLAUSIBLE = 1 << 20  # frames lost at once; more is a bench that counts anew
_HEADS = np.dtype([("kind", "u1"), ("version", "u1"), ("reserved", "<u2"), ("number", "<u4"), ("time_ns", "<i8")])
_HEAD_BYTES, _CRC_BYTES = _HEADS.itemsize, 4
Bytes = NDArray[np.uint8]
FramePlaces = NDArray[np.int64]


@dataclass(frozen=True)
class _Found:
    """Samples of one kind, and the numbers of the frames they came in."""

    kind: int
    places: FramePlaces
    time_ns: Times
    values: Floats


def uncobs(data: bytes) -> bytes | None:
    """What was encoded by Consistent Overhead Byte Stuffing (Cheshire and Baker, 1999); None where that cannot be."""
    decoded, position = bytearray(), 0
    while position < len(data):
        code = data[position]
        if not code or position + code > len(data):
            return None
        decoded += data[position + 1 : position + code]
        position += code
        if code < 0xFF and position < len(data):
            decoded.append(0)
    return bytes(decoded)


def _uncobs_alike(table: Bytes) -> tuple[Bytes, Mask]:
    """Frames (n, m) of one encoded length m <= 255, decoded (n, m - 1), and which of them could be, (n,)."""
    count, length = table.shape
    decoded, rows, at = table.copy(), np.arange(count), np.zeros(count, np.int64)
    sound = np.ones(count, bool)
    while len(rows):  # every frame's next code byte at once; as many turns as the frame with most zeros has
        code = table[rows, at].astype(np.int64)
        decoded[rows, at] = 0
        at = at + code
        sound[rows[(at > length) | (code == 0)]] = False
        on = (at < length) & (code > 0)
        rows, at = rows[on], at[on]
    return decoded[:, 1:], sound


class FrameReader(Described):
    """Reads frames block by block; those that cannot be used are counted.

    lost: readings whose numbers are missing. The unit of readings is m/s^2, where no option states another.
    """

    advice = (
        "send a frame of the bench, then frames of readings (kind A) and of poses (kind G or Q), as docs/live.md says"
    )

    def __init__(self, counts: LineCounts) -> None:
        super().__init__(counts)
        self.lost = 0
        counts.what = "frames"
        self._tail = b""
        self._number: int | None = None

    def push(self, block: bytes) -> Batch:
        """The samples of the frames that end in ``block``."""
        *frames, self._tail = (self._tail + block).split(b"\0")
        if len(self._tail) > _LONGEST:  # no frame: what follows up to the next zero byte is none either
            self._tail = self._tail[: _LONGEST + 1]
        frames = [frame for frame in frames if frame]
        first = self._counts.lines + 1
        self._counts.lines += len(frames)
        return self._read(frames, first)

    def cut_off(self) -> None:
        """The link broke: a frame that has begun will not end."""
        if self._tail:
            self._counts.lines += 1
            self._counts.refuse(self._counts.lines, "the link broke in it")
        self._tail = b""

    def joined_amid(self) -> None:
        """What comes next may begin within a frame, which its checksum tells."""

    def rest(self) -> Batch:
        """Nothing: a frame without an end is none."""
        return Batch(Stream.empty(3), Stream.empty(self.pose_width))

    def _settle(self, frames: list[bytes]) -> None:
        """Learns from the first pose of all what poses are: below, frames are read by their lengths."""
        for frame in frames:
            if not (_HEAD_BYTES < len(frame) <= _SHORT + 1 and frame[0] > 1 and frame[1] in (ANGLES, ATTITUDE)):
                continue
            body = _sound_body(frame)
            size = len(body) - _HEAD_BYTES - _CRC_BYTES if body else 0
            if body and body[1] == FRAME_VERSION and size and size % 8 == 0 and (frame[1] == ANGLES or size == 32):
                self.has_angles, self.pose_width = frame[1] == ANGLES, size // 8
                return

    def _read(self, frames: list[bytes], first: int) -> Batch:
        if not self.pose_width:
            self._settle(frames)
        lengths = np.fromiter(map(len, frames), np.int64, len(frames))
        samples = list[_Found]()
        for length in np.unique(lengths).tolist():
            at = np.flatnonzero(lengths == length)
            if length > _SHORT + 1:
                for i in at.tolist():
                    self._read_long(frames[i], first + i)
            elif length > _HEAD_BYTES + _CRC_BYTES:
                table = np.frombuffer(b"".join([frames[i] for i in at.tolist()]), np.uint8).reshape(-1, length)
                samples += self._read_alike(table, first + at)
            else:
                self._refuse(first + at, "it is too short")
        poses = ANGLES if self.has_angles else ATTITUDE
        return Batch(
            _stream(samples, ACCEL, 3), _stream(samples, poses, self.pose_width), _stream(samples, TEMPERATURE, 1)
        )

    def _read_alike(self, table: Bytes, places: FramePlaces) -> Iterator[_Found]:
        """The samples in frames (n, m) of one encoded length, by kind."""
        bodies, sound = _uncobs_alike(table)
        size = bodies.shape[1] - _CRC_BYTES
        stated = np.ascontiguousarray(bodies[:, size:]).view("<u4")[:, 0]
        texts = np.ascontiguousarray(bodies[:, :size]).tobytes()
        sound &= stated == np.array([zlib.crc32(texts[k : k + size]) for k in range(0, len(texts), size)], np.uint32)
        self._refuse(places[~sound], "its checksum does not fit")
        for kind in np.unique(bodies[sound, 0]).tolist():
            of_kind = sound & (bodies[:, 0] == kind)
            heads = np.frombuffer(np.ascontiguousarray(bodies[of_kind, :_HEAD_BYTES]).tobytes(), _HEADS)
            contents = np.ascontiguousarray(bodies[of_kind, _HEAD_BYTES:size])
            if kind == BENCH:
                for content, place in zip(contents, places[of_kind].tolist(), strict=True):
                    self._learn(content.tobytes(), place)
            elif reason := self._misfit(kind, contents.shape[1], heads):
                self._refuse(places[of_kind], reason)
            else:
                values = contents.view("<f8").astype(float)
                usable = np.isfinite(values).all(axis=1)
                self._refuse(places[of_kind][~usable], "a number is not finite")
                if kind == ATTITUDE:
                    is_zero = usable & ~values.any(axis=1)
                    self._refuse(places[of_kind][is_zero], "the quaternion is zero")
                    usable &= ~is_zero
                if kind == ACCEL:
                    self._follow(heads["number"].astype(np.int64))
                yield _Found(kind, places[of_kind][usable], heads["time_ns"][usable], values[usable])

    def _misfit(self, kind: int, size: int, heads: NDArray[np.void]) -> str | None:
        """Why frames of this kind with so many bytes of values cannot be used."""
        if (heads["version"] != FRAME_VERSION).any():
            return f"it is not of version {FRAME_VERSION}"
        if not size:
            return "it has no values"
        if kind == ATTITUDE and size != 32:
            return "it is not a quaternion"
        widths = {ACCEL: 3, TEMPERATURE: 1, ANGLES if self.has_angles else ATTITUDE: self.pose_width}
        if kind not in widths:
            return "it is of a kind that is not known, or not like the poses before it"
        return None if size == 8 * widths[kind] else f"it has {size} bytes of values"

    def _read_long(self, frame: bytes, place: int) -> None:
        body = _sound_body(frame) if len(frame) <= _LONGEST else None
        if body is None:
            self._counts.refuse(place, "its checksum does not fit")
        elif body[0] != BENCH:
            self._counts.refuse(place, f"it has {len(body) - _HEAD_BYTES - 4} bytes of values")
        else:
            self._learn(body[_HEAD_BYTES:-4], place)

    def _learn(self, text: bytes, place: int) -> None:
        try:
            facts = json.loads(text)
            if not isinstance(facts, dict):
                raise ValueError
            self.metadata = metadata_of({key: value for key, value in facts.items() if value is not None})
        except (ValueError, RecursionError):
            self._counts.refuse(place, "it holds no JSON object")

    def _follow(self, numbers: NDArray[np.int64]) -> None:
        """Counts the numbers passed over; one that is far off is that of a bench that counts anew."""
        if self._number is not None:
            numbers = np.concatenate([[self._number], numbers])
        passed = (np.diff(numbers) - 1) % (1 << 32)
        self.lost += int(passed[passed < _PLAUSIBLE].sum())
        self._number = int(numbers[-1])

    def _refuse(self, places: FramePlaces, reason: str) -> None:
        for place in places.tolist():
            self._counts.refuse(place, reason)


def _sound_body(frame: bytes) -> bytes | None:
    """A frame decoded, with its checksum; None where that does not fit."""
    body = uncobs(frame)
    if (
        body is None
        or len(body) < _HEAD_BYTES + _CRC_BYTES
        or int.from_bytes(body[-4:], "little") != zlib.crc32(body[:-4])
    ):
        return None
    return body


def _stream(groups: Sequence[_Found], kind: int, width: int) -> Stream:
    """All samples of a kind, in the order of their frames."""
    of_kind = [each for each in groups if each.kind == kind and len(each.places)]
    if not of_kind:
        return Stream.empty(width)
    order = np.argsort(np.concatenate([each.places for each in of_kind]), kind="stable")
    return Stream(
        np.concatenate([each.time_ns for each in of_kind]).astype(np.int64)[order],
        np.concatenate([each.values for each in of_kind])[order],
    )
