"""A file of a ROS 2 bag in SQLite (.db3), given out as blocks of MCAP records.

It has two tables: topics (name, type) and messages (topic, time of receipt, bytes). Messages are taken in the order in
which they were written. Where the file is damaged, the messages around the damage are lost and told, the rest is used.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from kf_calib.errors import InputError
from kf_calib.sources.files.mcap_chunks import DamagedError
from kf_calib.sources.files.mcap_file import Warn
from kf_calib.sources.files.mcap_messages import MESSAGE_FIELDS, MESSAGE_RECORD, RecordBlock
from kf_calib.sources.files.mcap_summary import Summary

_ROWS = 4096  # messages fetched at a time, and lost at once where one of them is damaged
_LATEST = (1 << 63) - 1
_Row = tuple[int, int, int, bytes | None]  # id, topic, time of receipt, message


class SqliteBag:
    """A .db3 file on disk; ``summary`` has its topics.

    place: where the file lies, if not at ``path``, which messages name. usable: types of messages to be read, and
    names of topics; all others (pictures, say) stay in the file.
    """

    trouble = ""

    def __init__(self, path: Path, place: Path, usable: Iterable[str]) -> None:
        self.path = path
        self._place, self._usable = place, frozenset(usable)
        self.size = place.stat().st_size
        try:
            with closing(self._connect()) as base:
                topics = base.execute("SELECT id, name, type, serialization_format FROM topics ORDER BY id").fetchall()
                definitions = _definitions(base)
                self._last = base.execute("SELECT max(id) FROM messages").fetchone()[0] or 0
        except sqlite3.Error as error:
            raise InputError(
                f"{path} is an SQLite file but cannot be read as a ROS 2 bag ({error}): give a bag's .db3 file; a "
                f"damaged one may be mended by `sqlite3 {path} .recover | sqlite3 mended.db3`."
            ) from None
        self._topics = {topic: k + 1 for k, (topic, *_) in enumerate(topics)}
        self.summary = Summary(0)
        for k, (_, name, kind, encoding) in enumerate(topics, 1):
            language, text = definitions.get(kind, ("ros2msg", ""))
            self.summary.schemas.append(Schema(k, str(text).encode(), str(language), str(kind)))
            self.summary.channels.append(Channel(k, str(name), str(encoding), {}, k))

    def blocks(self, warn: Warn, growing: bool = False) -> Iterator[RecordBlock]:
        """The usable messages, some thousands a block; ``warn`` is told what is lost. Raises InputError."""
        if growing:
            raise InputError(f"{self.path} is a bag in SQLite, which can be read when it is finished: use replay.")
        damaged = list[str]()
        with closing(self._connect()) as base:
            for rows, after in self._pages(base, damaged):
                yield self._block(rows, after)
        if damaged:
            lost = min(len(damaged) * _ROWS, self._last)
            warn(f"{self.path} is damaged ({damaged[0]}): up to {lost} of its {self._last} messages are lost.")

    def receipts(self, warn: Warn) -> Iterator[tuple[int, NDArray[np.int64]]]:
        """Of all topics: the channel and the times of receipt of messages of it, some thousands at a time."""
        query = "SELECT topic_id, CAST(timestamp AS INTEGER) FROM messages ORDER BY id"
        try:
            with closing(self._connect()) as base:
                cursor = base.execute(query)
                while rows := cursor.fetchmany(_ROWS):
                    table = np.array([(self._topics.get(topic, 0), stamp or 0) for topic, stamp in rows], np.int64)
                    for channel in np.unique(table[:, 0]).tolist():
                        yield channel, table[table[:, 0] == channel, 1]
        except sqlite3.Error as error:
            warn(f"{self.path} is damaged ({error}): what lies behind that is not counted.")

    def first(self, channel: int) -> bytes:
        """The first message of a channel; nothing where there is none, or none that can be read."""
        topic = next(topic for topic, k in self._topics.items() if k == channel)
        query = "SELECT CAST(data AS BLOB) FROM messages WHERE topic_id = ? ORDER BY id LIMIT 1"
        try:
            with closing(self._connect()) as base:
                found = base.execute(query, (topic,)).fetchone()
        except sqlite3.Error:  # told where the messages are read
            found = None
        return (found[0] if found else None) or b""

    def record_at(self, position: int, opcode: int) -> bytes:
        raise DamagedError(f"an SQLite file has no record of kind {opcode} at byte {position}")

    def _connect(self) -> sqlite3.Connection:
        # A bag that was closed has no journal, and is then read without one: the folder may be write-protected.
        closed = not self._place.with_name(f"{self._place.name}-wal").exists()
        base = sqlite3.connect(
            f"{self._place.absolute().as_uri()}?mode=ro{'&immutable=1' * closed}", uri=True, check_same_thread=False
        )
        base.text_factory = lambda text: text.decode(errors="replace")
        return base

    def _pages(self, base: sqlite3.Connection, damaged: list[str]) -> Iterator[tuple[list[_Row], int]]:
        """Rows of usable topics, and the id up to which the table has been read; what fails is put in ``damaged``."""
        own = zip(self._topics, self.summary.schemas, self.summary.channels, strict=True)
        wanted = [topic for topic, schema, channel in own if {schema.name, channel.topic} & self._usable]
        query = (
            "SELECT id, topic_id, CAST(timestamp AS INTEGER), CAST(data AS BLOB) FROM messages "
            f"WHERE id > ? AND topic_id IN ({','.join('?' * len(wanted))}) ORDER BY id LIMIT {_ROWS}"
        )
        after = 0
        while after < self._last:
            try:
                rows = base.execute(query, (after, *wanted)).fetchall()
            except sqlite3.Error as error:
                damaged.append(str(error))
                after += _ROWS
                continue
            after = rows[-1][0] if len(rows) == _ROWS else self._last
            yield rows, after

    def _block(self, rows: list[_Row], after: int) -> RecordBlock:
        records = list[bytes]()
        for _, topic, stamp, data in rows:
            message, time_ns = data or b"", min(max(stamp or 0, 0), _LATEST)
            length = MESSAGE_FIELDS + len(message)
            records.append(
                MESSAGE_RECORD.pack(Opcode.MESSAGE, length, self._topics[topic], 0, time_ns, time_ns) + message
            )
        starts = np.cumsum([0, *map(len, records)])[:-1].astype(np.int64)
        data = b"".join(records)
        return RecordBlock(data, (len(data),), starts, self.size * after // max(self._last, 1))


def _definitions(base: sqlite3.Connection) -> dict[str, tuple[str, str]]:
    """Language and text of the definition of each type, as newer bags have them."""
    try:
        rows = base.execute("SELECT topic_type, encoding, encoded_message_definition FROM message_definitions")
        return {kind: (language, text) for kind, language, text in rows.fetchall()}
    except sqlite3.Error:
        return {}
