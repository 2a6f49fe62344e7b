"""The bench where no angles are used: gravity, and a frame that is that of the sensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from kf_calib.bench.bench import Bench
from kf_calib.bench.streams import Batch, Stream
from kf_calib.errors import BenchError
from kf_calib.support.units import STANDARD_GRAVITY_MPS2

_SQUARE = {"theta1": 0.0, "theta3": 0.0}


def bench_without_angles(name: str, metadata: Mapping[str, str]) -> tuple[Bench, list[str]]:
    """The bench by the keys that are stated, and what to know of it; gravity is the standard one where none is stated.

    name: of the source. Raises BenchError for a key that cannot be.
    """
    gravity = {} if "latitude_deg" in metadata else {"gravity_mps2": str(STANDARD_GRAVITY_MPS2)}
    try:
        bench = Bench.from_metadata({**gravity, **metadata}, has_angles=False)
    except BenchError as error:
        raise BenchError(f"{name}: {error}") from error
    remarks = list[str]()
    if bench.gravity_mps2 == STANDARD_GRAVITY_MPS2:  # as also a recording made by it states
        remarks.append(
            f"gravity is taken as the standard {STANDARD_GRAVITY_MPS2} m/s^2; the local value differs by up to "
            "0.3 %, and every scale factor with it: state it by --gravity or --latitude."
        )
    square = _SQUARE | dict(bench.nominal)
    return replace(bench, angles=False, reference="base", angle_sigma_deg=None, nominal=square), remarks


def without_poses(batch: Batch) -> Batch:
    """The batch with its readings and temperatures only."""
    return Batch(batch.accel, Stream.empty(4), batch.temperature)
