"""Two evaluations side by side: of two recordings, or of one recording with two models."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kf_calib.bench.arrays import Mask
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.estimation.results import Calibration, Parameter
from kf_calib.support.tail_probabilities import chi_squared_tail


@dataclass(frozen=True)
class Difference:
    """A parameter in two evaluations, the second less the first.

    sigma: one standard deviation of the difference; None, as for the parameters, where one of them is not determined.
    Of two recordings it is the root of the sum of squares, since their noise is independent. Of two models of one
    recording it is the larger of both sigmas: the same readings are in both, and the difference says how much the model
    matters.
    """

    first: Parameter
    second: Parameter
    sigma: float | None

    @property
    def symbol(self) -> str:
        return self.first.symbol

    @property
    def value(self) -> float | None:
        """The second less the first, in SI units; None where one of them is not determined."""
        if self.first.value is None or self.second.value is None:
            return None
        return self.second.value - self.first.value

    @property
    def sigmas(self) -> float | None:
        """The difference over its sigma."""
        return None if self.value is None or not self.sigma else self.value / self.sigma


def differences(first: Calibration, second: Calibration, same_recording: bool) -> tuple[Difference, ...]:
    """The differences of the parameters that both models have: of the twelve, then of coefficients of effects."""
    rows, others = list[Difference](), second.parameters
    for name, parameter in first.parameters.items():
        if name in others:
            sigmas = parameter.sigma, others[name].sigma
            determined = [sigma for sigma in sigmas if sigma is not None]
            sigma_of_both = max(determined, default=0.0) if same_recording else float(np.hypot.reduce(determined))
            rows.append(Difference(parameter, others[name], sigma_of_both if len(determined) == len(sigmas) else None))
    return tuple(rows)


@dataclass(frozen=True)
class SideBySide:
    """Two diagnoses, and whether they are of one recording, evaluated with two models."""

    first: Diagnosis
    second: Diagnosis
    same_recording: bool

    @cached_property
    def differences(self) -> tuple[Difference, ...]:
        """The differences of the parameters, the second's less the first's."""
        return differences(self.first.before, self.second.before, self.same_recording)

    @cached_property
    def p_value(self) -> float | None:
        """The chance that noise alone lets the twelve parameters of two recordings differ as much.

        d^T (P1 + P2)^-1 d of the parameters that both determine is chi-squared distributed. None for one recording.
        """
        if self.same_recording:
            return None
        one, other = self.first.before.estimate, self.second.before.estimate
        determined: Mask = ~(one.unseen | other.unseen)
        if not determined.any():
            return None
        differ = (other.parameters - one.parameters)[determined]
        spread = (one.parameter_covariance + other.parameter_covariance)[np.ix_(determined, determined)]
        return chi_squared_tail(len(differ), float(differ @ np.linalg.solve(spread, differ)))

    @property
    def farthest(self) -> Difference | None:
        """The difference that is largest in its sigma."""
        return max((each for each in self.differences if each.sigmas is not None),
                   key=lambda each: abs(each.sigmas or 0.0), default=None)  # fmt: skip
