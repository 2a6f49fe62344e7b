"""The bench model that a pooled diagnosis leads to: errors of a bench that later single runs on it take as known."""

from __future__ import annotations

from kf_calib.errors import InputError
from kf_calib.estimation.bench_model import BenchModel, BenchTerm
from kf_calib.fleet.pooled_diagnosis import BenchCoefficients, PooledDiagnosis


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
