"""The predictions that a run allows about an effect before it is fitted: visibility, smallest detectable size and
look-alikes.

They depend only on the columns, not on the misfit: the effect and the catalogue are projected off the model
(``score_test``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from kf_calib.bench.arrays import Floats, one_blas_thread
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.effects import Coefficient, Effect, effect_named, names
from kf_calib.estimation.candidate_scan import Candidate, Scan
from kf_calib.estimation.dwell_columns import LinearisedDwells
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.score_test import scan
from kf_calib.support.tail_probabilities import LEVEL
from kf_calib.support.units import shown

POWER = 0.9
"""Share of runs in which an effect of the smallest detectable size is found."""

_IMPOSSIBLE = 1e3  # times a coefficient that a user would call large
_CONFUSED, _TWINS, _NAMED = 0.5, 0.99, 3  # overlap worth naming, overlap of look-alikes, number of effects named


@dataclass(frozen=True)
class Visibility:
    """The visibility of one effect in these orientations, beside a model.

    - share: largest share of one of its columns that the model leaves (0: invisible); None if it has no column in
      dwells, for the reason in ``why``.
    - unseen: symbols of coefficients that are not determined.
    - smallest: the coefficient that is hardest to detect, and its smallest detectable size in SI.
    - rivals: name and overlap of the effects that overlap most with it.
    - degeneracy: exact degeneracies, in words.
    """

    effect: Effect
    share: float | None
    unseen: tuple[str, ...] = ()
    smallest: tuple[Coefficient, float] | None = None
    rivals: tuple[tuple[str, float], ...] = ()
    degeneracy: str = ""
    why: str = ""

    @property
    def visible(self) -> bool | None:
        """Whether anything of it is left beside the model; None if it has no column in dwells."""
        return None if self.share is None else self.share > 0.0

    def __str__(self) -> str:
        """The visibility in one sentence."""
        if self.share is None:
            return f"{self.effect}: {self.why}"
        seen = f"visible: {_in_per_cent(self.share)} of it cannot be imitated by the other parameters"
        parts = [seen if self.visible else "invisible in this run: it adds nothing, or what the other parameters add"]
        if self.unseen and self.visible:
            parts.append(f"not determined: {' '.join(self.unseen)}")
        if self.smallest is not None:
            own, size = self.smallest
            parts.append(f"smallest size {shown(own).text(size)}{self.at}")
        for words, twins in (("cannot be told from", True), ("overlaps with", False)):
            named = [f"{name} ({overlap:.2f})" for name, overlap in self.rivals if (overlap > _TWINS) == twins]
            parts += [f"{words} {', '.join(named)}"] if named else []
        return "; ".join([f"{self.effect}: {parts[0]}", *parts[1:], *([self.degeneracy] if self.degeneracy else [])])

    @property
    def at_value(self) -> float | None:
        """Value of the effect's unknown constant (SI); None if it has none."""
        return None if self.effect.unknown is None else self.effect.value

    @property
    def at(self) -> str:
        """The value of the unknown constant in words, to follow a coefficient."""
        unknown = self.effect.unknown
        if unknown is None:
            return ""
        return f" with {unknown.symbol} at {shown(unknown).text(self.effect.value)}"


def _in_per_cent(share: float) -> str:
    """Return a share in per cent, to two digits where it is small."""
    return f"{100.0 * share:.2g} %" if share < 0.1 else f"{100.0 * share:.0f} %"


def visibility_of(fitted: Fit, effects: Sequence[Effect]) -> list[Visibility]:
    """The visibility of each effect beside the model without it; an unknown constant is at the value at which the
    effect shows best."""
    with one_blas_thread():
        model = fitted.linearised.model
        inside = [each for each in effects if str(each) in model.parts]
        seen = {str(each): _beside(fitted, model - each, [each])[0] for each in inside}
        outside = [each for each in effects if str(each) not in seen]
        seen |= {str(each.effect): each for each in (_beside(fitted, model, outside) if outside else [])}
        return [seen[str(each)] for each in effects]


def _beside(fitted: Fit, model: Model, effects: Sequence[Effect]) -> list[Visibility]:
    """Return the visibility of effects that are not in ``model``, with their overlaps with each other and with the
    catalogue."""
    bench, named = model.bench, {str(each) for each in effects}
    others = [effect_named(name, bench) for name in names(bench) if name not in named | set(model.parts)]
    tried = [at for each in (*effects, *others) if not each.no_columns for at in _values(each)]
    state = np.concatenate([fitted.linearised.state[:STATE_COUNT], np.zeros(model.count - STATE_COUNT)])
    linearised = LinearisedDwells(fitted.dwells, model, state)
    found = scan(linearised, fitted.noise.for_goodness_of_fit, tried)
    return [replace(_sight(found, each), degeneracy=each.degeneracy(bench)) for each in effects]


def _values(effect: Effect) -> list[Effect]:
    """Return the effect at each value of a coarse grid of its unknown constant, or alone if it has none."""
    return [effect] if effect.unknown is None else [effect.at(value) for value in effect.unknown.grid(2.0)]


def _sight(scan: Scan, effect: Effect) -> Visibility:
    """Return the visibility of one effect from the scan of all."""
    if effect.no_columns:
        return Visibility(effect, None, why=effect.no_columns)
    of_effect = [each for each in scan.candidates if str(each.effect) == str(effect)]
    tests = len({str(each.effect) for each in scan.candidates if each.dof})
    chance = 0.5 * LEVEL / max(tests, 1)  # half: the misfit as a whole is tested beside
    sized = [(smallest_size(each, chance), each) for each in of_effect]
    size, best = min(sized, key=lambda pair: np.inf if pair[0] is None else pair[0][1])
    if not is_seen(best, chance):
        return Visibility(best.effect, 0.0)
    overlaps = dict[str, float]()
    for other in scan.candidates:
        name = str(other.effect)
        if name != str(effect):
            overlaps[name] = max(overlaps.get(name, 0.0), best.overlap(other))
    confused = sorted((pair for pair in overlaps.items() if pair[1] > _CONFUSED), key=lambda pair: -pair[1])[:_NAMED]
    lost = (best.hidden | np.isinf(_found_from(best, chance))).tolist()
    unseen = [each.symbol for each, is_lost in zip(best.effect.coefficients, lost, strict=True) if is_lost]
    return Visibility(best.effect, min(best.visibility, 1.0), tuple(unseen), size, tuple(confused))


def smallest_size(candidate: Candidate, chance: float) -> tuple[Coefficient, float] | None:
    """The coefficient that is hardest to detect, and the size (SI) that is found in 9 of 10 runs; None if none is
    determined.

    An effect is found where it lowers chi-squared by more than c, P(chi2(k) > c) = ``chance``, k its degrees of
    freedom. A coefficient of size a, whose column g is in units of the noise, lowers it by a noncentral chi-squared;
    so a = sqrt(l) / |g|, l being the noncentrality with P(chi2(k, l) > c) = 0.9.
    """
    sizes = np.where(candidate.hidden, np.inf, _found_from(candidate, chance))
    if np.isinf(sizes).all():
        return None
    worst = int(np.argmax(np.where(np.isfinite(sizes), sizes, 0.0)))
    return candidate.effect.coefficients[worst], float(sizes[worst])


def impossible_size(effect: Effect) -> float:
    """The size from which on none of an effect's coefficients could be: it would add about 1 g to a reading."""
    return _IMPOSSIBLE * max(each.scale for each in effect.coefficients)


def is_seen(candidate: Candidate, chance: float) -> bool:
    """Whether a sensor could have so much of an effect that it is found."""
    return bool(np.isfinite(_found_from(candidate, chance)).any())


def _found_from(candidate: Candidate, chance: float) -> Floats:
    """Return the sizes (q,) from which on coefficients alone are found; infinite where none could be so large."""
    from scipy.special import chdtri, chndtrinc

    sizes: Floats = np.linalg.norm(candidate.columns, axis=0)
    if not candidate.dof:
        return np.full(len(sizes), np.inf)
    threshold = float(chdtri(candidate.dof, chance))
    needed = float(np.sqrt(chndtrinc(threshold, candidate.dof, 1.0 - POWER)))
    found = needed / np.maximum(sizes, 1e-300)
    return np.where(found > _IMPOSSIBLE * candidate.scales, np.inf, found)
