"""One row of a table of orientations."""

from __future__ import annotations

from dataclasses import dataclass

from kf_calib.bench.arrays import Floats


@dataclass(frozen=True, slots=True)
class Orientation:
    """A dwell as a table has it: conditions and mean readings.

    - mean_mps2 (3,): mean readings of accelerometers 1, 2, 3.
    - pose (k,): gimbal angles, rad, or quaternion.
    - elapsed_s: time of its middle since the first row.
    - sigma_mps2 (3,): standard deviation of the readings about their mean; None where it is not known.
    - count: number of readings behind the mean; 1 where the standard deviation is not known.
    - temperature_c: NaN where it was not measured.
    """

    mean_mps2: Floats
    pose: Floats
    elapsed_s: float
    sigma_mps2: Floats | None
    count: int
    temperature_c: float
