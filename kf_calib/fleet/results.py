"""The table of a fleet as a Python program has it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from kf_calib.errors import InputError
from kf_calib.fleet.run_factor import RunFactor
from kf_calib.fleet.run_row import SCHEMA, factor_of
from kf_calib.fleet.store import Store
from kf_calib.support.extras import need

_HEAVY = ("replay", "diagnosis", "factor")
_IDENTITY = ("run", "unit", "bench", "date")


class Fleet:
    """The runs in the folder of ``kf-calib fleet``; what is asked for is read when it is asked for.

        fleet = kf_calib.open_fleet("fleet")
        fleet.verdicts()                            # {"consistent": 37, "second-order": 2, "failed": 1}
        fleet.parameters(["K1", "b1"]).to_pandas()  # one line for each run and parameter
        for factor in fleet.factors(): ...          # what each run tells of its parameters and of every effect

    Raises InputError where the folder has no table.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        self.path = Path(path)
        self._store = Store(self.path)
        if not self._store.exists:
            raise InputError(f"{path} has no table of a fleet: name the folder that kf-calib fleet wrote (-o).")

    def __len__(self) -> int:
        """Number of runs."""
        return self.rows(["run"]).num_rows

    def rows(self, columns: Sequence[str] | None = None) -> pa.Table:
        """A row for each run (docs/fleet.md). Without ``columns`` all but the factor and the whole documents."""
        read = [name for name in SCHEMA.names if name not in _HEAVY] if columns is None else list(columns)
        if unknown := sorted(set(read) - set(SCHEMA.names)):
            raise InputError(f"the table has no column {unknown[0]}, it has {', '.join(SCHEMA.names)}.")
        schema = pa.schema([SCHEMA.field(name) for name in read])
        return pa.Table.from_batches(self._store.batches(read), schema)

    def frame(self, columns: Sequence[str] | None = None) -> Any:
        """The same as a DataFrame of pandas, which has to be installed."""
        need("pandas", None, "a DataFrame")
        return self.rows(columns).to_pandas()
