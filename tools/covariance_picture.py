"""The covariance that shrinks orientation by orientation: the moving picture of README, from recordings/hidden.mcap.

Ellipses of 1 and 2 sigma of scale factor and bias of each accelerometer after each dwell, about the final estimate.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from matplotlib.patches import Ellipse
from PIL import Image

import kf_calib
from kf_calib.support.units import shown
from kf_calib.views.figures.style import ACCELEROMETERS, GREY, blank, content_of, styled

RECORDING = Path(__file__).resolve().parents[1] / "recordings" / "hidden.mcap"
_FIRST = 7  # dwells, from which on all twelve are determined well enough to be drawn
_WIDTH_PX, _COLOURS = 900, 48
_FRAME_MS, _LAST_MS = 350, 3000


def frames() -> list[Image.Image]:
    """A picture after each dwell."""
    run = kf_calib.calibrate(RECORDING, kf_calib.Settings(effects=("hysteresis",)))
    return [_frame(run, k) for k in range(_FIRST - 1, len(run.visits))]


def save(path: Path) -> Path:
    """Write the frames as a GIF that begins again, with a rest at the end."""
    drawn = frames()
    palette = drawn[0].quantize(_COLOURS)  # in which all ellipses are large, so that none loses its colour
    pictures = [each.quantize(palette=palette, dither=Image.Dither.NONE) for each in drawn]
    durations = [_FRAME_MS] * (len(pictures) - 1) + [_LAST_MS]
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=durations, loop=0, optimize=True)
    return path


def _frame(run: kf_calib.Calibration, k: int) -> Image.Image:
    scales = np.array([shown("1").per_si, shown("m/s^2").per_si])
    last = run.visits[-1].estimate
    with styled():
        figure = blank(9.0, 3.4)
        for i, axes in enumerate(figure.subplots(1, 3)):
            places = [4 * i + 2, 4 * i + 3]  # K and b of the twelve in their order
            estimate = run.visits[k].estimate
            middle = (estimate.parameters - last.parameters)[places] * scales
            covariance = estimate.parameter_covariance[np.ix_(places, places)] * np.outer(scales, scales)
            widest = np.sqrt(np.diag(run.visits[_FIRST - 1].estimate.parameter_covariance)[places]) * scales
            values, vectors = np.linalg.eigh(covariance)
            for times, alpha in ((2.0, 0.25), (1.0, 0.55)):
                axes.add_patch(Ellipse(middle, *(2.0 * times * np.sqrt(values)), color=ACCELEROMETERS[i], alpha=alpha,
                                       angle=float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))))  # fmt: skip
            axes.plot(0.0, 0.0, "+", color="#111111", markersize=8.0)
            axes.set_xlim(-2.6 * widest[0], 2.6 * widest[0])
            axes.set_ylim(-2.6 * widest[1], 2.6 * widest[1])
            axes.set_xlabel(f"K{i + 1} less its final value, {shown('1').label}")
            axes.set_ylabel(f"b{i + 1} less its final value, {shown('m/s^2').label}")
            sigma_k, sigma_b = np.sqrt(np.diag(covariance))
            axes.set_title(f"σ(K{i + 1}) {sigma_k:.2f} ppm, σ(b{i + 1}) {sigma_b:.2f} µg", fontsize=8.5)
        number = run.visits[k].dwell.number
        figure.suptitle(f"After orientation {number} of {len(run.visits)}: ellipses of 1σ and 2σ", x=0.01, ha="left",
                        color=GREY)  # fmt: skip
        png = content_of(figure, "png", _WIDTH_PX / 9.0)
    return Image.open(io.BytesIO(png)).convert("RGB")
