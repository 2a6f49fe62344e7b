"""A misfit that no known effect explains, described: which channel, driven by what, a formula to begin with."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from kf_calib.bench import Bench
from kf_calib.effects import effect_named
from kf_calib.fitting import Fit
from kf_calib.samples import Floats
from kf_calib.scan import scan

_PRICE = 6.63  # of a coefficient, in chi-squared
_DECAYS_S = (10, 30, 100, 300)


@dataclass(frozen=True)
class Description:
    """channel: x, y, z or all; driver: in words; share: of the misfit it explains; formula: to add as it stands."""

    channel: str
    driver: str
    share: float
    formula: str


def described(fitted: Fit, residuals: Floats) -> Description | None:
    """The family of formulas that explains most of what the model leaves for the number of its coefficients."""
    bench = fitted.carried.model.bench
    families = list(_families(bench, fitted.dwells[-1].end_s))
    effects = [effect_named(f"mine = {text}", bench) for _, texts in families for text in texts]
    found = scan(fitted.carried, fitted.noise.judging, effects, fitted.walk_variances)
    best, best_score, place = None, 0.0, 0
    for driver, texts in families:
        own = range(place, place + len(texts))
        place += len(texts)
        basis = np.concatenate([found.candidates[k].basis for k in own], axis=1)
        left, singular, _ = np.linalg.svd(basis, full_matrices=False)
        left = left[:, singular > 1e-6]
        fall = float(np.sum((left.T @ found.residual) ** 2))
        if fall - _PRICE * left.shape[1] > best_score:
            best_score = fall - _PRICE * left.shape[1]
            strongest = texts[int(np.argmax(found.statistics[list(own)]))]
            share = fall / max(float(found.residual @ found.residual), 1e-300)
            best = Description(_channel(residuals), driver, share, f"mine = {strongest}")
    return best


def _channel(residuals: Floats) -> str:
    """The accelerometer with most of the squared residuals (D, 3) of the dwells; all, where none stands out."""
    squares = np.sum(residuals**2, axis=0)
    return "xyz"[int(np.argmax(squares))] if squares.max() > 0.7 * squares.sum() else "all"


def _families(bench: Bench, duration_s: float) -> Iterator[tuple[str, list[str]]]:
    """What may drive a misfit, in words, and formulas of it."""
    yield "specific force, degree 2", ["a*a", "a*p", "a*o", "p*o", "p*p"]
    yield "specific force, degree 3", ["a**3", "a*a*p", "a*a*o", "a*p*o", "p**3", "o**3"]
    yield "specific force, degree 4", ["a**4", "p**4", "a**2*p**2"]
    yield "specific force, degree 5", ["a**5", "p**5"]
    for k in range(len(bench.axes)):
        for n in (1, 2, 3, 4, 6):
            yield f"angle of gimbal {k + 1}, {n} a turn", [f"sin({n}*q{k + 1})", f"cos({n}*q{k + 1})"]
        for n in (3, 4):
            turned = [f"{wave}({n}*q{k + 1})*{axis}" for wave in ("sin", "cos") for axis in ("p", "o")]
            yield f"angle of gimbal {k + 1}, {n} a turn", turned
    yield "time", ["t", "t*t"]
    for share in np.linspace(0.05, 0.95, 19):
        yield "time (a jump)", [f"t > {share * duration_s:.0f}*s"]
    for decay_s in _DECAYS_S:
        yield "time (a decay)", [f"exp(-t/({10 * decay_s}*s))"]
        yield "time since arrival", [f"exp(-tau/({decay_s}*s))"]
        yield "time since arrival", [f"{axis}*exp(-tau/({decay_s}*s))" for axis in ("fx", "fy", "fz")]
    yield "temperature", ["T", "T*T", "T**3"]
    yield "temperature", ["a*T", "a*T*T"]
    yield "temperature", ["p*T", "o*T"]
    yield "rate of temperature", ["dT"]
    yield "previous orientation", ["da", "da*abs(da)"]
    yield "previous orientation", ["sign(da)"]
