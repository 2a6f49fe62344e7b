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
    p_values = {name: _p_value(together.fit, name, len(names)) for name in names}
    missing = tuple(sorted((name for name in names if p_values[name] < CLEAR), key=lambda name: p_values[name]))
    if not missing:
        return None
    after, p_value = refits.of(together, (*before.settings.effects, *missing)), p_values[missing[0]]
    families = tuple(dict.fromkeys(effect_named(name, before.bench).family for name in missing))
    dof = sum(len(effect_named(name, before.bench).coefficients) for name in missing)
    row = Hypothesis(missing, families=families, dof=dof, refit=after)
    return table_of([row, Hypothesis(families=(NOTHING,), log_evidence=-log_odds_of(p_value))]), p_value


def _p_value(fit: Fit, name: str, effects: int) -> float:
    """Return the p-value of an effect, of so many that are tried, by how its k coefficients x scatter between slews.

      F = (x' C^-1 x / k) / phi,  phi = (g - 1) / g  sum_s d_s' C^-1 d_s / k,  d_s = x - x without the slews s

    C is the covariance of x if noise were white. In motion it is not, and angles are less true; but slews are
    independent, so that leaving out each of g groups of them in turn (the jackknife) shows the noise as it is. The
    degrees of freedom of phi are (tr G)^2 / tr G^2, G the covariance of all d_s in white noise (R. Bell, D. McCaffrey,
    2002): what rests on one slew has hardly more than k.
    """
    slews = [rows for rows in fit.following if len(rows)]
    if len(slews) < 2:
        return 1.0
    groups = [np.concatenate(slews[part]) for part in portions(len(slews), -(-len(slews) // _GROUPS))]
    part = fit.linearised.model.parts[name]
    factor = square_root_information.accumulate(fit.all_rows(), fit.steps)[:-1]
    size = np.linalg.norm(factor[:, :-1], axis=0)
    scale = 1.0 / np.append(np.where(size > 0.0, size, 1.0), 1.0)
    whole, grouped = _squared(factor * scale), np.array([_squared(rows * scale) for rows in groups])
    covariance = np.linalg.pinv(whole[:-1, :-1], hermitian=True)
    # what no other slew determines is 0 without it, and so off by all that it is
    without = np.linalg.pinv(whole[:-1, :-1] - grouped[:, :-1, :-1], rcond=ROUNDING, hermitian=True)
    state = covariance @ whole[:-1, -1]
    off = state - np.einsum("spq,sq->sp", without, whole[:-1, -1] - grouped[:, :-1, -1])
    whitened = np.linalg.inv(np.linalg.cholesky(covariance[part, part]))
    ratio = float(np.sum((whitened @ state[part]) ** 2) / np.sum((off[:, part] @ whitened.T) ** 2))
    seen = np.asarray(whitened @ without[:, part], np.float64)
    spread = _covariance_of_changes(whole[:-1, :-1], grouped[:, :-1, :-1], seen)
    freedom = float(np.trace(spread) ** 2 / np.sum(spread**2))
    return sidak(f_tail(len(whitened), freedom, ratio * len(groups) / (len(groups) - 1.0)), effects)


def _covariance_of_changes(whole: Floats, grouped: Floats, seen: Floats) -> Floats:
    """Return the covariance G (g k, g k) of the changes L^-1 d_s in white noise; ``seen`` (g, k, p) is L^-1 P_s.

    cov(d_s, d_t) = P_s (S - S_s - S_t) P_t - P,  and P_s - P for s = t,  P = S^-1 = L L',  P_s = (S - S_s)^-1
    """
    groups, count = seen.shape[:2]
    of_groups = seen @ grouped
    spread = np.einsum("sip,tjp->sitj", seen @ whole - of_groups, seen) - np.einsum("sip,tjp->sitj", seen, of_groups)
    each = np.arange(groups)
    spread[each, :, each] += of_groups @ np.swapaxes(seen, 1, 2)
    return (spread - np.eye(count)[:, None, :]).reshape(groups * count, groups * count)


def _squared(rows: Floats) -> Floats:
    """Return R' R of rows."""
    return rows.T @ rows
