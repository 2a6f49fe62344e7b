"""An SQLite file that anybody may have made, opened so that every query of it ends, and soon.

A few kB can hold a view that never ends, a column that is computed and fills the memory, or pages that lead to each
other. So only real tables are read, no value is longer than the file, and the steps of the queries are counted.
"""

from __future__ import annotations

import sqlite3
from pathlib import Path

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


def words_of(error: Exception) -> str:
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
