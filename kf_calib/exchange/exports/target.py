"""What every program that a calibration is exported to has in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import cached_property
from typing import ClassVar

from kf_calib.bench.arrays import Floats
from kf_calib.bench.raw_input import PLAIN, RawInput
from kf_calib.estimation.correction import Correction
from kf_calib.exchange.calibration_file import SavedCalibration
from kf_calib.exchange.exports.force_grid import ErrorLeft, ForceGrid, force_grid
from kf_calib.exchange.exports.quoting import in_comment


class Target(ABC):
    """A calibration in the form of another program.

    title: the program. lost: what of the calibration it cannot hold, by name; nothing, unless a subclass says so.
    folds: whether it has room for order, sign and size of the device's raw readings.
    """

    title: ClassVar[str]
    folds: ClassVar[bool] = True

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

    @property
    def input(self) -> RawInput:
        """What it takes: raw readings as the device sends them, or readings in m/s^2 that have to be made of them."""
        return self.correction.input if self.folds else PLAIN

    @property
    def to_be_done_before(self) -> str:
        """How the readings that it takes have to be made of raw ones, in words; nothing where it takes raw ones."""
        return "" if self.input == self.correction.input else self.correction.input.formula

    @property
    def takes(self) -> str:
        """What it takes, in words."""
        made = f"; to be made before of what the device sends: {self.to_be_done_before}" * bool(self.to_be_done_before)
        return f"takes {self.input}{made}"

    def corrected(self, readings_mps2: Floats, temperature_c: Floats) -> Floats:
        """Specific force (n, 3) from readings (n, 3), m/s^2, by the formula of the program."""
        return self.correction.of_readings(readings_mps2, temperature_c)

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
    def heading(self) -> tuple[str, str]:
        """The lines of a comment that a file begins with: where the numbers come from, and what it takes."""
        return f"# {self.origin}.", f"# It {self.takes}."

    @property
    def origin(self) -> str:
        """Where the numbers come from, fit for a comment of any of the formats."""
        made = self.saved.provenance
        name = in_comment(made.recording) or "a run that was not recorded"
        version, created = in_comment(made.versions.get("kf_calib", "")), in_comment(made.created)
        return f"calibration of {name} by kf_calib {version}, {created}"
