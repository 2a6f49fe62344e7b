"""The picture of a fleet: parameters over units and dates, verdicts by week, errors of the bench, units to look at."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime

import numpy as np
from matplotlib.axes import Axes
from matplotlib.dates import date2num
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from kf_calib.bench.arrays import Floats
from kf_calib.fleet.overview import FleetOverview, Track
from kf_calib.fleet.pooled_diagnosis import BenchCoefficients, Finding
from kf_calib.fleet.text import chance_words, short_name
from kf_calib.support.units import shown
from kf_calib.views.figures import Figures, figures
from kf_calib.views.figures.style import (
    ACCELEROMETERS,
    ALARM,
    BAND,
    BEST,
    GREY,
    MARKERS,
    PALE,
    accelerometer_of,
    dated,
    drawn_on,
    log_scale,
    mark_of,
    panels_of,
    say,
    say_once,
    wrapped,
)
from kf_calib.views.notation import symbol

_OUTSIDE = 0.01  # chance below which a unit is an outlier
_NAMED = 30  # units, above which they are numbered and not named
_TOLD = 7  # verdicts with a colour of their own
_LISTED = 20
_COLOURS = ("#0072b2", "#e69f00", "#cc79a7", "#009e73", "#56b4e9", "#d55e00", "#f0e442")
_KNOWN = {"consistent": PALE, "failed": ALARM, "not judged": "#e9e9e9", "inconsistent": GREY}


@drawn_on()
def units(figure: Figure, overview: FleetOverview) -> None:
    """A panel a parameter: each run and the mean of each unit, on the band of the population; outliers are named."""
    panels = panels_of(figure, len(overview.tracks), 1.0, 2.3)
    names = [short_name(name) for name in overview.units]
    for track, axes in zip(overview.tracks, panels, strict=True):
        _population(axes, overview.units, track)
        axes.set_xlim(-0.7, len(names) - 0.3)
        if len(names) <= _NAMED:
            axes.set_xticks(range(len(names)), names, rotation=90, fontsize=6.0)
        else:
            axes.set_xlabel("unit")
    say_once(figure, panels)


def _population(axes: Axes, names: Sequence[str], track: Track) -> None:
    """Draw one parameter over the units, from its nominal value."""
    unit = shown(track.unit)
    values, means = ((each - track.nominal) * unit.per_si for each in (track.values, track.units))
    middle, spread = (track.mean - track.nominal) * unit.per_si, track.spread * unit.per_si
    axes.axhspan(
        middle - 2.0 * spread, middle + 2.0 * spread, color=BAND, linewidth=0.0, label="median of the units ± 2 spreads"
    )
    axes.axhline(middle, color=GREY, linewidth=0.8)
    axes.plot(track.places, values, ".", color=PALE, markersize=4.0, label="run")
    marker, colour = mark_of(accelerometer_of(track.symbol) or 0)
    axes.plot(range(len(means)), means, marker, color=colour, markersize=4.0, label="mean of a unit")
    outside = np.flatnonzero(track.chances < _OUTSIDE)
    axes.plot(outside, means[outside], "o", markersize=9.0, markerfacecolor="none", markeredgecolor=ALARM,
              label="outlier (1 % of all parameters together)")  # fmt: skip
    for k in outside.tolist():
        axes.annotate(short_name(names[k]), (k, means[k]), xytext=(6, 0), textcoords="offset points", color=ALARM,
                      va="center", fontsize=7.0)  # fmt: skip
    axes.set_title(f"{symbol(track.symbol)} less nominal, {unit.label}".rstrip(", "))


@drawn_on()
def charts(figure: Figure, overview: FleetOverview) -> None:
    """A Shewhart chart of individual runs for each parameter: each run less the mean of its unit in the order of dates,
    with control limits at 3 sigma of a run, pooled over the units, and warning limits at 2."""
    if all(date is None for track in overview.tracks for date in track.dates):
        return _say_alone(figure, "No run has a date, so there is no control chart.")
    panels = panels_of(figure, len(overview.tracks), 1.0, 2.3)
    for track, axes in zip(overview.tracks, panels, strict=True):
        _chart(axes, track)
        dated(axes)
    say_once(figure, panels)


def _chart(axes: Axes, track: Track) -> None:
    """Draw one parameter, with the value of each control limit at its end."""
    unit = shown(track.unit)
    kept = np.array([date is not None for date in track.dates]) & np.isfinite(track.deviations)
    dates = date2num([date for date, here in zip(track.dates, kept, strict=True) if here and date is not None])
    order = np.argsort(dates, kind="stable")
    dates, values = dates[order], (track.deviations[kept] * unit.per_si)[order]
    sigma = track.scatter * unit.per_si
    axes.axhline(0.0, color=GREY, linewidth=1.0, label="centre line")
    for sigmas, style, colour, name in ((2.0, ":", GREY, "warning limit, 2σ"), (3.0, "-", ALARM, "control limit, 3σ")):
        for sign in (-1.0, 1.0):
            axes.axhline(sign * sigmas * sigma, color=colour, linewidth=0.9, linestyle=style, label=name)
    for sign, name in ((1.0, "UCL"), (-1.0, "LCL")):
        axes.annotate(f"{name} {unit.number(sign * 3.0 * track.scatter)}".replace("-", "−"), (1.0, sign * 3.0 * sigma),
                      xytext=(0, 2 if sign > 0 else -2), xycoords=("axes fraction", "data"), textcoords="offset points",
                      ha="right", va="bottom" if sign > 0 else "top", color=ALARM, fontsize=7.0)  # fmt: skip
    marker, colour = mark_of(accelerometer_of(track.symbol) or 0)
    axes.plot(dates, values, marker=marker, color=colour, markersize=3.0, linewidth=0.6,
              label="run less the mean of its unit")  # fmt: skip
    outside = np.abs(values) > 3.0 * sigma
    axes.plot(dates[outside], values[outside], "o", markersize=8.0, markerfacecolor="none", markeredgecolor=ALARM,
              label="out of control")  # fmt: skip
    largest = max(float(np.abs(values).max(initial=0.0)), 3.0 * sigma)
    axes.set_ylim(-1.35 * largest, 1.35 * largest)
    axes.set_title(f"{symbol(track.symbol)}, {unit.label}".rstrip(", "))


@drawn_on(13.0, 4.5)
def sigmas(figure: Figure, overview: FleetOverview) -> None:
    """The sigma that runs gave of each parameter: middle 50 and 90 % of the runs, and the target where there is one."""
    kinds = list(dict.fromkeys(track.unit for track in overview.tracks))
    if not kinds:
        return _say_alone(figure, "No run determined a parameter.")
    groups = [[track for track in overview.tracks if track.unit == kind] for kind in kinds]
    panels = figure.subplots(1, len(kinds), squeeze=False, width_ratios=[len(own) + 1 for own in groups])
    for own, axes in zip(groups, panels.flat, strict=True):
        _achieved(axes, own)
    say_once(figure, [*panels.flat])


def _achieved(axes: Axes, tracks: Sequence[Track]) -> None:
    unit = shown(tracks[0].unit)
    for k, track in enumerate(tracks):
        low, inner, middle, outer, high = np.quantile(track.sigmas * unit.per_si, [0.05, 0.25, 0.5, 0.75, 0.95])
        _, colour = mark_of(accelerometer_of(track.symbol) or 0)
        axes.plot([k, k], [low, high], color=colour, linewidth=1.2, label="middle 90 % of the runs")
        axes.plot([k, k], [inner, outer], color=colour, linewidth=5.0, solid_capstyle="butt", label="middle 50 %")
        axes.plot(k, middle, "o", color="white", markeredgecolor=colour, markersize=5.0, label="median")
        if track.target is not None:
            wanted = track.target * unit.per_si
            axes.plot([k - 0.4, k + 0.4], [wanted, wanted], color=ALARM, linewidth=1.4, label="target")
            reached = int(np.sum(track.sigmas <= track.target))
            axes.annotate(f"{reached} of {len(track.sigmas)}", (k, wanted), xytext=(0, 3), textcoords="offset points",
                          ha="center", color=ALARM, fontsize=7.0)  # fmt: skip
    log_scale(axes, [np.append(track.sigmas, track.target or track.sigmas[0]) * unit.per_si for track in tracks])
    axes.set_xticks(range(len(tracks)), [symbol(track.symbol) for track in tracks])
    axes.set_xlim(-0.7, len(tracks) - 0.3)
    axes.set_title(f"σ of a run, {unit.label}".rstrip(", "))


@drawn_on(13.0, 4.0)
def verdicts(figure: Figure, overview: FleetOverview) -> None:
    """How many runs came to what in each week."""
    weeks = overview.weeks
    if not weeks.begins:
        return _say_alone(figure, "No run has a date, so there are no weeks.")
    axes = figure.subplots()
    begins, bottom = date2num(weeks.begins), np.zeros(len(weeks.begins))
    colours = iter(_COLOURS)
    runs_by_label = dict[str, Floats]()
    for name, counts in weeks.counts.items():
        label = name if len(runs_by_label) < _TOLD or name in _KNOWN else "other"
        runs_by_label[label] = runs_by_label.get(label, np.zeros(len(begins))) + np.array(counts)
    for label, counts in runs_by_label.items():
        colour = _KNOWN.get(label) or next(colours, BEST)
        axes.bar(begins + 3.5, counts, width=6.0, bottom=bottom, color=colour, label=label)
        bottom = bottom + counts
    axes.set_ylabel("runs a week")
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    dated(axes)
    if weeks.undated:
        axes.set_title(f"without a date, not shown: {weeks.undated}", color=GREY)
    say_once(figure, [axes])


@drawn_on()
def bench_terms(figure: Figure, overview: FleetOverview) -> None:
    """Each error of a bench that was found: its coefficients in parts of the campaign, and those of all of it."""
    terms = [each for each in (overview.pooled.findings if overview.pooled else ()) if each.over_time]
    if not terms:
        if overview.pooled is None:
            return _say_alone(figure, "The runs were not diagnosed together.")
        return _say_alone(figure, "The runs show no error of a bench.")
    pairs = [(term, bench) for term in terms for bench in dict.fromkeys(each.bench for each in term.over_time)]
    wide = min(len(pairs), 2)
    high = -(-len(pairs) // wide)
    figure.set_size_inches(13.0, 0.8 + 3.2 * high)
    panels = figure.subplots(high, wide, squeeze=False)
    for (term, bench), axes in zip(pairs, panels.flat, strict=False):
        _followed(axes, term, bench)
    for axes in [*panels.flat][len(pairs) :]:
        axes.set_axis_off()


def _followed(axes: Axes, term: Finding, bench: str) -> None:
    """Draw the coefficients of one effect on one bench."""
    parts = [coefficient for coefficient in term.over_time if coefficient.bench == bench]
    whole = [coefficient for coefficient in term.benches if coefficient.bench == bench]
    unit = shown(parts[0].coefficients[0].unit)
    axes.axhline(0.0, color=GREY, linewidth=0.7)
    for k, coefficient in enumerate(parts[0].coefficients):
        colour, marker = ACCELEROMETERS[k % 3], MARKERS[k % 3]
        dates, values, reach = _curve(parts, k, unit.per_si)
        shift = (k - 0.5 * (len(parts[0].coefficients) - 1)) * 0.06
        places = _places(dates, shift)
        axes.errorbar(places, values, reach, fmt=marker, color=colour, elinewidth=0.9, label=symbol(coefficient.symbol))
        first, constants, _ = _curve(whole, k, unit.per_si)
        first = [dates[0], *first[1:]]  # the first values hold from the first run on
        axes.step([*first, places[-1]], [*constants, constants[-1]], where="post", color=colour, linewidth=1.1)
    axes.set_title(f"{term.effect}, {bench or 'the bench'}, {unit.label} (2σ)")
    if all(coefficient.since for coefficient in parts):
        dated(axes)
    axes.legend(loc="best", fontsize=7.5)


def _curve(parts: Sequence[BenchCoefficients], k: int, per_si: float) -> tuple[list[float], Floats, Floats]:
    """Return date, value and 2 sigma of one coefficient; where dates are not known, the numbers of the parts."""
    dated = all(each.since for each in parts[1:])
    begins = [float(date2num(datetime.fromisoformat(each.since))) if dated and each.since else float(n)
              for n, each in enumerate(parts)]  # fmt: skip
    own = [each.coefficients[k] for each in parts]
    values = np.array([np.nan if each.value is None else each.value for each in own]) * per_si
    return begins, values, 2.0 * np.array([np.nan if each.sigma is None else each.sigma for each in own]) * per_si


def _places(dates: Sequence[float], shift: float) -> list[float]:
    """Return the middle of each part of a campaign, moved by a share of it so that marks do not hide each other."""
    width = (dates[-1] - dates[0]) / max(len(dates) - 1, 1) or 1.0
    ends = [*dates[1:], dates[-1] + width]
    return [0.5 * (begin + end) + shift * width for begin, end in zip(dates, ends, strict=True)]


@drawn_on()
def another_look(figure: Figure, overview: FleetOverview) -> None:
    """Units that need another look, those of which noise explains least first."""
    shown_here = overview.looks[:_LISTED]
    if not shown_here:
        return _say_alone(figure, "No unit needs another look.")
    figure.set_size_inches(13.0, 0.8 + 0.36 * len(shown_here))
    axes = figure.subplots()
    axes.set_axis_off()
    axes.set_ylim(len(shown_here) - 0.4, -1.0)
    axes.set_xlim(0.0, 1.0)
    for x, words in ((0.0, ""), (0.03, "unit"), (0.2, "chance by noise"), (0.32, "why")):
        axes.text(x, -0.7, words, color=GREY, va="center")
    for k, look in enumerate(shown_here):
        axes.text(0.0, k, f"{k + 1}", color=GREY, va="center")
        axes.text(0.03, k, short_name(look.unit), va="center", fontweight="bold")
        axes.text(0.2, k, chance_words(look.chance), va="center")
        axes.text(0.32, k, wrapped(look.why, 120), va="center", fontsize=8.0)
    if len(overview.looks) > len(shown_here):
        axes.text(0.03, len(shown_here) - 0.5, f"{len(overview.looks) - len(shown_here)} more", color=GREY)


def _say_alone(figure: Figure, text: str) -> None:
    figure.set_size_inches(9.0, 2.0)
    say(figure, text)


@figures.register
def fleet_figures(overview: FleetOverview) -> Figures:
    """The figures of a fleet by title."""
    return {
        "Parameters over the units": lambda: units(overview),
        "Units that need another look first": lambda: another_look(overview),
        "Errors of the bench over time": lambda: bench_terms(overview),
        "Verdicts by week": lambda: verdicts(overview),
        "Control charts": lambda: charts(overview),
        "Sigma achieved": lambda: sigmas(overview),
    }
