"""The bench model that a pooled diagnosis leads to: errors of a bench that later single runs on it take as known."""

from __future__ import annotations

from kf_calib.errors import InputError
from kf_calib.estimation.bench_model import BenchModel, BenchTerm
from kf_calib.fleet.pooled_diagnosis import BenchCoefficients, PooledDiagnosis


def bench_model(found: PooledDiagnosis, bench: str) -> BenchModel:
    """The errors of a bench as its last runs have them; those of a bench that was repaired are those since then.

    Coefficients that the runs do not determine are left out: no run on that bench shows them. What the coefficients of
    different effects have in common of their uncertainty is left out, too.

    Raises InputError if the bench is not one of the runs, or if none of its errors was found.
    """
    if bench not in found.benches:
        raise InputError(f"no run is of the bench {bench!r}: name one of {', '.join(map(repr, found.benches))}.")
    terms = list[BenchTerm]()
    for finding in found.findings:
        own = [each for each in finding.benches if each.bench == bench]
        if own and (term := _term(finding.effect, own[-1])).symbols:
            terms.append(term)
    if not terms:
        raise InputError(f"no error of the bench {bench!r} was found in {found.runs} runs, so there is none to save.")
    return BenchModel(tuple(terms), bench, found.runs)


def bench_models(found: PooledDiagnosis) -> dict[str, BenchModel]:
    """The bench model of each bench that has errors which the runs determine, by its name."""
    shown = {
        each.bench
        for finding in found.findings
        for each in finding.benches
        if any(own.value is not None for own in each.coefficients)
    }
    return {bench: bench_model(found, bench) for bench in found.benches if bench in shown}


def _term(effect: str, own: BenchCoefficients) -> BenchTerm:
    kept = [k for k, each in enumerate(own.coefficients) if each.value is not None]
    values = tuple(each.value for each in own.coefficients if each.value is not None)
    covariance = tuple(tuple(own.covariance[i][k] for k in kept) for i in kept)
    return BenchTerm(effect, tuple(own.coefficients[k].symbol for k in kept), values, covariance, own.since or "")
