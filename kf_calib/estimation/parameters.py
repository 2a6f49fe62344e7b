"""The estimated parameters of a calibration, by symbol, and as the rows of a DataFrame."""

from __future__ import annotations

from collections.abc import ItemsView, Iterable, Iterator, KeysView, ValuesView
from dataclasses import asdict, dataclass
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kf_calib.support.extras import need


@dataclass(frozen=True)
class Parameter:
    """An estimated parameter and its sigma in SI units; both are None if the orientations do not determine it.

    A value times ``per_si`` is in ``shown_unit``, the unit of the field (``support.units``).
    """

    symbol: str
    value: float | None
    sigma: float | None
    unit: str
    nominal: float
    shown_unit: str
    per_si: float

    def __str__(self) -> str:
        if self.value is None or self.sigma is None:
            return f"{self.symbol} is not determined"
        return f"{self.symbol} = {self.value:.9g} ± {self.sigma:.2g}" + f" {self.unit}" * (self.unit != "1")


class Parameters:
    """Parameters by symbol, used as a dictionary; ``pandas.DataFrame`` and ``polars.DataFrame`` make rows of them.

    It is no ``Mapping``: of one, polars makes columns.
    """

    def __init__(self, parameters: Iterable[Parameter]) -> None:
        self._by_symbol = {parameter.symbol: parameter for parameter in parameters}

    def __getitem__(self, symbol: str) -> Parameter:
        return self._by_symbol[symbol]

    def __iter__(self) -> Iterator[str]:
        return iter(self._by_symbol)

    def __len__(self) -> int:
        return len(self._by_symbol)

    def __contains__(self, symbol: object) -> bool:
        return symbol in self._by_symbol

    def __eq__(self, other: object) -> bool:
        return self._by_symbol == (other._by_symbol if isinstance(other, Parameters) else other)

    __hash__ = None  # type: ignore[assignment]  # as of a dictionary

    def get(self, symbol: str, default: Parameter | None = None) -> Parameter | None:
        """The parameter; the default if there is none of this symbol."""
        return self._by_symbol.get(symbol, default)

    def keys(self) -> KeysView[str]:
        """The symbols."""
        return self._by_symbol.keys()

    def values(self) -> ValuesView[Parameter]:
        """The parameters."""
        return self._by_symbol.values()

    def items(self) -> ItemsView[str, Parameter]:
        """Symbols and parameters."""
        return self._by_symbol.items()

    def __repr__(self) -> str:
        return "\n".join(map(str, self.values()))

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[np.object_]:
        """The parameters as objects, of which pandas makes rows."""
        rows = np.empty(len(self), object)
        rows[:] = list(self.values())
        return rows

    def __arrow_c_stream__(self, requested_schema: object = None) -> object:
        """A stream of rows as Arrow defines it, which polars takes and makes."""
        need("polars", None, "an Arrow table")
        frame = import_module("polars").DataFrame([asdict(own) for own in self.values()])
        return frame.__arrow_c_stream__(requested_schema)
