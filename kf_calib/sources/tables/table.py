"""A table of orientations as a source: dwells of which only mean readings are known."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from kf_calib.bench.bench import Bench
from kf_calib.bench.streams import Batch
from kf_calib.errors import InputError
from kf_calib.sources.tables.orientation import Orientation, Orientations


class Table:
    """Mean readings of dwells, with the bench they were taken on.

    name: what messages call it. warnings: how it was understood. start_ns: stamp of the first row, if it has a date.
    path: the file that it is from, if it is from one.
    """

    def __init__(
        self,
        name: str,
        bench: Bench,
        orientations: Sequence[Orientation],
        warnings: Sequence[str] = (),
        start_ns: int | None = None,
        path: Path | None = None,
    ) -> None:
        self.name, self.bench, self.orientations = name, bench, Orientations.of(orientations)
        self.warnings, self.fraction, self._start_ns, self.path = list(warnings), 1.0, start_ns, path

    def __repr__(self) -> str:
        return f"<Table {self.name}: {len(self.orientations)} orientations, {self.bench.input}>"

    def begin_ns(self) -> int | None:
        """Stamp of the first row; None where the table has no date."""
        return self._start_ns

    def __iter__(self) -> Iterator[Batch]:
        self.refuse("this")
        yield from ()

    def refuse(self, what: str) -> None:
        """Raise InputError for what means do not show."""
        raise InputError(
            f"{self.name} is a table of mean readings, and {what} needs the readings themselves: evaluate a recording "
            "of the run (docs/own_csv.md)."
        )
