"""What a simulated recording holds, for the side file that no estimator opens."""

from __future__ import annotations

import json
from dataclasses import asdict
from os import PathLike
from pathlib import Path
from typing import Any

from kf_calib.sources.simulation.by_hand import without_angles
from kf_calib.sources.simulation.detectability import sizes_in_sigma
from kf_calib.sources.simulation.simulator import Simulation
from kf_calib.support.output_files import write_whole


def truth_file(recording: Path) -> Path:
    """The side file with the truth of ``NAME.mcap``: ``NAME.truth.json``."""
    return recording.parent / f"{recording.stem}.truth.json"


def truth_of(simulation: Simulation, angles: bool = True) -> dict[str, Any]:
    """Parameters by symbol (rad, 1, m/s^2), noise, seed, effects.

    ``size_sigma`` of an effect is worked out by further runs (``detectability``), for a recording with ``angles`` or
    without; None where it is not seen.
    """
    sizes = sizes_in_sigma(simulation if angles else without_angles(simulation), simulation.hidden)
    at_end = simulation.parameters_at_end()
    return {
        "grade": simulation.grade,
        "seed": simulation.seed,
        "parameters": dict(simulation.sensors.parameters),
        **({} if at_end is None else {"parameters_at_end": at_end}),
        "noise": asdict(simulation.noise),
        "ambient": asdict(simulation.ambient),
        "effects": [effect.truth | {"size_sigma": n} for effect, n in zip(simulation.hidden, sizes, strict=True)],
    }


def write_truth(simulation: Simulation, recording: str | PathLike[str], angles: bool = True) -> Path:
    """Writes ``NAME.truth.json`` beside the recording ``NAME.mcap``; returns its path. Raises InputError."""
    path = truth_file(Path(recording))
    write_whole(path, (json.dumps(truth_of(simulation, angles), indent=2) + "\n").encode())
    return path
