"""What depends on where the block was before: the last step of the specific force along an input axis."""

from __future__ import annotations

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.sources.simulation.injected.kinds import Rig, made
from kf_calib.sources.simulation.injected.terms import adding, column, sign
from kf_calib.sources.simulation.physics import State, Step


class LastStep:
    """The change of a_i from the end of the dwell before to the beginning of this one: (n, 3) or (1, 3).

    On the way to the next dwell it is what has changed so far. In the first dwell it is zero: what was before is not
    known.
    """

    def __init__(self) -> None:
        self._dwell = -1
        self._step = np.zeros((1, 3))
        self._end: Floats | None = None

    def __call__(self, state: State) -> Floats:
        inputs = state.input_mps2
        if state.moving and self._end is not None:
            return inputs - self._end
        if state.dwell != self._dwell:
            self._dwell, before = state.dwell, inputs[:1] if self._end is None else self._end
            self._step = inputs[:1] - before
        self._end = inputs[-1:]
        return self._step


@made("settling", "1", ("1ug/g", "30ug/g"), ("0.1mg/g", "3mg/g"))
def settling(c: Floats, rig: Rig, *, tau: float = 60.0) -> Step:
    """Settling: C Delta a_i exp(-time since arrival / tau), creep of the suspension after the last step Delta a_i;
    on the way to the next dwell C times the change so far (IEEE Std 1293, settling time; anelastic relaxation)."""
    last = LastStep()

    def contribution(state: State) -> Floats:
        rested = np.zeros(1) if state.moving else state.since_arrival_s
        return c * last(state) * column(np.exp(-rested / tau))

    return adding(contribution)


@made("hysteresis", "m/s^2", ("1ug", "20ug"), ("0.1mg", "2mg"))
def hysteresis(h: Floats, rig: Rig, *, threshold: float = 1e-3) -> Step:
    """Hysteresis: h sgn Delta a_i, the last step; none for steps below the threshold (IEEE Std 1293, hysteresis)."""
    last = LastStep()
    return adding(lambda state: h * sign(last(state), threshold))
