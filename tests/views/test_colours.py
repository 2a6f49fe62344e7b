"""Colours that mean something are told apart by eyes that lack a kind of cone, on paper and on a dark screen."""

import re
from collections.abc import Sequence
from importlib import import_module
from itertools import combinations
from typing import Any

import numpy as np
import pytest

from kf_calib.report.page import own_text
from kf_calib.views.figures import style

SEEN = {
    "all cones": np.eye(3),
    "protanopia": np.array([[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216],
                            [-0.003882, -0.048116, 1.051998]]),
    "deuteranopia": np.array([[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413],
                              [-0.011820, 0.042940, 0.968881]]),
    "tritanopia": np.array([[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602],
                            [0.004733, 0.691367, 0.303900]]),
}  # fmt: skip
"""What is left of linear red, green and blue: Machado, Oliveira and Fernandes (2009), severity 1."""
TO_XYZ = np.array([[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750],
                   [0.0193339, 0.1191920, 0.9503041]])  # fmt: skip
WHITE = np.array([0.95047, 1.0, 1.08883])
LEAST = 10.0
"""Distance in CIELAB of two colours that a glance tells apart; 2.3 is what is just noticed side by side."""


def _of_page(block: int) -> list[str]:
    """The colours of the accelerometers in the style of the page: block 0 on light, 1 on dark."""
    return re.findall(r"--a\d: (#[0-9a-f]{6})", own_text("style.css"))[3 * block : 3 * block + 3]


def _on_dark(colours: Sequence[str], keep: float = 0.72) -> list[str]:
    """As a figure of the page shows them in the dark: mixed with white."""
    mixed = keep * _rgb(colours) + 255.0 * (1.0 - keep)
    return ["#" + "".join(f"{round(value):02x}" for value in colour) for colour in mixed]


def _rgb(colours: Sequence[str]) -> np.ndarray:
    return np.array([[int(colour[k : k + 2], 16) for k in (1, 3, 5)] for colour in colours], float)


def _in_figure(module: str, name: str) -> Any:
    return getattr(import_module(f"kf_calib.{module}"), name)


FAMILIES, KNOWN = _in_figure("views.figures.explanations", "_FAMILIES"), _in_figure("fleet.figures", "_KNOWN")
PALETTES: dict[str, Sequence[str]] = {
    "accelerometers": style.ACCELEROMETERS,
    "accelerometers in the dark": _on_dark(style.ACCELEROMETERS),
    "explorer": _of_page(0),
    "explorer in the dark": _of_page(1),
    "explanations": [style.BEST, style.RUNNER_UP, _in_figure("views.figures.explanations", "_FITTING")],
    "families": FAMILIES,
    "families in the dark": _on_dark(FAMILIES),
    "verdicts of a fleet": [
        *_in_figure("fleet.figures", "_COLOURS"),
        *(KNOWN[name] for name in ("consistent", "failed", "inconsistent")),
    ],
    "detection limits": [_in_figure("views.figures.explanations", name) for name in ("_SEEN", "_HIDDEN")],
    "NIS": ["#222222", style.ALARM],
    "gimbals": _in_figure("views.figures.orientations", "_GIMBALS"),
    "engines": list(_in_figure("views.figures.engines", "_COLOURS").values()),
    "sets of orientations": [colour for colour, _ in _in_figure("reproduction.figures", "_SETS").values()],
}


def _lab(colours: Sequence[str], left: np.ndarray) -> np.ndarray:
    """CIELAB (n, 3) of colours as eyes see them of which ``left`` is left of linear red, green and blue."""
    share = _rgb(colours) / 255.0
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    ratio = np.clip(linear @ left.T, 0.0, 1.0) @ TO_XYZ.T / WHITE
    f = np.where(ratio > (6 / 29) ** 3, np.cbrt(ratio), ratio / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.stack([116.0 * f[:, 1] - 16.0, 500.0 * (f[:, 0] - f[:, 1]), 200.0 * (f[:, 1] - f[:, 2])], axis=1)


def _nearest(colours: Sequence[str], eyes: str) -> float:
    return min(float(np.linalg.norm(one - other)) for one, other in combinations(_lab(colours, SEEN[eyes]), 2))


@pytest.mark.parametrize("eyes", SEEN)
@pytest.mark.parametrize("palette", PALETTES)
def test_colours_are_told_apart(palette: str, eyes: str) -> None:
    colours = PALETTES[palette]
    assert len(set(colours)) == len(colours) >= 2
    assert _nearest(colours, eyes) > LEAST


def test_colours_that_are_known_to_be_alike_are_noticed() -> None:
    assert _nearest(["#0072b2", "#8a4fbf"], "deuteranopia") < LEAST < _nearest(["#0072b2", "#8a4fbf"], "all cones")
    assert _nearest(["#b3001b", "#8a6100"], "deuteranopia") < LEAST  # red and brown
