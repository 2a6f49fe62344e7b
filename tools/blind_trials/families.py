"""The trials of each family of figures, without their seeds."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from blind_trials.catalogue import outside_effects
from blind_trials.random_bench import draw_bench
from blind_trials.task import BENCH_SIZES_SIGMA, FAR_SIGMA, NOISES, PAIR_SIGMA, PLANS, SIZES_SIGMA, UNDERSTATED
from blind_trials.visible_effects import confusable, visible_effects

COUNTS: dict[str, float] = {
    "noise@white": 500, "noise": 60, "name": 1, "unstated": 0.25, "power": 4, "invisible": 0.2, "outside": 2,
    "pair": 40, "plans@nothing": 8, "plans": 0.2, "improve": 0.4, "advice": 1, "ideal": 2, "benches": 30,
    "understated": 15, "unstated-outside": 1,
}  # fmt: skip
"""Trials for each unit of ``--runs``: in all, or for each hidden effect (and size, and plan); at least one."""
_BESIDE_THE_TWELVE = {"magnetic": ";up=0"}
"""Parts to leave out because they only change the twelve parameters, whose truth is stated without them."""


@dataclass(frozen=True)
class Request:
    """What a family of trials is made from.

    family: its name. runs: the scale of ``COUNTS``. effects: hide only these (empty: all that the run shows). visible:
    effects that a run of the usual plan shows. rng: what is drawn at random.
    """

    family: str
    runs: int
    effects: Sequence[str]
    visible: Sequence[str]
    rng: np.random.Generator

    def rounds(self, of: str = "") -> range:
        """Return the rounds to play of a key of ``COUNTS``, by default the family."""
        return range(max(1, round(COUNTS[of or self.family] * self.runs)))


@dataclass(frozen=True)
class Row:
    """One trial without its seed.

    which: variant of the figure. hidden: effects to hide. options: of ``simulate``. setting: setting error, deg (empty:
    that of the whole trial). round: trials of the same round share a seed (None: a seed of its own).
    """

    which: str
    hidden: tuple[str, ...] = ()
    options: tuple[str, ...] = ()
    setting: str = ""
    round: int | None = None


def _noise(asked: Request) -> Iterator[Row]:
    """Yield runs with noise alone, of each kind."""
    for name, options in NOISES.items():
        for _ in asked.rounds(f"noise@{name}" if f"noise@{name}" in COUNTS else "noise"):
            yield Row(name, options=options)


def _power(asked: Request) -> Iterator[Row]:
    """Yield runs with an effect of the stated size; the sizes stated for one run serve all effects."""
    for round_, name in itertools.product(asked.rounds(), asked.visible):
        yield Row("stated", (name,), round=round_)


def _ideal(asked: Request) -> Iterator[Row]:
    """Yield runs for the best possible share of right names."""
    for _ in asked.rounds():
        yield Row("any")


def _understated(asked: Request) -> Iterator[Row]:
    """Yield runs with more noise from dwell to dwell than is stated."""
    for what, (options, setting) in UNDERSTATED.items():
        for _ in asked.rounds():
            yield Row(what, options=options, setting=setting)


def _invisible(asked: Request) -> Iterator[Row]:
    """Yield runs of each plan, for the lists of invisible effects."""
    for name, _ in itertools.product(PLANS, asked.rounds()):
        yield Row(name, options=PLANS[name])


def _pair(asked: Request) -> Iterator[Row]:
    """Yield runs with two effects."""
    for _ in asked.rounds() if len(asked.visible) > 1 else ():
        both = asked.rng.choice(asked.visible, 2, replace=False)
        yield Row(f"{PAIR_SIGMA}", tuple(f"{name}={PAIR_SIGMA}sigma" for name in both))


def _benches(asked: Request) -> Iterator[Row]:
    """Yield runs of benches drawn at random, every third with nothing hidden."""
    for number in asked.rounds():
        options, setting, axes = draw_bench(asked.rng)
        name, _, place = str(asked.rng.choice(asked.visible)).partition(":")
        effect = f"{name}:{asked.rng.choice(axes)}" if place else name
        hidden = f"{effect}={asked.rng.choice(BENCH_SIZES_SIGMA)}sigma"
        what, hides = ("nothing", ()) if number % 3 == 0 else ("one", (hidden,))
        yield Row(f"other benches, {what} hidden", hides, options, setting)


def _plans(asked: Request) -> Iterator[Row]:
    """Yield runs of other plans, with nothing hidden and with one effect."""
    for plan in ("six faces", "monotone", "six dwells"):
        for _ in asked.rounds("plans@nothing"):
            yield Row(f"{plan}, nothing hidden", options=PLANS[plan])
        seen = asked.effects or (asked.visible if plan == "monotone" else visible_effects(PLANS[plan]))
        for effect, _ in itertools.product(seen, asked.rounds()):
            yield Row(f"{plan}, one hidden", (f"{effect}=10sigma",), PLANS[plan])


def _one(
    asked: Request,
    sizes_sigma: Sequence[int],
    hidden: Callable[[Request], Sequence[str]] = lambda asked: asked.visible,
    options: tuple[str, ...] = (),
    endings: dict[str, str] | None = None,
) -> Iterator[Row]:
    """Yield runs with one effect of each size; endings: what to add to the text that hides an effect."""
    for size, name, _ in itertools.product(sizes_sigma, hidden(asked), asked.rounds()):
        yield Row(str(size), (f"{name}={size}sigma{(endings or {}).get(name, '')}",), options)


def _outside_of(asked: Request) -> list[str]:
    """Return the effects in no catalogue, or those of them that are asked for."""
    every = outside_effects()
    return [name for name in every if name in asked.effects] or every


ROWS: dict[str, Callable[[Request], Iterator[Row]]] = {
    "noise": _noise,
    "name": partial(_one, sizes_sigma=SIZES_SIGMA),
    "unstated": partial(_one, sizes_sigma=(10, FAR_SIGMA), options=NOISES["unstated"]),
    "power": _power,
    "invisible": _invisible,
    "outside": partial(_one, sizes_sigma=(15,), hidden=_outside_of),
    "pair": _pair,
    "plans": _plans,
    "improve": partial(_one, sizes_sigma=(15,), endings=_BESIDE_THE_TWELVE),
    "advice": partial(_one, sizes_sigma=(8,), hidden=lambda asked: asked.effects or confusable(asked.visible)),
    "ideal": _ideal,
    "benches": _benches,
    "understated": _understated,
    "unstated-outside": partial(_one, sizes_sigma=(15,), hidden=_outside_of, options=NOISES["unstated"]),
}
"""How the trials of each family are made."""
