"""An effect whose coefficients are known from elsewhere, as those of a bench are from many runs on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.effects import Effect


@dataclass(frozen=True)
class KnownEffect:
    """An effect with its coefficients (q,) and their covariance (q, q), SI. It is subtracted from the readings, and
    that the coefficients are uncertain enlarges the covariance of what is estimated (Schmidt)."""

    effect: Effect
    coefficients: Floats
    covariance: Floats

    @property
    def sentence(self) -> str:
        """What has been done with it, in words without a full stop."""
        return f"{self.effect} of the bench is taken from the bench model: subtracted, and its sigma considered"

    @property
    def root(self) -> Floats:
        """A root (q, q) of the covariance: changes of the coefficients by one sigma in independent directions."""
        values, vectors = np.linalg.eigh(self.covariance)
        return vectors * np.sqrt(np.maximum(values, 0.0))
