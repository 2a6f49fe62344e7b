"""The recording with a hidden hysteresis, diagnosed and improved once for all tests of a process."""

from __future__ import annotations

from functools import cache

from helpers.paths import RECORDINGS
from kf_calib.diagnosis.missing_effect import diagnose
from kf_calib.diagnosis.refits import Refits
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.stepwise_selection import Improvement, improve

HIDDEN = RECORDINGS / "hidden.mcap"


@cache
def _refits() -> Refits:
    """What the diagnosis has computed, the improvement need not again."""
    return Refits(HIDDEN)


@cache
def hidden_diagnosed() -> Diagnosis:
    return diagnose(HIDDEN, _refits())


@cache
def hidden_improved() -> Improvement:
    return improve(hidden_diagnosed().before, refits=_refits())
