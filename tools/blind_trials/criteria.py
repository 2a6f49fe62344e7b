"""When an outcome counts as right, and when it is to be looked at."""

from __future__ import annotations

from blind_trials.outcome import Outcome
from blind_trials.task import OUTSIDE

APART = 0.7  # overlap below which two effects are expected to be told apart


def is_alarm(each: Outcome) -> bool:
    """Tell whether the program found something wrong, or gave no answer."""
    return each.refused or each.consistent is False


def is_named_without_doubt(each: Outcome) -> bool:
    """Tell whether a name was given without saying that it may be scatter; no answer counts as such."""
    return each.refused or (each.named is not None and not each.extra.get("may_be_scatter", False))


def overlap_of(each: Outcome) -> float:
    """Return the overlap of the hidden effects; 0 where the program gave no answer, so that the trial is judged."""
    return float(each.extra.get("overlap", 0.0))


def is_driver_right(each: Outcome) -> bool:
    """Tell whether the kind of driver is right: "angle of gimbal 2, 3 a turn" is "angle"."""
    said = each.extra.get("driver") or ""
    for end in (",", "(", " of gimbal"):
        said = said.split(end)[0]
    return not each.refused and said.strip() == each.extra["true_drivers"][0]


def is_failure(each: Outcome) -> bool:
    """Tell whether an outcome is not what was hoped for, so that someone should look at it."""
    family, close = each.task.family, overlap_of(each) >= APART
    if each.error:
        return each.refused
    if family in ("noise", "plans", "benches") and not each.truth:
        return is_alarm(each)
    if family in OUTSIDE:
        told = each.outside_right and (each.first != "unknown" or is_driver_right(each))
        return not close and not told
    return {
        "name": not each.right, "unstated": not each.right, "plans": each.wrong, "benches": each.wrong,
        "power": False, "understated": is_named_without_doubt(each),
        "invisible": bool(each.extra.get("differ")),
        "pair": not close and not (each.found and each.nothing_else), "improve": not each.right,
        "advice": each.extra.get("advised", 1.0) < each.extra.get("random", 0.0),
    }.get(family, False)  # fmt: skip
