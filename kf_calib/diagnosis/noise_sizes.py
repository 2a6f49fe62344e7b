"""The noise from dwell to dwell of unknown size beside which all explanations are weighed: none beyond what was stated,
scatter, setting errors, and both.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.in_noises import InNoises
from kf_calib.diagnosis.run_likelihood import RunLikelihood, integrated, of_unit_size
from kf_calib.noise.noise_model import Noise
from kf_calib.noise.reml import OF_ONE, Parts

_STATED, _UNSTATED = 0.02, 0.5  # prior probability of noise beyond what was stated, and where nothing was stated
_OF_ONE = 0.1  # share of one accelerometer alone in scatter, and of one gimbal alone in setting errors
INDEPENDENT = 0.5
"""Share of the values that are independent, where dwells differ by more than was stated, or by what no function has."""

_HOPELESS = 30.0  # in log likelihood
_FEWEST = 4  # sizes of noise over which is integrated
_RANGE = math.log(1e4)  # width of the flat prior of the logarithm of a size of noise


@dataclass(frozen=True)
class NoiseFamily:
    """Noise of which some parts are free.

    parts: "setting" and "common" (scatter). shapes: covariances (D, 3, 3) per unit of the squared size, in units of the
    noise that was stated. log_prior: log of its prior probability.
    """

    parts: Parts
    shapes: Floats
    log_prior: float


class NoiseSizes:
    """All noises in which a run is weighed.

    noise: what was stated. spare: degrees of freedom that the model leaves of the dwells' means. turns: the change
    (D, 3) of the means by a turn of each gimbal, by its name.
    """

    def __init__(self, likelihood: RunLikelihood, noise: Noise, spare: int, turns: Mapping[str, Floats]) -> None:
        self._likelihood, self._noise, self._spare, self.turns = likelihood, noise, spare, turns
        self._sizes = likelihood.sizes_of_noise()

    @cached_property
    def families(self) -> list[NoiseFamily]:
        """The families, that with no free part first."""
        families = [NoiseFamily((), np.zeros((self._likelihood.rows // 3, 3, 3)), self._log_prior(()))]
        if self._spare <= 0:
            return families
        common = self._likelihood.shapes_of("common")
        families.append(NoiseFamily(("common",), common, self._log_prior(("common",))))
        if self._noise.attitude_unknown:  # a rotation of the dwells has no limit anyway
            return families
        setting = self._likelihood.shapes_of("setting")
        families.append(NoiseFamily(("setting",), setting, self._log_prior(("setting",))))
        if not (self._noise.setting.stated and self._noise.scatter.stated):
            both = ("setting", "common")
            families.append(NoiseFamily(both, setting + common, self._log_prior(both)))
        return families

    @cached_property
    def of_one(self) -> list[tuple[str, NoiseFamily, float]]:
        """Scatter of one accelerometer alone, and setting errors of one gimbal alone, by name, with their log evidence
        without any term. They stand against all effects: beside one they would hide what else is missing, which often
        shows in one accelerometer, or goes with one gimbal."""
        if len(self.families) < 2 or self._noise.attitude_unknown:
            return []
        run, (common, setting) = self._likelihood, self.families[1:3]
        alone = [(f"accelerometer {k}", common, run.shapes_of(part)) for k, part in enumerate(OF_ONE, start=1)]
        alone += [(name, setting, of_unit_size(turn[:, :, None] * turn[:, None])) for name, turn in self.turns.items()]
        evidence = list[tuple[str, NoiseFamily, float]]()
        for name, of_all, shapes in alone:
            alike = sum(other is of_all for _, other, _ in alone)
            family = NoiseFamily(of_all.parts, shapes, of_all.log_prior + math.log(_OF_ONE / alike))
            logs = run.in_noises(shapes, self.squares).logs[None]
            evidence.append((name, family, float(self._over_sizes(logs)[0]) + family.log_prior))
        return evidence

    @property
    def squares(self) -> Floats:
        """The squares (k,) of all sizes of noise."""
        return np.asarray(self._sizes**2, float)

    @cached_property
    def covariances(self) -> list[Floats | None]:
        """Covariances (D, 3, 3) of all noises; None for none beyond what was stated."""
        return [None, *(square * family.shapes for family in self.families[1:] for square in self.squares.tolist())]

    def in_families(self, products: Callable[[Floats, Floats], InNoises]) -> list[InNoises]:
        """Products in all noises of each family, made from the shapes of a family and the squares of its sizes."""
        none, *others = self.families
        return [products(none.shapes, np.zeros(1)), *(products(family.shapes, self.squares) for family in others)]

    def likely(self, logs: Floats, most: Floats) -> list[list[int]]:
        """Numbers of the noises of each family that are not much larger than the likeliest by log likelihoods
        (noises,), nor so small that even these with the most (noises,) that a term gains are hopeless."""
        count, numbers, best = len(self._sizes), [[0]], float((logs + most).max())
        for first in range(1, len(logs), count):
            end = max(int(np.argmax(logs[first : first + count])) + 2, _FEWEST)
            hopeful = np.flatnonzero((logs + most)[first : first + count] > best - _HOPELESS)
            begin = min(max(int(hopeful[0]) - 1, 0) if hopeful.size else count, min(end, count) - _FEWEST)
            numbers.append([*range(first + begin, first + min(end, count))])
        return numbers

    def evidence(self, logs: Floats, numbers: Sequence[Sequence[int]] | None = None) -> Floats:
        """Log evidence (n, families) from log likelihoods (n, noises), with the priors of the noise.

        numbers: those of each family that count (``likely``); None: all.
        """
        count = len(self._sizes)
        numbers = numbers or [[0], *([*range(first, first + count)] for first in range(1, logs.shape[1], count))]
        families = enumerate(numbers[1:], start=1)
        parts = [logs[:, 0], *(self._beside_causes(k, self._over_sizes(logs[:, some])) for k, some in families)]
        return np.stack(parts, axis=1) + [family.log_prior for family in self.families]

    def _over_sizes(self, logs: Floats) -> Floats:
        """Return the log mean (n,) of likelihoods over the sizes of a family."""
        return integrated(logs, self._likelihood.step) - math.log(_RANGE)

    def _beside_causes(self, number: int, logs: Floats) -> Floats:
        """Return log evidence (n,) beside what a family has beyond stated noise.

        That is no noise, but causes that nobody knows. Orientations that are like each other share them, so that they
        are fewer independent values than dwells, and what is gained beside them counts by this share: the likelihood
        has a power below 1 (Miller and Dunson, Robust Bayesian inference via coarsening, 2019).
        """
        family = self.families[number]
        if not any(self._stated[part] for part in family.parts):
            return logs
        gains = logs - self._without[number - 1]
        return np.where(gains > 0.0, logs - (1.0 - INDEPENDENT) * gains, logs)

    @cached_property
    def _without(self) -> list[float]:
        """Log evidence of the families but the first without any term."""
        noises = self.in_families(self._likelihood.in_noises)[1:]
        return [float(self._over_sizes(of_family.logs[None])[0]) for of_family in noises]

    @property
    def _stated(self) -> dict[str, bool]:
        """Whether the noise from dwell to dwell was stated, by its parts."""
        return {"setting": self._noise.setting.stated, "common": self._noise.scatter.stated}

    def _log_prior(self, parts: Parts) -> float:
        """Return the log of the prior probability that these parts of the noise are free, and no others."""
        priors = {part: _STATED if is_stated else _UNSTATED for part, is_stated in self._stated.items()}
        return sum(math.log(prior if part in parts else 1.0 - prior) for part, prior in priors.items())
