"""The messages in a block of records, found by array operations rather than by walking from one to the next."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

MAGIC = b"\x89MCAP0\r\n"
HEAD = struct.Struct("<BQ")  # opcode, length of the content
MESSAGE_FIELDS = 22  # channel u16, sequence u32, log time u64, publish time u64; then the message itself
MESSAGE_RECORD = struct.Struct("<BQHIQQ")  # head and fields of a message's record
Integers = NDArray[np.int64]
_MOST_KINDS = 16  # of record heads; beyond that, searching for them costs more than walking
_MOST_OTHERS = 1 << 17  # records of a block that are no messages: every schema and channel there can be


@dataclass(frozen=True)
class RecordBlock:
    """Records of the file as they lie in it: what some chunks hold, and what lies outside chunks, joined together.

    borders: bytes of ``data`` where its parts end, ascending, the last one its size; damage does not spread over them.
    index: bytes of ``data`` where messages start, if the file's index is right: no checksum of a chunk covers it.
    end: byte of the file up to which it has been read.
    """

    data: bytes
    borders: tuple[int, ...]
    index: Integers
    end: int


@dataclass(frozen=True)
class MessageGroup:
    """Messages of one channel and one length: byte of the block where each starts (n,), bytes that each takes."""

    channel: int
    at: Integers
    size: int


@dataclass(frozen=True)
class Messages:
    """What a block holds: messages, opcode and content of other records, and how many bytes make no sense."""

    groups: list[MessageGroup]
    others: list[tuple[int, bytes]]
    lost: int


_MESSAGE = int(Opcode.MESSAGE)  # a plain int: comparing a whole block with an enum would widen it first
_LEAST_MESSAGE = HEAD.size + MESSAGE_FIELDS
_SPARSE = 16  # bytes to one with a message's opcode, at least: of random bytes it is one of 256
_HEADS = np.dtype([("opcode", "u1"), ("length", "<i8"), ("channel", "<u2")])
_CHANNEL_SHIFT, _LENGTH_SHIFT = 8, 24


class MessageFinder:
    """Finds the messages of block after block.

    Where records may start is known from the file's index, or is every byte with a message's opcode. Of these are kept
    the ones whose head (length and channel) was met before, all at once. They are right if each record ends where
    the next begins, from the block's first byte to its last; if not, the block is walked through record by record.
    """

    def __init__(self) -> None:
        self._known: list[int] = []

    def __call__(self, block: RecordBlock) -> Messages:
        data = block.data
        return self._chain(data, block.index) or self._chain(data, _candidates(data)) or self._walk(data, block.borders)

    def _chain(self, data: bytes, start: Integers) -> Messages | None:
        """The messages, if all of them are among the records at ``start`` (ascending), and nothing else is there."""
        start = start[np.searchsorted(start, 0) : np.searchsorted(start, len(data) - _LEAST_MESSAGE, side="right")]
        if not self._known or not len(start):
            return None
        kind = _kinds(data, start)
        masks = [kind == known for known in self._known]
        found = np.logical_or.reduce(masks)
        first, end = start[found], start[found] + HEAD.size + (kind[found] >> _LENGTH_SHIFT)
        if not len(first) or first[0] != 0 or end[-1] != len(data) or np.any(first[1:] != end[:-1]):
            return None
        groups = [_group(known, start[mask]) for known, mask in zip(self._known, masks, strict=True)]
        return Messages(groups, others=[], lost=0)

    def _walk(self, data: bytes, borders: tuple[int, ...]) -> Messages:
        starts: list[int] = []
        others: list[tuple[int, bytes]] = []
        position = lost = 0
        for border in borders:
            while position < border:
                opcode, length = HEAD.unpack_from(data, position) if position + HEAD.size <= border else (0, 0)
                content = position + HEAD.size
                if not opcode or content + length > border or (opcode == _MESSAGE and length < MESSAGE_FIELDS):
                    lost += border - position
                    break
                if opcode == _MESSAGE:
                    starts.append(position)
                elif len(others) < _MOST_OTHERS:
                    others.append((opcode, data[content : content + length]))
                else:
                    lost += border - position
                    break
                position = content + length
            position = border
        start = np.array(starts, np.int64)
        kind = _kinds(data, start)
        kinds: list[int] = np.unique(kind).tolist()
        self._known = sorted({*self._known, *kinds})
        if len(self._known) > _MOST_KINDS:
            self._known = []
        return Messages([_group(known, start[kind == known]) for known in kinds], others, lost)


def _candidates(data: bytes) -> Integers:
    """Bytes with a message's opcode; none where far too many have it to be worth looking at."""
    has_opcode = np.frombuffer(data, np.uint8) == _MESSAGE
    is_sparse = np.count_nonzero(has_opcode) <= len(data) // _SPARSE
    return np.flatnonzero(has_opcode) if is_sparse else np.empty(0, np.int64)


def _kinds(data: bytes, start: Integers) -> Integers:
    """Opcode, channel and length of the records at ``start`` in one number each."""
    heads = np.ndarray((max(len(data) - _HEADS.itemsize + 1, 0),), _HEADS, data, strides=(1,))
    channel = heads["channel"][start].astype(np.int64) << _CHANNEL_SHIFT
    return (heads["length"][start] << _LENGTH_SHIFT) | channel | heads["opcode"][start]


def _group(kind: int, start: Integers) -> MessageGroup:
    channel, length = (kind >> _CHANNEL_SHIFT) & 0xFFFF, kind >> _LENGTH_SHIFT
    return MessageGroup(channel, start + _LEAST_MESSAGE, length - MESSAGE_FIELDS)
