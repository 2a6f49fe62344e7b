"""What every program that a calibration is exported to has in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import cached_property
from typing import ClassVar

from kf_calib.bench.arrays import Floats
from kf_calib.estimation.correction import Correction
from kf_calib.exchange.calibration_file import SavedCalibration
from kf_calib.exchange.exports.force_grid import ErrorLeft, ForceGrid, force_grid
from kf_calib.exchange.exports.quoting import in_comment


class Target(ABC):
    """A calibration in the form of another program.

    title: the program. lost: what of the calibration it cannot hold, by name; nothing, unless a subclass says so.
    """

    title: ClassVar[str]

    def __init__(self, saved: SavedCalibration, correction: Correction) -> None:
        self.saved, self.correction = saved, correction

    @abstractmethod
    def text(self) -> str:
        """The content of the file; raises InputError where the program would not take it."""

    @property
    def lost(self) -> tuple[str, ...]:
        return ()

    @property
    def remarks(self) -> tuple[str, ...]:
        """What a user of the program should know besides."""
        return ()

    def corrected(self, readings_mps2: Floats, temperature_c: Floats) -> Floats:
        """Specific force (n, 3) from readings (n, 3), by the formula of the program."""
        return self.correction(readings_mps2, temperature_c)

    @cached_property
    def grid(self) -> ForceGrid:
        """All directions of gravity, at the temperatures of the run."""
        conditions = self.saved.conditions
        return force_grid(
            self.correction.bench.gravity_mps2, conditions.temperature_min_c, conditions.temperature_max_c
        )

    @cached_property
    def error_left(self) -> ErrorLeft | None:
        """By how much corrected readings are wrong for what is lost; None where nothing is."""
        return self.grid.error_of(self.correction, self.corrected) if self.lost else None

    @property
    def origin(self) -> str:
        """Where the numbers come from, fit for a comment of any of the formats."""
        made = self.saved.provenance
        name = in_comment(made.recording) or "a live run"
        version, created = in_comment(made.versions.get("kf_calib", "")), in_comment(made.created)
        return f"calibration of {name} by kf_calib {version}, {created}"
