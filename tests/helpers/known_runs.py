"""Diagnoses and improvements that several tests look at: each is made once for all tests of a process.

Those of the recording with a hidden hysteresis, and of simulated runs by what is hidden in them.
"""

from functools import cache

from helpers.hidden_effects import run
from helpers.paths import RECORDINGS
from kf_calib.diagnosis.missing_effect import diagnose
from kf_calib.diagnosis.refits import Refits
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.stepwise_selection import Improvement, improve

HIDDEN = RECORDINGS / "hidden.mcap"


@cache
def refits(*hidden: str, recorded: bool = False) -> Refits:
    """What a diagnosis has computed, the improvement need not again."""
    return Refits(HIDDEN if recorded else None)


@cache
def hidden_diagnosed() -> Diagnosis:
    return diagnose(HIDDEN, refits(recorded=True))


@cache
def hidden_improved() -> Improvement:
    return improve(hidden_diagnosed().before, refits=refits(recorded=True))


@cache
def diagnosed(*hidden: str) -> Diagnosis:
    return diagnose(run(*hidden), refits(*hidden))


@cache
def improved(*hidden: str) -> Improvement:
    return improve(diagnosed(*hidden).before, refits=refits(*hidden))
