"""A file of a ROS 2 bag in SQLite (.db3), given out as blocks of MCAP records.

It has two tables: topics (name, type) and messages (topic, time of receipt, bytes). Messages are taken in the order in
which they were written. Where the file is damaged, the messages around the damage are lost and told, the rest is used.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from kf_calib.errors import InputError
from kf_calib.sources.files.mcap_chunks import DamagedError
from kf_calib.sources.files.mcap_file import Warn
from kf_calib.sources.files.mcap_messages import MESSAGE_FIELDS, MESSAGE_RECORD, RecordBlock
from kf_calib.sources.files.mcap_summary import Summary
from kf_calib.sources.files.sqlite_base import FAILURES, NoBagError, connect, refuse_unreal, size_of, words_of
from kf_calib.sources.files.sqlite_rows import ROWS, MessageRows, Row

_MOST_TOPICS, _MOST_DEFINITION_BYTES = 2000, 1 << 24
_LATEST = (1 << 63) - 1


class SqliteBag:
    """A .db3 file on disk; ``summary`` has its topics.

    place: where the file lies, if not at ``path``, which messages name. usable: types of messages to be read, and
    names of topics; all others (pictures, say) stay in the file. longest: bytes of one message.
    """

    trouble = ""

    def __init__(self, path: Path, place: Path, usable: Iterable[str], longest: int = 1 << 28) -> None:
        self.path = path
        self._place, self._usable, self._longest = place, frozenset(usable), longest
        self.size = size_of(place)
        self.summary, self._topics, self._unfit = Summary(0), dict[Any, int](), 0
        try:
            with closing(connect(place, _MOST_DEFINITION_BYTES)) as base:
                for table in ("topics", "messages"):
                    refuse_unreal(base, table)
                self._list_topics(base)
                ends = "SELECT (SELECT min(rowid) FROM messages), (SELECT max(rowid) FROM messages)"
                first, last = base.execute(ends).fetchone()
        except (*FAILURES, NoBagError) as error:
            raise InputError(
                f"{path} is an SQLite file but cannot be read as a ROS 2 bag ({words_of(error)}): give a bag's .db3 "
                f"file; a damaged one may be mended by `sqlite3 {path} .recover | sqlite3 mended.db3`."
            ) from None
        self._first, self._last = (0, -1) if first is None else (first, last)

    def _list_topics(self, base: sqlite3.Connection) -> None:
        """Take the topics; such as have no name, or the id of another one, are left out and counted."""
        definitions = _definitions(base)
        query = f"SELECT id, name, type, serialization_format FROM topics ORDER BY rowid LIMIT {_MOST_TOPICS}"
        for topic, name, kind, encoding in _within(base.execute(query)):
            named = all(isinstance(own, str) for own in (name, kind, encoding))
            if topic is None or topic in self._topics or not named:
                self._unfit += 1
                continue
            k = self._topics[topic] = len(self._topics) + 1
            language, text = definitions.get(kind, ("ros2msg", ""))
            self.summary.schemas.append(Schema(k, text.encode(), language, kind))
            self.summary.channels.append(Channel(k, name, encoding, {}, k))

    def blocks(self, warn: Warn, growing: bool = False) -> Iterator[RecordBlock]:
        """The usable messages, some thousands a block; ``warn`` is told what is lost. Raises InputError."""
        if growing:
            raise InputError(f"{self.path} is a bag in SQLite, which can be read when it is finished: use replay.")
        self._warn_of_topics(warn)
        with closing(connect(self._place, self._longest)) as base:
            messages = MessageRows(base, self._wanted, self._first, self._last, self.size)
            for rows, after in messages:
                yield self._block(rows, after)
        if messages.why:
            lost = f"up to {messages.lost} of its {self._last - self._first + 1} messages are lost"
            warn(f"{self.path} is damaged ({messages.why}): {lost}.")
        if messages.empty:
            warn(f"{self.path}: {messages.empty} messages are empty and left out.")

    def receipts(self, warn: Warn) -> Iterator[tuple[int, NDArray[np.int64]]]:
        """Of all topics: the channel and the times of receipt of messages of it, some thousands at a time."""
        self._warn_of_topics(warn)
        query, strangers = "SELECT topic_id, CAST(timestamp AS INTEGER) FROM messages ORDER BY rowid", 0
        try:
            with closing(connect(self._place, self._longest)) as base:
                cursor = base.execute(query)
                while rows := cursor.fetchmany(ROWS):
                    table = np.array([(self._topics.get(topic, 0), stamp or 0) for topic, stamp in rows], np.int64)
                    strangers += int((table[:, 0] == 0).sum())
                    for channel in np.unique(table[table[:, 0] > 0, 0]).tolist():
                        yield channel, table[table[:, 0] == channel, 1]
        except FAILURES as error:
            warn(f"{self.path} is damaged ({words_of(error)}): what lies behind that is not counted.")
        if strangers:
            warn(f"{self.path}: {strangers} messages are of no topic that it lists, and left out.")

    def first(self, channel: int) -> bytes:
        """The first message of a channel; nothing where there is none, or none that can be read."""
        topic = next(topic for topic, k in self._topics.items() if k == channel)
        query = "SELECT CAST(data AS BLOB) FROM messages WHERE +topic_id = ? ORDER BY rowid LIMIT 1"
        try:
            with closing(connect(self._place, self._longest)) as base:
                row = base.execute(query, (topic,)).fetchone()
        except FAILURES:  # told where the messages are read
            row = None
        return (row[0] if row else None) or b""

    def record_at(self, position: int, opcode: int) -> bytes:
        raise DamagedError(f"an SQLite file has no record of kind {opcode} at byte {position}")

    def _warn_of_topics(self, warn: Warn) -> None:
        if self._unfit:
            warn(f"{self.path}: {self._unfit} of its topics have no name or the id of another one, and are left out.")

    @property
    def _wanted(self) -> list[Any]:
        """Ids of the usable topics."""
        own = zip(self._topics, self.summary.schemas, self.summary.channels, strict=True)
        return [topic for topic, schema, channel in own if {schema.name, channel.topic} & self._usable]

    def _block(self, rows: list[Row], after: int) -> RecordBlock:
        records = list[bytes]()
        for _, topic, stamp, message in rows:
            time_ns = min(max(stamp or 0, 0), _LATEST)
            length = MESSAGE_FIELDS + len(message)
            records.append(
                MESSAGE_RECORD.pack(Opcode.MESSAGE, length, self._topics[topic], 0, time_ns, time_ns) + message
            )
        starts = np.cumsum([0, *map(len, records)])[:-1].astype(np.int64)
        data = b"".join(records)
        share = (after - self._first + 1) / (self._last - self._first + 1)
        return RecordBlock(data, (len(data),), starts, int(self.size * share))


def _definitions(base: sqlite3.Connection) -> dict[str, tuple[str, str]]:
    """Language and text of the definition of each type, as newer bags have them."""
    query = f"SELECT topic_type, encoding, encoded_message_definition FROM message_definitions LIMIT {_MOST_TOPICS}"
    try:
        refuse_unreal(base, "message_definitions")
        rows = list(_within(base.execute(query)))
    except (*FAILURES, NoBagError):
        return {}
    return {row[0]: (row[1], row[2]) for row in rows if all(isinstance(own, str) for own in row)}


def _within(cursor: sqlite3.Cursor) -> Iterator[tuple[Any, ...]]:
    """The rows, as long as they are no longer together than topics and their definitions are."""
    size = 0
    for row in cursor:
        size += sum(len(own) for own in row if isinstance(own, str | bytes))
        if size > _MOST_DEFINITION_BYTES:
            raise sqlite3.DatabaseError("its topics are longer than those of any bag")
        yield row
