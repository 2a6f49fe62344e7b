"""Figures of each family of trials, and what is asked for."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TypeVar

import numpy as np
from scipy.stats import chi2

from blind_trials.criteria import APART, is_alarm, is_driver_right, is_named_without_doubt, overlap_of
from blind_trials.figure import ENOUGH_TRIALS, Figure, rate
from blind_trials.ideal import SCATTER_ALLOWED, WALK
from blind_trials.outcome import NONE, Outcome
from blind_trials.scores import score_figures
from blind_trials.statements import probability_of_truth
from blind_trials.task import FAMILIES, SIZES_SIGMA
from kf_calib.design.next_orientation import ENOUGH

_POWER = (0.86, 0.94)  # asked for; the stated sizes are those that are found in 9 of 10 runs
Hit = TypeVar("Hit", bool, float)


def figures(outcomes: Sequence[Outcome]) -> list[Figure]:
    """Return every figure that the outcomes allow."""
    done = [each for each in outcomes if each.refused or not each.error]
    groups = dict[str, list[Outcome]]()
    for each in sorted(done, key=lambda each: FAMILIES.index(each.task.family)):
        groups.setdefault(each.task.figure, []).append(each)
    out = list[Figure]()
    for figure, own in groups.items():
        refused = sum(each.refused for each in own)
        found = _FIGURES[own[0].task.family](figure.partition("@")[2], own)
        out += [dataclasses.replace(each, refused=refused) for each in found if each.count]
    blind = [each.named not in each.invisible for each in done if each.named]
    if blind:
        out.append(rate("a name that is given is not of an effect it calls invisible", blind, least=1.0))
    return [*out, *score_figures(done)]


def _noise(which: str, own: list[Outcome]) -> Iterator[Figure]:
    """Yield the figures of runs with noise alone."""
    alarms = rate(f"false alarm, {which}", [is_alarm(each) for each in own], most=0.03)
    if which == "white":
        enough = alarms.count >= 1000
        alarms = dataclasses.replace(
            alarms, bar="<= 2 % (upper limit, of 1000)", meets=alarms.high <= 0.02 if enough else None
        )
    yield alarms
    yield rate(f"a name given, {which}", [each.named is not None for each in own])


def _name(which: str, own: list[Outcome]) -> Iterator[Figure]:
    """Yield the figures of runs with one hidden effect."""
    least, worst = {"8": (0.93, 0.75), "10": (0.96, None), "15": (0.98, 0.90)}.get(which, (None, None))
    stated = "" if own[0].task.family == "name" else ", nothing stated"
    yield rate(f"right name first, n = {which}{stated}", [each.right for each in own], least)
    lowest, hits = _worst((each.truth[0], each.right) for each in own)
    yield rate(f"worst effect, n = {which}{stated}: {lowest}", hits, worst)
    given = [each for each in own if each.ambiguity or each.refused]
    yield rate(f"ambiguity set holds the truth, n = {which}{stated}", [each.held for each in given], 0.99)
    sizes = [len(each.ambiguity) for each in own if each.ambiguity]
    if sizes:
        size, (low, high) = float(np.median(sizes)), np.percentile(sizes, [2.5, 97.5])
        yield Figure(f"median size of the set, n = {which}{stated}", size, low, high, len(sizes), "1", size == 1.0)
    yield rate(f"wrong name, n = {which}{stated}", [each.wrong for each in own])
    answers = [each.extra["replicates"] for each in own if each.extra.get("replicates")]
    for answer in ("yes", "no") if answers else ():
        yield rate(f"replicates, n = {which}{stated}: {answer}", [each == answer for each in answers])
    if any(each.families for each in own):
        yield rate(f"family right, n = {which}{stated}", [each.family_right for each in own], 0.98)
    if any(each.hypotheses for each in own):
        shares, least = [probability_of_truth(each) for each in own], 0.90 if which == "10" else None
        yield _mean_share(f"probability of the truth, n = {which}{stated}, mean", shares, least)


def _mean_share(name: str, shares: Sequence[float], least: float | None) -> Figure:
    """Return the mean of probabilities, and the range of 95 % of the trials."""
    mean, low, high = _mean_and_range(shares)
    bar = "" if least is None else f">= {least:.2f}"
    meets = None if least is None or len(shares) < ENOUGH_TRIALS else mean >= least
    return Figure(name, mean, low, high, len(shares), bar, meets)


def _understated(which: str, own: list[Outcome]) -> Iterator[Figure]:
    """Yield the figures of runs with more noise from dwell to dwell than is stated."""
    said = f"{which} stated too small"
    yield rate(f"{said}: noticed", [each.consistent is False for each in own])
    yield rate(f"{said}: a name", [each.named is not None for each in own])
    yield rate(f"{said}: called noise", [each.first == "noise" for each in own])
    yield rate(
        f"{said}: a name without saying that it may be scatter",
        [is_named_without_doubt(each) for each in own],
        most=0.05,
    )


def _worst(found: Iterable[tuple[str, Hit]]) -> tuple[str, list[Hit]]:
    """Return the effect with the smallest share of hits, and its hits."""
    by_effect = _by_effect(found)
    lowest = min(by_effect, key=lambda name: (np.mean(by_effect[name]), name))
    return lowest, by_effect[lowest]


def _by_effect(found: Iterable[tuple[str, Hit]]) -> dict[str, list[Hit]]:
    """Return the hits of each effect."""
    out = dict[str, list[Hit]]()
    for name, hit in found:
        out.setdefault(name, []).append(hit)
    return out


def _power(_: str, own: list[Outcome]) -> Iterator[Figure]:
    """Yield the figures of runs with an effect of the smallest detectable size that the program states."""
    found = [(each.truth[0], each.consistent is False) for each in own]
    yield rate("power at the stated size, all effects", [hit for _, hit in found], *_POWER)
    for name, hits in sorted(_by_effect(found).items()):
        each = rate(f"power at the stated size, {name}", hits, *_POWER)
        if (
            each.meets is not None
        ):  # one effect has too few trials for a share within 4 %: its limits must reach the band
            each = dataclasses.replace(each, meets=each.low <= _POWER[1] and each.high >= _POWER[0])
        yield each


def _invisible(which: str, own: list[Outcome]) -> Iterator[Figure]:
    """Yield the figure of the lists of invisible effects."""
    differ = sorted({name for each in own for name in each.extra.get("differ", ())})
    yield rate(f"invisible list exact, {which}" + f": not {', '.join(differ)}" * bool(differ),
               [not each.refused and not each.extra["differ"] for each in own], 1.0)  # fmt: skip


def _outside(which: str, every: list[Outcome]) -> Iterator[Figure]:
    """Yield the figures of runs with an effect that is in no catalogue."""
    stated = every[0].task.family == "outside"
    said, least = ("outside the catalogue", 0.90) if stated else ("nothing stated, outside the catalogue", 0.85)
    own = [each for each in every if overlap_of(each) < APART]
    yield rate(f"{said}, n = {which}: unknown", [each.outside_right for each in own], least)
    if own:
        lowest, hits = _worst((each.truth[0], each.outside_right) for each in own)
        yield rate(f"{said}: unknown, worst effect: {lowest}", hits)
    wrong = [each.named is not None and not each.outside_right for each in own]
    yield rate(f"{said}: a wrong name", wrong, most=0.05)
    answers = [each for each in own if each.first == "unknown" or each.refused]
    yield rate(f"{said}: driver right, of unknown", [is_driver_right(each) for each in answers], 0.80)
    near = [each.outside_right for each in every if overlap_of(each) >= APART]
    yield rate(f"{said}, but overlap >= {APART}: unknown", near)
    if any(each.families for each in every):
        classed = [each for each in every if each.true_families != (NONE,)]
        yield rate(f"{said}: family right, of those that belong to one", [e.family_right for e in classed], 0.95)
        if classed:
            lowest, hits = _worst((each.truth[0], each.family_right) for each in classed)
            yield rate(f"{said}: family right, worst effect: {lowest}", hits)


def _pair(which: str, every: list[Outcome]) -> Iterator[Figure]:
    """Yield the figures of runs with two hidden effects."""
    own = [each for each in every if overlap_of(each) < APART]
    yield rate(f"two at once, n = {which} each: both found", [each.found for each in own], 0.85)
    nothing_else = [each.nothing_else and not each.refused for each in own]
    yield rate("two at once: nothing else", nothing_else, 0.95)
    yield rate("two at once: one of them found", [any(map(each.means_truth, each.names)) for each in own])


def _plans(which: str, own: list[Outcome]) -> Iterator[Figure]:
    """Yield the figures of other plans and benches, with one hidden effect or none."""
    if "one hidden" in which:
        yield rate(f"{which}: a wrong name", [each.wrong for each in own], most=0.0)
        yield rate(f"{which}: noticed", [each.consistent is False for each in own])
        yield rate(f"{which}: right name first", [each.right for each in own])
    else:
        yield rate(f"{which}: false alarm", [is_alarm(each) for each in own], most=0.03)
        yield rate(f"{which}: a name", [each.named is not None for each in own], most=0.01)


def _improve(which: str, own: list[Outcome]) -> Iterator[Figure]:
    """Yield the figures of ``improve``."""
    settled = [each for each in own if each.extra.get("stopped") == "consistent"]
    yield rate(f"improve, n = {which}: ends consistent", [each in settled for each in own])
    ambiguous = [each.extra.get("stopped") == "ambiguous" for each in own]
    yield rate(f"improve, n = {which}: ends ambiguous", ambiguous)
    yield rate("after improve: the right effect and no other", [each.right and each.nothing_else for each in settled])
    ratios = [each.extra["held_out"] for each in settled if each.extra["held_out"]]
    if ratios:
        mean, (low, high) = float(np.mean(ratios)), np.percentile(ratios, [2.5, 97.5])
        yield Figure("after improve: held-out rms / floor, mean", mean, low, high, len(ratios), "<= 1.05", mean <= 1.05)
    yield from _coverage("in a second run", settled)
    yield from _coverage("in a second run, right effect", [each for each in settled if each.right], judged=False)


def _coverage(where: str, own: list[Outcome], judged: bool = True) -> Iterator[Figure]:
    """Yield the errors of the twelve parameters against their covariance.

    The limits of the NEES are those that its mean keeps in 95 % of cases if the covariance is right.
    """
    if own:
        nees, count = float(np.mean([each.extra["nees"] for each in own])), len(own)
        low, high = chi2.ppf([0.025, 0.975], 12 * count) / count
        meets = bool(low <= nees <= high) if judged and count >= ENOUGH_TRIALS else None
        bar = "in its 95 % band" if judged else ""
        yield Figure(f"after improve, {where}: NEES of the twelve, mean", nees, low, high, count, bar, meets)
        hits = [k < each.extra["inside"] for each in own for k in range(12)]
        bars = (0.92, 0.98) if judged else (None, None)
        yield rate(f"after improve, {where}: 95 % intervals cover", hits, *bars)


def _advice(_: str, own: list[Outcome]) -> Iterator[Figure]:
    """Yield the figures of advised orientations, against random ones."""
    for most, words in ((ENOUGH, f", up to {ENOUGH:g} sigma"), (math.inf, "")):
        pairs = [[min(each.extra.get(key, 0.0), most) for key in ("advised", "random")] for each in own]
        ratios = [advised / max(random, 1e-9) for advised, random in pairs]
        yield rate(f"4 advised separate an ambiguous pair as well as 12 random{words}", [x >= 1.0 for x in ratios])
        median, (low, high) = float(np.median(ratios)), np.percentile(ratios, [2.5, 97.5])
        bar = (">= 1", median >= 1.0 if len(own) >= ENOUGH_TRIALS else None) if most == math.inf else ("", None)
        yield Figure(f"separation, 4 advised / 12 random, median{words}", median, low, high, len(own), *bar)
    times = [each.extra["dwells"] / 12.0 for each in own if "dwells" in each.extra]
    if times:
        low, high = np.percentile(times, [2.5, 97.5])
        yield Figure(
            "time the 4 advised take, in that of 12 random, median", float(np.median(times)), low, high, len(times)
        )


def _ideal(_: str, own: list[Outcome]) -> Iterator[Figure]:
    """Yield the best possible shares."""
    for size, words in itertools.product(map(str, SIZES_SIGMA), ("", SCATTER_ALLOWED)):
        shares = [each.extra[size + words] for each in own if size + words in each.extra]
        if not shares:
            continue
        said = f"n = {size}{words}"
        runs = [float(np.mean(list(each.values()))) for each in shares]
        yield Figure(f"right name first, {said}: best possible", *_mean_and_range(runs), len(runs))
        lowest, hits = _worst((name, share) for each in shares for name, share in each.items())
        yield Figure(f"worst effect, {said}, best possible: {lowest}", *_mean_and_range(hits), len(hits))
        walks = [each[WALK] for each in shares]
        yield Figure(f"{WALK}, {said}: best possible", *_mean_and_range(walks), len(walks))
    for key, words in (("probability", ""), ("probability, two possible", ", size and number unknown")):
        known = [each.extra[key] for each in own if key in each.extra]
        for size in map(str, SIZES_SIGMA) if known else ():
            means = [float(np.mean(list(each[size].values()))) for each in known]
            said = f"probability of the truth, n = {size}, mean: best possible{words}"
            yield Figure(said, *_mean_and_range(means), len(means))
    hits = [(pair, right) for each in own for pair, right in each.extra.get("pairs", [])]
    for walks, words in ((False, ""), (True, ", a walk of the biases being one")):
        shown = [right for pair, right in hits if WALK in pair or not walks]
        if shown:
            yield rate(f"two at once{words}, both found and nothing else: best possible", shown)


def _mean_and_range(values: Sequence[float]) -> tuple[float, float, float]:
    """Return the mean of values, and the limits that hold 95 % of them."""
    low, high = np.percentile(values, [2.5, 97.5])
    return float(np.mean(values)), float(low), float(high)


_FIGURES: dict[str, Callable[[str, list[Outcome]], Iterator[Figure]]] = {
    "noise": _noise, "name": _name, "unstated": _name, "power": _power, "invisible": _invisible, "outside": _outside,
    "unstated-outside": _outside,
    "pair": _pair, "plans": _plans, "improve": _improve, "advice": _advice, "ideal": _ideal,
    "benches": _plans, "understated": _understated,
}  # fmt: skip
