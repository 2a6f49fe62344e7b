"""What the panels share: timelines, colours, labels and units."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import rerun as rr

from kf_calib.bench import paper_parameters
from kf_calib.estimation.measurement_model import Model
from kf_calib.support.plain_text import printable

BENCH_TIME = "bench_time"
ORIENTATION = "orientation"

Colour = tuple[int, int, int]
ACCELEROMETERS: tuple[Colour, Colour, Colour] = ((235, 115, 40), (40, 185, 130), (85, 160, 245))
"""One colour an accelerometer in all panels: in the order of x, y, z, and told apart by colour-blind eyes."""
PALE: tuple[Colour, Colour, Colour] = ((255, 190, 130), (150, 235, 195), (175, 215, 255))
"""The same accelerometers' second angle."""
GREY: Colour = (135, 135, 140)
WHITE: Colour = (235, 235, 235)
GIMBALS: tuple[Colour, ...] = ((205, 160, 255), (255, 160, 205), (225, 215, 130), (200, 200, 205))
GOLD: Colour = (250, 210, 70)
RED: Colour = (240, 50, 70)

CHANNELS = ("a1", "a2", "a3")
LABELS = {
    "theta1": "θ₁", "phi1": "φ₁", "K1": "K₁", "b1": "b₁",
    "nu1": "ν₁", "nu2": "ν₂", "K2": "K₂", "b2": "b₂",
    "theta3": "θ₃", "phi3": "φ₃", "K3": "K₃", "b3": "b₃",
}  # fmt: skip
MICRO = 1e6
MAUVE: Colour = (214, 150, 235)
"""Coefficients of effects."""


@dataclass(frozen=True)
class EntityGroup:
    """Parameters of one kind: what is shown is the SI value times ``per_si``, in ``unit``."""

    title: str
    unit: str
    per_si: float
    symbols: tuple[str, ...]


def _of_unit(unit: str) -> tuple[str, ...]:
    return tuple(
        symbol for symbol, own in zip(paper_parameters.SYMBOLS, paper_parameters.UNITS, strict=True) if own == unit
    )


GROUPS = (
    EntityGroup("angles", "arcsec", float(np.degrees(3600.0)), _of_unit("rad")),
    EntityGroup("scale factors", "ppm", MICRO, _of_unit("1")),
    EntityGroup("biases", "µm/s²", MICRO, _of_unit("m/s^2")),
)
GROUP_OF = {symbol: group for group in GROUPS for symbol in group.symbols}
PER_SI = np.array([GROUP_OF[symbol].per_si for symbol in paper_parameters.SYMBOLS])


def colour_of(symbol: str) -> Colour:
    """The accelerometer's colour, paler for its second angle."""
    accelerometer, place = divmod(paper_parameters.SYMBOLS.index(symbol), 4)
    return PALE[accelerometer] if place == 1 else ACCELEROMETERS[accelerometer]


def path_of(symbol: str) -> str:
    """The parameter's entity; the accelerometer comes first, so that legends list one after the other."""
    return f"parameters/a{paper_parameters.SYMBOLS.index(symbol) // 4 + 1}/{symbol}"


@dataclass(frozen=True)
class Quantity:
    """What is estimated and drawn as one curve: the SI value times ``per_si`` is in ``unit``."""

    label: str
    unit: str
    per_si: float
    colour: Colour
    path: str


TWELVE = tuple(
    Quantity(LABELS[symbol], GROUP_OF[symbol].unit, GROUP_OF[symbol].per_si, colour_of(symbol), path_of(symbol))
    for symbol in paper_parameters.SYMBOLS
)


def quantities(model: Model) -> tuple[Quantity, ...]:
    """The twelve parameters, then the coefficients of the effects in the model."""
    coefficients = [
        Quantity(printable(each.symbol), printable(each.shown_unit), each.per_si, MAUVE,
                 rr.new_entity_path(["parameters", "effects", each.symbol]).lstrip("/"))
        for each in model.coefficients
    ]  # fmt: skip
    return (*TWELVE, *coefficients)
