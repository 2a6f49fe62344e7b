"""The pictures of README and docs: ``tools/pictures`` draws them again, or those whose name is given.

Figures are the program's own (``kf_calib.plot``), from recordings/hidden.mcap; pictures of the Rerun view are
screenshots of it and need a graphics driver. Colours are reduced to a palette, so that a picture has some ten kB: one
that covers all colours, as the most frequent ones would make thin curves of one colour where they have two.

Each of them carries a digest of what it was drawn from (``drawn_from``): a test compares it with the digest of today.
Pictures of simulated runs are drawn by scripts of their own beside this one (``OF_SCRIPTS``). Only those of the blind
trial are not drawn here: tools/blind_trial.py draws them at the end of a trial, which takes hours.
"""

from __future__ import annotations

import hashlib
import io
import json
import sys
import tempfile
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

import conventions_picture
import covariance_picture
import fleet_picture
import live_page_picture
import numpy as np
import right_pictures
import run_picture
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from screenshot import screenshot

import kf_calib

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
RECORDING = ROOT / "recordings" / "hidden.mcap"
KEY = "drawn-from"
_PALETTE = 96  # colours
_WIDTH_PX = 1200
_SIZE_PX = 1200, 750  # of a screenshot


@cache
def found() -> kf_calib.Diagnosis:
    """The diagnosis of the recording."""
    return kf_calib.diagnose(RECORDING)


@cache
def improved() -> kf_calib.Improvement:
    """The recording with what was missing in the model."""
    return kf_calib.improve(RECORDING)


def _figure(draw: Callable[[], object]) -> Callable[[], Image.Image]:
    """Return what makes a picture of a figure."""

    def made() -> Image.Image:
        with tempfile.TemporaryDirectory() as folder:
            png = Path(folder, "figure.png")
            kf_calib.plot.save(draw(), png, width_px=_WIDTH_PX)  # type: ignore[arg-type]  # a figure
            return Image.open(io.BytesIO(png.read_bytes())).convert("RGB")

    return made


def _view(result: Callable[[], object]) -> Callable[[], Image.Image]:
    """Return what makes a screenshot of the Rerun view of a result."""

    def made() -> Image.Image:
        with tempfile.TemporaryDirectory() as folder:
            rrd, png = Path(folder, "view.rrd"), Path(folder, "view.png")
            kf_calib.save_view(result(), rrd)  # type: ignore[arg-type]
            screenshot(rrd, png, _SIZE_PX)
            return Image.open(io.BytesIO(png.read_bytes())).convert("RGB")

    return made


PICTURES: dict[str, Callable[[], Image.Image]] = {
    "diagnose": _figure(lambda: kf_calib.plot.residuals(found())),
    "improve": _figure(lambda: kf_calib.plot.improvement(improved())),
    "replay_figure": _figure(lambda: kf_calib.plot.convergence(found().before)),
    "tutorial_dwell": _figure(lambda: kf_calib.plot.dwell(kf_calib.open_recording(RECORDING), found().before)),
    "tutorial_suspects": _figure(lambda: kf_calib.plot.suspects(found())),
    "tutorial_sigmas": _figure(lambda: kf_calib.plot.convergence(improved().result)),
    "replay": _view(lambda: found().before),
    "diagnose_view": _view(found),
}
"""Name of each picture in docs of the recording, and what draws it."""

OF_SCRIPTS: dict[str, Callable[[], Image.Image]] = {
    "conventions": conventions_picture.drawn,
    "fleet": fleet_picture.drawn,
    "live_page": live_page_picture.drawn,
    "run": _figure(run_picture.drawn),
    **{name: _figure(partial(right_pictures.drawn, name)) for name in right_pictures.FIGURES},
}
"""Name of each other picture, and what draws it."""

MOVING = "covariance"
"""Name of the one that moves, a film of the Rerun view, which covariance_picture draws."""


@cache
def drawn_from() -> str:
    """Digest of what the pictures show: the recording, the verdict, and the numbers to three digits, which other
    machines share."""
    numbers = [
        *(float(p.value or 0.0) for p in improved().result.parameters.values()),
        *(float(p.sigma or 0.0) for p in improved().result.parameters.values()),
        *found().before.residuals_mps2.ravel(), *improved().result.residuals_mps2.ravel(),
    ]  # fmt: skip
    largest = np.abs(found().before.residuals_mps2).max()
    rounded = [f"{value if abs(value) > 1e-3 * largest else 0.0:.2e}" for value in numbers]
    content = {"recording": hashlib.sha256(RECORDING.read_bytes()).hexdigest(), "numbers": rounded,
               "verdict": found().verdict, "pictures": sorted(PICTURES)}  # fmt: skip
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def save(name: str) -> Path:
    """Draw one picture into docs."""
    path, content = DOCS / f"{name}.png", PngInfo()
    if name in PICTURES:
        content.add_text(KEY, drawn_from())
    drawn = (PICTURES | OF_SCRIPTS)[name]()
    picture = drawn.quantize(_PALETTE, Image.Quantize.MAXCOVERAGE, 1, dither=Image.Dither.NONE)
    picture.save(path, optimize=True, pnginfo=content)
    return path


def main(names: list[str]) -> None:
    """Draw the pictures of these names, or all."""
    known = PICTURES | OF_SCRIPTS | {MOVING: None}
    unknown = sorted(set(names) - set(known))
    if unknown:
        sys.exit(f"tools/pictures: there is no picture {unknown[0]}: name some of {', '.join(known)}.")
    for name in names or known:
        path = covariance_picture.save(DOCS / f"{MOVING}.gif") if name == MOVING else save(name)
        print(f"{path.relative_to(ROOT)}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main(sys.argv[1:])
