"""A simulated run whose angles nobody records, as that of a board which is turned by hand."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from kf_calib.bench.bench import Bench
from kf_calib.bench.streams import Batch, Stream
from kf_calib.sources.simulation.simulator import Simulation

_ANY_DEG = 1e3  # a setting error that leaves the size of f alone, and rounding far below the noise


def without_angles(run: Simulation) -> Simulation:
    """The run as an evaluation without angles sees it, for sizes in sigma: every orientation may be any."""
    return run.hiding(run.hidden, replace(run.noise, setting_sigma_deg=_ANY_DEG))


class ByHand:
    """The readings and temperatures of a simulated run, without its angles and without its gimbals.

    - bench: what is known without them.
    - warnings, fraction: as of every source.
    """

    def __init__(self, run: Simulation) -> None:
        self._run, self.warnings = run, list[str]()
        square = {"theta1": 0.0, "theta3": 0.0}
        self.bench: Bench = replace(run.bench, axes=(), angles=False, angle_sigma_deg=None, nominal=square)

    @property
    def fraction(self) -> float:
        """The share of the run that has passed."""
        return self._run.fraction

    def __iter__(self) -> Iterator[Batch]:
        for batch in self._run:
            yield Batch(batch.accel, Stream.empty(4), batch.temperature)
