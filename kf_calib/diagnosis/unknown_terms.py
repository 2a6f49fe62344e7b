"""Terms of unknown form: smooth functions of one driver, in each accelerometer or as a rotation.

Each is a Gaussian prior over the span of some formulas of its driver, so that its formula can be read off. A driver may
have alternatives, as the moments of a jump, of which one is true.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from kf_calib.bench.bench import Bench
from kf_calib.dwells.sufficient_statistics import Dwell

RETURNING = "time (irregular, and comes back)"
"""What biases depend on that change as irregularly as a random walk, and return to their mean."""

_DECAYS = (1, 3, 10, 30, 100, 300, 1000, 3000)  # time constants, over the least
_STEADY_K = 0.1  # a temperature that changes by less drives nothing
MOST_ALTERNATIVES = 100
"""Of one cause that are tried: moments of a jump, orientations to which something comes back."""

_SUMS = ((1, 1), (1, -1), (2, 1), (2, -1), (1, 2), (1, -2), (2, 2), (2, -2))  # of two angles, in turns of each
_TURNS = (0.5, 1, 1.5, 2, 3, 4, 6, 8)  # of what is periodic, in a run


@dataclass(frozen=True)
class UnknownTerm:
    """Unknown functions of one driver.

    driver: in words. family: the physical class of effects to which such functions belong; "" for none. summands:
    formulas that belong together, as sine and cosine; ``:place = ...`` stands for a rotation. weights: the usual sizes
    of the summands, of as many columns of equal rms. exclusive: only one of the summands is true; else one or all.
    """

    driver: str
    family: str
    summands: tuple[tuple[str, ...], ...]
    weights: tuple[float, ...] = ()
    exclusive: bool = False

    def weight(self, k: int) -> float:
        """The usual size of one of the summands."""
        return self.weights[k] if self.weights else 1.0


def unknown_terms(bench: Bench, dwells: Sequence[Dwell]) -> Iterator[UnknownTerm]:
    """All terms of unknown form that a run of these dwells may show."""
    yield from _of_force()
    slow = [("time", "t"), *([("temperature", "T")] if _varies(dwells) else [])]
    yield from _of_gimbals(len(bench.axes), slow)
    yield from _of_time(dwells, bench.angles)
    yield from _of_jumps(dwells, bench.angles)
    yield from _of_arrival(len(bench.axes), dwells)
    yield from _of_surroundings(len(bench.axes), bench.angles)
    yield from _of_slow_changes(slow)


def _term(
    driver: str, family: str, texts: Sequence[str | tuple[str, ...]], weights: Sequence[float] = ()
) -> UnknownTerm:
    """A term whose functions are sums of these formulas, or pairs of them."""
    return UnknownTerm(driver, family, tuple((t,) if isinstance(t, str) else t for t in texts), tuple(weights))


def _one_of(driver: str, family: str, alternatives: Sequence[tuple[str, ...]]) -> UnknownTerm:
    """A term of which one alternative is true."""
    return UnknownTerm(driver, family, tuple(alternatives), exclusive=True)


def _of_force() -> Iterator[UnknownTerm]:
    powers = ["{0}*{0}", "{0}**3", "abs({0})", "{0}*abs({0})", "{0}**4", "{0}**5", "{0}**6"]
    weights = (1.0, 1.0, 0.7, 0.7, 0.7, 0.5, 0.4)
    for axis, words, family in (("a", "input", "nonlinearity"), ("p", "pendulous", "cross-axis"),
                                ("o", "output", "cross-axis")):  # fmt: skip
        yield _term(f"specific force along the {words} axis", family, [each.format(axis) for each in powers], weights)
    of_degree = {
        2: ["a*a", "a*p", "a*o", "p*o", "p*p"],
        3: ["a**3", "a*a*p", "a*a*o", "a*p*o", "a*p*p", "p**3", "o**3"],
        4: ["a**4", "a**3*p", "a**3*o", "a*a*p*p", "a*a*p*o", "a*p**3", "a*p*p*o", "p**4", "p**3*o"],
    }
    texts = [text for of_one in of_degree.values() for text in of_one]
    weights = tuple(2.0 / degree for degree, of_one in of_degree.items() for _ in of_one)
    yield _term("direction of the specific force", "cross-axis", texts, weights)


def _varies(dwells: Sequence[Dwell]) -> bool:
    """Tell whether the temperature varies: times one that stays, all is as it is alone."""
    levels = np.array([np.mean(dwell.pieces.nodes.temperature_c) for dwell in dwells])
    return bool(np.ptp(levels) > _STEADY_K)  # False of NaN, where it was not measured


def _of_gimbals(count: int, slow: Sequence[tuple[str, str]]) -> Iterator[UnknownTerm]:
    """slow: what changes slowly, in words and as formulas have it."""
    for k in range(1, count + 1):
        waves = {n: _waves(_turned(n, k)) for n in (1, 2, 3, 4, 6)}
        weights = [n**-0.5 for n in waves]
        yield _term(f"angle of gimbal {k}", "", [(f"q{k}",), *waves.values()], (1.0, *weights))
        products = [_times(waves[n], force) for n in (1, 2) for force in ("a", "p", "o")]
        yield _term(f"angle of gimbal {k} and specific force", "", products)
        for words, symbol in slow:
            products = [_times(waves[n], symbol) for n in (1, 2, 3, 4)]
            yield _term(f"angle of gimbal {k} and {words}", "", products, weights[:4])
        yield _term(f"last move of gimbal {k}", "memory", [f"sign(q{k}_move)", f"q{k}_move"])
        before = (f"sin(q{k}_before)", f"cos(q{k}_before)")
        yield _term(f"previous orientation (angle of gimbal {k})", "memory", [before])
        turning = [(f"q{k}",), *waves.values()]
        for j in range(1, count + 1):
            words = "as an error of its encoder" if j == k else f"a rotation of gimbal {j}"
            yield _term(f"angle of gimbal {k} ({words})", "gimbal and encoder",
                        [_turning(str(j), texts) for texts in turning], (1.0, *weights))  # fmt: skip
        for place, words in (("base", "a tilt of the base"), ("platform", "a rotation of the platform")):
            yield _term(f"angle of gimbal {k} ({words})", "gimbal and encoder",
                        [_turning(place, texts) for texts in turning[:5]], (1.0, *weights[:4]))  # fmt: skip
    for k, j in itertools.combinations(range(1, count + 1), 2):
        angles = [f"{_turned(n, k)}{'-' if m < 0 else '+'}{_turned(abs(m), j)}" for n, m in _SUMS]
        weights = [max(n, abs(m)) ** -0.5 for n, m in _SUMS]
        yield _term(f"angles of gimbals {k} and {j}", "", [*map(_waves, angles)], weights)


def _turned(turns: int, gimbal: int) -> str:
    """An angle, a number of times."""
    return f"q{gimbal}" if turns == 1 else f"{turns}*q{gimbal}"


def _waves(angle: str) -> tuple[str, str]:
    return f"sin({angle})", f"cos({angle})"


def _decays(time: str, least_s: int, longest_s: float) -> list[tuple[str, ...]]:
    """Decays of three neighbouring time constants together: all between them are sums of these, to a thousandth."""
    texts = [f"exp(-{time}/({least_s * k}*s))" for k in _DECAYS if k == 1 or least_s * k <= longest_s]
    return [tuple(texts[k : k + 3]) for k in range(max(len(texts) - 2, 1))]


def _times(texts: Sequence[str], force: str) -> tuple[str, ...]:
    return tuple(f"{text}*{force}" for text in texts)


def _turning(place: str, texts: Sequence[str]) -> tuple[str, ...]:
    """Rotations of a gimbal, the base or the platform by these functions."""
    return tuple(f":{place} = {text}" for text in texts)


def _of_time(dwells: Sequence[Dwell], turns: bool) -> Iterator[UnknownTerm]:
    run_s = f"({dwells[-1].end_s:.0f}*s)"
    texts = ["t", "t*t", *(f"cos({n}*pi*t/{run_s})" for n in range(1, 9))]
    weights = (1.0, 0.5, *(1.0 / n for n in range(1, 9)))
    yield _term("time", "bias in time", texts, weights)
    products = [f"{power}*{force}" for power in ("t", "t*t") for force in ("a", "p", "o")]
    products += [f"{power}*{force}" for power in ("t", "t*t") for force in ("a*a", "p*p", "a*p", "a*o", "p*o")]
    products += [f"cos({n}*pi*t/{run_s})*a" for n in range(1, 7)]
    yield _term("time and specific force", "scale in time", products)
    decays = _decays("t", 10, 10.0 * dwells[-1].end_s)
    yield _one_of("time (a decay)", "bias in time", decays)
    yield _one_of("time and specific force (a decay)", "scale in time",
                  [tuple(f"{decay}*{force}" for force in forces for decay in few)
                   for few in decays for forces in ("a", "po")])  # fmt: skip
    waves = [tuple(f"{wave}({n}*2*pi*t/{run_s})" for wave in ("sin", "cos")) for n in _TURNS]
    yield _one_of("time (periodic)", "bias in time", waves)
    if turns:
        for place, words in (("base", "a tilt of the base"), ("platform", "a rotation of the platform")):
            turning = [f":{place} = {text}" for text in texts[:6]]
            yield _term(f"time ({words})", "base and platform", turning, weights[:6])
            relaxing = [_turning(place, few) for few in decays]
            yield _one_of(f"time ({words}, a decay)", "base and platform", relaxing)
        tilts = [_turning("base", pair) for pair in waves]
        yield _one_of("time (a periodic tilt of the base)", "base and platform", tilts)


def _of_jumps(dwells: Sequence[Dwell], turns: bool) -> Iterator[UnknownTerm]:
    """Jumps of biases at any time; of scale factors, alignment and base between dwells, in the middle of the way: what
    shows in the first or the last dwell alone is that this one is off."""
    within_s = [0.5 * (dwell.start_s + dwell.end_s) for dwell in dwells]
    between_s = [0.5 * (before.end_s + dwell.start_s) for before, dwell in itertools.pairwise([*dwells][1:-1])]
    moments_s = sorted(within_s + between_s)
    moments_s, between_s = (each[:: len(each) // MOST_ALTERNATIVES + 1] for each in (moments_s, between_s))
    if not between_s:
        return
    yield _one_of("time (a jump)", "bias in time", [(f"t > {s:.6g}*s",) for s in moments_s])
    bends = [f"(t > {s:.6g}*s)*(t-{s:.6g}*s)" for s in between_s]
    rates = [("t", *both) for both in itertools.pairwise(bends)] or [("t", *bends)]
    yield _one_of("time (a change of its rate)", "bias in time", rates)
    decaying = "(t > {0:.6g}*s)*exp(-abs(t-{0:.6g}*s)/({1}*s))"
    yield _one_of("time (a jump that decays)", "bias in time",
                  [tuple(decaying.format(s, 10 * k) for k in _DECAYS[:4]) for s in between_s])  # fmt: skip
    steps = [f"(t > {s:.6g}*s)" for s in between_s]
    yield _one_of("time (a jump of the scale factors)", "scale in time", [(f"a*{step}",) for step in steps])
    across = [(f"p*{step}", f"o*{step}") for step in steps]
    yield _one_of("time (a jump of the alignment)", "base and platform", across)
    if turns:
        for place, words in (("base", "a jump of the tilt of the base"), ("platform", "a jump of the mounting")):
            turned = [(f":{place} = {step[1:-1]}",) for step in steps]
            yield _one_of(f"time ({words})", "base and platform", turned)


def _of_arrival(gimbals: int, dwells: Sequence[Dwell]) -> Iterator[UnknownTerm]:
    longest_s = max(dwell.end_s - dwell.start_s for dwell in dwells)
    decays = _decays("tau", 1, 2.0 * longest_s)
    yield _one_of("time since arrival", "memory", decays)
    creeps = [tuple(f"{f}*{decay}" for f in ("fx", "fy", "fz") for decay in few) for few in decays]
    yield _one_of("time since arrival and specific force", "memory", creeps)
    for k in range(1, gimbals + 1):
        sizes = (f"q{k}_move", f"sign(q{k}_move)", f"abs(q{k}_move)", f"abs(sign(q{k}_move))")
        texts = [tuple(f":{k} = {size}*{decay}" for decay in few) for few in decays for size in sizes]
        yield _one_of(f"time since arrival and last move of gimbal {k}", "gimbal and encoder", texts)


def _of_surroundings(gimbals: int, turns: bool) -> Iterator[UnknownTerm]:
    yield _term("temperature", "temperature", ["T", "T*T", "T**3"])
    products = [f"{power}*{force}" for power in ("T", "T*T") for force in ("a", "p", "o")]
    products += [f"{power}*{force}" for power in ("T", "T*T") for force in ("a*a", "p*p", "a*p", "a*o", "p*o")]
    yield _term("temperature and specific force", "temperature", products)
    yield _term("rate of temperature", "temperature", ["dT", "a*dT"])
    if turns:
        for place, words in (("base", "a tilt of the base"), ("platform", "a rotation of the platform")):
            yield _term(f"temperature ({words})", "temperature", [f":{place} = T", f":{place} = T*T"])
    texts = ["da", "da*abs(da)", "abs(da)", *(f"tanh(da/({width}*m/s**2))" for width in (2, 5)), "play3", "play6"]
    yield _term("previous orientation", "memory", [*texts, "a-da", "(a-da)**2"])
    steps = [f"{step}*{force}" for step in ("da", "abs(da)") for force in ("a", "p", "o")]
    yield _term("previous orientation and specific force", "memory", steps)


def _of_slow_changes(slow: Sequence[tuple[str, str]]) -> Iterator[UnknownTerm]:
    """Products of what changes slowly with the last step, and with each other."""
    for words, symbol in slow:
        yield _term(f"previous orientation and {words}", "memory", [f"{symbol}*da", f"{symbol}*abs(da)"])
    if len(slow) > 1:
        yield _term("temperature and time", "", ["t*T", "t*t*T", "t*T*T"])


def name_of_formula(number: int) -> str:
    """Names of formulas: mine, mine2, mine3 ..."""
    return f"mine{number + 1}" if number else "mine"


def text_named(text: str, number: int = 0) -> str:
    """A formula with a name in front, from ``:z = sin(q1)`` or ``sin(q1)``."""
    name = name_of_formula(number)
    return f"{name}{text}" if text.startswith(":") else f"{name} = {text}"
