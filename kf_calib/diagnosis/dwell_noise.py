"""The noise from dwell to dwell in a diagnosis: what was stated of it, and what is left of it beside an explanation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kf_calib.diagnosis.refits import Refits
from kf_calib.estimation.results import Calibration


def dwell_noise_is_stated(before: Calibration) -> bool:
    """Whether both scatter and setting error were stated rather than estimated."""
    return before.noise.scatter_stated and before.noise.setting_stated


def with_noise_as_stated(refits: Refits, before: Calibration, refit: Calibration) -> Calibration:
    """The run without the added effects, with the noise from dwell to dwell as it was estimated in their refit.

    Estimated without the effects, the noise would be too large, as it would contain what they explain.
    """
    noise, bench = refit.noise, before.bench
    if not noise.setting_stated:
        bench = replace(bench, angle_sigma_deg=float(np.degrees(noise.setting_rad)))
    if not noise.scatter_stated:
        bench = replace(bench, scatter_sigma_mps2=float(np.sqrt(np.mean(noise.scatter_mps2**2))))
    return refits.of(replace(before, bench=bench), before.settings.effects)
