"""What to do after a diagnosis, as sentences with a command to paste."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import dataclass

from kf_calib.diagnosis.results import Diagnosis

_TELLS = 1.0  # sigma; an orientation that separates explanations by less tells nothing


@dataclass(frozen=True)
class NextStep:
    """why: a sentence without its full stop. command: what to paste; "" where there is none."""

    why: str
    command: str = ""


def next_steps(diagnosis: Diagnosis, typed: str) -> list[NextStep]:
    """What to do, the first thing first.

    typed: recording and options of the command that was given, as words of a shell; "" outside the command line, where
    no command can be told.
    """
    steps = list(_steps(diagnosis, typed))
    if typed:
        return steps
    return [NextStep(each.why) for each in steps if not each.command or each.why.startswith("Measure")]


def _steps(diagnosis: Diagnosis, typed: str) -> Iterator[NextStep]:
    test, before = diagnosis.test, diagnosis.before
    if test.consistent is None:
        yield NextStep("Find orientations that determine the model", f"kf-calib plan {typed} --count 24")
    elif test.consistent:
        yield NextStep("Keep this calibration", f"kf-calib replay {typed} --save calibration.json")
    elif before.outlying:
        number = before.outlying[0].number
        yield NextStep(f"Try the run without dwell {number}", f"kf-calib diagnose {typed} --leave-out {number}")
    elif diagnosis.sure:
        yield NextStep("Add it and see the error fall", f"kf-calib improve {typed}")
    else:
        yield from _unsure(diagnosis, typed)


def _unsure(diagnosis: Diagnosis, typed: str) -> Iterator[NextStep]:
    """Yield what decides among several explanations, then what can be tried without it."""
    going = diagnosis.next_orientation
    if going is not None and going[0].told and going[0].after < _TELLS:
        yield NextStep("No single orientation tells them apart here: measure at more, or for longer")
    elif going is not None:
        yield NextStep(f"Measure with the gimbals at {angles_in_words(diagnosis)}: it {going[1]}")
    if diagnosis.description is not None:
        texts = " ".join(f"--with {shlex.quote(text)}" for text in diagnosis.description.formulas)
        yield NextStep("Try what describes it", f"kf-calib diagnose {typed} {texts}")
    elif diagnosis.missing:
        yield NextStep("Or take the likeliest", f"kf-calib improve {typed} --accept-first")


def angles_in_words(diagnosis: Diagnosis) -> str:
    """The angles of the next orientation, outer gimbal first."""
    assert diagnosis.next_orientation is not None
    return f"{', '.join(f'{angle:g}' for angle in diagnosis.next_orientation[0].gimbal_deg)} deg"
