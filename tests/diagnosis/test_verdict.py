"""The verdict of a diagnosis in words, for tables of probabilities that are made up."""

from __future__ import annotations

import math
from dataclasses import replace

from helpers.known_runs import hidden_diagnosed

from kf_calib.diagnosis.hypothesis_table import IRREGULAR, NOISE, NONE, NOTHING, Hypothesis, table_of
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.verdict import verdict_in_words


def diagnosis_of(nothing: float, noise: float, irregular: float) -> Diagnosis:
    """A failed test, with these probabilities and no known effect among the explanations."""
    rows = [
        Hypothesis(families=(NOTHING,), log_evidence=math.log(nothing)),
        Hypothesis(families=(NOISE,), log_evidence=math.log(noise)),
        Hypothesis(driver=IRREGULAR, families=(NONE,), log_evidence=math.log(irregular)),
    ]
    nameless = replace(hidden_diagnosed(), table=table_of(rows), missing=(), after=None, suspects=(), ambiguity=())
    return replace(nameless, unknown=irregular > noise, noise=noise > irregular)


def test_that_nothing_is_missing_is_told_first_where_it_is_likeliest() -> None:
    verdict = verdict_in_words(diagnosis_of(nothing=0.5, noise=0.03, irregular=0.47))
    assert "It may be chance: nothing is missing (50 %). Otherwise: unknown: no known effect explains it" in verdict
    assert verdict.count("nothing") == 1 and "(47 %)" in verdict, verdict
    verdict = verdict_in_words(diagnosis_of(nothing=0.6, noise=0.3, irregular=0.1))
    assert "It may be chance: nothing is missing (60 %). Otherwise: the dwells scatter more than was stated" in verdict


def test_that_nothing_may_be_missing_is_told_among_the_others_where_it_is_less_likely() -> None:
    verdict = verdict_in_words(diagnosis_of(nothing=0.2, noise=0.02, irregular=0.78))
    assert "chance" not in verdict and "; or nothing missing 20 %" in verdict, verdict
