"""The table of a fleet as a Python program has it.

The bench models lie in its folder, a file for each bench. The first line of each says that the fleet wrote it under
this name, with a checksum of the rest. A file that is still as it says is replaced, and removed when it no longer
holds. Any other is somebody's own, and stays.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute

from kf_calib.errors import InputError, need
from kf_calib.estimation.bench_model import BenchModel, BenchTerm
from kf_calib.fleet.overview import COLUMNS, FleetOverview, counted, overview_of
from kf_calib.fleet.pooled_diagnosis import BenchCoefficients, PooledDiagnosis, pooled_diagnosis
from kf_calib.fleet.run_factor import ReferenceUnit, RunFactor
from kf_calib.fleet.run_list import SCHEMA, factor_of
from kf_calib.fleet.store import AT_ONCE, Store
from kf_calib.support.output_files import write_whole

pc: Any = pyarrow.compute  # its functions are made when it is imported, which no type checker sees
_HEAVY = ("replay", "diagnosis", "factor")
_ALONE = "the runs were not diagnosed together"
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

    def parameters(self, symbols: Sequence[str] = ()) -> pa.Table:
        """A row for each run and parameter: run, unit, bench, date, symbol, value, sigma, si_unit and nominal.

        symbols: of the parameters that are wanted; all where there are none. Values are null where a run does not
        determine them.
        """
        table = self.rows([*_IDENTITY, "parameters"]).combine_chunks()
        lists = pc.fill_null(table["parameters"], [])
        inside = pc.list_flatten(lists).combine_chunks().flatten()
        named = dict(zip(("symbol", "value", "sigma", "si_unit", "nominal"), inside, strict=True))
        long = table.select(_IDENTITY).take(pc.list_parent_indices(lists))
        for name, column in named.items():
            long = long.append_column(name, column)
        return long.filter(pc.is_in(long["symbol"], pa.array(symbols, pa.string()))) if symbols else long

    def verdicts(self) -> dict[str, int]:
        """How many runs came to what: ``consistent``, the effect that is missing, ``unknown``, ``not judged`` where
        nothing was left to judge by, or ``failed``; the most frequent first."""
        table = self.rows(["error", "consistent", "missing"])
        return counted(table.to_pylist())

    def factors(self) -> Iterator[RunFactor]:
        """The reduced factor of each run that has one; one part of the table is in memory at a time."""
        for batch in self._store.batches([*_IDENTITY, "factor"], AT_ONCE):
            for row in batch.to_pylist():
                if (found := factor_of(row)) is not None:
                    yield found

    def pooled(self, *, reference_unit: ReferenceUnit | None = None) -> PooledDiagnosis:
        """The diagnosis of all runs together: which effects they have, and whether each is the bench's or the units'.

        reference_unit: a unit whose scale factors are known, so that an error of gravity shows. Raises InputError where
        there are no runs to diagnose, or where these scale factors are from one of them.
        """
        if reference_unit is not None and reference_unit.sha256:
            for row in self.rows(["run", "sha256"]).to_pylist():
                if row["sha256"] == reference_unit.sha256:
                    raise InputError(
                        f"the scale factors of the reference unit {reference_unit.unit} are from {row['run']}, one of "
                        "these runs, which has their gravity: name a calibration that was made elsewhere."
                    )
        return pooled_diagnosis(self.factors, reference_unit=reference_unit)

    def overview(
        self,
        targets: Mapping[str, float] | None = None,
        *,
        pooled: bool = True,
        reference_unit: ReferenceUnit | None = None,
    ) -> FleetOverview:
        """What all runs come to, for ``kf_calib.plot.figures`` too.

        targets: sigma wanted of parameters, in SI. pooled: whether two runs or more are diagnosed together. Raises
        InputError where the reference unit was not measured.
        """
        found, remarks = self._pooled_or_why(reference_unit) if pooled and len(self) > 1 else (None, ())
        return overview_of(str(self.path), self.rows(COLUMNS).to_pylist(), targets or {}, found, remarks)

    def _pooled_or_why(self, reference: ReferenceUnit | None) -> tuple[PooledDiagnosis | None, tuple[str, ...]]:
        """Return the diagnosis of all runs together, and what is to be said of it."""
        table = self.rows(["unit", "error"])
        units = table.filter(pc.is_null(table["error"]))["unit"]
        if len(units) < 2:
            verb = "is" if len(units) == 1 else "are"
            return None, (f"{_ALONE}: that needs two that did not fail, and there {verb} {len(units)}.",)
        try:
            diagnosis = self.pooled(reference_unit=reference)
        except InputError as error:
            if reference is not None:
                raise
            return None, (f"{_ALONE}: {error}",)
        return diagnosis, (_unnamed(units.null_count),) if units.null_count else ()

    def distinct(self, column: str) -> int:
        """Number of different values of a column, what is not known left out."""
        return pc.count_distinct(self.rows([column])[column], mode="only_valid").as_py()

    def failures(self) -> dict[str, str]:
        """What was wrong with each run that failed, by its place."""
        return {row["run"]: row["error"] for row in self.rows(["run", "error"]).to_pylist() if row["error"]}

    def __str__(self) -> str:
        counts = ", ".join(f"{count} {verdict}" for verdict, count in self.verdicts().items())
        return f"{self.path}: {len(self)} runs ({counts})"


def _unnamed(count: int) -> str:
    one = "1 run has no unit, so it counts as a unit"
    each = one if count == 1 else f"{count} runs have no unit, so each counts as a unit"
    return f"{each} of its own: say which it is in a list of runs (.csv with the columns run and unit)."


_NOT_IN_NAMES = re.compile(r"[^\w.-]+|^\.+")  # of files, on any system
_LONGEST = 60


@dataclass(frozen=True)
class BenchModelFiles:
    """The files that a pooled diagnosis leads to; diagnosis: None where there is none, and then all stays as it is."""

    fleet: Path
    diagnosis: PooledDiagnosis | None
    overwrite: bool = False

    @property
    def folder(self) -> Path:
        return self.fleet / "bench_models"

    @cached_property
    def models(self) -> dict[Path, BenchModel]:
        """The bench model of each bench that has errors, by its file; no two benches share one."""
        names = dict[str, Path]()
        models = {} if self.diagnosis is None else bench_models(self.diagnosis)
        for bench in models:
            name = stem = _NOT_IN_NAMES.sub("_", bench)[:_LONGEST] or "bench"
            while name.casefold() in names:
                name = f"{stem}-{len(names) + 1}"
            names[name.casefold()] = self.folder / f"{name}.toml"
        return dict(zip(names.values(), models.values(), strict=True))

    def write(self, path: Path) -> None:
        """Write one of them. Raises InputError where somebody's own file is in its place, or it cannot be written."""
        if not (self.overwrite or _is_own(path)) and path.exists():
            raise InputError(
                f"{path} is not as kf-calib fleet wrote it, and was left: move it away, or give --overwrite."
            )
        try:
            self.folder.mkdir(exist_ok=True)
        except OSError as error:
            raise InputError(f"{self.folder} cannot be made ({error.strerror}): move away what is there.") from None
        text = self.models[path].text
        write_whole(path, (_head(path, text) + text).encode())

    @property
    def outdated(self) -> list[Path]:
        """Files of before that no longer hold."""
        if self.diagnosis is None:
            return []
        return [path for path in sorted(self.folder.glob("*.toml")) if path not in self.models and _is_own(path)]


def _head(path: Path, text: str) -> str:
    checksum = hashlib.sha256(text.encode()).hexdigest()[:16]
    return f"# {path.name}: kf-calib fleet replaces or removes this file as long as nobody changes it ({checksum})\n"


def _is_own(path: Path) -> bool:
    """Whether a file is as it was written here."""
    try:
        head, line_end, text = path.read_bytes().decode().partition("\n")
    except (OSError, ValueError):
        return False
    return not path.is_symlink() and head + line_end == _head(path, text)


def bench_model(diagnosis: PooledDiagnosis, bench: str) -> BenchModel:
    """The errors of a bench as its last runs have them; those of a bench that was repaired are those since then.

    Coefficients that the runs do not determine are left out: no run on that bench shows them. What the coefficients of
    different effects have in common of their uncertainty is left out, too.

    Raises InputError if the bench is not one of the runs, or if none of its errors was found.
    """
    if bench not in diagnosis.benches:
        raise InputError(f"no run is of the bench {bench!r}: name one of {', '.join(map(repr, diagnosis.benches))}.")
    if bench not in (models := bench_models(diagnosis)):
        raise InputError(
            f"no error of the bench {bench!r} was found in {diagnosis.runs} runs, so there is none to save."
        )
    return models[bench]


def bench_models(diagnosis: PooledDiagnosis) -> dict[str, BenchModel]:
    """The bench model of each bench that has errors which its last runs determine, by its name."""
    terms = {bench: list[BenchTerm]() for bench in diagnosis.benches}
    for finding in diagnosis.findings:
        for bench, estimate in {each.bench: each for each in finding.benches}.items():  # the last of each bench
            if (term := _term(finding.effect, estimate)).symbols:
                terms[bench].append(term)
    return {bench: BenchModel(tuple(own), bench, diagnosis.runs) for bench, own in terms.items() if own}


def _term(effect: str, estimate: BenchCoefficients) -> BenchTerm:
    determined = [k for k, each in enumerate(estimate.coefficients) if each.value is not None]
    values = tuple(each.value for each in estimate.coefficients if each.value is not None)
    covariance = tuple(tuple(estimate.covariance[i][k] for k in determined) for i in determined)
    return BenchTerm(
        effect, tuple(estimate.coefficients[k].symbol for k in determined), values, covariance, estimate.since or ""
    )
