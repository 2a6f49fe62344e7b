"""Effects that show while the platform turns only: looked at where the model agrees with the run at rest.

They change no reading at rest, so that the twelve parameters are what they are; one more pass over the readings folds
the slews, and all such effects are fitted to them together.
"""

from __future__ import annotations

import math

from kf_calib.diagnosis.hypothesis_table import NOTHING, Hypothesis, HypothesisTable, table_of
from kf_calib.diagnosis.refits import Refits
from kf_calib.effects import effect_named, slew_effects
from kf_calib.errors import InputError, UnobservableError
from kf_calib.estimation.results import Calibration
from kf_calib.support.tail_probabilities import CLEAR, log_odds_of, sidak

_CORRELATED = 4.0  # by so much sigmas may be too small: noise while the platform turns is neither white nor modelled
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
    p_values = {name: _p_value(together, name, len(names)) for name in names}
    missing = tuple(sorted((name for name in names if p_values[name] < CLEAR), key=lambda name: p_values[name]))
    if not missing:
        return None
    after, p_value = refits.of(together, (*before.settings.effects, *missing)), p_values[missing[0]]
    families = tuple(dict.fromkeys(effect_named(name, before.bench).family for name in missing))
    dof = sum(len(effect_named(name, before.bench).coefficients) for name in missing)
    row = Hypothesis(missing, families=families, dof=dof, refit=after)
    return table_of([row, Hypothesis(families=(NOTHING,), log_evidence=-log_odds_of(p_value))]), p_value


def _p_value(result: Calibration, name: str, effects: int) -> float:
    """Return the p-value of the clearest coefficient of an effect, of those of all effects, in correlated noise."""
    symbols = [each.symbol for each in effect_named(name, result.bench).coefficients]
    known = [result.parameters[symbol] for symbol in symbols]
    ratios = [abs(own.value) / own.sigma for own in known if own.value is not None and own.sigma]
    return sidak(math.erfc(max(ratios, default=0.0) / _CORRELATED / math.sqrt(2.0)), effects * len(symbols))
