"""A file of a ROS 2 bag in SQLite (.db3), given out as blocks of MCAP records.

It has two tables: topics (name, type) and messages (topic, time of receipt, bytes). Messages are taken in the order in
which they were written. Where the file is damaged, the messages around the damage are lost and told, the rest is used:
where a query fails, fewer rows are fetched, until it is one that fails, and that one is passed over. Where not even its
number can be read, as many are passed over as are fetched at a time, and ever more if that goes on: numbers may reach
to 2^63, and reading has to end.

Anybody may have made the file, and a few kB can hold a view that never ends, a column that is computed and fills the
memory, or pages that lead to each other. So only real tables are read, no value is longer than the file, and the steps
of the queries are counted.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from kf_calib.errors import InputError
from kf_calib.sources.files.mcap_file import Warn
from kf_calib.sources.files.mcap_records import MESSAGE_FIELDS, MESSAGE_RECORD, DamagedError, RecordBlock, Summary

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
                f"{path} is an SQLite file but cannot be read as a ROS 2 bag ({error_text(error)}): give a bag's .db3 "
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
            warn(f"{self.path} is damaged ({error_text(error)}): what lies behind that is not counted.")
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

    def _block(self, rows: list[MessageRow], after: int) -> RecordBlock:
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


_STEPS, _STEPS_PER_BYTE = 100_000_000, 20  # of SQLite's machine; a row takes some ten, and at least some bytes
_COUNTED = 10_000  # steps at a time


FAILURES = (sqlite3.Error, UnicodeError, MemoryError)
"""What a damaged file makes queries raise; a message that quotes it may be no text, and a size of it anything."""


class NoBagError(Exception):
    """The file has not the tables that are sought."""


def size_of(place: Path) -> int:
    """Bytes of the file, and of what was written to it last and lies beside it."""
    beside = _log_of(place)
    return place.stat().st_size + (beside.stat().st_size if beside.exists() else 0)


def connect(place: Path, longest: int) -> sqlite3.Connection:
    """The file, read-only; longest: bytes of one value, and more is an error."""
    # A bag that was closed has no journal, and is then read without one: the folder may be write-protected.
    closed = not _log_of(place).exists()
    base = sqlite3.connect(
        f"{place.absolute().as_uri()}?mode=ro{'&immutable=1' * closed}", uri=True, check_same_thread=False
    )
    base.text_factory = lambda text: text.decode(errors="replace")
    base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max(min(longest, size_of(place)), 4096))
    base.set_progress_handler(_Steps(_STEPS + _STEPS_PER_BYTE * size_of(place)), _COUNTED)
    base.execute("PRAGMA trusted_schema = OFF")
    return base


def refuse_unreal(base: sqlite3.Connection, table: str) -> None:
    """Raise NoBagError unless a table holds rows of its own: it may be a view, or compute what it gives."""
    kinds = base.execute(
        "SELECT type, lower(substr(sql, 1, 14)) FROM sqlite_master WHERE lower(name) = ?", (table,)
    ).fetchall()
    if not kinds:
        raise NoBagError(f"it has no table {table}")
    if [kind for kind, _ in kinds] != ["table"] or kinds[0][1] == "create virtual":
        raise NoBagError(f"its {table} are no table but computed")
    columns = base.execute("SELECT lower(name), hidden FROM pragma_table_xinfo(?)", (table,)).fetchall()
    if any(hidden for _, hidden in columns) or "rowid" in dict(columns):
        raise NoBagError(f"its table {table} has columns that are computed")


def error_text(error: Exception) -> str:
    """What is wrong, in words."""
    if getattr(error, "sqlite_errorcode", None) == sqlite3.SQLITE_INTERRUPT:
        return "reading it takes more steps than a file of its size needs"
    return str(error)


def is_over(error: Exception) -> bool:
    """Whether nothing more can be read after this error, as all steps are used up."""
    return getattr(error, "sqlite_errorcode", None) == sqlite3.SQLITE_INTERRUPT


class _Steps:
    """Counts steps down; SQLite ends a query where the answer is 1."""

    def __init__(self, steps: int) -> None:
        self._left = steps

    def __call__(self) -> int:
        self._left -= _COUNTED
        return int(self._left < 0)


def _log_of(place: Path) -> Path:
    """Where SQLite writes before it writes to the file."""
    return place.with_name(f"{place.name}-wal")


ROWS = 4096
"""Messages fetched at a time."""
_FEWER = 16  # of how many times fewer the damaged one is looked for
_BLOCK_BYTES = 1 << 26  # of messages that are given out at a time
_MOST_FAILURES, _STEADY = 200, 8  # failures in all; on end, after which ever more is passed over
_BYTES = "CASE WHEN typeof(data) IN ('blob', 'text') THEN CAST(data AS BLOB) END"
MessageRow = tuple[int, Any, int, bytes]
"""Number, topic, time of receipt, message."""


@dataclass
class MessageRows:
    """Iterating gives rows of the topics ``wanted``, and the number up to which the table has been read then.

    first, last: numbers of the first and the last message. size: bytes of the file. why: the first thing that failed.
    lost: messages that could not be read, at most. empty: messages without content, which are left out.
    """

    base: sqlite3.Connection
    wanted: Sequence[Any]
    first: int
    last: int
    size: int
    why: str = ""
    lost: int = 0
    empty: int = 0
    _on_end: int = 0  # failures one after the other

    def __iter__(self) -> Iterator[tuple[list[MessageRow], int]]:
        start, count, read, failures = self.first, ROWS, 0, 0
        while start <= self.last and read <= self.size and failures < _MOST_FAILURES:
            try:
                rows, is_last = self._page(start, count)
            except FAILURES as error:
                if is_over(error):
                    self.why = self.why or error_text(error)
                    break
                if count == 1:
                    self.why, failures = self.why or error_text(error), failures + 1
                    start, count = self._behind(start)
                else:
                    count = max(count // _FEWER, 1)
                continue
            full = [row for row in rows if row[3]]
            self.empty += len(rows) - len(full)
            read += sum(len(row[3]) for row in full)
            start = self.last + 1 if is_last else rows[-1][0] + 1
            count, self._on_end = min(count * _FEWER, ROWS), 0
            yield full, start - 1
        if start <= self.last:
            self.why = self.why or "its messages are longer than the file"
            self.lost += self.last - start + 1

    def _page(self, start: int, count: int) -> tuple[list[MessageRow], bool]:
        """The next rows, some MB of them at most, and whether they are the last. Raises sqlite3.Error."""
        rows, size = list[MessageRow](), 0
        columns = f"rowid, topic_id, CAST(timestamp AS INTEGER), {_BYTES}"
        with closing(self._query(columns, start, count)) as cursor:
            for row in cursor:
                if row[0] < (rows[-1][0] + 1 if rows else start):
                    raise sqlite3.DatabaseError("its rows are out of order")
                rows.append(row)
                size += len(row[3] or b"")
                if size > _BLOCK_BYTES:
                    return rows, False
        return rows, len(rows) < count

    def _behind(self, start: int) -> tuple[int, int]:
        """Where to go on behind the next row, which cannot be read, and with how many rows at a time."""
        try:
            row = self._query("rowid", start, 1).fetchone()
        except FAILURES:
            row = None
        if row and row[0] >= start:
            self._on_end, self.lost = 0, self.lost + 1
            return row[0] + 1, 1
        self._on_end += 1
        step = ROWS << max(self._on_end - _STEADY, 0)
        self.lost += min(step, self.last - start + 1)
        return start + step, ROWS

    def _query(self, columns: str, start: int, count: int) -> sqlite3.Cursor:
        places = ",".join("?" * len(self.wanted))  # +: by number, never by an index, after which they would be sorted
        return self.base.execute(
            f"SELECT {columns} FROM messages WHERE rowid >= ? AND +topic_id IN ({places}) ORDER BY rowid LIMIT {count}",
            (start, *self.wanted),
        )
