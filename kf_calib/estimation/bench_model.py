"""Bench models: what many runs have shown of the errors of a bench, as TOML, for single runs on that bench.

    bench = "bench 1"

    [[terms]]
    effect = "encoder-harmonic-1:z"
    symbols = ["s1_z", "c1_z"]              # coefficients that are known; the others are taken for zero
    coefficients = [1.2e-6, -3.0e-7]        # in SI units
    covariance = [[4.0e-14, 0.0], [0.0, 4.0e-14]]

The terms are subtracted from the readings of a run, and their covariance is considered in its sigmas.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NotRequired

import numpy as np
from pydantic import Field
from typing_extensions import TypedDict

from kf_calib.bench.arrays import ROUNDING
from kf_calib.bench.bench import Bench
from kf_calib.effects import effect_named
from kf_calib.effects.effect import KnownEffect
from kf_calib.errors import InputError
from kf_calib.support.output_files import write_whole
from kf_calib.support.toml_files import FINITE, TEXT, Misfit, converted, toml_table

_EXAMPLE = '[[terms]] with effect = "flexure", symbols, coefficients, covariance'


class _Term(TypedDict):
    """A term of a bench model; since: date from which it holds, for information."""

    effect: TEXT
    symbols: Annotated[list[TEXT], Field(min_length=1)]
    coefficients: list[FINITE]
    covariance: list[list[FINITE]]
    since: NotRequired[TEXT]


class _Content(TypedDict):
    """The content of a bench model."""

    bench: NotRequired[TEXT]
    runs: NotRequired[int]
    terms: Annotated[list[_Term], Field(min_length=1)]


@dataclass(frozen=True)
class BenchTerm:
    """An error of a bench: its effect, and coefficients (q,) of the symbols that are known with their covariance (q,
    q), SI."""

    effect: str
    symbols: tuple[str, ...]
    coefficients: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]
    since: str = ""


@dataclass(frozen=True)
class BenchModel:
    """The errors of a bench that are known; bench: its name. runs: number of runs that they are from."""

    terms: tuple[BenchTerm, ...]
    bench: str = ""
    runs: int = 0

    def on(self, bench: Bench) -> tuple[KnownEffect, ...]:
        """The terms as effects of a bench; raises InputError if it cannot have them."""
        return tuple(_known(term, bench) for term in self.terms)

    def write(self, path: Path) -> None:
        """Write it whole or not at all; raises InputError if it cannot be written."""
        write_whole(path, self.text.encode())

    @property
    def text(self) -> str:
        """It as TOML."""
        import tomli_w

        table: dict[str, Any] = {"bench": self.bench} if self.bench else {}
        table |= {"runs": self.runs} if self.runs else {}
        table["terms"] = [
            {
                "effect": term.effect, "symbols": list(term.symbols), "coefficients": list(term.coefficients),
                "covariance": [list(row) for row in term.covariance], **({"since": term.since} if term.since else {}),
            }
            for term in self.terms
        ]  # fmt: skip
        head = "# Bench model of kf_calib, SI units: kf-calib replay RECORDING --bench-model THIS_FILE\n"
        return head + tomli_w.dumps(table)


def read_bench_model(path: str | Path) -> BenchModel:
    """Read a bench model; raises InputError, with the path, if the file cannot be read or used."""
    path = Path(path)
    table = toml_table(path, _EXAMPLE)
    try:
        content: _Content = converted(table, _Content)
        terms = tuple(_term(each) for each in content["terms"])
    except (Misfit, ValueError) as error:
        raise InputError(f"{path}: is no bench model: {error}: write {_EXAMPLE}.") from None
    return BenchModel(terms, content.get("bench", ""), content.get("runs", 0))


def _term(entry: _Term) -> BenchTerm:
    """Return one term; raises ValueError where its parts do not fit together."""
    name, count = entry["effect"], len(entry["symbols"])
    if len(entry["coefficients"]) != count or [len(row) for row in entry["covariance"]] != [count] * count:
        raise ValueError(f"{name} has {count} symbols, so it needs as many coefficients and rows of the covariance")
    covariance = np.array(entry["covariance"])
    sizes = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    relative = covariance / np.maximum(np.outer(sizes, sizes), 1e-300)
    if not np.allclose(covariance, covariance.T, rtol=ROUNDING, atol=0.0) or np.linalg.eigvalsh(relative)[0] < -1e-6:
        raise ValueError(f"the covariance of {name} is not one: it must be symmetric, without a negative variance")
    rows = tuple(tuple(row) for row in entry["covariance"])
    return BenchTerm(name, tuple(entry["symbols"]), tuple(entry["coefficients"]), rows, entry.get("since", ""))


def _known(term: BenchTerm, bench: Bench) -> KnownEffect:
    effect = effect_named(term.effect, bench)
    symbols = [each.symbol for each in effect.coefficients]
    unknown = [symbol for symbol in term.symbols if symbol not in symbols]
    if unknown or effect.no_columns:
        why = f"no coefficient {unknown[0]}: it has {', '.join(symbols)}" if unknown else "no columns in dwells"
        raise InputError(f"the bench model has the term {term.effect}, which has {why}.")
    places = [symbols.index(symbol) for symbol in term.symbols]
    coefficients, covariance = np.zeros(len(symbols)), np.zeros((len(symbols), len(symbols)))
    coefficients[places] = term.coefficients
    covariance[np.ix_(places, places)] = term.covariance
    return KnownEffect(effect, coefficients, covariance)
