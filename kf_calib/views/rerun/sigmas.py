"""Sigma of all that is estimated against the number of the orientation, with the share of information of each.

Entities: ``sigmas/KIND/...`` for the overview, a chart a kind of parameter; ``each/PARAMETER/...``, a chart each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.estimation.information_share import information_shares
from kf_calib.estimation.results import Calibration
from kf_calib.support import units
from kf_calib.views.rerun.chart import LABEL_HEIGHT, LEFT, RIGHT, TOP, Axis, Chart, Ink, sheet, thin
from kf_calib.views.rerun.names import GREY, GROUPS, WHITE, Colour, Quantity, per_si
from kf_calib.views.rerun.series import Counts, History

BARS: Colour = (92, 96, 110)
ROOM = 32.0
"""Between a chart and the title of the next."""
_TALLEST = 0.45  # of the chart's height: the bar of the largest share


@dataclass(frozen=True)
class Falling:
    """Sigmas (n, 12 + q) in shown units after each orientation (n,), and the shares (n, 12) of information.

    wanted (12 + q,): targets, NaN where there are none. Orientation 0 is a stated prior. path: entity of the overview.
    across: what is counted. beside: other sigmas that are to be in the range of the axes. size: width of
    the overview's charts, and height of all.
    """

    shown: tuple[Quantity, ...]
    orientation: Counts
    sigma: Floats
    shares: Floats
    wanted: Floats
    path: str = "sigmas"
    across: str = "orientation"
    beside: Floats | None = None
    size: tuple[float, float] = (520.0, 640.0)

    @classmethod
    def of(cls, result: Calibration, history: History, wanted: Floats | None = None) -> Falling:
        """Of a run; ``wanted`` (12,): targets in SI."""
        ends, shares = history.by_orientation, np.vstack([np.zeros((1, 12)), information_shares(result)])
        first = 0 if np.isfinite(ends.sigma[0]).any() else 1
        aims = np.full(len(ends.shown), np.nan)
        aims[:12] = np.nan if wanted is None else wanted * per_si()
        return cls(ends.shown, ends.orientation[first:], ends.sigma[first:], shares[first:], aims)

    @cached_property
    def kinds(self) -> list[tuple[str, str, list[int]]]:
        """Name, unit and columns of each chart of the overview; coefficients are in final sigmas."""
        places = {symbol: k for k, symbol in enumerate(paper_parameters.SYMBOLS)}
        own = [(each.title, units.shown(each.unit).label, [places[symbol] for symbol in each.symbols])
               for each in GROUPS]  # fmt: skip
        rest = list(range(12, len(self.shown)))
        return [*own, *([("coefficients of effects", "final σ", rest)] if rest else [])]

    def values(self, columns: Sequence[int], alone: bool = False) -> Floats:
        """Sigmas (n, k) of one chart, in its unit; ``alone``: in the unit of the one that it shows."""
        own = self.sigma[:, columns]
        return own / own[-1] if columns[0] >= 12 and not alone else own

    def share(self, columns: Sequence[int]) -> Floats | None:
        """Mean share (n,) of information about the parameters of one chart that are determined; None: of none."""
        own = self.shares[:, [k for k in columns if k < 12]]
        own = own[:, np.isfinite(own).all(axis=0)]
        return own.mean(axis=1) if own.size else None

    def _across(self, title: str) -> Axis:
        return Axis.counted(int(self.orientation[0]), int(self.orientation[-1]), title)

    def _chart(self, path: str, columns: Sequence[int], title: str, place: Chart, below: str,
               alone: bool = False) -> Chart:  # fmt: skip
        others = self.sigma[:0] if self.beside is None else self.beside
        values = np.concatenate([self.values(columns, alone).ravel(), self.wanted[list(columns)],
                                 others[:, list(columns)].ravel()])  # fmt: skip
        return Chart(path, self._across(below), Axis.around(values, log=True), title, place.corner, place.width,
                     place.height, place.colour)  # fmt: skip

    def overview(self) -> list[Chart]:
        """A chart a kind, one below the other."""
        out, (wide, high) = list[Chart](), self.size
        tall = high / len(self.kinds) - TOP - ROOM
        for k, (name, unit, columns) in enumerate(self.kinds):
            corner, last = (0.0, k * (tall + TOP + ROOM)), k == len(self.kinds) - 1
            place = Chart("", self._across(""), self._across(""), "", corner, wide, tall)
            path = f"{self.path}/{name.replace(' ', '_')}"
            out.append(self._chart(path, columns, self._title(name, unit, columns), place, self.across if last else ""))
        return out

    def _title(self, name: str, unit: str, columns: Sequence[int]) -> str:
        """Return which is worst in the end, and which is best."""
        final, known = self.values(columns)[-1], np.isfinite(self.sigma[-1, columns])
        if not known.any():
            return f"σ of {name}: not determined"
        if columns[0] >= 12:
            return f"σ of {name} over their final σ"
        worst, best = int(np.nanargmax(final)), int(np.nanargmin(final))
        ends = [f"{final[k]:.3g}" for k in (worst, best)]
        told = f"all {ends[0]}" if ends[0] == ends[1] else f"worst {self.shown[columns[worst]].label} {ends[0]}"
        if self.size[0] < 300.0:
            return f"{name}, {unit}: {told}"
        least = "" if ends[0] == ends[1] else f", best {self.shown[columns[best]].label} {ends[1]}"
        return f"σ of {name}, {unit}: {told}{least}"

    def single(self) -> list[Chart]:
        """A chart for each parameter and coefficient, four a row."""
        rows = -(-len(self.shown) // 4)
        wide, tall = 300.0, max(90.0, 860.0 / rows - TOP - ROOM)
        out = list[Chart]()
        for k, shown in enumerate(self.shown):
            row, column = divmod(k, 4)
            corner = (column * (wide + LEFT + RIGHT), row * (tall + TOP + ROOM))
            place = Chart("", self._across(""), self._across(""), "", corner, wide, tall, shown.colour)
            final = f"{self.sigma[-1, k]:.3g} {shown.unit}" if np.isfinite(self.sigma[-1, k]) else "not determined"
            below = self.across if row == rows - 1 else ""
            out.append(self._chart(f"each/{shown.path}", [k], f"σ of {shown.label}: {final}", place, below, alone=True))
        return out

    def log(self, stream: rr.RecordingStream) -> None:
        """Send all charts."""
        self.log_overview(stream)
        self._log(self.single(), [[k] for k in range(len(self.shown))], "each", stream, alone=True)

    def log_overview(self, stream: rr.RecordingStream) -> None:
        """Send the charts of the overview."""
        self._log(self.overview(), [columns for _, _, columns in self.kinds], self.path, stream)

    def _log(
        self, charts: Sequence[Chart], columns: Sequence[Sequence[int]], path: str, stream: rr.RecordingStream,
        alone: bool = False,
    ) -> None:  # fmt: skip
        """Send charts, each of these columns: frames and bars as one entity, curves as another."""
        behind, curves = Ink(), Ink()
        for chart, own in zip(charts, columns, strict=True):
            behind.frame(chart)
            self._bars(chart, own, behind)
            self._curves(chart, own, curves, alone)
        behind.send(stream, f"{path}/frame", -10.0)
        curves.send(stream, f"{path}/curves")

    def _curves(self, chart: Chart, columns: Sequence[int], ink: Ink, alone: bool) -> None:
        """Draw a curve for each column, that which is worst in the end with points, and the targets."""
        x, own = self.orientation.astype(float), self.values(columns, alone)
        worst = int(np.nanargmax(own[-1])) if np.isfinite(own[-1]).any() else 0
        for k, column in enumerate(columns):
            ink.lines(chart.strip(x, own[:, k]), self.shown[column].colour, thin(1.6 if k == worst else 0.7))
        known = np.isfinite(own[:, worst])
        colour, radius = self.shown[columns[worst]].colour, thin(3.0 if len(x) < 60 else 1.5)
        ink.points(chart.at(x[known], own[known, worst]), colour, radius)
        wanted = self.wanted[list(columns)]
        for aim in np.unique(wanted[np.isfinite(wanted)]):
            ink.lines([chart.level(float(aim))], WHITE, thin(0.8))
            ink.write(
                (chart.corner[0] + 40.0, float(chart.level(float(aim))[0, 1]) - LABEL_HEIGHT - 4.0), "target", WHITE
            )

    def _bars(self, chart: Chart, columns: Sequence[int], ink: Ink) -> None:
        """Draw the share of information of each orientation as a bar from the bottom, and write the largest."""
        share = self.share(columns)
        if share is None or not share.max() > 0.0:
            return
        scale = Axis(0.0, float(share.max()) / _TALLEST)
        bars = Chart(chart.path, chart.x, scale, corner=chart.corner, width=chart.width, height=chart.height)
        x, radius = self.orientation.astype(float), min(6.0, 0.36 * chart.width / len(share))
        ink.lines(bars.bars(x, np.where(share > 0.0, share, np.nan), 0.0), BARS, radius)
        place = chart.corner[0] + chart.width - 62.0, chart.corner[1] + 2.0
        ink.write(place, f"highest bar {100 * share.max():.0f} %", GREY)


def overview_sheet(falling: Falling, name: str) -> rrb.Spatial2DView:
    """The charts of the overview in one view."""
    return sheet(falling.path, name, falling.overview())


def single_sheet(falling: Falling, name: str) -> rrb.Spatial2DView:
    """The charts of all parameters in one view."""
    return sheet("each", name, falling.single())
