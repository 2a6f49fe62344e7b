"""The messages of an SQLite file in the order of their numbers, around what cannot be read.

Where a query fails, fewer rows are fetched, until it is one that fails, and that one is passed over. Where not even its
number can be read, as many are passed over as are fetched at a time, and ever more if that goes on: numbers may reach
to 2^63, and reading has to end.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

from kf_calib.sources.files.sqlite_base import FAILURES, is_over, words_of

ROWS = 4096
"""Messages fetched at a time."""
_FEWER = 16  # of how many times fewer the damaged one is looked for
_BLOCK_BYTES = 1 << 26  # of messages that are given out at a time
_MOST_FAILURES, _STEADY = 200, 8  # failures in all; on end, after which ever more is passed over
_BYTES = "CASE WHEN typeof(data) IN ('blob', 'text') THEN CAST(data AS BLOB) END"
Row = tuple[int, Any, int, bytes]
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

    def __iter__(self) -> Iterator[tuple[list[Row], int]]:
        start, count, read, failures = self.first, ROWS, 0, 0
        while start <= self.last and read <= self.size and failures < _MOST_FAILURES:
            try:
                rows, is_last = self._page(start, count)
            except FAILURES as error:
                if is_over(error):
                    self.why = self.why or words_of(error)
                    break
                if count == 1:
                    self.why, failures = self.why or words_of(error), failures + 1
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

    def _page(self, start: int, count: int) -> tuple[list[Row], bool]:
        """The next rows, some MB of them at most, and whether they are the last. Raises sqlite3.Error."""
        rows, size = list[Row](), 0
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
