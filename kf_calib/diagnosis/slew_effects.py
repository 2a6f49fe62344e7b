"""Effects that show while the platform turns only: looked at where the model agrees with the run at rest.

They change no reading at rest, so that the twelve parameters are what they are; one more pass over the readings folds
the slews, and all such effects are fitted to them together.
"""

from __future__ import annotations

import numpy as np

from kf_calib.bench.arrays import ROUNDING, Floats, portions
from kf_calib.diagnosis.hypothesis_table import NOTHING, Hypothesis, HypothesisTable, table_of
from kf_calib.diagnosis.refits import Refits
from kf_calib.effects import effect_named, slew_effects
from kf_calib.errors import InputError, UnobservableError
from kf_calib.estimation import square_root_information
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.results import Calibration
from kf_calib.support.tail_probabilities import CLEAR, f_tail, log_odds_of, sidak

_GROUPS = 40  # of slews that are left out in turn
_FEWEST = 100  # readings of slews


def of_slews(refits: Refits, before: Calibration) -> tuple[HypothesisTable, float] | None:
    """The table that names the effects which show in the slews of a run, and the p-value of noise alone; None where
    none does, or where no slews can be read."""
    known = {str(effect) for effect in before.model.effects}
    names = [name for name in slew_effects(before.bench) if name not in known]
    if refits.source is None or not before.bench.angles or before.counts.moving < _FEWEST or not names:
        return None
    try:
        together = refits.with_effects(before, names)
    except (UnobservableError, InputError):
        return None
    if not together.linearised.slews:
        return None
    jackknife = _Jackknife(together.fit)
    p_values = {name: sidak(jackknife.p_value(name), len(names)) for name in names}
    missing = tuple(sorted((name for name in names if p_values[name] < CLEAR), key=lambda name: p_values[name]))
    if not missing:
        return None
    after, p_value = refits.of(together, (*before.settings.effects, *missing)), p_values[missing[0]]
    families = tuple(dict.fromkeys(effect_named(name, before.bench).family for name in missing))
    dof = sum(len(effect_named(name, before.bench).coefficients) for name in missing)
    row = Hypothesis(missing, families=families, dof=dof, refit=after)
    return table_of([row, Hypothesis(families=(NOTHING,), log_evidence=-log_odds_of(p_value))]), p_value


class _Jackknife:
    """A fit with its slews, and the same without each of g groups of them in turn, its states in similar units.

    The covariance that the rows tell holds if noise were white. In motion it is not, and angles are less true; but
    slews are independent of each other, so that the changes d_s without the slews s show the noise as it is.
    """

    def __init__(self, fit: Fit) -> None:
        slews = [rows for rows in fit.following if len(rows)]
        groups = [np.concatenate(slews[part]) for part in portions(len(slews), -(-len(slews) // _GROUPS) or 1)]
        self._count, self._parts = len(groups), fit.linearised.model.parts
        factor = square_root_information.accumulate(fit.all_rows(), fit.steps)[:-1]
        scale = np.append(square_root_information.scale_columns(factor)[1], 1.0)
        whole, left_out = _squared(factor / scale), np.array([_squared(rows / scale) for rows in groups])
        self._information, self._left_out = whole[:-1, :-1], left_out[..., :-1, :-1]
        self._covariance = np.linalg.pinv(self._information, hermitian=True)
        # what no other slew determines is 0 without it, and so changes by all that it is
        self._without = np.linalg.pinv(self._information - self._left_out, rcond=ROUNDING, hermitian=True)
        self._state = self._covariance @ whole[:-1, -1]
        along = whole[:-1, -1] - left_out[..., :-1, -1]
        self._changes = self._state - np.einsum("spq,sq->sp", self._without, along)

    def p_value(self, name: str) -> float:
        """The p-value of the k coefficients x of an effect, of covariance C in white noise.

          F = (x' C^-1 x / k) / phi,  phi = (g - 1) / g  sum_s d_s' C^-1 d_s / k

        The degrees of freedom of phi are (tr G)^2 / tr G^2, G the covariance of all d_s in white noise (R. Bell, D.
        McCaffrey, 2002): what rests on one slew has hardly more than k.
        """
        part = self._parts[name]
        values, vectors = np.linalg.eigh(self._covariance[part, part])
        seen = values > ROUNDING * values.max(initial=0.0)  # combinations that slews do not determine have none
        if self._count < 2 or not seen.any():
            return 1.0
        root = vectors[:, seen].T / np.sqrt(values[seen, None])
        ratio = np.sum((root @ self._state[part]) ** 2) / np.sum((self._changes[:, part] @ root.T) ** 2)
        spread = self._covariance_of_changes(root, part)
        freedom = float(np.trace(spread) ** 2 / np.sum(spread**2))
        return f_tail(len(root), freedom, float(ratio) * self._count / (self._count - 1.0))

    def _covariance_of_changes(self, root: Floats, part: slice) -> Floats:
        """Return the covariance G (g k, g k) of the changes L^-1 d_s of a part of the state, ``root`` is L^-1.

        cov(d_s, d_t) = P_s (S - S_s - S_t) P_t - P,  and P_s - P for s = t,  P = S^-1,  P_s = (S - S_s)^-1
        """
        seen = np.asarray(root @ self._without[:, part], np.float64)  # (g, k, p)
        of_groups = seen @ self._left_out
        spread = np.einsum("sip,tjp->sitj", seen @ self._information - of_groups, seen)
        spread -= np.einsum("sip,tjp->sitj", seen, of_groups)
        numbers = np.arange(self._count)
        spread[numbers, :, numbers] += of_groups @ np.swapaxes(seen, 1, 2)
        return (spread - np.eye(len(root))[:, None, :]).reshape(self._count * len(root), -1)


def _squared(rows: Floats) -> Floats:
    """Return R' R of rows."""
    return rows.T @ rows
