"""Terms of unknown form: smooth functions of one driver, in each accelerometer or as a rotation.

Each is a Gaussian prior over the span of some formulas of its driver, so that its formula can be read off. A driver may
have alternatives, as the moments of a jump, of which one is true.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from kf_calib.bench.bench import Bench
from kf_calib.dwells.sufficient_statistics import Dwell

RETURNING = "time (irregular, and comes back)"
"""What biases depend on that change as irregularly as a random walk, and return to their mean."""

_DECAYS = (1, 3, 10, 30, 100, 300, 1000, 3000)  # time constants, over the least
_STEADY_K = 0.1  # a temperature that changes by less drives nothing
MOST_ALTERNATIVES = 100
"""Of one cause that are tried: moments of a jump, orientations to which something comes back."""
_MOST_DECAYING = 32  # moments of a jump that decays: each has the columns of four decays
_SHARES = {1: 0.5, 2: 0.25, 0: 0.25}
"""Of one, two and all of the summands of an unknown function."""

_SUMS = ((1, 1), (1, -1), (2, 1), (2, -1), (1, 2), (1, -2), (2, 2), (2, -2))  # of two angles, in turns of each
_CAGE = 0.4  # turns of the cage of a bearing in one of the gimbal
_END = 0.125  # of a run
_CURVED = ("a*a", "p*p", "a*p", "a*o", "p*o", "abs(a)")  # functions of the force that are not straight
_LEVELS = (1, 2, 3, 4, 5, 6, 7, 8, 9)  # of the force at which a sensor may behave otherwise, in tenths of gravity
_IRREGULAR = 24  # half cycles in a run of what turns with time
_TURNS = 12  # of what oscillates, in a run, at most


@dataclass(frozen=True)
class UnknownTerm:
    """Unknown functions of one driver.

    driver: in words. family: the physical class of effects to which such functions belong; "" for none. summands:
    formulas that belong together, as sine and cosine; ``:place = ...`` stands for a rotation. weights: the usual sizes
    of the summands, of as many columns of equal rms. at_once: how many of the summands are true at most; 0: any number.
    """

    driver: str
    family: str
    summands: tuple[tuple[str, ...], ...]
    weights: tuple[float, ...] = ()
    at_once: int = 0

    def weight(self, k: int) -> float:
        """The usual size of one of the summands."""
        return self.weights[k] if self.weights else 1.0

    def share(self, count: int) -> float:
        """The probability that so many of the summands are true: 1, 2, or 0 for all of them."""
        may = [n for n in _SHARES if not self.at_once or 0 < n <= self.at_once]
        return _SHARES[count] / sum(_SHARES[n] for n in may) if len(self.summands) > 1 else float(count == 1)


def unknown_terms(bench: Bench, dwells: Sequence[Dwell]) -> Iterator[UnknownTerm]:
    """All terms of unknown form that a run of these dwells may show."""
    yield from _of_force()
    slow = [("time", "t"), *([("temperature", "T")] if _varies(dwells) else [])]
    yield from _of_gimbals(len(bench.axes), slow)
    places = _places(bench.angles)
    yield from _of_time(dwells, places)
    within = range(2, len(bench.axes) + 1) if bench.angles else ()  # the outer gimbal turns as the base does
    gimbals = [_Place(f"gimbal {k}", "gimbal and encoder", (f":{k} = {{0}}",)) for k in within]
    yield from _of_turning(dwells, [*(place for place in places if place.turns), *gimbals])
    yield from _of_jumps(dwells, [*places, *gimbals[:-1]])  # a slip of the inner one is one of the mounting
    yield from _of_arrival(len(bench.axes), dwells)
    yield from _of_way(len(bench.axes), dwells, places)
    yield from _of_history(len(bench.axes), dwells, slow)
    yield from _of_surroundings(len(bench.axes), bench.angles)
    yield from _of_slow_changes(slow)


def _term(
    driver: str, family: str, texts: Sequence[str | tuple[str, ...]], weights: Sequence[float] = ()
) -> UnknownTerm:
    """A term whose functions are sums of these formulas, or pairs of them."""
    return UnknownTerm(driver, family, tuple((t,) if isinstance(t, str) else t for t in texts), tuple(weights))


@dataclass(frozen=True)
class _Place:
    """Where something changes: in words ("" for the biases), the physical class, and formulas of what a function {0}
    adds there. lively: whether it changes not just steadily, or at once."""

    words: str
    family: str
    formulas: tuple[str, ...]
    lively: bool = False

    @property
    def turns(self) -> bool:
        """Whether it is a rotation."""
        return self.formulas[0].startswith(":")

    def of(self, functions: Sequence[str]) -> tuple[str, ...]:
        """The formulas of these functions together."""
        return tuple(formula.format(function) for function in functions for formula in self.formulas)

    def one_of(self, course: str, alternatives: Sequence[Sequence[str]]) -> UnknownTerm:
        """A term of which one of these courses in time is true."""
        words = f"{course} of {self.words}" if self.words else course
        return _one_of(f"time ({words})", self.family, [self.of(functions) for functions in alternatives])


def _one_of(driver: str, family: str, alternatives: Sequence[tuple[str, ...]]) -> UnknownTerm:
    """A term of which one alternative is true."""
    return UnknownTerm(driver, family, tuple(alternatives), at_once=1)


def _of_force() -> Iterator[UnknownTerm]:
    powers = ["{0}*{0}", "{0}**3", "abs({0})", "{0}*abs({0})", "{0}**4", "{0}**5", "{0}**6"]
    weights = (1.0, 1.0, 0.7, 0.7, 0.7, 0.5, 0.4)
    for axis, words, family in (("a", "input", "nonlinearity"), ("p", "pendulous", "cross-axis"),
                                ("o", "output", "cross-axis")):  # fmt: skip
        yield _term(f"specific force along the {words} axis", family, [each.format(axis) for each in powers], weights)
    # a value between two of those that are tried is told by both
    steps = [f"(a > {0.1 * level:.1f}*g)" for level in (*(-level for level in reversed(_LEVELS)), *_LEVELS)]
    ranges = [f"(abs(a) > {0.1 * level:.1f}*g)*a" for level in _LEVELS]
    values = [*itertools.pairwise(steps), *itertools.pairwise(ranges)]
    yield _one_of("specific force along the input axis (from a value on)", "nonlinearity", values)
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
        waves = {n: _waves(_turned(n, k)) for n in (1, 2, 3, 4, 5, 6)}
        cage = _waves(f"{_CAGE}*q{k}")
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
        held = [_turning(str(k), _times(waves[n], f"sign(q{k}_move)")) for n in (1, 2)]
        yield _term(f"angle and last move of gimbal {k} (as an error of its encoder)", "gimbal and encoder", held)
        turning = [(f"q{k}",), *waves.values(), cage]
        for j in range(1, count + 1):
            words = "as an error of its encoder" if j == k else f"a rotation of gimbal {j}"
            yield _term(f"angle of gimbal {k} ({words})", "gimbal and encoder",
                        [_turning(str(j), texts) for texts in turning], (1.0, *weights, 1.0))  # fmt: skip
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


def constants_s(least_s: int, longest_s: float) -> list[int]:
    """Time constants that are tried, the least in any case."""
    return [least_s * k for k in _DECAYS if k == 1 or least_s * k <= longest_s]


def _of_three(texts: Sequence[str]) -> list[tuple[str, ...]]:
    """Functions of three neighbouring time constants together: all between them are sums of these, to a thousandth."""
    return [tuple(texts[k : k + 3]) for k in range(max(len(texts) - 2, 1))]


def _decays(time: str, least_s: int, longest_s: float) -> list[tuple[str, ...]]:
    """Decays of any time constant."""
    return _of_three([f"exp(-{time}/({tau_s}*s))" for tau_s in constants_s(least_s, longest_s)])


def _with_forces(symbol: str) -> list[str]:
    """Products of a quantity, and of its square, with functions of the force."""
    powers = (symbol, f"{symbol}*{symbol}")
    return [f"{power}*{force}" for forces in (("a", "p", "o"), _CURVED) for power in powers for force in forces]


def _times(texts: Sequence[str], force: str) -> tuple[str, ...]:
    return tuple(f"{text}*{force}" for text in texts)


def _turning(place: str, texts: Sequence[str]) -> tuple[str, ...]:
    """Rotations of a gimbal, the base or the platform by these functions."""
    return tuple(f":{place} = {text}" for text in texts)


def _places(turns: bool) -> list[_Place]:
    """What may change with time: in the accelerometers and, of a bench with angles, what turns it."""
    places = [
        _Place("", "bias in time", ("{0}",), lively=True),
        _Place("the scale factors", "scale in time", ("{0}*a",), lively=True),
        _Place("the alignment", "base and platform", ("{0}*p", "{0}*o")),
    ]
    if turns:
        places += [_Place("the tilt of the base", "base and platform", (":base = {0}",), lively=True),
                   _Place("the mounting", "base and platform", (":platform = {0}",))]  # fmt: skip
    return places


def _of_time(dwells: Sequence[Dwell], places: Sequence[_Place]) -> Iterator[UnknownTerm]:
    """Smooth functions of time, and courses of which one is true."""
    run_s = f"({dwells[-1].end_s:.0f}*s)"
    texts = ["t", "t*t", *(f"cos({n}*pi*t/{run_s})" for n in range(1, 9))]
    weights = (1.0, 0.5, *(1.0 / n for n in range(1, 9)))
    yield _term("time", "bias in time", texts, weights)
    products = [*_with_forces("t"), *(f"cos({n}*pi*t/{run_s})*a" for n in range(1, 7))]
    yield _term("time and specific force", "scale in time", products)
    decays = _decays("t", 10, 10.0 * dwells[-1].end_s)
    creeps = [f"log(1+t/({tau_s}*s))" for tau_s in (1, *constants_s(10, dwells[-1].end_s))]
    # between neighbouring frequencies all are sums of these
    waves = {n: _waves(f"{n}*pi*t/{run_s}") for n in range(1, 2 * min(_TURNS, len(dwells) // 2) + 2)}
    oscillations = [(*waves[n - 1], *waves[n], *waves[n + 1]) for n in range(2, len(waves), 2)]
    for place in places:
        yield place.one_of("a decay", decays)
        if place.lively:
            yield place.one_of("a creep", [("sqrt(t/s)",), *itertools.pairwise(creeps)])
        if place.lively and oscillations:
            yield place.one_of("an oscillation", oscillations)


def _of_turning(dwells: Sequence[Dwell], places: Sequence[_Place]) -> Iterator[UnknownTerm]:
    """What turns with time, smoothly or as irregularly as a random walk, whose spectrum the waves have."""
    waves = range(1, min(2 * len(dwells), _IRREGULAR) + 1)
    texts = ["t", "t*t", *(f"cos({n}*pi*t/({dwells[-1].end_s:.0f}*s))" for n in waves)]
    weights = (1.0, 0.5, *(1.0 / n for n in waves))
    for place in places:
        yield _term(f"time ({place.words})", place.family, [place.of([text]) for text in texts], weights)


def _of_jumps(dwells: Sequence[Dwell], places: Sequence[_Place]) -> Iterator[UnknownTerm]:
    """Jumps of biases at any time; of all else, and other changes, between dwells, in the middle of the way: what shows
    in the first or the last dwell alone is that this one is off. Of two jumps the second may undo the first."""
    within_s = [0.5 * (dwell.start_s + dwell.end_s) for dwell in dwells]
    between_s = [0.5 * (before.end_s + dwell.start_s) for before, dwell in itertools.pairwise([*dwells][1:-1])]
    moments_s = sorted(within_s + between_s)
    moments_s, between_s = (each[:: len(each) // MOST_ALTERNATIVES + 1] for each in (moments_s, between_s))
    if not between_s:
        return
    # of one at either end nearly all is a drift of one rate
    inner_s = [s for s in between_s if _END < s / dwells[-1].end_s < 1.0 - _END] or between_s
    bends = [f"(t > {s:.6g}*s)*(t-{s:.6g}*s)" for s in inner_s]
    rates = [("t", *both) for both in itertools.pairwise(bends)] or [("t", *bends)]
    decaying = "(t > {0:.6g}*s)*exp(-abs(t-{0:.6g}*s)/({1}*s))"
    few_s = between_s[:: len(between_s) // _MOST_DECAYING + 1]
    decays = [tuple(decaying.format(s, 10 * k) for k in _DECAYS[:4]) for s in few_s]
    for place in places:
        least = len(place.formulas) - 1  # as many coefficients as dwells on one side would be just these dwells
        of_place_s = between_s[least : len(between_s) - least] if place.words else moments_s
        steps = [(f"(t > {s:.6g}*s)",) for s in of_place_s]
        if steps:
            yield replace(place.one_of("a jump", steps), at_once=2)
        if place.lively:
            yield place.one_of("a change of rate", rates)
            yield place.one_of("a decaying jump", decays)


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


def _of_way(gimbals: int, dwells: Sequence[Dwell], places: Sequence[_Place]) -> Iterator[UnknownTerm]:
    """What goes with the way that gimbals have turned, as wear does, or is lost again, as the warmth of motors."""
    ways = [(f"gimbal {k}", f"q{k}_way") for k in range(1, gimbals + 1)]
    if gimbals > 1:
        ways.append(("all gimbals", f"({'+'.join(way for _, way in ways)})"))
    taus_s = constants_s(10, 10.0 * dwells[-1].end_s)
    for words, way in ways:
        courses = [(way,), *_of_three([f"({way}-lag({way},{tau_s}*s))" for tau_s in taus_s])]
        for place in (place for place in places if place.lively):
            where = f" ({place.words})" if place.words else ""
            yield _one_of(f"way of {words}{where}", place.family, [place.of(course) for course in courses])


def _of_history(gimbals: int, dwells: Sequence[Dwell], slow: Sequence[tuple[str, str]]) -> Iterator[UnknownTerm]:
    """What follows the force across, an angle or the temperature with a time constant: between two all others are sums
    of both."""
    taus_s = constants_s(10, dwells[-1].end_s)
    between = [*itertools.pairwise(taus_s)] or [(taus_s[0],)]

    def lagging(*quantities: str, times: str = "") -> list[tuple[str, ...]]:
        """Return the alternatives of these quantities together, times a force."""
        return [tuple(f"lag({each},{tau_s}*s){times}" for tau_s in few for each in quantities) for few in between]

    yield _one_of("specific force before, across", "memory", [*lagging("p"), *lagging("o")])
    yield _one_of(
        "specific force before, and now", "memory", [*lagging("a", times="*a"), *lagging("abs(a)", times="*a")]
    )
    for k in range(1, gimbals + 1):
        yield _one_of(f"angle of gimbal {k} before", "memory", lagging(*_waves(f"q{k}")))
    for words, symbol in slow[1:]:
        yield _one_of(f"{words} before, and specific force", "temperature", lagging(symbol, times="*a"))


def _of_surroundings(gimbals: int, turns: bool) -> Iterator[UnknownTerm]:
    yield _term("temperature", "temperature", ["T", "T*T", "T**3"])
    yield _term("temperature and specific force", "temperature", _with_forces("T"))
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
