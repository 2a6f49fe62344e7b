"""The residuals of a calibration as a table: a row for each dwell and accelerometer, with what the bench did there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench
from kf_calib.dwells.limits import SIMPSON
from kf_calib.effects import Stimulus
from kf_calib.effects.formula import quantities
from kf_calib.errors import InputError, need
from kf_calib.estimation.dwell_columns import LinearisedDwells, stimulus_of
from kf_calib.noise.noise_model import Noise, mean_covariances


class Step(Protocol):
    """The filter's step on a dwell, as ``Visit`` has it."""

    @property
    def nis(self) -> float: ...
    @property
    def dof(self) -> int: ...
    @property
    def innovation_mps2(self) -> Floats: ...
    @property
    def innovation_sigma_mps2(self) -> Floats: ...


class Run(Protocol):
    """What the table is made of: a ``Calibration``, which gives the table and so cannot be named here."""

    @property
    def bench(self) -> Bench: ...
    @property
    def linearised(self) -> LinearisedDwells: ...
    @property
    def noise(self) -> Noise: ...
    @property
    def visits(self) -> Sequence[Step]: ...
    @property
    def residuals_mps2(self) -> Floats: ...


def mean_sigmas(result: Run, noise: Noise | None = None) -> Floats:
    """Sigma (D, 3) of the mean of each dwell, m/s^2, in a noise or in that by which the misfit is judged."""
    noise = result.noise.for_goodness_of_fit if noise is None else noise
    covariances = mean_covariances(noise.of_readings, result.linearised.means, result.linearised.state)
    return np.sqrt(np.einsum("dii->di", covariances))


def quantity_means(result: Run, names: list[str]) -> dict[str, Floats]:
    """Means (D, 3) over each dwell of quantities that formulas may name, in SI units, for each accelerometer."""
    known = quantities(result.bench.axes)
    means = means_over_dwells(result, [known[name].of for name in names])
    return dict(zip(names, means, strict=True))


def means_over_dwells(result: Run, functions: Sequence[Callable[[Stimulus], Floats | float]]) -> list[Floats]:
    """Means (D, 3) over each dwell of functions of what the bench does, a number or values (m, 1) or (m, 3) each."""
    dwells = result.linearised.dwells
    stimulus = stimulus_of(dwells, result.bench, result.linearised.state)
    folded = dwells.folded
    weights = np.outer(folded.piece_counts / np.repeat(folded.counts, folded.piece_numbers), SIMPSON).ravel()
    values = [np.broadcast_to(function(stimulus), (len(stimulus), 3)) for function in functions]
    return [np.add.reduceat(each * weights[:, None], 3 * folded.ends[:-1]) for each in values]


def residual_table(result: Run) -> NDArray[np.void]:
    """The table as a structured array (3 D,), dwell by dwell, accelerometers 1, 2, 3 in each.

    Columns: ``dwell`` (from 1), ``accelerometer``, ``start_s``, ``end_s``, ``readings``; gimbal angles
    ``gimbal1_deg``... as recorded; ``force_x_mps2``, ``force_y_mps2``, ``force_z_mps2``: specific force in the
    platform; ``along_mps2``, ``pendulous_mps2``, ``output_mps2``: along the axes of the accelerometer; ``step_mps2``:
    last change of the first of these; ``temperature_c`` and its rate ``temperature_rate_kps`` (NaN and 0 where it is
    not measured); ``mean_mps2``: mean reading; ``residual_mps2``: less its prediction by the final estimate;
    ``sigma_mps2``: of the mean; ``ratio``: residual over sigma; ``innovation_mps2``, ``innovation_sigma_mps2``: the
    mean less its prediction from the dwells before, NaN while there is none; ``nis``, ``nis_dof``: of the dwell.
    """
    dwells = result.linearised.dwells
    of = quantity_means(result, ["fx", "fy", "fz", "a", "p", "o", "da", "dT"])
    sigmas, visits = mean_sigmas(result), result.visits

    def for_accelerometers(values: Any) -> Floats:
        """Repeat a number of a dwell for its accelerometers."""
        return np.repeat(np.asarray(values), 3)

    poses = np.degrees(np.array([dwell.recorded_pose for dwell in dwells]))
    warmth = [float(np.mean(dwell.pieces.nodes.temperature_c)) for dwell in dwells]
    columns: dict[str, NDArray[Any]] = {
        "dwell": for_accelerometers([dwell.number for dwell in dwells]),
        "accelerometer": np.tile([1, 2, 3], len(dwells)),
        "start_s": for_accelerometers([dwell.start_s for dwell in dwells]),
        "end_s": for_accelerometers([dwell.end_s for dwell in dwells]),
        "readings": for_accelerometers([dwell.count for dwell in dwells]),
        **{f"gimbal{k + 1}_deg": for_accelerometers(poses[:, k]) for k in range(len(result.bench.axes))},
        **{f"force_{axis}_mps2": of[f"f{axis}"].ravel() for axis in "xyz"},
        "along_mps2": of["a"].ravel(),
        "pendulous_mps2": of["p"].ravel(),
        "output_mps2": of["o"].ravel(),
        "step_mps2": of["da"].ravel(),
        "temperature_c": for_accelerometers(warmth),
        "temperature_rate_kps": of["dT"].ravel(),
        "mean_mps2": np.concatenate([dwell.means[4:] for dwell in dwells]),
        "residual_mps2": result.residuals_mps2.ravel(),
        "sigma_mps2": sigmas.ravel(),
        "ratio": (result.residuals_mps2 / sigmas).ravel(),
        "innovation_mps2": np.array([visit.innovation_mps2 for visit in visits]).ravel(),
        "innovation_sigma_mps2": np.array([visit.innovation_sigma_mps2 for visit in visits]).ravel(),
        "nis": for_accelerometers([visit.nis for visit in visits]),
        "nis_dof": for_accelerometers([visit.dof for visit in visits]),
    }
    table = np.zeros(3 * len(dwells), dtype=[(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        table[name] = values
    return table


def table_as(table: NDArray[np.void], kind: str) -> Any:
    """A structured array as ``numpy`` has it, or as a DataFrame of ``pandas`` or ``polars``.

    Raises InputError for another kind, and MissingExtraError where the package is not installed.
    """
    if kind == "numpy":
        return table
    if kind not in ("pandas", "polars"):
        raise InputError(f"residuals cannot be given as {kind!r}: use numpy, pandas or polars.")
    need(kind, None, f"a {kind} table")
    return import_module(kind).DataFrame({name: table[name] for name in table.dtype.names or ()})
