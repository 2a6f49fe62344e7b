"""What was measured: the recording, its fingerprint, bench, dwells and noise, as rows of words."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime

from kf_calib.estimation.cross_validation import orientations
from kf_calib.estimation.results import Calibration

_NOTES = {"block_serial": "Sensor block", "bench": "Bench", "operator": "Operator", "note": "Note"}


@dataclass(frozen=True)
class Measured:
    """The recording of a result.

    began: when its run did, where that is known. decisions, ends: records of a bench that drove itself.
    """

    name: str
    sha256: str
    began: datetime | None = None
    decisions: Sequence[Mapping[str, str]] = ()
    ends: Sequence[Mapping[str, str]] = ()

    @property
    def date(self) -> str:
        """When it was begun, in words; empty where nothing tells."""
        return "" if self.began is None else f"{self.began:%Y-%m-%d %H:%M:%S} UTC"


def facts(measured: Measured, result: Calibration) -> list[tuple[str, str]]:
    """What was measured, a heading and words each."""
    return [each for each in _facts(measured, result) if each[1]]


def _facts(measured: Measured, result: Calibration) -> Iterator[tuple[str, str]]:
    bench, tally = result.bench, result.tally
    dwells = result.fit.dwells
    yield "Recording", measured.name
    yield "SHA-256", measured.sha256
    yield "Begun", measured.date
    for key, words in _NOTES.items():
        yield words, bench.notes.get(key, "")
    used = tally.used - tally.gated
    yield "Readings", f"{used} of {tally.read} used; {tally.moving} moving, {tally.settling} settling"
    last = dwells[-1].end_s
    yield "Dwells", f"{len(dwells)} in {len(orientations(dwells))} orientations, over {_duration(last)}"
    yield "Gimbals", _gimbals(result)
    yield "Gravity", f"{bench.gravity_mps2:.7g} m/s²"
    yield "Setting of angles", _stated(bench.angle_sigma_deg, "deg") if bench.angles else ""
    yield "Scatter from dwell to dwell", _stated(bench.scatter_sigma_mps2, "m/s²")
    yield "Model", result.model.sum


def _duration(seconds: float) -> str:
    minutes, left = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {left} s" if minutes else f"{left} s"


def _gimbals(result: Calibration) -> str:
    bench = result.bench
    if not bench.angles:
        return "no angles are used; the frame is that of the sensors"
    said = bench.to_metadata()
    axes = f"axes {said['axes']}, outer to inner" if bench.axes else "attitude recorded"
    held = "held in inertial space" if bench.reference == "inertial" else "angles relative to the bench"
    return f"{axes}; {held}; {said.get('up', 'y')} is up where all angles are zero"


def _stated(sigma: float | None, unit: str) -> str:
    return "estimated from the run where it can be" if sigma is None else f"stated: {sigma:.3g} {unit}, 1σ"
