"""The pictures of docs/is_my_calibration_right.md: p, held-out error, verification and orientations visited twice.

``tools/pictures`` draws them, from recordings of the checkout and from runs that ``kf-calib simulate`` makes anew.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import kf_calib
from kf_calib.bench.streams import Source
from kf_calib.estimation.filter_history import innovation_tests
from kf_calib.exchange.calibration_file import saved
from kf_calib.exchange.verification import Verification, verify
from kf_calib.support.units import shown
from kf_calib.views.figures.convergence import draw_nis
from kf_calib.views.figures.style import ACCELEROMETERS, ALARM, BAND, BEST, GREY, MARKERS, blank, styled, whole_numbers
from kf_calib.views.notation import symbol

RECORDINGS = Path(__file__).resolve().parents[1] / "recordings"
_SIZE_IN = 11.0, 3.6
_SIMULATED = "--dwell-s 6 --slew-degps 360 --sample-hz 50"
_NOTHING = ("third-order", "magnetic", "cross-coupling-io")
_ORIENTATIONS = 12
_WORN_UG, _SETTING_DEG = 2.0, 0.0005
"""Nonlinearity and setting error of the two runs in which each orientation is visited twice."""


@cache
def calibrated(name: str, *effects: str) -> kf_calib.Calibration:
    """A recording of the checkout with these effects in the model."""
    source = kf_calib.open_recording(RECORDINGS / f"{name}.mcap")
    return kf_calib.calibrate(source, kf_calib.Settings(effects=effects))


@contextmanager
def recorded(options: str, angles_deg: np.ndarray | None = None) -> Iterator[Source]:
    """A simulated run; angles_deg (n, 3): its orientations."""
    with tempfile.TemporaryDirectory() as folder:
        run, plan = Path(folder, "run.mcap"), Path(folder, "plan.csv")
        command = [sys.executable, "-m", "kf_calib", "simulate", str(run), *_SIMULATED.split(), *options.split()]
        if angles_deg is not None:
            np.savetxt(plan, angles_deg, "%.2f", ",")
            command += ["--plan", str(plan)]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        yield kf_calib.open_recording(run)


def misfit() -> Figure:
    """NIS of a run that agrees with its model, and of one that does not."""
    figure = blank(*_SIZE_IN)
    for axes, name in zip(figure.subplots(1, 2), ("navigation_24", "hidden"), strict=True):
        result = calibrated(name)
        tests = innovation_tests(result)
        draw_nis(axes, tests)
        whole_numbers(axes, tests.numbers[0], tests.numbers[-1], "orientation")
        axes.set_title(f"p = {result.consistency.p_value:.2g}: {axes.get_title('left')}")
    return figure


def held_out() -> Figure:
    """Errors in the fit and left out of it: with too few effects, with the right one, and with too many."""
    models = [(), ("hysteresis",), ("hysteresis", *_NOTHING)]
    names = [
        "twelve parameters:\ntoo little",
        "and hysteresis:\nright",
        f"and {len(_NOTHING)} that are not there:\ntoo much",
    ]
    results = [calibrated("hidden", *effects) for effects in models]
    floor = results[1].held_out_floor_mps2 or np.nan
    figure = blank(*_SIZE_IN)
    axes = figure.subplots()
    for shift, words, colour, errors in (
        (-0.2, "orientations in the fit", "#56b4e9", [each.residual_rms_mps2 for each in results]),
        (0.2, "orientations left out of it", BEST, [each.held_out_rms_mps2 or np.nan for each in results]),
    ):
        ratios = np.array(errors) / floor
        axes.bar(np.arange(3) + shift, ratios, 0.36, color=colour, label=words)
        for x, ratio in enumerate(ratios):
            axes.text(x + shift, ratio, f"{ratio:.2f}", ha="center", va="bottom", zorder=3,
                      bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0})  # fmt: skip
    axes.set_ylim(0.0, 2.0)
    axes.axhline(1.0, color=GREY, linestyle="--", linewidth=1.2)
    axes.set_xticks(range(3), names)
    axes.set_ylabel("rms error / that of noise alone")
    axes.legend(loc="upper right")
    axes.set_title("The error in the fit falls with everything that is added; the one left out tells what is true")
    return figure


def verification() -> Figure:
    """Changes of the parameters in their sigma: of a calibration that still holds, and of one that does not."""
    of_block = "--seed 5 --hide second-order="
    with recorded(f"{of_block}4ug/g^2") as source:
        first = kf_calib.calibrate(source, kf_calib.Settings(effects=("second-order",)))
    figure = blank(*_SIZE_IN)
    for axes, words, size in zip(
        figure.subplots(1, 2, sharey=True), ("nothing has changed", "the nonlinearity has"), ("4ug/g^2", "6ug/g^2"),
        strict=True,
    ):  # fmt: skip
        with recorded(f"{of_block}{size} --orientations 12") as source:
            checked = verify(saved(first), first.model, source)
        _changes(axes, checked)
        axes.set_title(f"{words}: p = {checked.p_value:.2g}")
    figure.axes[0].legend(loc="upper right")  # where no point is
    return figure


def _changes(axes: Axes, checked: Verification) -> None:
    """Draw the change of each parameter in its sigma."""
    changes = np.array([move.difference / move.sigma for move in checked.moves])
    axes.axhspan(-2.0, 2.0, color=BAND, linewidth=0.0, label="within 2σ")
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    axes.plot(changes, "o", color=BEST, label="change of a parameter")
    far = np.flatnonzero(np.abs(changes) > 3.0)
    axes.plot(far, changes[far], "D", color=ALARM, label="beyond 3σ")
    axes.set_xticks(range(len(changes)), [symbol(move.symbol) for move in checked.moves], fontsize=8.0)
    axes.set_ylabel("change / σ")


def repeated() -> Figure:
    """Residuals of the second visit of an orientation against those of the first: a law repeats, noise does not."""
    angles = np.random.default_rng(4).uniform(-180.0, 180.0, (_ORIENTATIONS, 3))
    figure = blank(*_SIZE_IN)
    for axes, words, options in zip(
        figure.subplots(1, 2), ("an effect is missing: it comes again", "the angles are set anew: it does not"),
        (f"--seed 3 --hide second-order={_WORN_UG}ug/g^2", f"--seed 3 --setting {_SETTING_DEG}"), strict=True,
    ):  # fmt: skip
        with recorded(options, np.vstack([angles, angles])) as source:
            result = kf_calib.calibrate(source)
        _visits(axes, result.residuals_mps2 * shown("m/s^2").per_si)
        axes.set_title(words)
    return figure


def _visits(axes: Axes, residuals: np.ndarray) -> None:
    """Draw residuals (2 n, 3) of n orientations, those of the second visit against those of the first."""
    first, second = np.split(residuals, 2)
    reach = 1.1 * float(np.abs(residuals).max())
    axes.plot([-reach, reach], [-reach, reach], color=GREY, linewidth=1.0, linestyle="--", label="the same again")
    for i in range(3):
        axes.plot(first[:, i], second[:, i], MARKERS[i], color=ACCELEROMETERS[i], label=f"accelerometer {i + 1}")
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-reach, reach)
    axes.set_xlabel(f"residual of the first visit, {shown('m/s^2').label}")
    axes.set_ylabel(f"of the second, {shown('m/s^2').label}")
    axes.legend(loc="upper left", fontsize=7.5)


FIGURES: dict[str, Callable[[], Figure]] = {
    "right_p": misfit, "right_held_out": held_out, "right_verify": verification, "right_repeat": repeated,
}  # fmt: skip
"""Name of each picture in docs, and what draws it."""


def drawn(name: str) -> Figure:
    """A picture of the page, in the style of the program's figures."""
    with styled():
        return FIGURES[name]()
