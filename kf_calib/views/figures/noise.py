"""The Allan deviation of sensors at rest, with the lines of the terms that were found in it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from kf_calib.noise.power_laws import FACTORS, POWERS, TERMS
from kf_calib.noise.rest_noise import ChannelNoise, RestNoise
from kf_calib.support.units import Unit
from kf_calib.views.figures.style import ACCELEROMETERS, GREY, MARKERS, drawn_on, log_scale, say, say_once
from kf_calib.views.noise import TITLES, channel_title, unit_of

_SLOPES = {"quantisation": "−1", "white": "−½", "bias_instability": "0", "random_walk": "+½"}
_SYMBOLS = {"quantisation": "Q", "white": "N", "bias_instability": "B", "random_walk": "K"}
_STYLES = {"quantisation": (0, (1, 1)), "white": "--", "bias_instability": "-.", "random_walk": ":"}
_ROOM = 3.0  # by how much a line of a term may be below the lowest deviation, to be drawn
_ACROSS = 3


@drawn_on()
def noise(figure: Figure, found: RestNoise) -> None:
    """A panel a channel: Allan deviation with 95 % intervals, the terms with their slopes, and their sum."""
    rows = [found.of_unit(unit) for unit in ("m/s^2", "rad/s", "K")]
    rows = [row for row in rows if row]
    figure.set_size_inches(11.5, 0.8 + 4.0 * len(rows))
    if not any(len(channel.deviation) for channel in found.channels):
        return say(figure, "There are too few readings at rest for an Allan deviation.")
    panels: list[list[Axes]] = figure.subplots(len(rows), _ACROSS, squeeze=False).tolist()
    for channels, axes in zip(rows, panels, strict=True):
        _draw_row(axes, channels)
    say_once(figure, panels[0], "outside lower center", 4)


def _draw_row(panels: Sequence[Axes], channels: Sequence[ChannelNoise]) -> None:
    """Draw the channels of one unit on axes of one scale."""
    unit = unit_of(channels[0].unit, "bias_instability")
    for panel, channel, colour, marker in zip(panels, channels, ACCELEROMETERS, MARKERS, strict=False):
        panel.set_title(channel_title(channel) + (f": {channel.why_not}" if channel.why_not else ""))
        _draw(panel, channel, unit, colour, marker)
        panel.set_xlabel("length of a cluster τ, s")
    for panel in panels[len(channels) :]:
        panel.set_axis_off()
    drawn = [each for channel in channels for each in (channel.deviation, channel.low, channel.high)]
    for panel in panels[: len(channels)]:
        log_scale(panel, [each * unit.per_si for each in drawn])
        log_scale(panel, [channel.tau_s for channel in channels], "x")
    panels[0].set_ylabel(f"Allan deviation, {unit.label}")


def _draw(panel: Axes, channel: ChannelNoise, unit: Unit, colour: str, marker: str) -> None:
    """Draw a channel: its deviations, the terms and their sum."""
    if not (channel.deviation > 0.0).any():
        return
    values = channel.deviation * unit.per_si
    ends = np.array([channel.deviation - channel.low, channel.high - channel.deviation]) * unit.per_si
    used = channel.tau_s > 0.99 * channel.from_s if channel.terms else np.ones(len(values), bool)
    for part, shade, name in ((used, colour, "readings, 95 %"), (~used, GREY, "readings not in the fit")):
        if part.any():
            panel.errorbar(channel.tau_s[part], values[part], ends[:, part], fmt=marker, color=shade, elinewidth=0.9,
                           label=name)  # fmt: skip
    if not channel.terms:
        return
    panel.plot(channel.tau_s[used], channel.model(channel.tau_s[used]) * unit.per_si, color="#222222", linewidth=1.6,
               label="sum of the terms")  # fmt: skip
    for term, factor, power, square in zip(TERMS, FACTORS, POWERS, channel.squares, strict=True):
        if square > 0.0:
            line = np.sqrt(square * factor * channel.tau_s**power)
            where = used & (line > channel.deviation.min() / _ROOM)
            panel.plot(channel.tau_s[where], line[where] * unit.per_si, linestyle=_STYLES[term], color="#222222",
                       linewidth=0.9, label=f"{TITLES[term]} {_SYMBOLS[term]}, slope {_SLOPES[term]}")  # fmt: skip
    text = "\n".join(_sizes(channel))
    panel.text(0.97, 0.97, text, transform=panel.transAxes, ha="right", va="top", fontsize=8.0, color="#222222",
               bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.5})  # fmt: skip


def _sizes(channel: ChannelNoise) -> Iterator[str]:
    for term in reversed(TERMS):
        size, unit = channel.terms[term], unit_of(channel.unit, term)
        if size.value is None:
            yield f"{_SYMBOLS[term]} < {unit.text(size.high)}"
        else:
            yield f"{_SYMBOLS[term]} = {unit.number(size.value)} ({unit.number(size.low)}–{unit.text(size.high)})"
