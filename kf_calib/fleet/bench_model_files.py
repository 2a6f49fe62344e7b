"""The bench models in the folder of a fleet: a file for each bench.

The first line of each says that the fleet wrote it under this name, with a checksum of the rest. A file that is still
as it says is replaced, and removed when it no longer holds. Any other is somebody's own, and stays.
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from kf_calib.errors import InputError
from kf_calib.estimation.bench_model import BenchModel, BenchTerm
from kf_calib.fleet.pooled_diagnosis import BenchCoefficients, PooledDiagnosis
from kf_calib.support.output_files import write_whole

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
    terms = list[BenchTerm]()
    for finding in diagnosis.findings:
        coefficients = [each for each in finding.benches if each.bench == bench]
        if coefficients and (term := _term(finding.effect, coefficients[-1])).symbols:
            terms.append(term)
    if not terms:
        raise InputError(
            f"no error of the bench {bench!r} was found in {diagnosis.runs} runs, so there is none to save."
        )
    return BenchModel(tuple(terms), bench, diagnosis.runs)


def bench_models(diagnosis: PooledDiagnosis) -> dict[str, BenchModel]:
    """The bench model of each bench that has errors which the runs determine, by its name."""
    with_values = {
        each.bench
        for finding in diagnosis.findings
        for each in finding.benches
        if any(own.value is not None for own in each.coefficients)
    }
    return {bench: bench_model(diagnosis, bench) for bench in diagnosis.benches if bench in with_values}


def _term(effect: str, estimate: BenchCoefficients) -> BenchTerm:
    determined = [k for k, each in enumerate(estimate.coefficients) if each.value is not None]
    values = tuple(each.value for each in estimate.coefficients if each.value is not None)
    covariance = tuple(tuple(estimate.covariance[i][k] for k in determined) for i in determined)
    return BenchTerm(
        effect, tuple(estimate.coefficients[k].symbol for k in determined), values, covariance, estimate.since or ""
    )
