"""One run of the trial: drawn, diagnosed, and what the program said beside what is true."""

from __future__ import annotations

import time
import traceback
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.stats import norm
from unknown_trials.small_bench import SmallRun, visits

from kf_calib.bench.arrays import one_blas_thread
from kf_calib.bench.bench import Bench
from kf_calib.diagnosis import hypothesis_table
from kf_calib.diagnosis.candidate_tests import assess_candidates
from kf_calib.diagnosis.hypothesis_table import Hypothesis
from kf_calib.diagnosis.missing_effect import diagnose
from kf_calib.diagnosis.posterior import RunPosterior
from kf_calib.diagnosis.refits import Refits
from kf_calib.errors import KfCalibError
from kf_calib.estimation.calibration import evaluate
from kf_calib.estimation.dwell_pass import Pass
from kf_calib.estimation.intervals import NORMAL
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.settings import Settings
from prior_trials.truth import DWELL, NOISE, NOTHING, UNKNOWN, Prior, Truth, with_truth

DWELLS = 12, 16, 24, 32
_READINGS, _LEAST = 240, 1e-4  # of a dwell; probability of a row that is kept


class OpenRun(SmallRun):
    """A run whose bench states no noise from dwell to dwell."""

    @property
    def bench(self) -> Bench:
        return replace(super().bench, angle_sigma_deg=None, scatter_sigma_mps2=None)


def play(seed: int) -> dict[str, Any]:
    """The run of a seed: what is true, the probabilities of all rows, and ranks of the true coefficients."""
    began, rng = time.process_time(), np.random.default_rng([seed, 64])
    dwells, stated = int(rng.choice(DWELLS)), bool(rng.random() < 0.5)
    kind = SmallRun if stated else OpenRun
    run = kind(visits(seed, dwells), np.zeros((dwells, _READINGS, 3)), seed)
    row: dict[str, Any] = {"seed": seed, "dwells": dwells, "stated": stated}
    with one_blas_thread():
        table = Pass(run, Settings()).fold()
        quiet = evaluate(table, run.bench, Settings())
        posterior = RunPosterior(Refits(), quiet, assess_candidates(quiet.fit))
        truth = Prior(posterior._run, posterior._sizes, table).drawn(rng)
        row["truth"] = truth.label
        try:
            found = evaluate(with_truth(table, truth), run.bench, Settings())
            row |= _said(found, truth)
        except KfCalibError as error:
            row |= {"refused": str(error)}
        except Exception as error:  # a run that the program does not survive is a finding, not the end of the trial
            row |= {"refused": f"crash {error!r} in {traceback.extract_tb(error.__traceback__)[-1]}"}
    return row | {"seconds": time.process_time() - began}


def _said(found: Calibration, truth: Truth) -> dict[str, Any]:
    """Return what the program says of a run, and the ranks of what is true in what it estimates."""
    refits = Refits()
    diagnosis = diagnose(found, refits, replicate=False)
    shares = dict[str, float]()
    for each in diagnosis.table.rows if diagnosis.table else ():
        shares[label_of(each)] = shares.get(label_of(each), 0.0) + each.probability
    kept = {label: share for label, share in shares.items() if share > _LEAST or label == truth.label}
    said: dict[str, Any] = {"labels": [*kept], "probabilities": [*kept.values()], "p": diagnosis.test.p_value}
    said |= {"verdict": diagnosis.verdict, "missing": " + ".join(sorted(diagnosis.missing)), "refused": ""}
    return said | {"ranks": _ranks(found, refits, truth)}


def label_of(row: Hypothesis) -> str:
    """A row of the table as a truth is labelled: what is irregular is noise, what only looks like an effect unknown."""
    effects = " + ".join(sorted(row.effects))
    if row.dwells:
        return DWELL
    if row.driver and row.driver != hypothesis_table.IRREGULAR:
        return f"{effects} + {UNKNOWN}" if effects else UNKNOWN
    return effects or (NOTHING if row.families == (hypothesis_table.NOTHING,) else NOISE)


def _ranks(found: Calibration, refits: Refits, truth: Truth) -> list[float]:
    """Return where the true coefficients of effects lie in their posteriors, 0 to 1, if these are in the model."""
    names = [*truth.coefficients]
    if not names or truth.label != " + ".join(names):
        return []
    after, ranks = refits.with_effects(found, names), list[float]()
    for effect in after.model.effects:
        values = truth.coefficients[str(effect)]
        for coefficient, value in zip(effect.coefficients, values, strict=True):
            known = after.parameters[coefficient.symbol]
            if known.value is not None and known.sigma:
                low, high = after.interval(known)
                assert low is not None and high is not None
                scaled = 2.0 * NORMAL * (value - known.value) / (high - low)
                ranks.append(float(norm.cdf(scaled)))
    return ranks
