"""docs/run.png: the orientations of a run that drives itself, as they grow on the sphere.

The bench is a simulated one that hides a second-order term. ``tools/pictures run`` draws it again.
"""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from run_trial import SteppedTime

from kf_calib.bench.arrays import Floats
from kf_calib.bench.paper_parameters import targets_of
from kf_calib.online.session import Session
from kf_calib.online.suggestion import Itinerary
from kf_calib.positioning.drive import Decision, Drive
from kf_calib.positioning.loop import Rules
from kf_calib.positioning.opening import SimulatedPositioner
from kf_calib.sources.simulation.driven import DrivenBench
from kf_calib.sources.simulation.options import options_from_query, simulation
from kf_calib.views.figures.orientations import on_map, sphere_map

QUERY, TARGETS = "seed=3&sample_hz=50&hide=second-order=25sigma", ("K=2ppm", "b=10ug", "angles=1arcsec")
COLOURS = {"first": "0.45", "opening": "tab:blue", "sharpen": "tab:green", "tell apart": "tab:red",
           "repeat": "tab:purple", "return": "tab:orange"}  # fmt: skip


def driven() -> tuple[Drive, Floats, list[str]]:
    """A run to its end; the directions of gravity (n, 3) in the platform, and what each orientation was for."""
    bench = DrivenBench(simulation(options_from_query(QUERY), {}), None, [0.0, 0.0, 0.0])
    session = Session.fed(bench.run.bench, wanted=targets_of(TARGETS), auto=True)
    itinerary = Itinerary(bench.run.bench, ends_when_named=False)
    rules = Rules(itinerary.limits, itinerary.slew_times)
    drive = Drive(SimulatedPositioner(bench), session, itinerary, rules, SteppedTime(bench, session))
    drive.run()
    going = [decision for decision in drive.decisions if decision.gimbal_deg]
    angles = np.radians([(0.0, 0.0, 0.0), *(decision.gimbal_deg for decision in going)])
    force = bench.run.bench.specific_force(np.zeros(len(angles)), angles)
    return drive, force, ["first", *(decision.purpose for decision in going)]


def draw(axes: Axes, force: Floats, purposes: list[str], decisions: list[Decision], count: int) -> None:
    """The first ``count`` orientations on the sphere: where gravity points in the platform."""
    longitude, latitude = on_map(force[:count])
    axes.plot(longitude, latitude, color="0.8", linewidth=0.7, zorder=1)
    colours = [COLOURS[purpose] for purpose in purposes[:count]]
    axes.scatter(longitude, latitude, s=75, c=colours, zorder=3, clip_on=False)
    for number, place in enumerate(zip(longitude, latitude, strict=True), start=1):
        if not any(np.allclose(place, later) for later in zip(longitude[number:], latitude[number:], strict=True)):
            axes.annotate(str(number), place, color="white", fontsize=6, ha="center", va="center", zorder=4)
    passed_s = decisions[min(count, len(decisions)) - 1].at_s
    axes.set_title(f"{count} orientations, {passed_s / 60.0:.1f} min", fontsize=9, pad=14.0)
    axes.grid(alpha=0.3)


def drawn() -> Figure:
    """The picture."""
    drive, force, purposes = driven()
    figure = Figure(figsize=(9.0, 5.6), layout="constrained")
    for place, count in enumerate([4, 8, 13, len(force)], start=1):
        draw(sphere_map(figure, (2, 2, place)), force, purposes, drive.decisions, count)
    shown = [Line2D([], [], marker="o", linestyle="", color=colour, label=name)
             for name, colour in COLOURS.items() if name in purposes]  # fmt: skip
    figure.legend(handles=shown, loc="outside lower center", ncols=len(shown), fontsize=8)
    return figure
