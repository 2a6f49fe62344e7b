"""What every program that a calibration is exported to has in common, and the plainest of them: a table as CSV."""

from __future__ import annotations

import csv
import io
import unicodedata
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.raw_input import PLAIN, RawInput
from kf_calib.effects.stimulus import REFERENCE_TEMPERATURE_C
from kf_calib.estimation.correction import Correction
from kf_calib.exchange.calibration_file import SavedCalibration
from kf_calib.exports.noise_keys import NoiseExport, in_comment, origin_of


class Target(ABC):
    """A calibration in the form of another program.

    title: the program. lost: what of the calibration it cannot hold, by name; nothing, unless a subclass says so.
    folds: whether it has room for order, sign and size of the device's raw readings. noise: what is to go into the
    file besides, of programs that have keys for it.
    """

    title: ClassVar[str]
    folds: ClassVar[bool] = True

    def __init__(self, saved: SavedCalibration, correction: Correction) -> None:
        self.saved, self.correction = saved, correction
        self.noise: NoiseExport | None = None

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
        before = self.to_be_done_before
        return f"takes {self.input}{f'; convert what the device sends before it goes in: {before}' * bool(before)}"

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
    def noise_in_yaml(self) -> list[str]:
        """The lines of the noise as they are indented in YAML."""
        return [f"  {line}" for line in self.noise.yaml_lines] if self.noise else []

    @property
    def heading(self) -> tuple[str, str]:
        """The lines of a comment that a file begins with: where the numbers come from, and what it takes."""
        return f"# {self.origin}.", f"# It {self.takes}."

    @property
    def origin(self) -> str:
        """Where the numbers come from, fit for a comment of any of the formats."""
        made = self.saved.provenance
        name = in_comment(made.recording) or "a run that was not recorded"
        return origin_of(f"calibration of {name}", made.versions.get("kf_calib", ""), made.created)


_DIRECTIONS = 10_000  # with the opposite of each, so that odd powers of the force cancel exactly
_LOBATTO = np.array([[-1.0, 0.1], [-np.sqrt(3 / 7), 49 / 90], [0.0, 32 / 45], [np.sqrt(3 / 7), 49 / 90], [1.0, 0.1]])
"""Nodes, weights: exact up to the seventh power of the temperature, and both ends are among the nodes."""


class ErrorLeft(NamedTuple):
    """Length of the error of corrected specific force, m/s^2."""

    rms_mps2: float
    worst_mps2: float


@dataclass(frozen=True, eq=False)
class ForceGrid:
    """Specific force (n, 3), temperature (n,), and shares (n,) that add up to one; low_c, high_c: the temperatures."""

    force_mps2: Floats
    temperature_c: Floats
    weight: Floats
    low_c: float
    high_c: float

    def error_of(self, correction: Correction, corrected: Callable[[Floats, Floats], Floats]) -> ErrorLeft:
        """How far ``corrected`` (readings, temperature) is from the specific force of which these are the readings."""
        found = corrected(correction.predicted(self.force_mps2, self.temperature_c), self.temperature_c)
        square = np.sum((found - self.force_mps2) ** 2, axis=1)
        return ErrorLeft(float(np.sqrt(self.weight @ square)), float(np.sqrt(square.max())))


def force_grid(gravity_mps2: float, low_c: float | None, high_c: float | None) -> ForceGrid:
    """Directions spread evenly by the golden angle, each at five temperatures from low to high (None: not known)."""
    low, high = (REFERENCE_TEMPERATURE_C if each is None else each for each in (low_c, high_c))
    number = np.arange(_DIRECTIONS // 2) + 0.5
    height, turn = 1.0 - 4.0 * number / _DIRECTIONS, number * np.pi * (1.0 + np.sqrt(5.0))
    radius = np.sqrt(1.0 - height**2)
    force = gravity_mps2 * np.column_stack([radius * np.cos(turn), radius * np.sin(turn), height])
    force = np.vstack([force, -force])
    temperature = 0.5 * (low + high) + 0.5 * (high - low) * _LOBATTO[:, 0]
    return ForceGrid(
        np.tile(force, (len(temperature), 1)),
        np.repeat(temperature, _DIRECTIONS),
        np.repeat(_LOBATTO[:, 1] / 2.0 / _DIRECTIONS, _DIRECTIONS),
        low,
        high,
    )


def in_cell(text: str) -> str:
    """The text as a cell of a table that no spreadsheet takes for a formula: with an apostrophe before = + - @."""
    begin = unicodedata.normalize("NFKC", text).lstrip()[:1]  # a wide equals sign begins a formula, too
    return f"'{text}" if begin and begin in "=+-@" else text


class CsvTable(Target):
    """CSV: a table of all numbers, for a spreadsheet or a program of one's own.

        f = C (raw - o) - E e(f, T)

    raw: what the device sends; C_ij, o1 o2 o3: matrix and offset, with the order, sign and size of its channels in
    them; e: the effects by their formulas, with the coefficients and constants in the table, E_ij: their matrix.
    channel1 ...: the channel of each accelerometer, count1 ...: the size of one count of each channel. Columns:
    name, value, sigma (1 sigma; empty where there is none), unit (SI).
    """

    title = "spreadsheets"

    def text(self) -> str:
        written = io.StringIO()
        writer = csv.writer(written, lineterminator="\n")
        writer.writerow(["name", "value", "sigma", "unit"])
        writer.writerows(self._rows())
        return written.getvalue()

    def _rows(self) -> Iterator[tuple[str, object, object, str]]:
        for own in self.saved.parameters:
            yield in_cell(own.symbol), own.value, own.sigma, in_cell(own.unit)
        for effect in self.correction.effects:
            if effect.unknown is not None and not effect.has_constant_in_state:  # else it is among the parameters
                yield effect.unknown.symbol, effect.value, None, effect.unknown.unit
        given, unit = self.input, "1" if self.input.is_plain else "m/s^2 a count"
        for i in range(3):
            yield f"channel{i + 1}", given.channels[i], None, "1"
            yield f"count{i + 1}", float(given.factors[i]), None, "m/s^2"
        yield from _elements("C", self.correction.matrix @ given.matrix, unit)
        offset = np.linalg.solve(given.matrix, self.correction.bias_mps2)
        yield from ((f"o{i + 1}", float(offset[i]), None, "m/s^2" if given.is_plain else "count") for i in range(3))
        yield from _elements("E", self.correction.matrix, "1") if self.correction.effects else ()


def _elements(name: str, matrix: Floats, unit: str) -> Iterator[tuple[str, object, object, str]]:
    """Rows of the elements of a matrix (3, 3)."""
    return ((f"{name}{i + 1}{j + 1}", float(matrix[i, j]), None, unit) for i in range(3) for j in range(3))
