"""The row of one run in the table of a fleet: what it says, and of which type each column is."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from kf_calib.bench.arrays import Floats, Mask
from kf_calib.fleet.run_factor import STATES, RunFactor

_WORDS = pa.list_(pa.string())
_PARAMETER = pa.struct({
    "symbol": pa.string(), "value": pa.float64(), "sigma": pa.float64(), "unit": pa.string(), "nominal": pa.float64(),
})  # fmt: skip
_HYPOTHESIS = pa.struct({"effects": _WORDS, "formula": pa.string(), "probability": pa.float64()})
_FAMILY = pa.struct({"family": pa.string(), "probability": pa.float64()})
_FACTOR = pa.struct({
    "columns": _WORDS, "width": pa.int32(), "upper": pa.list_(pa.float64()), "rows": pa.int64(),
    "constants": pa.list_(pa.struct({"effect": pa.string(), "value": pa.float64()})),
    "nominal": pa.list_(pa.float64()), "noise_estimated": pa.bool_(),
})  # fmt: skip

SCHEMA = pa.schema({
    "run": pa.string(), "unit": pa.string(), "bench": pa.string(), "date": pa.timestamp("ms", "UTC"),
    "error": pa.string(), "sha256": pa.string(), "version": pa.string(), "bytes": pa.int64(), "settings": pa.string(),
    "evaluated": pa.timestamp("us", "UTC"), "cpu_s": pa.float64(), "host": pa.string(),
    "samples": pa.int64(), "dwells": pa.int32(), "orientations": pa.int32(), "model": _WORDS,
    "parameters": pa.list_(_PARAMETER),
    "consistent": pa.bool_(), "p_value": pa.float64(), "nis_per_dof": pa.float64(),
    "residual_rms_mps2": pa.float64(), "held_out_rms_mps2": pa.float64(), "held_out_floor_mps2": pa.float64(),
    "verdict": pa.string(), "missing": pa.string(), "all_missing": _WORDS, "ambiguity_set": _WORDS,
    "hypotheses": pa.list_(_HYPOTHESIS), "families": pa.list_(_FAMILY), "warnings": _WORDS,
    "replay": pa.string(), "diagnosis": pa.string(), "factor": _FACTOR,
})  # fmt: skip
"""Columns of the table, docs/fleet.md says what is in each."""

SENTENCES = ("error", "verdict", "replay", "diagnosis")
"""Columns of text that may say where the recording is."""

Row = dict[str, Any]
_LARGEST = 1e50
"""Of the numbers of a factor: far beyond those of any run, and products of four are numbers still."""
_OF_REPLAY = (
    "samples", "dwells", "orientations", "model", "parameters", "residual_rms_mps2", "held_out_rms_mps2",
    "held_out_floor_mps2", "warnings",
)  # fmt: skip
_OF_DIAGNOSIS = (
    "consistent", "p_value", "verdict", "missing", "all_missing", "ambiguity_set", "hypotheses", "families",
)  # fmt: skip


def of_replay(document: Mapping[str, Any]) -> Row:
    """The columns that come from the JSON document of ``replay``, and the document itself.

    ``consistent`` and ``p_value`` are those of the misfit as a whole until a diagnosis replaces them.
    """
    judged = document["consistency"]
    row: Row = {key: document[key] for key in _OF_REPLAY}
    row |= {"consistent": judged["consistent"], "p_value": judged["p_value"], "nis_per_dof": judged["nis_per_dof"]}
    return row | {"replay": _text(document)}


def of_diagnosis(document: Mapping[str, Any]) -> Row:
    """The columns that come from the JSON document of ``diagnose``, and the document itself."""
    return {key: document[key] for key in _OF_DIAGNOSIS if key in document} | {"diagnosis": _text(document)}


def of_factor(factor: RunFactor) -> Row:
    """The column of the reduced factor: its upper triangle, row by row."""
    return {
        "factor": {
            "columns": list(factor.columns),
            "width": factor.width,
            "upper": factor.factor[np.triu_indices(len(factor.factor))],
            "rows": factor.rows,
            "constants": [{"effect": name, "value": value} for name, value in factor.constants.items()],
            "nominal": factor.nominal,
            "noise_estimated": factor.noise_estimated,
        }
    }


def factor_of(row: Mapping[str, Any]) -> RunFactor | None:
    """The reduced factor from a row as Arrow gives it; None where the run has none, as one that failed."""
    kept, date = row["factor"], row["date"]
    if kept is None:
        return None
    return RunFactor(
        row["run"], row["unit"], row["bench"], None if date is None else date.isoformat(timespec="milliseconds"),
        tuple(kept["columns"]), kept["width"], _upper(np.asarray(kept["upper"]), len(kept["columns"]) + 1),
        kept["rows"], {each["effect"]: each["value"] for each in kept["constants"]}, np.asarray(kept["nominal"]),
        kept["noise_estimated"],
    )  # fmt: skip


def are_whole(factors: pa.StructArray) -> Mask:
    """Which factors (n,) have as many numbers as their columns ask for, none of them absurd; that of a run that failed,
    which has none, counts as whole."""
    lengths = {name: _lengths(factors.field(name)) for name in ("columns", "upper", "nominal", "constants")}
    size, width = lengths["columns"] + 1, factors.field("width").fill_null(-1).to_numpy(zero_copy_only=False)
    right = (lengths["upper"] == size * (size + 1) // 2) & (lengths["nominal"] == len(STATES))
    right &= (lengths["constants"] >= 0) & (width >= 0) & (width < size)
    for name in ("rows", "noise_estimated"):
        right &= factors.field(name).is_valid().to_numpy(zero_copy_only=False)
    for name in ("upper", "nominal"):
        right &= _in_all(factors.field(name), _are_numbers)
    right &= _in_all(factors.field("columns"), _are_there)
    right &= _in_all(
        factors.field("constants"), lambda each: _have(each, ("effect",)) & _are_numbers(each.field("value"))
    )
    return right | factors.is_null().to_numpy(zero_copy_only=False)


def name_their_parameters(lists: pa.ListArray) -> Mask:
    """In which rows (n,) every parameter has symbol, unit and nominal value, and no number is absurd; a run that failed
    has none."""
    return _in_all(lists, lambda each: _have(each, ("symbol", "unit", "nominal"))
                   & _are_numbers(each.field("nominal")) & _are_numbers(each.field("value").fill_null(0.0))
                   & _are_numbers(each.field("sigma").fill_null(0.0)))  # fmt: skip


def _in_all(lists: pa.ListArray, are_right: Callable[[Any], Mask]) -> Mask:
    """Tell in which lists (n,) all elements are right; no list has none."""
    ends = np.concatenate([[0], np.cumsum(np.maximum(_lengths(lists), 0))])
    return np.diff(np.concatenate([[0], np.cumsum(~are_right(lists.flatten()))])[ends]) == 0


def _are_there(values: pa.Array) -> Mask:
    return values.is_valid().to_numpy(zero_copy_only=False)


def _have(structures: pa.StructArray, names: Sequence[str]) -> Mask:
    """Tell which structures (n,) are there and have these fields."""
    return np.logical_and.reduce([_are_there(structures), *(_are_there(structures.field(name)) for name in names)])


def _are_numbers(values: pa.Array) -> Mask:
    """Tell which values (n,) are numbers that a run may have."""
    return np.abs(values.to_numpy(zero_copy_only=False)) < _LARGEST  # that of null is not a number


def _lengths(lists: pa.ListArray) -> NDArray[np.int64]:
    """Return the lengths (n,) of lists, -1 where there is none."""
    return lists.value_lengths().fill_null(-1).to_numpy(zero_copy_only=False).astype(np.int64)


def _upper(packed: Floats, size: int) -> Floats:
    out = np.zeros((size, size))
    out[np.triu_indices(size)] = packed
    return out


def _text(document: Mapping[str, Any]) -> str:
    return json.dumps(document, ensure_ascii=False, allow_nan=False)
