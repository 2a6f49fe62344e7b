"""What is known at any moment of a run, whatever is calibrated in it, and the targets of its sigmas."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats


@dataclass(frozen=True)
class Progress:
    """What is known of a run at a moment.

    samples: number of readings. elapsed_s: time of the last of them. dwells: number of closed dwells. judged_s,
    looked_s: times of the latest judgement, and of the latest look at the open dwell. problem: why there is no
    judgement. notice: the latest action, such as an effect that was accepted or refused. model: effects in the model.
    """

    samples: int = 0
    elapsed_s: float = 0.0
    dwells: int = 0
    judged_s: float = 0.0
    looked_s: float = 0.0
    problem: str = ""
    notice: str = ""
    model: Sequence[str] = ()


def targets(texts: Mapping[str, float]) -> Floats:
    """Targets (12,) of the sigmas in SI, from numbers by symbol; NaN where there is none."""
    return np.array([texts.get(symbol, np.nan) for symbol in paper_parameters.SYMBOLS])
