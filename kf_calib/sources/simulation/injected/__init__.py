"""Hidden physical effects of the simulated bench: part of the truth, in the readings and in no recording's metadata.

    hidden = parse(["second-order=4e-5", "encoder-harmonic-2:z=2e-5", "warm-up=1e-4;tau=600"], axes)
    Simulation(bench, sensors, noise, plan, hidden=hidden)

Conventions, the same for every effect:

* SI throughout: contributions and accelerations in m/s^2, time in s since the first sample, temperature in K from the
  ``reference`` (25 degC unless told otherwise), angles in rad, magnetic flux density in T. A coefficient is what
  multiplies these: the K2 of ``second-order`` is in 1/(m/s^2), and K2 a_i^2 adds to the reading in m/s^2. A unit
  may be written after a number, ``second-order=4ug/g^2``, and is converted (``support.units.si``); g is 9.80665 m/s^2.
* a_i is the true specific force along the true input axis of accelerometer i, E_i . f; a_p and a_o are its parts along
  the platform axes of the nominal triads, (x, y, z), (y, z, x), (z, x, y). Contributions add to the reading as they
  are, not multiplied by the scale factor.
* One number is the size of every coefficient of the effect, with signs drawn from the seed where signs matter; as many
  numbers as coefficients are taken as they stand. A gimbal axis stands after a colon (its letter, its number from the
  outer one, ``outer`` or ``inner``); without one the effect is on every axis. Other constants follow after semicolons.
* A size may be given in sigma, ``second-order=10sigma``: n times what the noise of the run leaves uncertain, after what
  the twelve parameters absorb (``detectability``); ``parse`` then needs ``sized``, which knows the run.
* Size zero: the effect is absent, and the samples are bit for bit those of a run without it.

``gimbal`` (with surroundings), ``sensor`` (with temperature, time and history) and ``electronics`` hold the effects of
the catalogue, ``outside`` those that no catalogue knows. Nothing here is shared with an estimator.
"""

from __future__ import annotations

# Effects are registered when their module is imported; their steps stand in the chain in this order.
# isort: off
from kf_calib.sources.simulation.injected import gimbal, sensor, outside, electronics  # noqa: F401

# isort: on
from kf_calib.sources.simulation.injected.kinds import (
    INNER,
    EffectKind,
    Hidden,
    NoSizeError,
    Rig,
    Stage,
    catalogue,
    steps_of,
)
from kf_calib.sources.simulation.injected.text import parse
from kf_calib.support.units import si

__all__ = [
    "INNER", "EffectKind", "Hidden", "NoSizeError", "Rig", "Stage", "catalogue", "parse", "si", "steps_of",
]  # fmt: skip
