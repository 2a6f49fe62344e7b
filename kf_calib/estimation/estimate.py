"""What a run estimates: the parameters and their covariance, from the filter's triangle and by symbol."""

from __future__ import annotations

from collections.abc import ItemsView, Iterable, Iterator, KeysView, ValuesView
from dataclasses import asdict, dataclass
from functools import cached_property
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import ROUNDING, Floats, Mask
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.errors import need
from kf_calib.estimation import square_root_information

HOPELESS = {"rad": np.radians(10.0), "1": 0.2, "m/s^2": 2.0}
"""Sigmas from which on a parameter is not determined, by its unit."""


@dataclass(frozen=True)
class Estimate:
    """An estimate of the state.

    - state (p,): the twelve affine states, then the coefficients of effects.
    - covariance (p, p): its covariance.
    - undetermined (p, q): a basis of the combinations of states that are not determined.
    """

    state: Floats
    covariance: Floats
    undetermined: Floats

    @cached_property
    def parameters(self) -> Floats:
        """The paper's twelve parameters (12,)."""
        return paper_parameters.parameters_of(self.state[:STATE_COUNT])

    @cached_property
    def parameter_covariance(self) -> Floats:
        """Covariance (12, 12) of the twelve parameters, J P J^T with the closed-form Jacobian J."""
        jacobian = paper_parameters.jacobian(self.state[:STATE_COUNT])
        return jacobian @ self.covariance[:STATE_COUNT, :STATE_COUNT] @ jacobian.T

    @cached_property
    def unseen(self) -> Mask:
        """Mask (12,) of the parameters that the orientations do not determine."""
        sigma = np.sqrt(np.diag(self.parameter_covariance))
        unseen = sigma > np.array([HOPELESS[unit] for unit in paper_parameters.UNITS])
        if self.undetermined.size:
            jacobian = paper_parameters.jacobian(self.state[:STATE_COUNT])
            unseen |= np.linalg.norm(jacobian @ self._lost[:STATE_COUNT], axis=1) > 1e-6
        return np.asarray(unseen)

    @cached_property
    def _lost(self) -> Floats:
        """Return the basis of undetermined combinations with each column scaled to length 1."""
        return self.undetermined / np.linalg.norm(self.undetermined, axis=0)

    @cached_property
    def determined(self) -> Mask:
        """Mask (p,) of the states that the orientations determine."""
        return np.asarray(np.linalg.norm(self._lost, axis=1) < ROUNDING)

    @cached_property
    def sigma(self) -> Floats:
        """Sigmas (12,) of the twelve parameters; NaN where not determined."""
        return np.where(self.unseen, np.nan, np.sqrt(np.diag(self.parameter_covariance)))

    @cached_property
    def effects(self) -> Floats:
        """Coefficients (q,) of the effects."""
        return self.state[STATE_COUNT:]

    @cached_property
    def effect_sigma(self) -> Floats:
        """Sigmas (q,) of the coefficients of effects; NaN where not determined."""
        sigma = np.sqrt(np.diag(self.covariance)[STATE_COUNT:])
        if self.undetermined.size:
            lost = np.abs(self.undetermined[STATE_COUNT:]).max(axis=1)  # in the unit of the coefficient, as sigma
            sigma = np.where(lost > ROUNDING * sigma, np.nan, sigma)
        return sigma


def estimate_of(factor: Floats, nominal_state: Floats, extra: Floats) -> Estimate:
    """The estimate from a factor [R | z], with the covariance P enlarged to P + P B P by considered parameters, B =
    ``extra`` (p, p)."""
    return estimates(factor[None], nominal_state, extra)[0]


def estimates(factors: Floats, nominal_state: Floats, extra: Floats) -> list[Estimate]:
    """The estimates from many factors (n, p, p + 1), as ``estimate_of``; ``extra`` is (p, p) or (n, p, p)."""
    states, covariances, undetermined = zip(*square_root_information.solve_all(factors, nominal_state), strict=True)
    covariance = enlarged(np.array(covariances), extra)
    return [Estimate(*each) for each in zip(states, covariance, undetermined, strict=True)]


def enlarged(covariance: Floats, extra: Floats) -> Floats:
    """P + P B P for covariances P (..., p, p) and contributions B = ``extra`` (..., p, p) of considered parameters.

    By a root of B, so that no variance is negative whatever the rounding of large ones is.
    """
    if not extra.any():
        return covariance
    sizes = np.sqrt(np.maximum(np.einsum("...ii->...i", extra), 0.0))
    sizes = np.where(sizes > 0.0, sizes, 1.0)
    values, vectors = np.linalg.eigh(extra / (sizes[..., :, None] * sizes[..., None, :]))
    root = sizes[..., :, None] * vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
    gained = covariance @ root
    return np.asarray(covariance + gained @ np.swapaxes(gained, -1, -2), float)


def correlation(estimate: Estimate) -> Floats:
    """Correlations (12 + q, 12 + q) of the twelve parameters and the coefficients of effects; NaN in the rows and
    columns of those that are not determined."""
    covariance = estimate.covariance
    jacobian = np.eye(len(covariance))
    jacobian[:STATE_COUNT, :STATE_COUNT] = paper_parameters.jacobian(estimate.state[:STATE_COUNT])
    sigma = np.sqrt(np.diag(jacobian @ covariance @ jacobian.T))
    sigma[np.isnan(np.concatenate([estimate.sigma, estimate.effect_sigma]))] = np.nan
    return jacobian @ covariance @ jacobian.T / np.outer(sigma, sigma)


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
